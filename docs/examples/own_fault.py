"""Write a fault of your own, and see whether the shipped memory notices it."""

import gymnasium as gym
import numpy as np

from asm_gym import FaultInjection, NeuralASMSafety, register_fault
from asm_gym.faults.base import EditingFault, within


class Wind(EditingFault):
    """A force along the world's x axis on every body [N]; it is undone when the fault ends."""

    groups = ("torque", "wrench")  # groups of channels in which it shows
    newtons: float = within(5.0, low=0.0, high=1e3)

    def edits(self, env):
        forces = env.simulation.data.xfrc_applied  # (bodies, 6)
        places = [(body, slice(0, 3)) for body in range(1, len(forces))]
        return [(forces, places, lambda others: others + np.array([self.newtons, 0, 0]))]


register_fault("wind", lambda drawn, severity: Wind(newtons=(2.0, 5.0, 10.0)[severity]))  # for `evaluate --faults wind`
env = NeuralASMSafety(FaultInjection(gym.make("asm_gym/Lift-v0"), [Wind(newtons=10.0, onset=20)]), on_alarm="monitor")
env.reset(seed=0)
for step in range(40):
    info = env.step(np.zeros(7, np.float32))[-1]
    if info["asm"]["alarm"]:
        print(step, info["fault"], max(info["asm"]["attribution"], key=info["asm"]["attribution"].get))
