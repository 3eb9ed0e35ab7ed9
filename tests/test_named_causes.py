"""Causes in words: each event that a person knows has its name, and healthy rows have none."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from asm_gym.guard.live_causes import LiveCauses
from asm_gym.memory.completion import Completion
from asm_gym.monitors import named_causes
from asm_gym.monitors.blame import REMEMBERED, Blame
from asm_gym.monitors.named_causes import CauseNamer, NamedCause
from asm_gym.monitors.pace_memory import PaceMemory
from asm_gym.scaling import StreamScaler, rows_apart
from asm_gym.scripts.reproduce.alarm_causes import (
    EVENTS,
    LASTS_S,
    ONSET_S,
    Event,
    Fault,
    faulty,
    recorded,
)
from asm_gym.synthetic_arm import SyntheticArm

SPEC = SyntheticArm.stream_spec
ONSET = round(ONSET_S / SPEC.dt)


@cache
def learned() -> tuple[Blame, PaceMemory, np.ndarray]:
    streams = [recorded(seed, 20.0) for seed in range(14)]
    senses = StreamScaler.fit(SPEC, streams, rows_apart(SPEC.dt))
    completion = Completion.fit(senses, streams)
    pace = PaceMemory.fit(senses, streams)
    assert completion is not None
    assert pace is not None
    return Blame(completion), pace, np.ptp(np.concatenate(streams), axis=0)


@cache
def healthy() -> np.ndarray:
    return recorded(500, ONSET_S + LASTS_S)


def cause_of(rows: np.ndarray, first: int) -> NamedCause:
    blame, pace, _ = learned()
    blamed = blame(rows[first + 1 - REMEMBERED : first + 1], np.ones(SPEC.size))
    return CauseNamer(blame, pace)(rows[first - 100 : first + 500], 100, blamed)


@pytest.mark.parametrize(
    ("event", "name"),
    [
        ("30 % slower", "pace"),
        ("30 % faster", "pace"),
        ("standstill", "standstill"),
        ("payload of 0.5 kg", "payload"),
        ("another home", "another home"),
        ("healthy", "unexplained"),
    ],
)
def test_what_happens_to_the_arm_has_its_name(event, name):
    rows = recorded(700, ONSET_S + LASTS_S, EVENTS[event])
    assert cause_of(rows, ONSET + 40).name == name


@pytest.mark.parametrize("column", [1, 9, 17, 24])
@pytest.mark.parametrize(("kind", "name"), [("shift", "offset"), ("frozen", "frozen")])
def test_what_is_wrong_with_one_channel_has_its_name_and_size(kind, name, column):
    width = learned()[2]
    rows = faulty(healthy(), Fault(kind, column, 0.3), width)
    cause = cause_of(rows, ONSET + 4 * (kind == "frozen"))
    assert (cause.name, cause.column) == (name, column)
    if kind == "shift":
        assert cause.size == pytest.approx(0.3 * width[column], rel=0.3)


def test_an_encoder_that_wraps_is_told_from_an_offset():
    cause = cause_of(faulty(healthy(), Fault("wrapped", 3), learned()[2]), ONSET)
    assert (cause.name, cause.column) == ("wrapped", 3)
    assert cause.size == pytest.approx(2 * np.pi, abs=0.3)


def test_encoders_with_another_zero_are_another_home():
    rows = healthy().copy()
    rows[ONSET:, :7] += [0.2, -0.1, 0.15, 0.0, 0.1, -0.2, 0.1]
    assert cause_of(rows, ONSET).name == "another home"


@pytest.mark.parametrize("pace", [0.6, 0.8, 1.4])
def test_the_pace_is_measured(pace):
    rows = recorded(701, ONSET_S + LASTS_S, Event(pace=pace))
    assert learned()[1].pace(rows[ONSET + 50 :]) == pytest.approx(pace, rel=0.15)


def test_rows_that_lack_a_number_are_unexplained():
    rows = healthy().copy()
    rows[ONSET + 5, 3] = np.nan
    assert cause_of(rows, ONSET).name == "unexplained"


def test_what_a_memory_saves_of_pace_it_finds_again():
    _, pace, _ = learned()
    again = PaceMemory.found(pace.named(), pace.senses)
    assert again is not None
    rows = healthy()
    assert again.pace(rows) == pytest.approx(pace.pace(rows), rel=1e-3)
    assert again.longest_pause == pace.longest_pause
    assert PaceMemory.found({}, pace.senses) is None
    with pytest.raises(ValueError, match="pace_moments"):
        PaceMemory.found(pace.named() | {"pace_moments": np.zeros((3, 4))}, pace.senses)


def test_every_cause_has_a_remedy_and_says_its_size():
    labels = SPEC.labels
    for name in named_causes.REMEDIES:
        cause = NamedCause(name, 0, 0.7)
        assert cause.remedy
        of_channel = cause.in_words(labels, SPEC.units)
        if name in (named_causes.OFFSET, named_causes.WRAPPED):
            assert labels[0] in of_channel
            assert "0.7 rad" in of_channel
    slower = NamedCause(named_causes.PACE, None, 0.7)
    assert "0.70" in slower.in_words(labels)


def test_a_live_alarm_has_its_cause_as_soon_as_that_is_clear():
    blame, pace, width = learned()

    class Monitor:
        spec = SPEC
        cause_namer_ = CauseNamer(blame, pace)

    rows = faulty(healthy(), Fault("frozen", 9), width)
    live = LiveCauses(Monitor())
    named = {}
    for number, row in enumerate(rows):
        cause = live.follow(row)
        if cause is not None:
            named[number] = cause.name
        if number == ONSET + 4:
            live.open((9,))
    assert named == {ONSET + 4 + round(0.5 / SPEC.dt): "frozen"}
