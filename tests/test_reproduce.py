"""The studies: their instruments against oracles, the direction of each claim on small data, and every quick run."""

from __future__ import annotations

import csv
import itertools
import json
import math
import re

import numpy as np
import pytest
from asm_gym.scripts.reproduce.laws import LAWS, fit

from asm_gym.scripts.cli import main as cli
from asm_gym.scripts.reproduce import (
    INDEPENDENT,
    STUDIES,
    kit,
    memorise_and_recall,
    speed_accuracy,
)
from asm_gym.scripts.reproduce.expression import (
    Backpropagated,
    ExpressionMemory,
    Hopfield,
    mean_demonstrations,
    recalled,
)
from asm_gym.scripts.reproduce.handwriting import NOISE, STEPS, copybook, repertoire
from asm_gym.scripts.reproduce.kit import Config, over_seeds, shown


def letters_of(count: int, each: int = 6, seed: int = 0) -> tuple[list, list]:
    rng = np.random.default_rng(seed)
    letters = repertoire(count, 2, rng)
    return copybook(letters, each, 2, rng), copybook(letters, 3, 2, rng)


def test_a_hopfield_network_completes_what_it_has_stored():
    train, _ = letters_of(3, each=1)
    streams = np.stack([e.stream for e in train], axis=1).astype(np.float64)
    made = Hopfield.learned(train, beta=1e5).express(streams, 10)
    np.testing.assert_allclose(made[1:], streams[1:], atol=1e-4)


def test_a_cold_hopfield_network_answers_with_the_mean():
    train, _ = letters_of(2)
    hopfield = Hopfield.learned(train, beta=0.0)
    np.testing.assert_allclose(hopfield.retrieve(np.ones((1, 20)))[0], hopfield.values.mean(axis=0), atol=1e-9)


def test_a_recurrent_rival_offline_reads_its_own_predictions():
    train, tests = letters_of(2)
    model = Backpropagated.learned(train, "gru", 16, np.random.default_rng(0), updates=5)
    streams = np.stack([e.stream for e in tests], axis=1).astype(np.float64)
    offline = model.express(streams, 20)
    np.testing.assert_allclose(offline[:20], model.express(streams, STEPS)[:20], atol=1e-5)
    np.testing.assert_array_equal(
        offline, model.express(np.where(np.arange(STEPS)[:, None, None] < 20, streams, 9.0), 20)
    )


def test_the_memory_recalls_each_letter_from_its_cue():
    train, tests = letters_of(2, each=8)
    memory = ExpressionMemory.learned(train, 32, np.random.default_rng(0), 4000)
    error, right = recalled(memory, tests, mean_demonstrations(train, 2), 20)
    streams = np.stack([e.stream for e in tests], axis=1)
    still = np.linalg.norm(streams[20:, :, :2] - streams[19, :, :2], axis=2).mean()
    assert right >= 5 / 6
    assert error < 0.5 * still


@pytest.mark.parametrize(
    ("law", "true"),
    [("exponential", (0.4, 1.5, 6.0)), ("fitts", (1.5, 6.0)), ("power", (0.2, 2.0, 0.7)), ("linear", (0.5, 0.3))],
)
def test_a_law_is_found_again_within_its_intervals(law, true):
    x = np.repeat([1.0, 2, 4, 8, 16, 32, 64, 128], 4)
    y = LAWS[law][0](x, *true) + 0.01 * np.random.default_rng(0).normal(size=len(x))
    found = fit(law, x, y)
    np.testing.assert_allclose(found.values, true, rtol=0.15)
    # Within twice the 95 % interval, which chance leaves once in ten thousand times.
    assert all(abs(v - t) <= hi - lo for v, t, lo, hi in zip(found.values, true, found.low, found.high, strict=True))
    if law != "linear":
        other = fit({"exponential": "power", "fitts": "power", "power": "exponential"}[law], x, y)
        assert found.aic < other.aic


def test_traces_need_no_inference_and_a_state_that_settles_trades_it_for_accuracy():
    args = speed_accuracy.Config(skills=2, hidden=32, writings=4, steps=2000, iterations=(1, 5, 30, 100))
    found = {}
    for dynamics in ("traces", "settling"):
        rng = np.random.default_rng(0)
        letters = repertoire(2, 2, rng)
        records = speed_accuracy.by_iterations(0, letters, args, rng, dynamics)
        steps = [r for r in records if r["dynamics"] == dynamics and "iterations" in r]
        found[dynamics] = {(r["iterations"], r["shorter"]): r for r in steps}
    completed = [r["completed_cm"] for r in found["traces"].values()]
    assert max(completed) < 3 * NOISE  # the traces lead there; the state adds little
    assert max(completed) < 1.1 * min(completed)
    assert len({r["next_cm"] for r in found["traces"].values()}) == 1  # to the bit: nothing is inferred
    settling = [found["settling"][at]["next_cm"] for at in ((1, 20), (5, 20), (30, 20), (100, 1))]
    assert all(later < sooner for sooner, later in itertools.pairwise(settling))
    assert settling[0] > 1.3 * settling[-1]
    assert found["settling"][100, 1]["auroc"] > 0.6


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
        ("speed_accuracy", ["--iterations", "1", "2"], "needs 4 different numbers of iterations"),
        ("speed_accuracy", ["--speeds", "1", "2", "9"], "3 different speeds from 0.2 to 4"),
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
        ({"dims": (3,)}, r"in 2 dimensions, or in 2 and 3, got \(3,\)"),
        ({"hidden": 3}, "at least the number of channels, 6, got 3"),
        ({"splines": 33}, "1 to 32 skills, got 33"),
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


# harm has tests of its own; the pages of harm and attack are checked by a quick run.
COUNTED = ("failure",)
"""Studies that count episodes; the others print a mean over seeds."""


@pytest.mark.slow
@pytest.mark.parametrize("study", [s for s in INDEPENDENT if s not in ("harm", "attack")])
def test_every_study_runs_from_end_to_end(study, tmp_path, capsys):
    assert cli(["reproduce", study, "--quick", "--workers", "1", "--seed", "3", "--out", str(tmp_path)]) == 0
    written = {p.name for p in tmp_path.iterdir()} - {f"{study}.gif"}  # one of them has a film
    promised = {f"{study}.{kind}" for kind in ("png", "svg", "csv", "md", "json")}
    assert promised <= written if study in COUNTED else promised == written  # those keep what they recorded
    kept = json.loads((tmp_path / f"{study}.json").read_text())
    assert kept["seed"] == 3
    assert kept["versions"].keys() >= {"asm_gym", "numpy", "torch"}
    with (tmp_path / f"{study}.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    table = (tmp_path / f"{study}.md").read_text()
    if study in COUNTED:
        assert rows
        assert " of " in table
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
