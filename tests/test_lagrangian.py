"""The Lagrange multiplier: up while cost is above its limit, down below it, and felt in the reward."""

import json

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from asm_gym import collect
from asm_gym.monitors import NeuralASM
from asm_gym.scripts.examples import lagrangian
from asm_gym.scripts.examples.lagrangian import CostlyReward, LagrangeMultiplier
from tests.fakes import FakeEnv

LENGTH = 10


class Costly(FakeEnv):
    """Costs 1 in the first ``costly`` steps of each of its first ``bad`` episodes, and nothing later."""

    def __init__(self, costly=4, bad=6):
        super().__init__(LENGTH)
        self.costly, self.left = costly, bad + 1

    def reset(self, **kwargs):
        self.left -= 1
        return super().reset(**kwargs)

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        info["cost"] = float(self.left > 0 and self.t <= self.costly)
        return observation, reward, terminated, truncated, info


def learn(multiplier, envs, episodes):
    PPO("MlpPolicy", envs, n_steps=LENGTH, batch_size=LENGTH, n_epochs=1, seed=0).learn(
        episodes * LENGTH, callback=multiplier
    )


def test_the_multiplier_rises_above_the_limit_and_falls_below_it():
    multiplier = LagrangeMultiplier(limit=0.1, rate=2.0, every=2)
    learn(multiplier, DummyVecEnv([lambda: CostlyReward(Costly())]), 14)
    # Three changes at a cost of 0.4 a step: + 2 (0.4 - 0.1) each; then - 2 x 0.1 each, and never below 0.
    expected = [0.6, 1.2, 1.8, 1.6, 1.4, 1.2, 1.0]
    np.testing.assert_allclose([value for _, _, value in multiplier.history], expected)
    np.testing.assert_allclose([cost for _, cost, _ in multiplier.history], [0.4] * 3 + [0.0] * 4)
    assert multiplier.history[0][0] == 2 * LENGTH
    cheap = LagrangeMultiplier(limit=0.1, rate=2.0, every=2, initial=0.3)
    learn(cheap, DummyVecEnv([lambda: CostlyReward(Costly(bad=0))]), 8)
    np.testing.assert_allclose([value for _, _, value in cheap.history], [0.1, 0.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("vec_env", [DummyVecEnv, SubprocVecEnv])
def test_the_multiplier_reaches_the_reward_of_every_environment(vec_env):
    def make():
        return gym.wrappers.RecordEpisodeStatistics(CostlyReward(Costly(bad=100)))

    envs = vec_env([make, make])
    multiplier = LagrangeMultiplier(limit=0.1, rate=1.0, every=2)
    learn(multiplier, envs, 4)
    envs.reset()
    rewards = [envs.step(np.zeros((2, 3), np.float32))[1] for _ in range(LENGTH)]
    envs.close()
    assert multiplier.value == pytest.approx(0.6)
    np.testing.assert_allclose(rewards, [[1 - 0.6] * 2] * 4 + [[1.0] * 2] * 6, rtol=1e-6)


def test_an_environment_without_a_costly_reward_is_refused():
    with pytest.raises(ValueError, match="needs a CostlyReward"):
        learn(LagrangeMultiplier(), DummyVecEnv([Costly]), 1)


@pytest.mark.parametrize("bad", [{"limit": -0.1}, {"rate": 0.0}, {"every": 0}, {"initial": -1.0}])
def test_settings_that_make_no_sense_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        LagrangeMultiplier(**bad)


@pytest.mark.slow
def test_a_short_run_adapts_to_the_alarms_of_a_real_memory(tmp_path):
    episodes = collect("asm_gym/Lift-v0", episodes=18, seed=1, workers=1)
    memory = NeuralASM(episodes[0].spec, hidden_size=32, association_size=64, epochs=5)
    memory.fit(episodes[:9]).calibrate(episodes[9:], 0.1).save(tmp_path / "expert.asm")
    # An untrained agent is nothing like the expert that this memory knows: the cost is high, and the multiplier rises.
    out = tmp_path / "run"
    assert lagrangian.main([str(tmp_path / "expert.asm"), "--steps", "1000", "--out", str(out)]) == 0
    history = json.loads((out / "multiplier.json").read_text())
    assert [entry["steps"] for entry in history] == [400, 800]
    assert 0 < history[0]["multiplier"] < history[1]["multiplier"]
    assert history[1]["multiplier"] == pytest.approx(5.0 * sum(entry["cost"] - 0.01 for entry in history))
    assert PPO.load(out / "agent.zip").observation_space.shape == (37,)


def test_a_missing_memory_is_refused(tmp_path, capsys):
    assert lagrangian.main([str(tmp_path / "none.asm"), "--out", str(tmp_path / "out")]) == 2
    assert "none.asm" in capsys.readouterr().err
