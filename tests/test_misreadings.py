"""Numbers that a sense cannot have read, as a bus of servos returns them now and then."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asm_gym.data.episode import Episode
from asm_gym.detection.commands import healthy_commands
from asm_gym.detection.misreadings import misread, widened, without_misreadings
from asm_gym.monitors import NeuralASM, load_monitor

CELSIUS = 2  # column of the temperature


def servo_run(rng):
    """Return a run of two servos at 10 Hz, one of which becomes a degree warmer."""
    time = np.arange(100) / 10
    phases = rng.uniform(0, 6, 2)
    position = np.sin(time[:, None] + phases) + 0.01 * rng.normal(size=(100, 2))
    temperature = 30.0 + (time > rng.uniform(2, 8)) * rng.integers(-1, 2)
    return {"position": position, "temperature": temperature[:, None]}


@pytest.fixture(scope="module")
def runs():
    rng = np.random.default_rng(0)
    tables = [servo_run(rng) for _ in range(40)]
    tables[20]["position"][60:, 0] *= -1  # a jerk, as large as no servo's heat can surprise
    tables[21]["position"][70, 1] = 5.0  # healthy, though no run that is learned from went so far
    return Episode.from_tables(tables, rate=10.0)


@pytest.fixture(scope="module")
def memory(runs):
    asm = NeuralASM(runs[0].spec, hidden_size=8, association_size=16, epochs=1)
    return asm.fit(runs[:20]).calibrate(runs[20:35], false_alarm_rate=0.07)


def with_number(run, column, number, rows=1):
    """Return a run that reads a number for so many rows."""
    stream = run.stream.copy()
    stream[50 : 50 + rows, column] = number
    return Episode.from_stream(stream, run.spec)


@pytest.mark.parametrize(("column", "number"), [(CELSIUS, 255.0), (0, -30.0)])
def test_a_number_that_cannot_be_is_an_alarm(memory, runs, column, number, tmp_path):
    memory.save(tmp_path / "servos.asm")
    again = load_monitor(tmp_path / "servos.asm")
    for run in runs[35:]:
        wrong = with_number(run, column, number)
        for monitor in (memory, again):
            score = monitor.score(wrong)
            assert score.value[50] > monitor.threshold
            assert score.attribution[50].argmax() == column
            assert np.isfinite(np.delete(score.value, 50)).all()


def test_what_healthy_runs_read_is_no_misreading(memory, runs):
    healthy = memory.readings_
    assert np.isfinite(memory.threshold)
    for run in runs[:35]:
        assert without_misreadings(healthy, run.stream) is run.stream


def test_a_sense_that_stays_out_of_range_is_misread_once(memory, runs):
    stuck = memory.score(with_number(runs[36], CELSIUS, 255.0, rows=20))
    assert np.flatnonzero(np.isinf(stuck.value)).tolist() == [50]


@settings(deadline=None)
@given(seed=st.integers(0, 999), size=st.floats(0.1, 100))
def test_a_number_is_misread_where_it_is_out_of_range_and_its_step_is_too_large(seed, size):
    rng = np.random.default_rng(seed)
    healthy = healthy_commands([rng.normal(size=(50, 3))], np.arange(3))
    before, rows = size * rng.normal(size=(2, 20, 3))
    least, most, step = healthy.astype(np.float64)
    slack = 0.25 * (most - least)
    is_outside = (rows < least - slack) | (rows > most + slack)
    expected = is_outside & (np.abs(rows - before) > 2.0 * step + slack)
    np.testing.assert_array_equal(misread(healthy, before, rows), expected)
    assert not misread(healthy, np.full((20, 3), np.nan), rows).any()
    both = widened(healthy, healthy_commands([rows], np.arange(3)))
    assert not misread(both, before, rows).any()
    still = np.array([[1.0], [1.0], [0.0]])  # never moved
    assert not misread(still, np.ones((1, 1)), np.array([[9.0]])).any()
