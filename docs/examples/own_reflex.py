"""Act on an alarm in your own way: a reflex is a policy, here one that undoes the last action and then holds."""

import gymnasium as gym
import numpy as np

from asm_gym import FaultInjection, NeuralASMSafety
from asm_gym.faults import Push
from asm_gym.policies.reflexes import Hold


class BackOff(Hold):
    """Undo the last executed action once, then hold; ``Hold`` keeps the grip."""

    def begin(self, executed):
        self._undone = -np.asarray(executed, np.float32)
        return super().begin(executed)

    def move(self):
        undone, self._undone = self._undone, None
        return super().move() if undone is None else undone


pushed = FaultInjection(gym.make("asm_gym/Lift-v0"), [Push(newtons=60, onset=20, duration=10)])
env = NeuralASMSafety(pushed, on_alarm=BackOff)  # the class: the wrapper makes it for its own environment
env.reset(seed=0)
for step in range(60):
    info = env.step(np.array([0.2, 0, 0, 0, 0, 0, -1], np.float32))[-1]
    if info["overridden"]:
        print(step, info["asm"]["transition"], info["asm"]["executed_action"].round(2))
