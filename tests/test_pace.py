"""Which rows a memory reads from a source of its own rate, a faster one, and a slower one."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from rich.console import Console

from asm_gym.data.live import SourceDied
from asm_gym.data.pace import NEWEST, ClockWentBack, Pace
from asm_gym.monitors import make_monitor
from asm_gym.scripts.live_watching import follow
from asm_gym.spec import Channel, StreamSpec
from tests.streams import swing

SPEC = StreamSpec((Channel("q", 2, "rad"), Channel("torque", 2)), dt=0.02)


def read(stamps, dt=0.02):
    pace = Pace(dt)
    return [pace.lost(float(t)) for t in stamps], pace


def test_every_row_of_its_own_rate_is_read_however_it_jitters():
    rng = np.random.default_rng(0)
    stamps = 0.02 * (np.arange(500) + rng.uniform(-0.2, 0.2, 500))
    assert read(stamps)[0] == [0] * 500
    kept = np.delete(0.02 * np.arange(100), [50, 51])
    assert [n for n in read(kept)[0] if n] == [2]


def test_of_a_faster_source_rows_are_read_at_the_rate_of_the_memory():
    found, pace = read(0.005 * np.arange(800))
    after = found[NEWEST + 1 :]
    assert pace.kind == "faster"
    assert sum(n is not None for n in after) == pytest.approx(len(after) / 4, abs=1)
    assert not any(after)  # none of them was lost


def test_of_a_slower_source_nothing_is_judged_until_it_is_right_again():
    slow = 0.05 * np.arange(100)
    found, pace = read([*slow, *(slow[-1] + 0.02 * np.arange(1, 100))])
    assert pace.kind == "right"
    assert found[NEWEST:100] == [None] * (100 - NEWEST)
    assert found[-30:] == [0] * 30


def test_a_clock_that_goes_back_or_stands_is_told():
    with pytest.raises(ClockWentBack, match=r"time must increase, got 1 s after 2 s"):
        read([0.0, 2.0, 1.0])


@pytest.fixture(scope="module")
def monitor():
    made = make_monitor("kalman", SPEC).fit([swing(SPEC, n) for n in range(12)])
    return made.calibrate([swing(SPEC, 100 + n) for n in range(19)], 0.05)


def lines(stamps, rows, dies=False):
    for t, row in zip(stamps, np.resize(rows, (len(stamps), 4)), strict=True):
        yield json.dumps({"time": float(t), "q": row[:2].tolist(), "torque": row[2:].tolist()})
    if dies:
        raise SourceDied("nothing came")


def test_another_rate_is_said_once_and_is_an_alarm_where_it_is_slower(monitor):
    rows = swing(SPEC, 500).stream
    out = io.StringIO()
    assert follow(lines(0.05 * np.arange(200), rows), monitor, Console(file=out, width=200)) == 1
    assert out.getvalue().count("rows come at 20 a second, and the memory reads 50: they are not judged") == 1
    out = io.StringIO()
    follow(lines(0.01 * np.arange(200), np.repeat(rows, 2, axis=0)), monitor, Console(file=out, width=200))
    assert out.getvalue().count("rows come at 100 a second, and are read at 50, by their clock") == 1


def test_a_source_is_watched_anew_after_its_death_and_after_its_clock_went_back(monitor):
    rows, out = swing(SPEC, 501).stream, io.StringIO()
    opened = []

    def again():
        opened.append(1)
        if len(opened) == 1:
            raise ConnectionRefusedError
        return lines([5.0, 5.02, 1.0] if len(opened) == 2 else 0.02 * np.arange(20), rows)

    code = follow(lines(0.02 * np.arange(20), rows, dies=True), monitor, Console(file=out, width=200), 0.0, again, 5.0)
    said = out.getvalue()
    assert code == 1
    assert said.count("the source is back") == 2
    assert "time must increase, got 1 s after 5.02 s: an alarm, and a new beginning" in said
    assert "42 rows" in said
    with pytest.raises(ClockWentBack):
        follow(lines([5.0, 5.02, 1.0], rows), monitor, Console(file=io.StringIO()))


def test_what_does_not_come_back_is_said(monitor):
    out = io.StringIO()

    def again():
        raise OSError("no")

    source = lines(0.02 * np.arange(20), swing(SPEC, 502).stream, dies=True)
    follow(source, monitor, Console(file=out, width=200), 0.0, again, 0.3)
    assert "the source did not come back within 0.3 s" in out.getvalue()
