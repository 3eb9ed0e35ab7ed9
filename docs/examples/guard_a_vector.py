"""Guard several robots at once, and normalise outside of the guard: SB3's vectors, and Gymnasium's."""

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from asm_gym import NeuralASM, NeuralASMSafety, VectorNeuralASMSafety

LIFT = "asm_gym/Lift-v0"
memory = NeuralASM.pretrained("panda")  # one memory judges all members

robots = VecNormalize(make_vec_env(lambda: NeuralASMSafety(gym.make(LIFT), memory), 2))
robots.reset()
for _ in range(10):
    observations, rewards, dones, infos = robots.step(np.zeros((2, 7), np.float32))
print([info["asm_surprise"] for info in infos], [info["cost"] for info in infos])
robots.close()

envs = VectorNeuralASMSafety(gym.make_vec(LIFT, num_envs=2), memory)  # one batched call for all members
observations, infos = envs.reset(seed=0)
for _ in range(10):
    observations, rewards, terminations, truncations, infos = envs.step(np.zeros((2, 7), np.float32))
print(infos["asm_surprise"], infos["cost"])
envs.close()
