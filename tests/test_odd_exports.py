"""Exports that are no plain table: read by what their tool means, or refused with what to do.

Each is rebuilt small from the recipe of its tool. Two joints swing; their motion is the oracle.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asm_gym.data.episode import Episode
from asm_gym.data.logs import read_logs
from asm_gym.data.reader_notes import LogWarning
from asm_gym.data.schema_inference import SchemaHints
from asm_gym.data.table_layout import MOST_BYTES, table_of
from asm_gym.data.text_files import read_text

ROWS = 120
NAMES = ["q1", "q2", "M1", "M2"]
pytestmark = pytest.mark.filterwarnings("default::asm_gym.data.reader_notes.LogWarning")


def motion(dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,) [s] of two swinging joints, and their angles and torques (T, 4)."""
    rng = np.random.default_rng(0)
    t = dt * np.arange(ROWS)
    phase = t[:, None] * [5.0, 8.0] + [0.3, 1.0]
    values = np.column_stack([np.sin(phase), 9.0 * np.cos(phase)])
    return t, values + 1e-3 * rng.normal(size=values.shape)


def read(path: Path, **hints: Any) -> Episode:
    ((_, episode),) = read_logs(path, SchemaHints(**hints))
    return episode


def written(path: Path, lines: list[str], end: str = "\n") -> Path:
    path.write_text(end.join(lines) + end)
    return path


# ------------------------------------------------------------------ refused


def with_commas(values: np.ndarray, digits: int) -> list[str]:
    """Rows of numbers with decimal commas, separated by commas."""
    return [",".join(f"{x:.{digits}f}".replace(".", ",") for x in row) for row in values]


@pytest.mark.parametrize("above", [[], ["Robot cell 3"], ["Operator,somebody", "Log of today"]])
def test_decimal_commas_between_commas_are_refused(above, tmp_path):
    t, values = motion(0.02)
    rows = with_commas(np.column_stack([t, values]), 4)
    path = written(tmp_path / "x.csv", [*above, "t,q1,q2,M1,M2", *rows])
    with pytest.raises(ValueError, match="decimal commas") as refused:
        read(path)
    assert "semicolons" in str(refused.value)
    assert "--columns" not in str(refused.value)


def test_times_of_whole_numbers_hide_no_decimal_commas(tmp_path):
    _, values = motion(0.02)
    rows = [f"{20 * n},{cells}" for n, cells in enumerate(with_commas(values, 3))]
    path = written(tmp_path / "x.csv", ["ms,q1,q2,M1,M2", *rows])
    with pytest.raises(ValueError, match="decimal commas"):
        read(path)


def test_whole_numbers_and_german_numbers_are_no_decimal_commas_between_commas(tmp_path):
    whole = written(tmp_path / "whole.csv", ["Version,2", "t,a,b", "0,1,2", "1,3,5", "2,4,9"])
    np.testing.assert_array_equal(read_text(whole)["b"], [2, 5, 9])
    german = written(tmp_path / "german.csv", ["t;a, left", "0,0;1,5", "0,1;2,5", "0,2;3,5"])
    np.testing.assert_array_equal(read_text(german)["a, left"], [1.5, 2.5, 3.5])


# ------------------------------------------------------------------ pictures


@pytest.mark.parametrize(
    "pictures",
    [
        np.zeros((ROWS, MOST_BYTES + 1), np.uint8),
        np.zeros((ROWS, MOST_BYTES + 1), np.int8),
        np.zeros((ROWS, 4, 4), np.float32),
        np.zeros((ROWS, 2, 2, 3), np.uint8),
    ],
)
def test_pictures_in_a_table_are_left_out_and_that_is_said(pictures):
    q = motion(0.02)[1][:, :2]
    with pytest.warns(LogWarning, match="camera.*pictures"):
        table = table_of({"q": q, "camera": pictures})
    assert list(table) == ["q[0]", "q[1]"]


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float32])
def test_arrays_of_few_bytes_or_of_other_types_are_no_pictures(dtype):
    size = MOST_BYTES if dtype == np.uint8 else MOST_BYTES + 1
    assert len(table_of({"skin": np.zeros((3, size), dtype)})) == size


# ------------------------------------------------------------------ times


@pytest.mark.parametrize("day", ["", "2026-11-24 "])
@pytest.mark.parametrize("separator", [";", "\t"])
def test_times_with_a_decimal_comma_are_a_clock(day, separator, tmp_path):
    t, values = motion(0.02)
    lines = [separator.join(["time", "q1", "q2"])]
    for moment, (a, b) in zip(t, values[:, :2], strict=True):
        cells = [f"{day}10:15:{moment:06.3f}", f"{a:.5f}", f"{b:.5f}"]
        lines.append(separator.join(cells).replace(".", ","))
    path = written(tmp_path / "x.csv", lines)
    assert read_text(path)["time"][1] == f"{day}10:15:00.020"
    episode = read(path)
    assert episode.spec.dt == pytest.approx(0.02)
    np.testing.assert_allclose(episode.stream, values[:, :2], atol=1e-4)


def test_times_with_a_decimal_comma_in_quotes_are_a_clock(tmp_path):
    t, values = motion(0.02)
    moments = [f'"10:15:{moment:06.3f}"'.replace(".", ",") for moment in t]
    rows = [f"{moment},{a:.5f}" for moment, a in zip(moments, values[:, 0], strict=True)]
    episode = read(written(tmp_path / "x.csv", ["time,q", *rows]))
    assert episode.spec.dt == pytest.approx(0.02)


def test_other_words_keep_their_commas(tmp_path):
    lines = ["t;state", "0,0;ok, so far", "0,1;stopped, at once", "0,2;ok"]
    words = read_text(written(tmp_path / "x.csv", lines))["state"]
    assert list(words) == ["ok, so far", "stopped, at once", "ok"]
