"""Stop a ros2_control arm at an alarm: a node to copy into your workspace and adapt.

    asm-gym watch dds:/joint_states --monitor arm.asm --publish /asm_gym/alarm
    python ros2_stop.py --ros-args -p controllers:="[joint_trajectory_controller]"

It deactivates the controllers, so that a ros2_control arm stays by its own brakes or drives, until somebody activates
them again. A program can fail or be late: it does not replace the emergency stop.
"""

import json

import rclpy
from controller_manager_msgs.srv import SwitchController
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String


class StopOnAlarm(Node):
    """Deactivates controllers at every alarm that is published."""

    def __init__(self) -> None:
        super().__init__("asm_gym_stop")
        self.controllers = self.declare_parameter("controllers", ["joint_trajectory_controller"]).value
        topic = self.declare_parameter("topic", "/asm_gym/alarm").value
        self.switch = self.create_client(SwitchController, "/controller_manager/switch_controller")
        # As asm-gym publishes: the last alarm reaches a node that starts later.
        kept = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(String, topic, self.stop, kept)

    def stop(self, message: String) -> None:
        """Deactivate the controllers; an alarm that cannot be read stops the arm too."""
        try:
            alarm = json.loads(message.data)
        except ValueError:
            alarm = {"text": message.data}
        self.get_logger().error(f"asm-gym: {alarm.get('text', '')}")
        request = SwitchController.Request()
        request.deactivate_controllers = list(self.controllers)
        request.strictness = SwitchController.Request.BEST_EFFORT
        self.switch.call_async(request)


def main() -> None:
    rclpy.init()
    rclpy.spin(StopOnAlarm())


if __name__ == "__main__":
    main()
