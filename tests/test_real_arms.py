"""The study of real arms, on files of the same shape."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.data.episode import Episode
from asm_gym.monitors.torque.body_model import BodyModel
from asm_gym.scripts.cli import main
from asm_gym.scripts.reproduce import real_arms
from asm_gym.scripts.reproduce.real_arms import (
    ADDED_FAULTS,
    ARMS,
    NEWTONS,
    SLIP,
    Job,
    Piece,
    examined,
    jacobian,
    with_fault,
)
from tests.streams import pendulum_columns

INERTIAL = """<inertial><origin xyz="0.4 0 0"/><mass value="1"/>
<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>"""
PENDULUMS = f"""<robot name="two"><link name="base"/><link name="upper">{INERTIAL}</link>
<link name="lower">{INERTIAL}</link>
<joint name="a" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
<joint name="b" type="continuous"><parent link="upper"/><child link="lower"/><origin xyz="0.4 0 0"/><axis xyz="0 1 0"/>
</joint></robot>"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a recording of the UR10 alone, which has two joints here."""
    monkeypatch.setattr(real_arms, "read_joint_states", lambda path: pendulum_columns(1500))
    place = tmp_path / "arms" / ARMS["ur10"].bag
    place.parent.mkdir(parents=True)
    place.touch()
    (tmp_path / "arms" / "urdf").mkdir()
    (tmp_path / "arms" / "urdf" / "ur10_robot.urdf").write_text(PENDULUMS)
    return tmp_path / "arms"


TWO_LINKS = BodyModel.of(PENDULUMS, ["position[0]", "position[1]"])


def test_faults_change_one_joint_from_the_onset_on_and_nothing_else():
    episode = Episode.from_table(pendulum_columns(200))
    piece, rng, slices = (
        Piece(episode, 100, np.array([5.0, 5.0]), None),
        np.random.default_rng(0),
        episode.spec.slices,
    )
    for kind in ("frozen", "slipped", "late", "step"):
        found = with_fault(kind, piece, rng)
        changed = found.stream != episode.stream
        own = slices[ADDED_FAULTS[kind].column]
        assert not changed[:100].any()
        assert changed[100:, own].any(axis=0).sum() == 1
        assert not np.delete(changed, np.arange(episode.spec.size)[own], axis=1).any()
        np.testing.assert_array_equal(found.faults, np.arange(200) >= 100)
    slid = with_fault("slipped", piece, rng).stream - episode.stream
    assert np.abs(slid).max() == pytest.approx(SLIP, rel=1e-3)
    assert with_fault("push", piece, rng) is None  # motor currents say nothing of newtons


def test_a_push_does_the_work_of_its_force_at_the_outermost_link():
    a, b = 0.3, 0.9
    # about y: x and z of the end of the first link, where the second is
    moved = jacobian(TWO_LINKS, np.array([a, b]))
    np.testing.assert_allclose(
        moved[:, 0], 0.4 * np.array([-np.sin(a), 0.0, -np.cos(a)]), atol=1e-12
    )
    np.testing.assert_allclose(moved[:, 1], 0.0, atol=1e-12)
    episode = Episode.from_table(pendulum_columns(200))
    found = with_fault("push", Piece(episode, 100, np.ones(2), TWO_LINKS), np.random.default_rng(0))
    torque = (found.stream - episode.stream)[-1, episode.spec.slices["effort"]].astype(float)
    along = jacobian(TWO_LINKS, episode.stream[-1, episode.spec.slices["position"]].astype(float))[
        0, 0
    ]
    assert 0.0 < abs(torque[0] / along) <= NEWTONS


def test_the_study_runs_on_files_of_the_same_shape_and_names_a_missing_one(
    folder, tmp_path, capsys
):
    out = [
        "--out",
        str(tmp_path / "out"),
        "--workers",
        "1",
        "--monitors",
        "association_values",
        "friction_rule",
    ]
    assert (
        main(["reproduce", "real_arms", str(folder), *out, "--experiments", "ur10", "panda"]) == 0
    )
    text = (tmp_path / "out" / "real_arms.md").read_text()
    assert "UR10" in text
    assert "panda_exciting_trajectory.db3 is missing: it is unisa-acg" in text
    assert main(["reproduce", "real_arms", str(tmp_path), *out]) == 2
    assert "is missing: it is unisa-acg/inverse-dynamics-solver" in capsys.readouterr().err


def test_the_study_gives_monitors_a_body_model_or_names_the_missing_file(folder, tmp_path, capsys):
    out = ["--out", str(tmp_path / "out"), "--experiments", "ur10", "--workers", "1"]
    command = [
        "reproduce",
        "real_arms",
        str(folder),
        *out,
        "--monitors",
        "association_values, body",
    ]
    assert main(command) == 0
    assert "| association_values, body |" in (tmp_path / "out" / "real_arms.md").read_text()
    (folder / "urdf" / "ur10_robot.urdf").unlink()
    assert main(command) == 2
    assert "ur10_robot.urdf is missing: it is in example-robot-data" in capsys.readouterr().err


def test_every_monitor_meets_the_same_faults(folder):
    one, other = (
        [r["kind"] for r in examined(Job("ur10", m, 0, 1), folder)]
        for m in ("kalman", "friction_rule")
    )
    assert one == other
    assert set(one) == {*ADDED_FAULTS, ""}
