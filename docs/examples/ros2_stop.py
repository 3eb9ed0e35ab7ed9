"""Stop a ros2_control arm at an alarm: a node to copy into your workspace and adapt.

    asm-gym watch dds:/joint_states --monitor arm.asm --json | python ros2_stop.py joint_trajectory_controller

It deactivates the controllers at the first alarm, and when the watch ends, so that the arm stays by its own brakes or
drives until somebody activates them again. A program can fail or be late: it does not replace the emergency stop.
"""

import sys

import rclpy
from controller_manager_msgs.srv import SwitchController

rclpy.init()
node = rclpy.create_node("asm_gym_stop")
switch = node.create_client(SwitchController, "/controller_manager/switch_controller")
switch.wait_for_service()
for line in sys.stdin:
    print(line, end="", flush=True)
    if '"kind": "note"' not in line:
        break
request = SwitchController.Request(strictness=SwitchController.Request.BEST_EFFORT)
request.deactivate_controllers = sys.argv[1:]
rclpy.spin_until_future_complete(node, switch.call_async(request))
