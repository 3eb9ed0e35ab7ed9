"""Guard a policy in LeRobot's loop, here with a mock arm; LeRobot itself need not be installed to try it."""

import numpy as np

from asm_gym import Episode, make_monitor
from asm_gym.wrappers.lerobot import LeRobotGuard

RATE, JOINTS = 30.0, ["shoulder.pos", "elbow.pos", "wrist.pos"]  # positions and targets in degrees


def run(seed, guard=None, jammed=10**6):
    """Run the loop for 260 rows, or until an alarm; return positions that were read, and targets that were sent."""
    rng = np.random.default_rng(seed)
    position, phase, rows = np.zeros(3), rng.uniform(0, 6, 3), []
    for step in range(260):
        read = position + 0.05 * rng.normal(size=3)
        target = 30 * np.sin(np.array([0.4, 0.8, 1.2]) * step / RATE + phase) * min(1.0, step / 30)
        if (
            guard is not None
        ):  # in LeRobot: RobotProcessorPipeline([guard], …) as robot_action_processor
            transition = {
                "observation": dict(zip(JOINTS, read)),
                "action": dict(zip(JOINTS, target)),
            }
            target = np.array(list(guard(transition)["action"].values()) or position)
            if guard.alarm:
                return step, guard.last_alarm
        rows.append([*read, *target])
        position = np.where(
            [True, step < jammed, True], position + (target - position) / 3, position
        )
    return np.array(rows)  # (T, 6)


names = [f"{what}[{joint}]" for what in ("observation.state", "action") for joint in JOINTS]
healthy = [
    Episode.from_table(dict(zip(names, run(n).T)), rate=RATE, action=["action*"]) for n in range(60)
]
monitor = make_monitor("kalman+evidence", healthy[0].spec).fit(healthy[:20])
guard = LeRobotGuard(monitor.calibrate(healthy[20:], false_alarm_rate=0.025), on_alarm="hold")
print(run(1000, guard, jammed=100))
