"""Rows that come faster than what a body does: the memory compares those that are a twentieth of a second apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asm_gym.memory.recall import continued
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.memory_model import MemoryModel
from asm_gym.monitors.skills import recall
from asm_gym.scaling import StreamScaler
from tests.streams import sine_episodes, sine_spec

LAG = 3
FAST = replace(sine_spec(), dt=0.05 / LAG)


@pytest.fixture(scope="module")
def fast() -> NeuralASM:
    return NeuralASM(FAST, hidden_size=24, association_size=60, epochs=2).fit(sine_episodes(12, spec=FAST))


@pytest.fixture(scope="module")
def slow(fast) -> MemoryModel:
    """The same weights, for a stream at the control rate."""
    asm = NeuralASM(sine_spec(), hidden_size=24, association_size=60, epochs=2)
    return asm.model.restore(fast.model.learned_)


def told(model: MemoryModel, stream: np.ndarray) -> np.ndarray:
    """(T, X) errors, row by row."""
    state, errors = model.start(1), []
    for row in stream.astype(np.float64):
        state, output = model.predict(state, row[None])
        errors.append(output.errors[0])
    return np.array(errors)


def test_every_third_row_feels_as_if_there_were_no_others(fast, slow):
    stream = sine_episodes(1, seed=3)[0].stream
    errors = told(fast.model, stream)
    for first in range(LAG):
        np.testing.assert_allclose(errors[first::LAG], told(slow, stream[first::LAG]), rtol=2e-5, atol=2e-6)
    assert np.abs(errors[2 * LAG :]).max() > 0.1


def test_the_state_is_inferred_from_every_third_row(fast, slow):
    stream = sine_episodes(1, seed=3)[0].stream.astype(np.float64)
    state, rare = fast.model.start(1), slow.start(1)
    for t, row in enumerate(stream[:12]):
        state, output = fast.model.predict(state, row[None])
        if t % LAG == 0:
            rare, expected = slow.predict(rare, row[None])
        # The change of row 3 is over the three rows that are seen here as well
        np.testing.assert_allclose(state.traces, rare.traces, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(output.contexts, expected.contexts, rtol=1e-4, atol=1e-5)


def test_a_whole_episode_is_read_as_its_rows_are(fast):
    stream = sine_episodes(1, seed=4)[0].stream.astype(np.float64)
    senses = fast.senses_
    assert senses.lag == LAG
    whole = senses.read_episode(stream)
    for t in (0, LAG - 1, LAG, 2 * LAG - 1, 2 * LAG, 30):
        before = stream[t - LAG] if t >= LAG else stream[t]
        earlier = stream[t - 2 * LAG] if t >= 2 * LAG else before
        one = senses.read(*(x[None] for x in (stream[t], before, earlier)))
        np.testing.assert_array_equal(whole.inputs[t], one.inputs[0])


def test_changes_are_standardised_over_as_many_rows():
    streams = [e.stream for e in sine_episodes(5)]
    by_hand = np.concatenate([s[LAG:].astype(np.float64) - s[:-LAG] for s in streams]).std(axis=0)
    np.testing.assert_allclose(StreamScaler.fit(FAST, streams, LAG).change, by_hand)


def with_second(state, begun):
    """The state of two streams, of which the second is the one that ``begun`` has."""
    if isinstance(state, np.ndarray):
        return np.concatenate([state[:1], begun])
    return type(state)(*map(with_second, state, begun))


def test_side_by_side_is_as_one_by_one_whenever_each_began(fast):
    streams = [e.stream[:20].astype(np.float64) for e in sine_episodes(2, seed=5)]
    state = fast.model.start(2)
    late = []
    for t in range(20):
        state, output = fast.model.predict(state, np.stack([s[t] for s in streams]))
        if t == 4:  # the second stream begins anew, as after a reset
            state = with_second(state, fast.model.start(1))
        if t > 4:
            late.append(output.errors[1])
    np.testing.assert_allclose(late, told(fast.model, streams[1][5:]), rtol=1e-3, atol=1e-4)


def test_recall_goes_on_with_every_third_row(fast, slow):
    cue = sine_episodes(1, seed=6)[0].stream[:16]
    rows = recall(fast, cue, 7)
    for turn in range(LAG):  # the cue's first row belongs to none of them
        expected = continued(slow.network, slow.senses_, cue[1 + turn :: LAG], 3)
        np.testing.assert_allclose(rows[turn::LAG], expected[: len(rows[turn::LAG])], rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match="at least 6 rows long"):
        recall(fast, cue[:5], 1)


def test_episodes_too_short_to_have_a_change_are_refused():
    short = sine_episodes(1, spec=FAST, steps=(LAG, LAG))
    with pytest.raises(ValueError, match="episode 0 must be at least 4 steps long, got 3"):
        NeuralASM(FAST).fit(short)
