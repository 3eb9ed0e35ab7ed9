"""Guard a policy in LeRobot's loop, here with a mock arm; LeRobot itself need not be installed to try it."""

import numpy as np

from asm_gym import Episode, make_monitor
from asm_gym.wrappers.lerobot import LeRobotGuard

RATE, JOINTS = 30.0, ["shoulder.pos", "elbow.pos", "wrist.pos"]


def policy(step, phase):
    return 30 * np.sin([0.4, 0.8, 1.2] * np.full(3, step / RATE) + phase) * min(1.0, step / 30)  # targets [degrees]


def run(seed, guard=None, rows=260, jammed=10**6):
    """Run the loop, and return the rows: positions that were read, and targets that were sent (T, 6)."""
    rng = np.random.default_rng(seed)
    position, phase, rows_of = np.zeros(3), rng.uniform(0, 6, 3), []
    for step in range(rows):
        read, target = position + 0.05 * rng.normal(size=3), policy(step, phase)
        if guard is not None:  # in LeRobot: RobotProcessorPipeline([guard], …) as robot_action_processor
            transition = {"observation": dict(zip(JOINTS, read)), "action": dict(zip(JOINTS, target))}
            target = np.array(list(guard(transition)["action"].values()) or position)
        rows_of.append([*read, *target])
        moving = [True, step < jammed, True]  # the elbow jams
        position = np.where(moving, position + (target - position) / 3, position)
        if guard is not None and guard.alarm:
            return step, guard.last_alarm
    return np.array(rows_of)


names = [f"{what}[{joint}]" for what in ("observation.state", "action") for joint in JOINTS]
healthy = [Episode.from_table(dict(zip(names, run(n).T)), rate=RATE, action=["action*"]) for n in range(60)]
monitor = make_monitor("kalman+evidence", healthy[0].spec).fit(healthy[:20])
guard = LeRobotGuard(monitor.calibrate(healthy[20:], false_alarm_rate=0.025), on_alarm="hold")
print(run(1000, guard, jammed=100))
