"""Make an environment of robosuite of your own a task of this package, with its sensors as channels."""

import gymnasium as gym
from robosuite.environments.manipulation.lift import Lift

from asm_gym import NeuralASMSafety, collect, make_monitor, register_task


class HeavyLift(Lift):
    """Yours: its arena, its objects, its reward and its ``_check_success``."""

    def reward(self, action=None):
        return float(self._check_success())


register_task("HeavyLift", HeavyLift, horizon=20, robots="Sawyer", control_freq=20)
episodes = collect("asm_gym/HeavyLift-v0", "sway", episodes=24, workers=1)  # "sway" stands for your policy
monitor = make_monitor("kalman+evidence", episodes[0].spec).fit(episodes[:12])
monitor.calibrate(episodes[12:], false_alarm_rate=0.1)
env = NeuralASMSafety(gym.make("asm_gym/HeavyLift-v0"), monitor, on_alarm="terminate")
env.reset(seed=0)
info = env.step(env.action_space.sample())[-1]
print(monitor.spec.labels[:3], info["asm"]["surprise"], info["asm"]["threshold"])
