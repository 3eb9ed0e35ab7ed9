"""Guard a policy that predicts a chunk of actions at once, as ACT and diffusion policies do."""

import gymnasium as gym
import numpy as np

from asm_gym import FaultInjection, NeuralASMSafety, make_policy
from asm_gym.faults import Push

CHUNK = 8


class Chunked:
    """Ask ``model`` for a chunk (CHUNK, A) and play it; the state is what is left of it."""

    def __init__(self, model):
        self.model = model

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        chunk = self.model(observation) if state is None or not len(state) else state
        return chunk[0], chunk[1:]


env = NeuralASMSafety(
    FaultInjection(gym.make("asm_gym/Lift-v0"), [Push(newtons=60, onset=20, duration=10)])
)
agent = make_policy("lift_sac", env)  # stands for a network that predicts CHUNK actions
policy = Chunked(lambda observation: np.repeat(agent.predict(observation)[0][None], CHUNK, axis=0))
observation, info = env.reset(seed=0)
state, done = None, False
while not done:
    action, state = policy.predict(observation, state)
    observation, reward, terminated, truncated, info = env.step(action)
    if info["overridden"]:
        state = None  # the arm is elsewhere than the chunk expects: ask for a new one
    done = terminated or truncated
print(f"{info['asm']['alarms']} steps in alarm, success {info['success']}")
