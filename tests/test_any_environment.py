"""The memory outside robosuite: Pusher-v5 under a scripted policy, whose senses have neither noise nor groups."""

from __future__ import annotations

from collections.abc import Callable

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.episode import Episode
from asm_gym.monitors import CalibratedMonitor, make_monitor
from asm_gym.spec import StreamSpec, control_period
from tests.needs import needs

needs("mujoco")

STEPS, ONSET = 60, 30

SensorFault = Callable[[np.ndarray], np.ndarray]
"""From a stream (T, D) to what broken sensors make of it."""


def frozen(entry: int) -> SensorFault:
    def broken(x: np.ndarray) -> np.ndarray:
        x[ONSET:, entry] = x[ONSET - 1, entry]
        return x

    return broken


def offset(x: np.ndarray) -> np.ndarray:
    x[ONSET:, 2] += 0.1
    return x


def delayed(x: np.ndarray) -> np.ndarray:
    x[ONSET:, 4] = x[ONSET - 3 : -3, 4]
    return x


def lost(x: np.ndarray) -> np.ndarray:
    return np.delete(x, np.s_[ONSET : ONSET + 5], axis=0)


@pytest.fixture(scope="module")
def pusher():
    """``run(seed, scale, broken)``: the stream of an episode, its actions scaled from the onset on."""
    env = gym.make("Pusher-v5")
    spec = StreamSpec.from_spaces(env.observation_space, env.action_space, control_period(env))
    middle, speed = np.array([-0.3, 0.4, 0.0, -0.6, 0.0, -0.4, 0.0]), np.array([0.5, 0.4, 0.6, 0.5, 0.7, 0.6, 0.8])

    def run(seed: int, scale: float = 1.0, broken: SensorFault = lambda x: x) -> Episode:
        rng, (x, _) = np.random.default_rng([seed, 7]), env.reset(seed=seed)
        phase, wide, noise, rows = rng.normal(0, 0.3, 7), 0.4 * rng.uniform(0.8, 1.2, 7), np.zeros(7), []
        for t in range(STEPS):
            noise = 0.7 * noise + 0.1 * rng.standard_normal(7)
            towards = middle + wide * np.sin(2 * np.pi * speed * 0.05 * t + phase) - x[:7]
            action = np.clip(1.5 * towards - 0.3 * x[7:14] + noise, -2, 2).astype(np.float32)
            x, *_ = env.step(action * (scale if t >= ONSET else 1.0))
            rows.append(np.concatenate([x, action]))
        return Episode.from_stream(broken(np.array(rows)), spec)

    yield run
    env.close()


@pytest.fixture(scope="module")
def nominal(pusher) -> tuple[list[Episode], list[Episode]]:
    return [pusher(seed) for seed in range(40)], [pusher(1000 + seed) for seed in range(39)]


@pytest.fixture(scope="module", params=["neural_asm", "association_linear+evidence", "window_pca+evidence"])
def monitor(request, nominal) -> CalibratedMonitor:
    fit, others = nominal
    small = {"hidden_size": 16, "association_size": 92, "epochs": 2} if request.param == "neural_asm" else {}
    return make_monitor(request.param, fit[0].spec, **small).fit(fit).calibrate(others, 0.05)


def test_what_any_sensor_or_motor_fault_does_to_a_body_is_found(pusher, monitor):
    broken = [frozen(0), frozen(3), frozen(7), frozen(10), offset, delayed, lost]
    faulty = [pusher(2000 + seed, broken=b) for b in broken for seed in range(3)]
    faulty += [pusher(2000 + seed, scale=0.5) for seed in range(3)]
    surprises = [s.value for s in monitor.score_episodes(faulty)]
    found = np.mean([s[ONSET : ONSET + 20].max() > monitor.threshold for s in surprises])
    before = np.mean([s[:ONSET].max() > monitor.threshold for s in surprises])
    assert found >= 0.9
    assert before <= 0.2


def test_one_episode_and_episodes_of_two_rows_can_be_learned_from(nominal):
    fit, others = nominal
    for episodes in (fit[:1], [Episode.from_stream(e.stream[:2], e.spec) for e in fit[:3]]):
        monitor = make_monitor("neural_asm", fit[0].spec, hidden_size=8, association_size=23, epochs=1).fit(episodes)
        assert all(np.isfinite(s.value).all() for s in monitor.score_episodes(others[:2]))


def test_units_of_any_size_make_no_difference(nominal):
    fit, others = nominal
    units = np.ones(fit[0].stream.shape[1])
    units[[0, 1]] = 1e-6, 1e6
    surprises = []
    for factor in (1.0, units):
        scaled = [Episode.from_stream(e.stream * factor, e.spec) for e in (*fit[:10], *others[:2])]
        monitor = make_monitor("association_linear+evidence", fit[0].spec).fit(scaled[:10])
        surprises.append(np.concatenate([s.value for s in monitor.score_episodes(scaled[10:])]))
    np.testing.assert_allclose(np.log(surprises[1]), np.log(surprises[0]), atol=0.2)
