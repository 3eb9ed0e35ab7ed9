"""Recordings for Rerun's viewer: written row by row, opened again, and compared with what was seen."""

from __future__ import annotations

import subprocess
import sys
from functools import partial

import numpy as np
import pytest

import asm_gym  # noqa: F401
from asm_gym.episode import save_episode
from asm_gym.evaluation.rerun_view import LiveView
from asm_gym.monitors import make_monitor
from asm_gym.scripts.cli import main
from asm_gym.spec import MOTOR, Channel, StreamSpec
from tests.fakes import SPEC
from tests.needs import needs
from tests.streams import swing

rerun = needs("rerun")

ARM = StreamSpec((Channel("q", 2, "rad"), Channel("torque", 1), Channel("cmd", 1, group=MOTOR)), dt=0.05)


def column(path, entity):
    """(T, n) what a recording holds of an entity, row by row."""
    recording = rerun.dataframe.load_recording(str(path))
    view = recording.view(index="time", contents=f"/{entity}/**").select()
    table = view.read_all()
    name = next(n for n in table.column_names if n.endswith(":Scalar") and entity in n)
    return np.array([row for row in table[name].to_pylist() if row is not None])


def origins(path):
    """What the views of a recording's blueprints show."""
    command = [sys.executable, "-m", "rerun", "rrd", "print", "-vvv", str(path)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return {name for name in ("log",) if f"[/{name}]" in said}


@pytest.fixture(scope="module")
def arm():
    episode = partial(swing, ARM)
    small = {"hidden_size": 8, "association_size": 12, "epochs": 1}
    made = make_monitor("neural_asm", ARM, seed=0, **small).fit([episode(n) for n in range(12)])
    return made.calibrate([episode(100 + n) for n in range(19)], 0.05), episode


def test_nearly_all_that_is_normal_lies_in_the_band_and_a_stuck_sense_leaves_it(arm, tmp_path):
    asm, episode = arm
    rows = episode(500).stream.copy()
    rows[40:, 0] += 1.0
    with LiveView(tmp_path / "a.rrd", ARM, asm.model, ["q"]) as view:
        for t, row in enumerate(rows):
            view.row(t * ARM.dt, row, 0.1, 1.0, np.zeros(4))
    low, high, sensed = (column(tmp_path / "a.rrd", f"senses/q/{what}")[:, 0] for what in ("low", "high", "sensed"))
    np.testing.assert_allclose(sensed, rows[:, 0], rtol=1e-6)
    inside = (low <= sensed) & (sensed <= high)
    assert inside[1:40].mean() > 0.8
    assert inside[41:].mean() < 0.2


def test_a_log_is_written_for_the_viewer_by_a_command(arm, tmp_path):
    asm, episode = arm
    asm.save(tmp_path / "x.asm")
    save_episode(tmp_path / "log.npz", episode(500))
    said = ["--monitor", str(tmp_path / "x.asm"), "--out", str(tmp_path / "out"), "--rerun", str(tmp_path / "log.rrd")]
    assert main(["watch", str(tmp_path / "log.npz"), *said]) in (0, 1)
    np.testing.assert_allclose(
        column(tmp_path / "log.rrd", "surprise").ravel(), asm.score(episode(500)).value, rtol=1e-9
    )
    assert origins(tmp_path / "log.rrd") == {"log"}


def test_what_cannot_be_drawn_is_refused(tmp_path):
    with pytest.raises(ValueError, match="unknown channel 'smell'; known: position, action"):
        LiveView(tmp_path / "x.rrd", SPEC, channels=["smell"])
