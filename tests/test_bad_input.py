"""Streams that tell little, or too much: what cannot be learned from is refused with what is missing, all else fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asm_gym.data.episode import Episode
from asm_gym.monitors import make_monitor
from asm_gym.monitors.training_data import mute_channels
from asm_gym.spec import MOTOR, Channel, StreamSpec
from tests.streams import sine_episodes

NAMES = ("neural_asm", "association_linear+evidence", "kalman+evidence")


def fresh(name, spec):
    small = {"hidden_size": 8, "association_size": 24, "epochs": 2} if name == "neural_asm" else {}
    return make_monitor(name, spec, **small)


def changed(episodes, change):
    def one(episode):
        stream = episode.stream.copy()
        change(stream)
        return replace(episode, stream=stream)

    return [one(episode) for episode in episodes]


def constant(stream):
    stream[:, 3] = 0.7


def copied(stream):
    stream[:, 4] = stream[:, 5]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("change", [constant, copied])
def test_a_sense_that_never_moves_and_one_that_is_another_s_copy_are_watched_too(name, change):
    """Fresh episodes are judged as learned ones are, and the sense is blamed once it does otherwise."""
    monitor = fresh(name, sine_episodes(1)[0].spec).fit(changed(sine_episodes(12), change))
    nominal = [
        s.value.max() for s in monitor.score_episodes(changed(sine_episodes(6, seed=1), change))
    ]
    assert np.isfinite(nominal).all()
    column, stream = (
        {constant: 3, copied: 4}[change],
        changed(sine_episodes(1, seed=2), change)[0].stream.copy(),
    )
    stream[20:, column] += 5.0
    score = monitor.score(Episode.from_stream(stream, sine_episodes(1)[0].spec))
    assert score.value[20:].max() > 2 * max(nominal)
    assert np.argmax(score.attribution[20:23].sum(axis=0)) in (
        {3} if change is constant else {4, 5}
    )


@pytest.mark.parametrize("change", [constant, copied])
def test_senses_that_tell_nothing_are_named_and_no_precision_is_infinite(change):
    episodes = changed(sine_episodes(12), change)
    named = {constant: ["joint_position[3]"], copied: ["joint_position[5]", "joint_position[4]"]}[
        change
    ]
    (line,) = mute_channels(episodes)
    assert all(name in line for name in named)
    assert mute_channels(sine_episodes(12)) == []
    still = changed(sine_episodes(3), lambda stream: stream.fill(0.5))
    assert len(mute_channels(still)) == still[0].spec.size
    monitor = fresh("neural_asm", episodes[0].spec).fit(episodes)
    known = monitor.model.network.association
    assert known.leverage_scale[1].max() > 0
    assert all(np.isfinite(array).all() for array in known)
    stream = changed(sine_episodes(1, seed=2), change)[0].stream.astype(np.float64)
    stream[10] = 1e9
    stream[20, 3] = np.nan
    stream[30:, 4] += 1e3
    state, values = monitor.initial_state(1), []
    for row in stream:
        state, surprise = monitor.observe(state, row[None])
        values.append(surprise.value[0])
    assert np.flatnonzero(~np.isfinite(values)).tolist() == [20]
    assert min(values[10], values[30]) > max(values[:10])


@pytest.mark.parametrize("name", NAMES)
def test_one_episode_fits_and_says_what_its_threshold_lacks(name):
    (only,) = sine_episodes(1)
    monitor = fresh(name, only.spec).fit([only])
    assert np.isfinite(monitor.score(only).value).all()
    with pytest.raises(
        ValueError,
        match=r"needs at least 19 nominal episodes, got 1: these can promise 0\.5 at best",
    ):
        monitor.calibrate(sine_episodes(1, seed=1), 0.05)


@pytest.mark.parametrize("name", NAMES)
def test_episodes_of_one_row_are_refused_with_how_many_it_takes(name):
    rows = [replace(e, stream=e.stream[:1]) for e in sine_episodes(5)]
    with pytest.raises(ValueError, match=r"episode 0 must be at least [2-9] steps long, got 1"):
        fresh(name, rows[0].spec).fit(rows)


@pytest.mark.parametrize("name", NAMES)
def test_ten_thousand_senses_are_refused_at_once_with_what_to_do(name):
    spec = StreamSpec((Channel("pixels", 10_000), Channel("command", 1, group=MOTOR)), dt=0.05)
    episode = Episode.from_stream(np.random.default_rng(0).normal(size=(6, 10_001)), spec)
    with pytest.raises(ValueError, match=r"at most 8192 inputs.* makes \d+: leave channels out"):
        fresh(name, spec).fit([episode])
