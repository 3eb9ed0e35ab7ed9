"""The safety wrapper under agents of others, in the order in which each wants its wrappers."""

import gymnasium as gym
import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv

from asm_gym.monitors import NeuralASM
from asm_gym.wrappers import NeuralASMSafety, StreamRecorder
from tests.fakes import CueMonitor, FakeEnv

LENGTH, CUE = 10, (3, 4)


def watched():
    return NeuralASMSafety(FakeEnv(LENGTH), CueMonitor(CUE), on_alarm="hold", release_after=2)


def test_an_off_policy_agent_keeps_what_it_commanded_and_is_told_what_was_done():
    envs = DummyVecEnv([watched])
    agent = SAC("MlpPolicy", envs, learning_starts=5, seed=0, buffer_size=100)
    agent.learn(2 * LENGTH)
    kept = agent.replay_buffer.actions[: 2 * LENGTH, 0]
    assert np.abs(kept[4:7, :2]).min() > 0.0  # the policy's own, though the reflex rested
    envs.reset()
    for _ in range(5):
        infos = envs.step(np.full((1, 3), 0.5, np.float32))[3]
    np.testing.assert_array_equal(infos[0]["asm"]["executed_action"], [0.0, 0.0, 0.5])


class Swaying:
    """Moves each joint along a sine of its own, as an agent does that has learned something smooth."""

    def __init__(self, seed, size):
        rng = np.random.default_rng(seed)
        self.rate, self.phase = np.linspace(0.1, 0.4, size), rng.uniform(0, 2 * np.pi, size)

    def __call__(self, t):
        return np.sin(self.rate * t + self.phase).astype(np.float32)


def play(env, seed, steps=60, disturb=lambda t: None):
    """The surprise of each step of an episode."""
    sway = Swaying(seed, env.action_space.shape[0])
    env.reset(seed=seed)
    infos = []
    for t in range(steps):
        disturb(t)
        infos.append(env.step(sway(t))[4])
    return infos


def test_an_environment_that_is_not_ours_is_learned_and_watched():
    env = StreamRecorder(gym.make("Pusher-v5"))
    for seed in range(50):
        play(env, seed)
        env.reset()
    asm = NeuralASM(env.stream_spec, hidden_size=32, association_size=64, epochs=20)
    asm.fit(env.episodes[:30]).calibrate(env.episodes[30:50], false_alarm_rate=0.1)
    # damped joints rest without torque
    guarded = NeuralASMSafety(env, asm, on_alarm="hold", action_means="velocity")
    data = env.unwrapped.data
    alarms = [any(i["cost"] for i in play(guarded, seed)) for seed in range(100, 110)]
    assert sum(alarms) <= 2

    def push(t):
        data.qfrc_applied[:7] = 20.0 if t >= 30 else 0.0

    infos = play(guarded, 200, disturb=push)
    assert not any(i["cost"] for i in infos[:30])
    assert any(i["cost"] for i in infos[30:36])
    first = next(t for t, i in enumerate(infos) if i["cost"])
    assert infos[first + 1]["asm"]["intervened"]
    np.testing.assert_array_equal(infos[first + 1]["asm"]["executed_action"], np.zeros(7))
    env.close()
