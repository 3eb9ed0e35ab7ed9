"""Guard a robot of another package: MuJoCo's, Fetch (gymnasium_robotics) or dm_control (through Shimmy)."""

import sys

import gymnasium as gym

from asm_gym import FaultInjection, NeuralASMSafety, collect, make_monitor, make_policy
from asm_gym.faults import Freeze

# Or gymnasium_robotics:FetchReach-v4, or shimmy:dm_control/reacher-easy-v0: pip install 'asm-gym[environments]'
TASK = [*sys.argv, "HalfCheetah-v5"][1]

episodes = collect(TASK, policy="sway", episodes=40, workers=1, max_episode_steps=100)  # "sway" stands for your policy
monitor = make_monitor("association_linear+evidence", episodes[0].spec).fit(episodes[:20])
monitor.calibrate(episodes[20:], false_alarm_rate=0.05)

channel = episodes[0].spec.channels[0].name  # of observations in a dict: a key
env = FaultInjection(gym.make(TASK), [Freeze(channel=channel, element=0, onset=20)])
env = NeuralASMSafety(env, monitor, on_alarm="monitor")  # torques have no hold: "terminate", or a policy of yours
policy, (observation, info) = make_policy("sway", env, seed=1), env.reset(seed=1)
for step in range(40):
    observation, reward, terminated, truncated, info = env.step(policy.predict(observation)[0])
    if info["asm"]["alarm"]:
        print(step, info["fault"], max(info["asm"]["attribution"], key=info["asm"]["attribution"].get))
