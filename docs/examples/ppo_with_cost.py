"""Train PPO under the guard: each step in alarm costs, and alarms go to Stable-Baselines3's logger."""

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from asm_gym import NeuralASMSafety, collect, make_monitor
from asm_gym.rollouts.safety_callback import SafetyCallback

ARM, PRICE = "asm_gym/SyntheticArm-v0", 0.1  # reward that a step in alarm costs


class CostInReward(gym.Wrapper):
    """Subtract the cost, for learners that know no constraint."""

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward - PRICE * info["cost"], terminated, truncated, info


def guarded():
    return CostInReward(NeuralASMSafety(gym.make(ARM, horizon=50), monitor, on_alarm="hold"))


agent = PPO("MlpPolicy", gym.make(ARM, horizon=50), n_steps=100, batch_size=50, seed=0)
# how it explores while nothing is wrong
episodes = collect(ARM, policy=agent, episodes=40, workers=1, horizon=50)
monitor = (
    make_monitor("kalman", episodes[0].spec)
    .fit(episodes[:20])
    .calibrate(episodes[20:], false_alarm_rate=0.05)
)

agent.set_env(make_vec_env(guarded, 1))
# safety/alarms, safety/cost, safety/overridden, safety/surprise, safety/slowed
safety = SafetyCallback()
agent.learn(400, callback=safety)
print(f"steps in alarm by episode: {[episode['cost'] for episode in safety.ended]}")
