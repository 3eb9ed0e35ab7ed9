"""The studies: their instruments against oracles, the direction of each claim on small data, and every quick run."""

from __future__ import annotations

import csv
import json
import math
import re

import numpy as np
import pytest

from asm_gym.scripts.cli import main as cli
from asm_gym.scripts.reproduce import (
    INDEPENDENT,
    STUDIES,
    kit,
    memorise_and_recall,
)
from asm_gym.scripts.reproduce.handwriting import STEPS
from asm_gym.scripts.reproduce.kit import Config, over_seeds, shown


def test_a_difference_is_paired_by_seed_and_has_students_interval():
    records = [
        {"seed": s, "m": m, "x": x} for m, values in (("a", (3, 9, 6)), ("b", (2, 7, 3))) for s, x in enumerate(values)
    ]
    records.append({"seed": 3, "m": "a", "x": 100})  # nobody to compare it with
    found = kit.paired(records, "x", {"m": "a"}, {"m": "b"})
    half = 4.302653 / math.sqrt(3)  # of differences 1, 2 and 3, with two degrees of freedom
    assert found == pytest.approx((2.0, 2.0 - half, 2.0 + half))
    assert kit.paired(records[:1] + records[3:4], "x", {"m": "a"}, {"m": "b"}) == (1.0, -math.inf, math.inf)


def test_spread_is_over_seeds_and_not_over_measurements():
    records = [{"seed": s, "x": x, "kind": "a"} for s, xs in enumerate([(1, 3), (5, 7)]) for x in xs]
    assert over_seeds(records, "x", kind="a") == pytest.approx((4.0, math.sqrt(8)))
    assert shown(records, "x", 1, kind="a") == "4.0 ± 2.8"
    assert shown(records, "x", kind="b") == ""


@pytest.mark.parametrize(
    ("study", "arguments", "message"),
    [
        ("memorise_and_recall", ["--cues", "60"], "shorter than the letter, 1 to 59 steps, got 60"),
        ("memorise_and_recall", ["--repertoires", "0"], "1 to 32 skills, got 0"),
        ("memorise_and_recall", ["--seeds", "0"], "seeds must be at least 1, got 0"),
        ("local_learning", ["--skills", "0"], "1 to 32 skills, got 0"),
        ("local_learning", ["--hidden", "1"], "at least the number of channels, 4, got 1"),
        ("speed_accuracy", ["--speeds", "1", "9"], "speed must be .* 4"),
        ("speed_accuracy", ["--skills", "0"], "1 to 32 skills, got 0"),
        ("speed_accuracy", ["--budgets", "30"], "30 steps of inference a second is less than one for each of 60 rows"),
        ("speed_accuracy", ["--hidden", "3"], "at least the number of channels, 4, got 3"),
        ("memorise_and_recall", ["--repertoires"], "number of repertoires must be at least 1, got 0"),
    ],
)
def test_what_makes_no_sense_is_refused_in_words(study, arguments, message, capsys, tmp_path):
    assert cli(["reproduce", study, *arguments, "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert re.search(message, said), said
    assert not list(tmp_path.iterdir())


def test_an_unknown_study_is_refused_with_those_that_exist(capsys):
    assert cli(["reproduce", "everything"]) == 2
    assert "unknown study 'everything'; known: all, memorise_and_recall" in capsys.readouterr().err
    assert cli(["reproduce", "--help"]) == 0
    said = capsys.readouterr().out
    assert all(study in said for study in STUDIES)


def test_arguments_that_all_studies_share_are_checked():
    with pytest.raises(ValueError, match="workers must be at least 1, got 0"):
        Config(workers=0)
    with pytest.raises(ValueError, match="seed must be at least 0, got -1"):
        Config(seed=-1)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"cues": (10, STEPS)}, "cue must be shorter"),
        ({"hidden": 3}, "at least the number of channels, 4, got 3"),
    ],
)
def test_what_is_set_in_python_only_is_checked_too(wrong, message):
    with pytest.raises(ValueError, match=message):
        memorise_and_recall.Config(**wrong)


def test_a_folder_that_cannot_be_made_is_refused_before_the_study(tmp_path, capsys, monkeypatch):
    (tmp_path / "file").write_text("taken")
    monkeypatch.setattr(memorise_and_recall, "run", None)
    assert cli(["reproduce", "memorise_and_recall", "--out", str(tmp_path / "file")]) == 2
    assert "file" in capsys.readouterr().err


COUNTED = ("failure", "harm")
"""Studies that count episodes; the others print a mean over seeds and draw a figure."""


@pytest.mark.slow
@pytest.mark.parametrize("study", INDEPENDENT)
def test_every_study_runs_from_end_to_end(study, tmp_path, capsys):
    assert cli(["reproduce", study, "--quick", "--workers", "1", "--seed", "3", "--out", str(tmp_path)]) == 0
    written = {p.name for p in tmp_path.iterdir()}
    assert {f"{study}.{kind}" for kind in ("csv", "md", "json")} <= written
    kept = json.loads((tmp_path / f"{study}.json").read_text())
    assert kept["seed"] == 3
    assert kept["versions"].keys() >= {"asm_gym", "numpy", "torch"}
    with (tmp_path / f"{study}.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    table = (tmp_path / f"{study}.md").read_text()
    if study in COUNTED:
        assert rows
        assert "|" in table
    else:
        assert {r["seed"] for r in rows} >= {"3", "4"}
        assert "±" in table
        assert "±" in capsys.readouterr().out
        assert (tmp_path / f"{study}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_the_same_seed_gives_the_same_numbers(tmp_path):
    runs = []
    for folder in ("a", "b"):
        where = ["--workers", "1", "--out", str(tmp_path / folder)]
        assert cli(["reproduce", "local_learning", "--quick", *where]) == 0
        with (tmp_path / folder / "local_learning.csv").open(encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        runs.append(
            {seed: np.array([float(r["mse"]) for r in rows if r["seed"] == seed and r["mse"]]) for seed in "01"}
        )
    # To rounding, which depends on where arrays lie in memory, and can turn a close decision.
    again, other = np.abs(runs[0]["0"] - runs[1]["0"]).mean(), np.abs(runs[0]["0"] - runs[0]["1"]).mean()
    assert again < 0.1 * other
