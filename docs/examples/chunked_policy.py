"""Guard a policy that predicts a chunk of actions at once, as ACT and diffusion policies do."""

import gymnasium as gym
import numpy as np

from asm_gym import FaultInjection, NeuralASMSafety, make_policy
from asm_gym.faults import Push

CHUNK = 8


class Chunked:
    """Ask for a chunk, and play it action by action; the state is what is left of it.

    After a step that was not the policy's, the rest of the chunk is of no use any more: a new one is asked for.
    """

    def __init__(self, model):
        self.model = model  # (observation) -> (CHUNK, A)

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        chunk = self.model(observation) if state is None or not len(state) else state
        return chunk[0], chunk[1:]


env = NeuralASMSafety(FaultInjection(gym.make("asm_gym/Lift-v0"), [Push(newtons=60, onset=20, duration=10)]))
agent = make_policy("lift_sac", env)  # stands for a network with an action head of CHUNK actions
policy = Chunked(lambda observation: np.repeat(agent.predict(observation)[0][None], CHUNK, axis=0))
observation, info = env.reset(seed=0)
state, done, thrown_away = None, False, 0
while not done:
    action, state = policy.predict(observation, state)
    observation, reward, terminated, truncated, info = env.step(action)
    if info["overridden"]:
        thrown_away, state = thrown_away + len(state), None
    done = terminated or truncated
print(f"{thrown_away} planned actions were thrown away, success {info['success']}")
