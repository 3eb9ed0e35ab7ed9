"""Wear: drifts that no row and no episode shows, told by what episodes add up to."""

from __future__ import annotations

from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asm_gym import Channel, Episode, NeuralASM, NeuralASMSafety, StreamSpec
from asm_gym.detection.drift import DriftSenses, WearCounter, WearScale, wear_scale
from asm_gym.memory.completion import Completion
from asm_gym.scaling import StreamScaler

SPEC = StreamSpec(
    (
        Channel("joint_position", 2, "rad", noise=0.01, group="joint"),
        Channel("joint_velocity", 2, "rad/s", noise=0.01, group="joint"),
        Channel("joint_torque", 2, "N m", noise=0.05, group="torque"),
        Channel("hand_position", 2, "m", noise=0.01, group="hand"),
        Channel("command", 2, "rad/s", group="action"),
    ),
    dt=0.05,
)
ROWS = 100  # of an episode
PAIRS = np.array([[4, 2], [5, 3]])


def arm(rng: np.random.Generator, friction: float = 1.0, bias: float = 0.0) -> np.ndarray:
    """An episode of a two-jointed arm that is swayed about; ``bias`` of its first encoder."""
    phase = rng.uniform(0, 2 * np.pi, 2)
    speed = np.cos(2.0 * SPEC.dt * np.arange(ROWS)[:, None] * rng.uniform(0.5, 1.5, 2) + phase)
    angle = np.cumsum(speed, axis=0) * SPEC.dt
    torque = 2.0 * angle + friction * np.sign(speed)
    hand = np.stack([angle.sum(axis=1), angle[:, 0] - angle[:, 1]], axis=1)
    rows = np.hstack([angle + np.array([bias, 0.0]), speed, torque, hand, speed])
    return rows + rng.normal(size=rows.shape) * SPEC.noise


@cache
def senses() -> DriftSenses:
    rng = np.random.default_rng(0)
    streams = [arm(rng) for _ in range(30)]
    completion = Completion.fit(StreamScaler.fit(SPEC, streams), streams)
    withheld = np.array([channel.group == "torque" for channel in SPEC.channels])
    return DriftSenses.of(completion, PAIRS, np.repeat(withheld, 2))


@cache
def scale() -> WearScale:
    rng = np.random.default_rng(1)
    return wear_scale(senses(), [arm(rng) for _ in range(60)], SPEC.dt)


def followed(episodes, counter=None):
    """The counter after episodes, and after how many of them it told wear first."""
    counter = counter or WearCounter(senses(), scale())
    first = None
    for n, episode in enumerate(episodes):
        if counter.follow(episode, SPEC.dt) and first is None:
            first = n + 1
    return counter, first


def test_healthy_episodes_of_two_hours_tell_no_wear():
    rng = np.random.default_rng(2)
    _, first = followed(arm(rng) for _ in range(1440))
    assert first is None


def test_an_encoder_whose_bias_grows_in_ten_minutes_is_named():
    rng = np.random.default_rng(3)
    counter, first = followed(arm(rng, bias=0.05 * k / 120) for k in range(120))
    assert first is not None
    worn = {(wear.channel, wear.kind) for wear in counter.worn}
    assert ("joint_position[0]", "offset") in worn
    assert 0 < counter.worn[0].since_s < 600.0


def test_friction_that_grows_by_a_fifth_in_an_hour_is_drag_of_its_torque():
    rng = np.random.default_rng(4)
    counter, first = followed(arm(rng, friction=1.0 + 0.2 * k / 720) for k in range(720))
    assert first is not None
    assert counter.worn[0].kind == "drag"
    assert counter.worn[0].channel.startswith("joint_torque")


def test_what_differs_from_the_beginning_on_is_no_wear():
    rng = np.random.default_rng(5)
    _, first = followed(arm(rng, friction=1.5, bias=0.2) for _ in range(200))
    assert first is None


def test_drift_that_is_acknowledged_is_the_new_healthy():
    rng = np.random.default_rng(6)
    counter, first = followed(arm(rng, bias=0.001 * k) for k in range(100))
    assert first is not None
    counter.acknowledge()
    assert counter.worn == ()
    _, again = followed((arm(rng, bias=0.1) for _ in range(100)), counter)
    assert again is None


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(20, 60))
def test_healthy_blocks_keep_the_expected_evidence_at_one(seed, blocks):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(blocks, 3)) * [1.0, 10.0, 0.1]
    found = WearScale.of(values, block_s=5.0)
    np.testing.assert_allclose(found.spread, values.std(axis=0, ddof=1))
    assert ((found.rising >= 1.0) & (found.falling >= 1.0)).all()
    np.testing.assert_array_equal(WearScale.restored(found.array, 3).array, found.array)


def test_too_few_blocks_tell_nothing_and_a_damaged_scale_is_refused():
    rng = np.random.default_rng(7)
    assert wear_scale(senses(), [arm(rng)] * 19, SPEC.dt) is None
    with pytest.raises(ValueError, match="wear should be"):
        WearScale.restored(-scale().array, len(scale().spread))


class Drifting(gym.ObservationWrapper):
    """An arm whose first encoder is off by ``bias``."""

    bias = 0.0

    def observation(self, observation):
        return observation

    def step(self, action):
        *result, info = self.env.step(action)
        stream = info["stream"].copy()
        stream[0] += self.bias
        return *result, info | {"stream": stream}


def swayed(env, seed: int) -> list[dict]:
    rng = np.random.default_rng(seed)
    _, info = env.reset(seed=seed)
    infos = [info]
    phase = rng.uniform(0, 6, 7)
    for t in range(60):
        *_, info = env.step(np.cos(0.1 * t + phase).astype(np.float32))
        infos.append(info)
    return infos


def test_the_guard_tells_wear_and_does_not_act_on_it(tmp_path):
    bare = Drifting(gym.make("asm_gym/SyntheticArm-v0", horizon=60, disable_env_checker=True))
    spec = bare.unwrapped.stream_spec
    streams = [[info["stream"] for info in swayed(bare, seed)[1:]] for seed in range(100)]
    episodes = [Episode.from_stream(np.array(stream), spec) for stream in streams]
    memory = NeuralASM(spec, hidden_size=8, association_size=16, epochs=1, values=False)
    memory.fit(episodes[:50]).calibrate(episodes[50:], false_alarm_rate=0.05)
    memory.save(tmp_path / "memory.asm")
    kept = NeuralASM.load(tmp_path / "memory.asm")
    guarded = NeuralASMSafety(bare, kept.with_threshold(1e6), on_alarm="hold")
    told = []
    for n in range(40):
        bare.bias = 0.01 * n
        infos = swayed(guarded, 1000 + n)
        told.append(infos[-1]["asm"]["wear"]["channel"])
        assert not any(info["asm"]["alarm"] or info["asm"]["intervened"] for info in infos)
    assert not any(told[:6])
    assert told[-1]
    guarded.acknowledge_wear()
    assert not swayed(guarded, 5000)[-1]["asm"]["wear"]["channel"]
