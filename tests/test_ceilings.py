"""Ceilings from healthy hours: how far each sense goes at its worst, so that rare alarms are as rare in each."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest

from asm_gym import Episode, NeuralASM
from asm_gym.detection.evidence import HOURS_QUANTILE, HOURS_TAIL_INDEX, TAIL_INDEX
from asm_gym.detection.evidence_detection import EvidenceDetection
from asm_gym.monitors import calibration, make_monitor
from asm_gym.monitors.training_data import hashes_of
from tests.memories import sine_memory
from tests.streams import sine_episodes, sine_spec


@pytest.fixture
def asm() -> NeuralASM:
    return deepcopy(sine_memory())  # ceilings are learned in place


def shaken(episodes, column=3, by=4.0):
    """One sense makes a jump now and then: that of these hours is not that of what was learned."""
    rng = np.random.default_rng(1)
    for episode in episodes:
        stream = np.array(episode.stream)
        if rng.random() < 0.3:
            stream[rng.integers(10, len(stream)) :, column] += by * rng.pareto(2.0)
        yield Episode.from_stream(stream, episode.spec)


def test_of_many_episodes_a_third_sets_ceilings_and_the_others_the_threshold(asm):
    hours = list(shaken(sine_episodes(450, seed=20)))
    before, detection = asm.detection.detector_, asm.detection
    maxima = np.array(calibration._largest_strengths(asm, detection, hours[::3]))
    asm.calibrate(hours, false_alarm_rate=0.05)
    after = asm.detection.detector_
    np.testing.assert_allclose((maxima <= after.ceiling).mean(axis=0), HOURS_QUANTILE, atol=0.01)
    np.testing.assert_allclose(after.tail, before.tail * HOURS_TAIL_INDEX / TAIL_INDEX)
    np.testing.assert_array_equal(after.whitening, before.whitening)
    assert set(asm.ceilings_from_) == set(hashes_of(hours[::3]))
    others = [e for n, e in enumerate(hours) if n % 3]
    np.testing.assert_allclose(asm.maxima_, [s.value.max() for s in asm.score_episodes(others)])
    np.testing.assert_allclose(
        asm.calibrate(hours, false_alarm_rate=0.05).detection.detector_.tail, after.tail
    )
    again = asm.fit(sine_episodes(50)).detection.detector_  # anew: nothing is left of hours
    for name in ("ceiling", "tail"):
        np.testing.assert_array_equal(getattr(again, name), getattr(before, name))


def test_a_group_gives_a_third_of_its_own(asm):
    hours = sine_episodes(330, seed=20)
    asm.calibrate(hours, false_alarm_rate=0.05, each=["a"] * 300 + ["b"] * 30)
    assert set(asm.ceilings_from_) == set(hashes_of([*hours[:300:3], *hours[300::3]]))
    first_of_episode = asm.blocks_.hours > 0  # further incidents of an episode take no time
    assert sorted(asm.blocks_.group[first_of_episode].tolist()) == [0] * 200 + [1] * 20


def test_a_tenth_where_a_third_is_too_many(asm):
    hours = sine_episodes(1000, seed=20)
    asm.calibrate(hours, false_alarm_rate=0.00125)  # which takes 799
    assert set(asm.ceilings_from_) == set(hashes_of(hours[::10]))
    assert len(asm.maxima_) == 900


@pytest.mark.parametrize("asked", [{"false_alarm_rate": 0.004}, {"false_alarms_per_hour": 6.0}])
def test_none_are_taken_where_the_promise_needs_all_which_is_said(asm, asked, caplog):
    hours = sine_episodes(300, seed=20)
    assert 1.0 < 6.0 * sum(len(e) * e.spec.dt for e in hours) / 3600 < 1.5
    asm.calibrate(hours, **asked)
    assert "takes all 300 episodes" in caplog.text
    assert asm.ceilings_from_ is None
    assert len(asm.maxima_) == 300
    asm.calibrate(hours[:200], false_alarm_rate=0.05)  # too few
    assert asm.ceilings_from_ is None
    other = (
        make_monitor("kalman", sine_spec()).fit(sine_episodes(30, seed=0)).calibrate(hours, 0.05)
    )
    assert len(other.maxima_) == 300  # its detection has no ceilings


def test_a_sense_that_jumps_in_healthy_hours_sets_no_threshold_for_the_others(asm):
    hours = list(shaken(sine_episodes(525, seed=22)))
    faults = [
        Episode.from_stream(
            e.stream + np.r_[np.zeros(7), 3.0, np.zeros(6)] * (np.arange(len(e))[:, None] > 20),
            e.spec,
        )
        for e in sine_episodes(60, seed=23)
    ]

    def found(episodes):
        asm.calibrate(episodes, false_alarm_rate=0.02)
        return np.mean([(s.value > asm.threshold).any() for s in asm.score_episodes(faults)])

    as_it_was = found(hours[:290])
    assert asm.ceilings_from_ is None
    assert found(hours) > as_it_was + 0.1


def test_what_ceilings_are_of_sets_no_threshold_by_the_hour(asm):
    hours = sine_episodes(300, seed=28)
    asm.calibrate(hours, false_alarms_per_hour=60.0)
    with pytest.raises(ValueError, match="learned from"):
        asm.calibrate(hours[:150], false_alarms_per_hour=60.0)
    with pytest.raises(ValueError, match="tail_index must be"):
        EvidenceDetection(sine_spec(), tail_index=0.0)
