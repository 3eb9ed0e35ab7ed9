"""Guard a policy of your own: any object with Stable-Baselines3's ``predict`` will do."""

import gymnasium as gym
import numpy as np

from asm_gym import FaultInjection, NeuralASMSafety
from asm_gym.faults import Push


class Circle:
    """Move the hand along a circle; the state is the step within the episode."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        step = state or 0
        x, y = 0.1 * np.cos(0.1 * step), 0.1 * np.sin(0.1 * step)
        return np.array([x, y, 0, 0, 0, 0, -1], np.float32), step + 1


pushed = FaultInjection(gym.make("asm_gym/Lift-v0"), [Push(newtons=60, onset=20, duration=10)])
env = NeuralASMSafety(pushed)  # the shipped memory of the Panda knows the body, whatever the policy does
policy, state, (observation, info) = Circle(), None, env.reset(seed=0)
for step in range(60):
    action, following = policy.predict(observation, state)
    observation, reward, terminated, truncated, info = env.step(action)
    state = state if info["overridden"] else following  # the policy resumes where it was left
    if info["asm"]["alarm"]:
        print(step, info["fault"], info["asm"]["reason"], info["asm"]["response"], info["asm"]["state"])
