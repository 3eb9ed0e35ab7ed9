"""Spikes of one group in one row: held back, let go by a second row, and told as an event."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asm_gym import Channel, Episode, NeuralASM, StreamSpec
from asm_gym.detection import EvidenceDetection
from asm_gym.detection.alarm_rule import GLITCH_EVENT
from asm_gym.detection.evidence import Evidence, accumulated
from asm_gym.detection.glitches import SPIKE, SpikeRule, Waiting
from tests.spikes import followed, held_back

GAINS = np.array([0.8, 0.2, 0.05])
PAIRS = np.array([0, 0, 1, 1])


def rule(rows: int = 1) -> SpikeRule:
    return SpikeRule(usual=np.array([1.0, 2.0, 1.0, 0.5]), groups=PAIRS, rows=rows)


def vectors_of(errors, spikes):
    contexts = np.zeros((len(errors), 0))
    waiting = Waiting.start(1, errors.shape[1])
    return accumulated(np.array(errors, float), contexts, GAINS, spikes, waiting)[0]


def plain(errors):
    return vectors_of(errors, SpikeRule.unused(errors.shape[1]))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_the_compiled_rows_follow_the_equations(seed, rows):
    rng = np.random.default_rng(seed)
    errors = 0.5 * rng.standard_t(2, size=(60, 4))
    spikes = rule(rows)
    evidence = Evidence.start(1, len(GAINS), 4)
    wanted = []
    for error in errors:
        limited, late, waiting = held_back(spikes, evidence.waiting, error[None])
        vector = followed(evidence, limited, late, GAINS)
        evidence = evidence._replace(vector=vector, waiting=waiting)
        wanted.append(vector[0])
    np.testing.assert_allclose(vectors_of(errors, spikes), wanted, rtol=1e-9, atol=1e-12)


def one_row(column: int, size: float = 4.5) -> np.ndarray:
    errors = np.zeros((30, 4))
    errors[10, column] = size
    return errors


@pytest.mark.parametrize("column", range(4))
def test_a_spike_without_a_trace_counts_as_much_as_what_is_usual(column):
    spikes = rule()
    found = vectors_of(one_row(column), spikes)
    np.testing.assert_allclose(found, plain(one_row(column, spikes.usual[column])))


def test_a_spike_that_another_group_feels_is_not_held_back():
    errors = one_row(0)
    errors[10, 3] = 1.0  # twice what is usual
    np.testing.assert_array_equal(vectors_of(errors, rule()), plain(errors))


def test_a_jump_that_no_healthy_row_comes_near_is_not_held_back():
    errors = one_row(0, size=11.0)
    np.testing.assert_array_equal(vectors_of(errors, rule()), plain(errors))


def test_what_lasts_is_let_go_one_row_later_as_if_it_had_never_waited():
    errors = one_row(0)
    errors[11, 0] = 1.5
    found = vectors_of(errors, rule())
    assert (np.abs(found[10, :, 0]) < np.abs(plain(errors)[10, :, 0])).all()
    np.testing.assert_allclose(found[11:], plain(errors)[11:])


@pytest.mark.parametrize("late", [1, 3, 5])
def test_at_a_fast_rate_any_row_of_a_twentieth_of_a_second_lets_go(late):
    errors = one_row(2)
    errors[10 + late, 1] = 2.5
    found = vectors_of(errors, rule(rows=5))
    np.testing.assert_allclose(found[10 + late :], plain(errors)[10 + late :])


def test_a_row_that_comes_too_late_lets_nothing_go():
    errors = one_row(2)
    errors[16, 1] = 2.5
    found = vectors_of(errors, rule(rows=5))
    assert (np.abs(found[16:, :, 2]) < 0.3 * np.abs(plain(errors)[16:, :, 2])).all()


def test_two_spikes_in_a_row_both_count():
    errors = one_row(0)
    errors[11, 2] = 4.5
    np.testing.assert_allclose(vectors_of(errors, rule())[11:], plain(errors)[11:])


SPEC = StreamSpec(
    (
        Channel("position", 2, "m", group="a"),
        Channel("force", 3, "N", group="b"),
        Channel("command", 1, group="action"),
    ),
    dt=0.05,
)


@pytest.fixture(scope="module")
def streams() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.normal(size=(60, 6)) for _ in range(60)]


def memory_of(streams, **settings) -> NeuralASM:
    episodes = [Episode.from_stream(stream, SPEC) for stream in streams]
    settings = {"glitches": True} | settings
    memory = NeuralASM(SPEC, hidden_size=16, association_size=16, epochs=2, **settings)
    return memory.fit(episodes[:30]).calibrate(episodes[30:], false_alarm_rate=0.05)


def spiked(streams) -> Episode:
    stream = streams[0].copy()
    stream[30, 0] += 15.0
    return Episode.from_stream(stream, SPEC)


def test_a_memory_tells_a_glitch_where_it_would_have_alarmed(streams, tmp_path):
    memory = memory_of(streams)
    surprise = memory.score(spiked(streams))
    assert surprise.value.max() <= memory.threshold < surprise.raw[30]
    assert surprise.excuse[30] == GLITCH_EVENT
    assert surprise.excused_by_event["glitch"].argmax() == 30
    rate = memory.glitch_promise
    assert 0.0 < rate.rate <= rate.at_most

    memory.save(tmp_path / "memory.asm")
    again = NeuralASM.load(tmp_path / "memory.asm")
    assert again.glitches
    assert again.glitch_promise == rate
    np.testing.assert_array_equal(again.score(spiked(streams)).value, surprise.value)


def test_without_the_rule_the_same_row_is_an_alarm_and_a_file_says_so(streams, tmp_path):
    memory = memory_of(streams, glitches=False)
    assert memory.score(spiked(streams)).value[30] > memory.threshold
    memory.save(tmp_path / "memory.asm")
    again = NeuralASM.load(tmp_path / "memory.asm")
    assert not again.glitches
    assert "usual_errors" not in again.learned_
    np.testing.assert_array_equal(
        again.score(spiked(streams)).value, memory.score(spiked(streams)).value
    )


def test_memories_of_an_earlier_release_go_on_without_the_rule():
    assert not NeuralASM.pretrained("panda").glitches


def test_arrays_that_do_not_fit_are_refused(streams):
    detection = EvidenceDetection(SPEC)
    learned = {**memory_of(streams).detection.learned_, "usual_errors": np.zeros(5)}
    with pytest.raises(ValueError, match="usual_errors"):
        detection.restore(learned)


def test_a_response_to_an_alarm_forgets_what_waits(streams):
    memory = memory_of(streams)
    state = memory.initial_state()
    for row in spiked(streams).stream[:31]:
        state, _ = memory.observe(state, row[None])
    assert state.detection.evidence.waiting.left[0]
    assert np.abs(state.detection.evidence.waiting.rest).max() > SPIKE
    state = memory.reset_evidence(state)
    assert not state.detection.evidence.waiting.rest.any()
