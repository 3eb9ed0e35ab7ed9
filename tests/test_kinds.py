"""Few and long logs: which pieces are unlike the others, and what a kind of move raises that was not learned from."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from asm_gym.scripts.cli import main
from asm_gym.scripts.unlike_pieces import kind_of, unlike


@pytest.mark.parametrize(
    ("maxima", "odd"),
    [
        ([1, 2, 3, 4, 5, 6, 7, 33], [7]),
        ([33, 2, 3, 4, 31, 6, 7, 5], [0, 4]),
        ([1, 2, 3, 4, 5, 6, 7, 8], []),
        ([1, 1, 1, 9, 9, 9, 9, 9], []),
        ([5.0], []),
    ],
)
def test_what_stands_apart_is_found_and_nothing_else(maxima, odd):
    assert unlike(np.array(maxima, float)).tolist() == odd


def test_a_kind_is_a_folder_or_else_a_log():
    assert [kind_of(log) for log in ("a.csv", "pick/a.csv", "pick/b.csv")] == ["a.csv", "pick", "pick"]


def write(path, seed, seconds, weight=1.0, jolt=None):
    rng, rows = np.random.default_rng(seed), int(seconds * 50)
    q = np.sin(np.outer(np.arange(rows) / 50, [1.0, 1.7]) + rng.uniform(0, 6, 2)) + 1e-3 * rng.normal(size=(rows, 2))
    torque = weight * 3 * q + 0.01 * rng.normal(size=q.shape)
    if jolt is not None:
        torque[int(50 * jolt) :][:10] += 5.0
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["time", "q_0", "q_1", "torque_0", "torque_1"])
        out.writerows(np.column_stack([np.arange(rows) / 50, q, torque]).tolist())


FIT = ["--monitor", "association_values+evidence", "--split", "2"]


def test_fit_names_the_piece_that_sets_the_threshold(tmp_path, capsys):
    for n in range(3):
        write(tmp_path / "logs" / f"{n}.csv", n, 60, jolt=45 if n == 1 else None)
    fit = ["fit", str(tmp_path / "logs"), "--out", str(tmp_path / "m.asm"), *FIT, "--false-alarms-per-hour", "80"]
    assert main(fit) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "1 of 42 pieces are unlike the others" in said
    assert "1.csv from 44 s" in said


def test_a_kind_that_was_left_out_is_surprising_where_it_differs(tmp_path, capsys):
    for kind, weight in (("empty", 1.0), ("light", 1.0), ("heavy", 2.0)):
        write(tmp_path / "logs" / kind / "a.csv", len(kind), 60, weight)
    fit = ["fit", str(tmp_path / "logs"), "--out", str(tmp_path / "m.asm"), *FIT, "--false-alarm-rate", "0.1"]
    assert main([*fit, "--leave-out"]) == 0
    said = {
        line.split()[2].rstrip(":"): line for line in capsys.readouterr().out.splitlines() if "Learned without" in line
    }
    assert set(said) == {"empty", "light", "heavy"}
    share = {kind: float(line.split(" min, ")[1].split(" %")[0]) for kind, line in said.items()}
    assert share["heavy"] > 50
    assert max(share["light"], share["empty"]) < 5


def test_a_long_log_is_learned_from_between_its_marked_rows(tmp_path, capsys):
    write(tmp_path / "log.csv", 0, 120)
    rows = (tmp_path / "log.csv").read_text().splitlines()
    marked = [f"{row},{'fault' if n == 0 else int(2500 <= n < 2550)}" for n, row in enumerate(rows)]
    (tmp_path / "log.csv").write_text("\n".join(marked))
    fit = ["fit", str(tmp_path / "log.csv"), "--out", str(tmp_path / "m.asm"), "--monitor", "kalman"]
    fit += ["--false-alarm-rate", "0.1"]
    assert main(fit) == 2
    assert "1 with a fault; --split 5 learns from between" in " ".join(capsys.readouterr().err.split())
    assert main([*fit, "--split", "1"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Learned from 54 episodes: 2700 rows" in said  # half of 44 pieces before the mark, 64 after it
    assert "with a fault" not in said


def test_a_threshold_that_is_refused_names_the_piece(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("asm_gym.monitors.blindness.MOST", 0.0)
    write(tmp_path / "log.csv", 0, 60)
    rows = [row.split(",") for row in (tmp_path / "log.csv").read_text().splitlines()]
    for row in rows[2701:2750]:
        row[1:] = [str(1e4 * float(cell)) for cell in row[1:]]
    (tmp_path / "log.csv").write_text("\n".join(map(",".join, rows)))
    fit = ["fit", str(tmp_path / "log.csv"), "--out", str(tmp_path / "m.asm"), *FIT[:2], "--split", "2"]
    assert main([*fit, "--false-alarms-per-hour", "200"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "could pass" in said
    assert "log.csv from 54 s" in said


def test_two_logs_of_different_columns_are_refused_in_one_line(tmp_path, capsys):
    for name, column in (("a", "torque"), ("b", "current")):
        rows = [f"{n / 50},{n % 7},{n % 3}" for n in range(100)]
        (tmp_path / f"{name}.csv").write_text("\n".join([f"time,q,{column}", *rows]))
    assert main(["fit", str(tmp_path), "--out", str(tmp_path / "m.asm"), "--split", "0.5"]) == 2
    said = capsys.readouterr().err.strip()
    assert "b.csv" in said
    assert "channels that are not there: torque" in " ".join(said.split())
    assert not (tmp_path / "m.asm").exists()
