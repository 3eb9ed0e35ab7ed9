"""Learn to lift from scratch, alone and under the guard: reward and harm of both, printed and drawn."""

import sys

import gymnasium as gym
import pandas as pd
from matplotlib.figure import Figure
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from asm_gym import VectorNeuralASMSafety
from asm_gym.rollouts.learner_vector import LearnerVector
from asm_gym.rollouts.learning_record import LearningRecord

STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 40_960
DISABLED = gym.vector.AutoresetMode.DISABLED


def learn(guarded):
    """Return a row for each episode of an agent that learns."""
    envs = gym.make_vec("asm_gym/Lift-v0", num_envs=4, autoreset_mode=DISABLED)
    if guarded:
        envs = VectorNeuralASMSafety(envs)  # all that the guard takes
    record = LearningRecord(envs)
    learned_from = VecNormalize(LearnerVector(record), norm_reward=False)
    agent = PPO("MlpPolicy", learned_from, n_steps=256, batch_size=256, gamma=0.98, seed=0)
    for fifth in range(5):
        agent.learn(STEPS // 5, reset_num_timesteps=False)
        print(f"{(fifth + 1) * 20} %", end=" ", file=sys.stderr, flush=True)
    envs.close()
    return pd.DataFrame(record.episodes)


figure = Figure(figsize=(8, 3), layout="constrained")
left, right = figure.subplots(1, 2)
for label, guarded in (("alone", False), ("under the guard", True)):
    episodes = learn(guarded)
    reward = episodes.reward.rolling(20, min_periods=1).mean().groupby(episodes.step).last()
    harm = episodes.harm.cumsum().groupby(episodes.step).last()
    reward.plot(ax=left, label=label, legend=True, title="reward, mean of 20 episodes")
    harm.plot(ax=right, label=label, legend=True, logy="sym", title="harm so far [N s]")
    hardest = f"hardest contact {episodes.peak.max():.0f} N"
    print(f"{label}: reward {reward.iloc[-1]:.1f}, harm {harm.iloc[-1]:.0f} N s, {hardest}")
figure.savefig("learn_safely.png", dpi=120)
print("wrote learn_safely.png")
