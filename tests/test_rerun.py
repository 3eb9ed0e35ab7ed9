"""Recordings for Rerun's viewer: written by the command, opened again, and compared with what was watched."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from asm_gym.data.episode import save_episode
from asm_gym.monitors import make_monitor
from asm_gym.scripts.cli import main
from asm_gym.spec import MOTOR, Channel, StreamSpec
from tests.needs import needs
from tests.streams import swing

chunk = needs("rerun.chunk")  # of rerun-sdk 0.41

ARM = StreamSpec((Channel("q", 2, "rad"), Channel("torque", 1), Channel("cmd", 1, group=MOTOR)), dt=0.05)


def column(path, entity, kind="Scalars:scalars"):
    """(T, n) what a recording holds of an entity, row by row."""
    chunks = chunk.RrdReader(path).stream().to_chunks()
    of_entity = (c.to_record_batch() for c in chunks if c.entity_path.startswith(f"/{entity}"))
    return [row for batch in of_entity for row in batch[kind].to_pylist()]


@pytest.fixture(scope="module")
def asm():
    episode = partial(swing, ARM)
    small = {"hidden_size": 8, "association_size": 12, "epochs": 1}
    made = make_monitor("neural_asm", ARM, seed=0, **small).fit([episode(n) for n in range(12)])
    return made.calibrate([episode(100 + n) for n in range(19)], 0.05)


def test_a_log_is_written_for_the_viewer(asm, tmp_path):
    asm.save(tmp_path / "x.asm")
    rows = swing(ARM, 500).stream.copy()
    rows[40:, 0] += 1.0
    episode = replace(swing(ARM, 500), stream=rows)
    save_episode(tmp_path / "log.npz", episode)
    path = tmp_path / "made" / "log.rrd"
    options = ["--monitor", str(tmp_path / "x.asm"), "--out", str(tmp_path / "out"), "--rerun", str(path)]
    assert main(["watch", str(tmp_path / "log.npz"), *options]) == 1
    np.testing.assert_allclose(np.ravel(column(path, "surprise")), asm.score(episode).value)
    assert set(np.ravel(column(path, "threshold"))) == {asm.threshold}
    np.testing.assert_allclose(np.array(column(path, "senses/q"))[:, 0], rows[:, 0], rtol=1e-6)
    assert column(path, "log", "TextLog:text")[0][0].startswith("alarm: ")
