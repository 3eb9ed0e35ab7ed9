"""The study of real arms, on files of the same shape."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.data.episode import Episode
from asm_gym.scripts.cli import main
from asm_gym.scripts.reproduce import real_arms
from asm_gym.scripts.reproduce.real_arms import (
    ARMS,
    FAULTS,
    NEWTONS,
    PANDA,
    SLIP,
    UR10,
    Job,
    Kinematics,
    Piece,
    examined,
    jacobian,
    with_fault,
)
from tests.streams import pendulum_columns

TWO_LINKS = Kinematics((0.4, 0.4), (0.0, 0.0), (0.0, 0.0), False)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a recording of the UR10 alone, which has two joints here."""
    monkeypatch.setattr(real_arms, "read_joint_states", lambda path: pendulum_columns(1500))
    monkeypatch.setitem(ARMS, "ur10", ARMS["ur10"]._replace(links=TWO_LINKS))
    place = tmp_path / "arms" / ARMS["ur10"].place
    place.parent.mkdir(parents=True)
    place.touch()
    return tmp_path / "arms"


def test_faults_change_one_joint_from_the_onset_on_and_nothing_else():
    episode = Episode.from_table(pendulum_columns(200))
    piece, rng, slices = (
        Piece(episode, 100, np.array([5.0, 5.0]), TWO_LINKS),
        np.random.default_rng(0),
        episode.spec.slices,
    )
    for kind in ("frozen", "slipped", "late", "step"):
        found = with_fault(kind, piece, rng)
        changed = found.stream != episode.stream
        own = slices[FAULTS[kind]]
        assert not changed[:100].any()
        assert changed[100:, own].any(axis=0).sum() == 1
        assert not np.delete(changed, np.arange(episode.spec.size)[own], axis=1).any()
        np.testing.assert_array_equal(found.faults, np.arange(200) >= 100)
    slid = with_fault("slipped", piece, rng).stream - episode.stream
    assert np.abs(slid).max() == pytest.approx(SLIP, rel=1e-3)


def test_a_push_does_the_work_of_its_force():
    q = np.tile(np.array([0.3, -0.4, 0.2, -1.8, 0.1, 1.5, 0.6]), (100, 1)) + 0.01 * np.arange(100)[:, None]
    rng = np.random.default_rng(0)
    velocity, effort = rng.normal(size=(2, *q.shape))
    episode = Episode.from_table({"position": q, "velocity": velocity, "effort": effort}, rate=50.0)
    found = with_fault("push", Piece(episode, 50, np.ones(7), PANDA), np.random.default_rng(0))
    torque = (found.stream - episode.stream)[-1, episode.spec.slices["effort"]].astype(float)
    force = np.linalg.lstsq(jacobian(PANDA, q[-1]).T, torque, rcond=None)[0]
    assert np.linalg.norm(force) == pytest.approx(NEWTONS, rel=1e-4)
    assert force[2] == pytest.approx(0.0, abs=1e-3)


def test_kinematics_are_those_of_two_links_and_of_the_simulated_panda():
    a, b = 0.3, 0.9
    first, second = 0.4 * np.array([-np.sin(a), np.cos(a), 0]), 0.4 * np.array([-np.sin(a + b), np.cos(a + b), 0])
    np.testing.assert_allclose(jacobian(TWO_LINKS, [a, b]).T, [first + second, second], atol=1e-12)
    stretched = jacobian(UR10, np.zeros(6))  # along x, its axes about y
    np.testing.assert_allclose(np.linalg.norm(stretched[:, 0]), np.hypot(0.612 + 0.5723, 0.163941 + 0.0922), rtol=1e-6)
    np.testing.assert_allclose(jacobian(PANDA, np.zeros(7))[:, 0], [0.0, 0.088, 0.0], atol=1e-9)  # upright


def test_the_study_runs_on_files_of_the_same_shape_and_names_a_missing_one(folder, tmp_path, capsys):
    out = [
        "--out",
        str(tmp_path / "out"),
        "--workers",
        "1",
        "--monitors",
        "association_values",
        "friction_rule",
    ]
    assert main(["reproduce", "real_arms", str(folder), *out, "--experiments", "ur10", "panda"]) == 0
    text = (tmp_path / "out" / "real_arms.md").read_text()
    assert "UR10" in text
    assert "panda_exciting_trajectory.db3 is missing: it is unisa-acg" in text
    assert main(["reproduce", "real_arms", str(tmp_path), *out]) == 2
    assert "is missing: it is unisa-acg/inverse-dynamics-solver" in capsys.readouterr().err


INERTIAL = """<inertial><origin xyz="0.4 0 0"/><mass value="1"/>
<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>"""
PENDULUMS = f"""<robot name="two"><link name="base"/><link name="upper">{INERTIAL}</link>
<link name="lower">{INERTIAL}</link>
<joint name="a" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
<joint name="b" type="continuous"><parent link="upper"/><child link="lower"/><origin xyz="0.4 0 0"/><axis xyz="0 1 0"/>
</joint></robot>"""


def test_the_study_gives_monitors_a_body_model_or_names_the_missing_file(folder, tmp_path, capsys):
    out = ["--out", str(tmp_path / "out"), "--experiments", "ur10", "--workers", "1"]
    command = ["reproduce", "real_arms", str(folder), *out, "--monitors", "association_values, body"]
    assert main(command) == 2
    assert "ur10_robot.urdf is missing: it is in example-robot-data" in capsys.readouterr().err
    (folder / "urdf").mkdir()
    (folder / "urdf" / "ur10_robot.urdf").write_text(PENDULUMS)
    assert main(command) == 0
    assert "| association_values, body |" in (tmp_path / "out" / "real_arms.md").read_text()


def test_every_monitor_meets_the_same_faults(folder):
    one, other = ([r["kind"] for r in examined(Job("ur10", m, 0, 1), folder)] for m in ("kalman", "friction_rule"))
    assert one == other
    assert set(one) == {*FAULTS, ""}
