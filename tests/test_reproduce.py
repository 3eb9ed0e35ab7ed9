"""The studies: what they count, what they refuse, and every quick run."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from asm_gym.evaluation.metrics import DetectionMetrics
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.rollouts.pretraining.body_evaluation import Scores, promises_table
from asm_gym.scripts.cli import main as cli
from asm_gym.scripts.reproduce import STUDIES, hours, kit, memorise_and_recall


def test_spread_is_over_seeds_and_not_over_measurements():
    records = [
        {"seed": s, "x": x, "kind": "a"} for s, xs in enumerate([(1, 3), (5, 7)]) for x in xs
    ]
    records.append({"seed": 0, "x": 1.0, "kind": "b", "when": "late"})
    table = kit.grid("", [{"when": "early"} | record for record in records], "x", "kind", "when", 1)
    assert table.headings == ["", "early", "late"]
    assert table.rows == [("a", "4.0 ± 2.8", ""), ("b", "", "1.0")]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("memorise_and_recall --cues 60", "cue must be .*59.*got 60"),
        ("memorise_and_recall --repertoires 0", "letters must be .*32.*got 0"),
        ("memorise_and_recall --seeds 0", "seeds must be at least 1, got 0"),
        ("repertoire --letters 1", "letters must be at least 2, got 1"),
        ("everything", "unknown study 'everything'; known: memorise_and_recall"),
    ],
)
def test_what_makes_no_sense_is_refused_in_words(arguments, message, capsys, tmp_path):
    assert cli(["reproduce", *arguments.split(), "--out", str(tmp_path)]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert re.search(message, said), said
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_made_is_refused_before_the_study(tmp_path, capsys, monkeypatch):
    (tmp_path / "file").write_text("taken")
    monkeypatch.setattr(memorise_and_recall, "run", None)
    assert cli(["reproduce", "memorise_and_recall", "--out", str(tmp_path / "file")]) == 2
    assert "file" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    "study", [study for study in STUDIES if study not in ("hours", "real_arms")]
)
def test_every_study_runs_from_end_to_end(study, tmp_path, capsys):
    assert (
        cli(
            ["reproduce", study, "--quick", "--workers", "1", "--seed", "3", "--out", str(tmp_path)]
        )
        == 0
    )
    kept = json.loads((tmp_path / f"{study}.json").read_text())
    assert kept["seed"] == 3
    assert kept["versions"].keys() >= {"asm_gym", "numpy", "torch"}
    with (tmp_path / f"{study}.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    table = (tmp_path / f"{study}.md").read_text()
    assert rows
    assert "|" in table
    if study in ("memorise_and_recall", "repertoire", "panda"):
        assert {r["seed"] for r in rows} >= {"3", "4"}
        assert "±" in table
        assert "±" in capsys.readouterr().out
    if study in ("repertoire", "panda"):
        assert (tmp_path / f"{study}.png").read_bytes().startswith(b"\x89PNG")


# ------------------------------------------------------------------ false alarms an hour


def ten_minutes(seed, peak, onset=None, severity=""):
    """A row a second, without surprise but for one row."""
    surprise = np.zeros(600)
    surprise[300 if onset is None else onset] = peak
    kind = "nominal" if onset is None else "push"
    return ScoredEpisode(
        kind, seed, 1.0, 0.0, surprise, onset=onset, task="Lift", severity=severity
    )


def test_each_promise_is_held_against_the_alarms_of_all_that_the_memory_never_met():
    solved = [ten_minutes(n, peak) for n, peak in enumerate([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])]
    severities = [(2.5, "strong"), (9.0, "medium"), (2.0, "mild")]
    faults = [ten_minutes(n, peak, 200, severity) for n, (peak, severity) in enumerate(severities)]
    marks = [
        Scores(
            "lift_sac", solved, [ten_minutes(9, 99.0)], DetectionMetrics("", faults, solved, 1.0)
        )
    ]
    table = promises_table(marks, {1.0: 4.5, 5.0: 1.5})
    assert "1.00 healthy hours" in table.caption
    assert [row[:2] for row in table.rows] == [("1", "4.5"), ("5", "1.5")]
    # peaks 5 and 6; peaks 2 to 6
    assert [row[2].split()[0] for row in table.rows] == [
        "2.0",
        "5.0",
    ]
    assert [row[-2:] for row in table.rows] == [
        ("50 % of 2", "0 % of 1"),
        ("100 % of 2", "100 % of 1"),
    ]
    severe = [marks[0]._replace(metrics=DetectionMetrics("", faults[:2], solved, 1.0))]
    assert [row[-1] for row in promises_table(severe, {1.0: 4.5, 5.0: 1.5}).rows] == [
        "50 % of 2",
        "100 % of 2",
    ]


def test_promises_over_halves_come_true_where_all_hours_are_alike():
    rng = np.random.default_rng(0)
    # 40 hours
    solved = [replace(ten_minutes(n, 0.0), surprise=rng.exponential(size=600)) for n in range(240)]
    faults = [ten_minutes(0, 99.0, 200, "strong"), ten_minutes(1, 0.5, 200, "strong")]
    table = hours.splits_table(
        [Scores("scripted", solved, [], DetectionMetrics("", faults, solved, 1.0))]
    )
    assert "40.0 healthy hours" in table.caption
    came = [float(cell.split()[0]) for cell in table.rows[0]]
    np.testing.assert_allclose(came, hours.PROMISES, rtol=0.25)
    assert all("50.0 ± 0.0 % found" in cell for cell in table.rows[0])
