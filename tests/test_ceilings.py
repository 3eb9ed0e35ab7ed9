"""Ceilings from healthy hours: how far each sense goes at its worst, so that rare alarms are as rare in each."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest

from asm_gym import Episode, NeuralASM
from asm_gym.detection.evidence import FEWEST_EPISODES, HOURS_QUANTILE, HOURS_TAIL_INDEX, TAIL_INDEX
from asm_gym.detection.evidence_detection import EvidenceDetection
from asm_gym.monitors import calibration, make_monitor
from asm_gym.monitors.calibration import learn_ceilings
from tests.memories import SMALL, sine_memory
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


def test_a_share_of_the_hours_stays_below_each_ceiling_and_tails_are_those_that_were_learned(asm):
    hours = list(shaken(sine_episodes(150, seed=20)))
    before, detection = asm.detection.detector_, asm.detection
    maxima = calibration._worst_of(asm, detection, hours)
    learn_ceilings(asm, hours)
    np.testing.assert_allclose((maxima <= asm.detection.detector_.ceiling).mean(axis=0), HOURS_QUANTILE, atol=0.01)
    np.testing.assert_allclose(asm.detection.detector_.tail, before.tail * HOURS_TAIL_INDEX / TAIL_INDEX)
    np.testing.assert_array_equal(asm.detection.detector_.whitening, before.whitening)
    assert asm.threshold_ is None
    again = asm.fit(sine_episodes(50)).detection.detector_  # anew: nothing is left of hours
    for name in ("ceiling", "tail"):
        np.testing.assert_array_equal(getattr(again, name), getattr(before, name))


def test_a_sense_that_jumps_in_healthy_hours_sets_no_threshold_for_the_others(asm):
    hours = list(shaken(sine_episodes(700, seed=22)))
    faults = [
        Episode.from_stream(e.stream + np.r_[np.zeros(7), 2.0, np.zeros(6)] * (np.arange(len(e))[:, None] > 20), e.spec)
        for e in sine_episodes(60, seed=23)
    ]

    def found():
        asm.calibrate(hours[350:], false_alarm_rate=0.02)
        return np.mean([(s.value > asm.threshold).any() for s in asm.score_episodes(faults)])

    as_it_was = found()
    learn_ceilings(asm, hours[:350])
    assert found() > as_it_was + 0.1


def test_what_ceilings_are_of_is_not_calibrated_on_by_the_hour(asm):
    hours = sine_episodes(120, seed=28)
    with pytest.raises(ValueError, match="was learned from"):
        learn_ceilings(asm, hours).calibrate(hours, false_alarms_per_hour=60.0)


def test_bad_input_is_named(asm):
    with pytest.raises(ValueError, match=f"{FEWEST_EPISODES} healthy episodes or more, got 3"):
        learn_ceilings(asm, sine_episodes(3, seed=0))
    with pytest.raises(ValueError, match="episode 119 was learned from"):
        learn_ceilings(asm, [*sine_episodes(119, seed=3), sine_episodes(50)[0]])
    with pytest.raises(ValueError, match="episodes 0 and 120 are the same"):
        learn_ceilings(asm, [*(hours := sine_episodes(120, seed=3)), hours[0]])
    with pytest.raises(RuntimeError, match="call fit"):
        learn_ceilings(NeuralASM(sine_spec(), **SMALL), sine_episodes(120, seed=0))
    other = make_monitor("kalman", sine_spec()).fit(sine_episodes(30, seed=0))
    with pytest.raises(TypeError, match="mahalanobis has no ceilings"):
        learn_ceilings(other, sine_episodes(120, seed=0))
    with pytest.raises(ValueError, match="tail_index must be"):
        EvidenceDetection(sine_spec(), tail_index=0.0)
