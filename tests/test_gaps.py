"""Short gaps are bridged, longer ones and frequent ones are alarms, and each alarm says why."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from rich.console import Console

from asm_gym.data.gaps import Bridge, blamed, bridged, filled, reason
from asm_gym.data.logs import Log
from asm_gym.episode import Episode
from asm_gym.evaluation.alarms import alarms_of, traces_of
from asm_gym.monitors import make_monitor
from asm_gym.scripts import watch

RATE = 50.0


def log(seed: int, rows: int = 200) -> Episode:
    rng = np.random.default_rng(seed)
    command = np.sin(np.outer(np.arange(rows) / RATE, [2.0, 3.0]) + rng.uniform(0, 6, 2))
    sensed = command + 0.01 * rng.normal(size=command.shape)
    return Episode.from_table({"q": sensed, "action": command}, rate=RATE, success=True)


@pytest.fixture(scope="module")
def monitor():
    return (
        make_monitor("kalman", log(0).spec)
        .fit([log(n) for n in range(20)])
        .calibrate([log(n) for n in range(20, 60)], 0.05)
    )


def with_gap(start: int, rows: int, column: int | None = None) -> Episode:
    episode = log(100)
    stream = episode.stream.copy()
    stream[start : start + rows, slice(None) if column is None else column] = np.nan
    return Episode.from_stream(stream, episode.spec)


def test_a_bridge_goes_over_short_gaps_and_no_longer_or_frequent_ones():
    missing = np.zeros((200, 1))
    missing[[10, 11, 100, 101, 102]] = np.nan
    assert np.flatnonzero(bridged(missing, 0.02, 0.04)).tolist() == [10, 11, 100, 101]
    assert not bridged(missing, 0.02, 0.0).any()
    loose = np.where(np.arange(400) % 3 == 0, np.nan, 0.0)[:, None]  # a third of all rows
    assert 0 < np.flatnonzero(np.isnan(loose[:, 0]) & ~bridged(loose, 0.02, 0.04))[0] < 10
    rare = np.where(np.arange(400) % 100 == 5, np.nan, 0.0)[:, None]
    np.testing.assert_array_equal(bridged(rare, 0.02, 0.02), np.isnan(rare[:, 0]))
    with pytest.raises(ValueError, match="bridge must be"):
        Bridge(-1.0, 0.02, 1)


def test_what_is_learned_from_lies_on_the_line_between_its_neighbours():
    stream = np.arange(12, dtype=np.float32).reshape(6, 2)
    holed = stream.copy()
    holed[2:4, 0] = np.nan
    holed[0, 1] = holed[4:, 1] = np.nan
    out = filled(holed, 0.02, 0.04)
    np.testing.assert_allclose(out[:, 0], stream[:, 0])
    assert np.isnan(out[[0, 4, 5], 1]).all()  # nothing is known beyond the ends
    assert np.isnan(filled(holed, 0.02, 0.02)[2:4, 0]).all()


def test_an_alarm_says_why_and_blames_missing_rows_on_nobody(monitor):
    def alarms(episode: Episode, bridge: float = 0.0) -> list[tuple[str, str]]:
        (trace,) = traces_of([Log("x", episode)], monitor, bridge)
        return [(a.why, a.channel) for a in alarms_of(trace)]

    assert alarms(log(100)) == []
    assert alarms(with_gap(50, 2)) == [("missing data", "")]
    assert alarms(with_gap(50, 2, column=1)) == [("missing data", "q[1]")]
    assert alarms(with_gap(50, 2), bridge=0.05) == []
    assert alarms(with_gap(50, 5), bridge=0.05) == [("missing data", "")]
    infinite = log(100).stream.copy()
    infinite[50, 0] = np.inf
    assert alarms(Episode.from_stream(infinite, log(0).spec), bridge=0.05) == [("not finite", "q[0]")]
    stuck = log(100).stream.copy()
    stuck[100:, 0] = stuck[100, 0]
    assert ("surprise", "q[0]") in alarms(Episode.from_stream(stuck, log(0).spec), bridge=0.05)


def test_a_healthy_log_with_a_few_blank_cells_raises_no_alarm_under_a_bridge(monitor):
    blank = log(100).stream.copy()
    blank[np.random.default_rng(0).random(blank.shape) < 0.01] = np.nan
    holes = np.isnan(blank).any(axis=1).sum()
    assert holes > 3
    (plain,), (over,) = (traces_of([Log("x", Episode.from_stream(blank, log(0).spec))], monitor, b) for b in (0, 0.05))
    assert len(alarms_of(plain)) == pytest.approx(holes, abs=2)
    assert alarms_of(over) == []


def test_rows_as_they_come_are_bridged_or_an_alarm_that_says_why(monitor):
    stream = log(100).stream.astype(float)

    def said(rows: np.ndarray, kept: np.ndarray, bridge: float) -> tuple[int, str]:
        lines = [
            json.dumps({"time": k / RATE, "q": row[:2].tolist(), "action": row[2:].tolist()}).replace("NaN", "null")
            for k, row in enumerate(rows)
            if kept[k]
        ]
        out = io.StringIO()
        return watch.follow(lines, monitor, Console(file=out, width=200), bridge), out.getvalue()

    every = np.ones(len(stream), bool)
    late = every.copy()
    late[60:62] = False
    assert said(stream, late, 0.05)[0] == 0
    code, text = said(stream, late, 0.0)
    assert code == 1
    assert "2 rows lost: an alarm (late)" in text
    holed = stream.copy()
    holed[80, 1] = np.nan
    assert said(holed, every, 0.05)[0] == 0
    assert "q[1]  inf thresholds" in said(holed, every, 0.0)[1]
    assert "(missing data)" in said(holed, every, 0.0)[1]


def test_reasons_and_blame_of_single_rows():
    assert reason(np.array([1.0, np.nan])) == "missing data"
    assert reason(np.array([1.0, np.inf])) == "not finite"
    assert reason(np.array([1.0, 2.0])) == "surprise"
    assert blamed(np.full(2, np.nan), np.zeros(2)) is None
    assert blamed(np.array([1.0, np.nan]), np.zeros(2)) == 1
    assert blamed(np.array([1.0, 2.0]), np.array([3.0, 1.0])) == 0
