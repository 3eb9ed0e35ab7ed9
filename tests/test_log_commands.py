"""Which columns of a log were commanded, and which of them answer what is sensed."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from asm_gym.data.commands import REACTS, feedback, is_command
from asm_gym.data.logs import LogLayout, read_logs
from asm_gym.episode import Episode
from asm_gym.scripts.cli import main

RATE = 100.0


def arm(seed: int, rows: int = 1500) -> dict[str, np.ndarray]:
    """Three joints under a PD controller, that follow a plan against friction and pushes by chance."""
    rng = np.random.default_rng(seed)
    plan = np.sin(np.outer(np.arange(rows) / RATE, [1, 1.7, 2.3]) + rng.uniform(0, 6, 3))
    q, v, found = plan[0].copy(), np.zeros(3), []
    for k in range(rows):
        sensed = q + 1e-3 * rng.normal(size=3)
        torque = 100 * (plan[k] - sensed) - 10 * v
        found.append([*sensed, *(v + 1e-3 * rng.normal(size=3)), *torque])
        v = v + (torque - 0.5 * np.tanh(v / 0.05) + 0.3 * rng.normal(size=3)) / RATE
        q = q + v / RATE
    said = np.array(found)
    forward = 3 * np.sin(plan) + 0.2 * np.gradient(plan, axis=0) * RATE
    made = {"q": said[:, :3], "dq": said[:, 3:6], "output": said[:, 6:], "plan": plan, "forward": forward}
    return {**made, "rounded": np.round(plan, 3), "chance": rng.normal(size=(rows, 3))}


@pytest.fixture(scope="module")
def logs():
    return [arm(seed) for seed in range(3)]


def episodes(logs, command, late=0):
    return [
        Episode.from_table({"q": a["q"], "dq": a["dq"], "cmd": np.roll(a[command], late, axis=0)}, None, RATE, ["cmd"])
        for a in logs
    ]


@pytest.mark.parametrize("command", ["plan", "rounded", "forward", "chance"])
def test_a_plan_answers_nothing(logs, command):
    assert feedback(episodes(logs, command)) == {}


@pytest.mark.parametrize(("late", "least"), [(0, 3), (1, 2)])
def test_a_controllers_output_answers_what_is_sensed(logs, late, least):
    found = feedback(episodes(logs, "output", late))
    assert len(found) >= least
    assert all(share > REACTS for share in found.values())


def test_of_few_rows_or_no_command_nothing_is_said(logs):
    short = [{k: v[:200] for k, v in logs[0].items()}]
    assert feedback(episodes(short, "output")) == {}
    assert feedback([Episode.from_table({"q": logs[0]["q"]}, rate=RATE)]) == {}


@pytest.mark.parametrize(
    ("name", "commanded"),
    [
        ("target_q_0", True),
        ("Desired Torque", True),
        ("cmd", True),
        ("actual_q", False),
        ("motor_reference_3", True),
        ("preference", False),
        ("distance_to_goalkeeper", False),
    ],
)
def test_commands_go_by_their_names(name, commanded):
    assert is_command(name) is commanded


def write(path, columns):
    flat = {f"{n}_{j}": v[:, j] for n, v in columns.items() for j in range(3)}
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["time", *flat])
        rows.writerows(zip(np.arange(1500) / RATE, *flat.values(), strict=True))


def test_fit_says_what_it_takes_for_a_command_what_answers_and_what_none_costs(logs, tmp_path, capsys):
    for n, log in enumerate(logs):
        write(tmp_path / f"{n}.csv", {"q": log["q"], "target_q": log["plan"], "desired_torque": log["output"]})
    (first, *_) = read_logs(tmp_path, LogLayout(by_name=True))
    assert [first.episode.spec.labels[i] for i in first.episode.spec.motor][:1] == ["target_q[0]"]
    fit = ["fit", str(tmp_path), "--out", str(tmp_path / "m.asm"), "--monitor", "kalman", "--split", "1"]
    fit += ["--false-alarm-rate", "0.1"]
    assert main(fit) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "taken as commanded, by name: target_q, desired_torque" in said
    assert "desired_torque[0] answers what is sensed" in said
    assert "target_q[0] answers" not in said
    assert main([*fit, "--channels", "q_*"]) == 0
    assert "no command is on record" in " ".join(capsys.readouterr().out.split())
