"""Learn to lift from scratch, alone and under the guard: reward and harm of both, printed and drawn."""

import sys

import gymnasium as gym
from matplotlib.figure import Figure
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from asm_gym import VectorNeuralASMSafety
from asm_gym.rollouts.learner_vector import LearnerVector
from asm_gym.rollouts.learning_record import LearningRecord

TASK = "asm_gym/Lift-v0"
STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 40_960


def learn(guarded):
    """Return a record of each episode of an agent that learns."""
    envs = gym.make_vec(TASK, num_envs=4, autoreset_mode=gym.vector.AutoresetMode.DISABLED)
    if guarded:
        envs = VectorNeuralASMSafety(envs)  # all that the guard takes
    record = LearningRecord(envs)
    learned_from = VecNormalize(LearnerVector(record), norm_reward=False)
    agent = PPO("MlpPolicy", learned_from, n_steps=256, batch_size=256, gamma=0.98, seed=0)
    agent.learn(STEPS)
    envs.close()
    return record.episodes


figure = Figure(figsize=(8, 3), layout="constrained")
left, right = figure.subplots(1, 2)
for label, guarded in (("alone", False), ("under the guard", True)):
    episodes = learn(guarded)
    steps = [each["step"] for each in episodes]
    rewards = [each["reward"] for each in episodes]
    harm_so_far = [sum(each["harm"] for each in episodes[:n]) for n in range(1, 1 + len(episodes))]
    last = rewards[-len(rewards) // 5 :]
    hardest = max(each["peak"] for each in episodes)
    print(f"{label}: harm {harm_so_far[-1]:.0f} N s, hardest contact {hardest:.0f} N, ", end="")
    print(f"reward of the last fifth {sum(last) / len(last):.1f}")
    left.plot(steps, rewards, ".", label=label, alpha=0.5)
    right.semilogy(steps, harm_so_far, label=label)
left.set(title="reward of an episode", xlabel="control steps")
right.set(title="harm so far [N s]", xlabel="control steps")
left.legend()
figure.savefig("learn_safely.png", dpi=120)
