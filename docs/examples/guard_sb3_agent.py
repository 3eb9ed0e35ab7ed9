"""Guard an agent of Stable-Baselines3: record healthy episodes of it, fit a monitor, and wrap the environment."""

import gymnasium as gym
from stable_baselines3 import PPO

from asm_gym import NeuralASMSafety, collect, make_monitor

ARM = "asm_gym/SyntheticArm-v0"  # any Gymnasium id with Box actions

agent = PPO("MlpPolicy", gym.make(ARM), n_steps=256, seed=0).learn(256)  # yours: PPO.load("agent.zip")
episodes = collect(ARM, policy=agent, episodes=40, workers=1, horizon=100)

monitor = make_monitor("kalman+evidence", episodes[0].spec).fit(episodes[:20])  # or "neural_asm", which takes longer
monitor.calibrate(episodes[20:], false_alarm_rate=0.05)  # one healthy episode in twenty may alarm

env = NeuralASMSafety(gym.make(ARM, horizon=100), monitor, on_alarm="hold")
observation, info = env.reset(seed=0)
done = False
while not done:
    action, _ = agent.predict(observation)
    observation, reward, terminated, truncated, info = env.step(action)
    done = terminated or truncated
print(f"{info['asm']['alarms']} steps in alarm; the largest shares: {info['asm']['attribution']}")
