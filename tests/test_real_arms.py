"""The study of real arms, on files of the same shape."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from asm_gym.data.episode import Episode
from asm_gym.detection import ModelOutput
from asm_gym.monitors import CalibratedMonitor
from asm_gym.monitors.stream_model import StreamModel, no_context
from asm_gym.monitors.torque.arm_features import position_columns, torque_columns
from asm_gym.monitors.torque.body_model import BodyModel
from asm_gym.scripts.cli import main
from asm_gym.scripts.reproduce import arm_recordings
from asm_gym.scripts.reproduce.added_faults import (
    ADDED_FAULTS,
    NEWTONS,
    Piece,
    jacobian,
    with_fault,
)
from asm_gym.scripts.reproduce.arm_recordings import ARMS, SLIP_RAD
from asm_gym.scripts.reproduce.real_arms import (
    Job,
    examined,
    fault_result,
    monitor_row,
    noise_table,
    split,
)
from asm_gym.scripts.reproduce.torque_residuals import RESIDUAL, residual_table, residuals
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
    monkeypatch.setattr(arm_recordings, "read_joint_states", lambda path: pendulum_columns(1500))
    place = tmp_path / "arms" / ARMS["ur10"].place
    place.parent.mkdir(parents=True)
    place.touch()
    (tmp_path / "arms" / "urdf").mkdir()
    (tmp_path / "arms" / "urdf" / "ur10_robot.urdf").write_text(PENDULUMS)
    return tmp_path / "arms"


TWO_LINKS = BodyModel.of(PENDULUMS, ["position[0]", "position[1]"])


def test_faults_change_one_joint_from_the_onset_on_and_nothing_else():
    episode = Episode.from_table(pendulum_columns(200))
    piece = Piece(episode, 100, np.array([5.0, 5.0]), None, ARMS["ur10"])
    rng = np.random.default_rng(0)
    for kind in ("frozen", "slipped", "late", "step 20%", "step 10%"):
        found = with_fault(kind, piece, rng)
        changed = found.stream != episode.stream
        own = piece.columns(ADDED_FAULTS[kind].what)
        assert not changed[:100].any()
        assert changed[100:, own].any(axis=0).sum() == 1
        assert not np.delete(changed, np.arange(episode.spec.size)[own], axis=1).any()
        np.testing.assert_array_equal(found.faults, np.arange(200) >= 100)
    slid = with_fault("slipped", piece, rng).stream - episode.stream
    assert np.abs(slid).max() == pytest.approx(SLIP_RAD, rel=1e-3)
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
    piece = Piece(episode, 100, np.ones(2), TWO_LINKS, ARMS["ur10"])
    found = with_fault("push", piece, np.random.default_rng(0))
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


class TorqueByAngle(StreamModel):
    """Says that the torque of each joint is three times its angle, and averages over four rows."""

    kind = "torque_by_angle"
    window = 4

    @property
    def error_columns(self):
        return torque_columns(self.spec)

    def start(self, batch):
        return np.zeros((batch, self.window, 2))

    def predict(self, state, rows):
        angles = rows[:, position_columns(self.spec)]
        rest = (rows[:, self.error_columns] - 3.0 * angles) / np.array([0.2, 5.0])
        state = np.concatenate([state[:, 1:], rest[:, None]], axis=1)
        return state, ModelOutput(state.mean(axis=1), no_context(rows))


def test_a_residual_is_what_a_prediction_leaves_of_a_torque_in_its_own_unit():
    episode = Episode.from_table(pendulum_columns(200))
    torques = torque_columns(episode.spec)
    stream = episode.stream.astype(np.float64)
    rest = stream[:, torques] - 3.0 * stream[:, position_columns(episode.spec)]
    expected = pd.DataFrame(rest).rolling(4).mean()
    found = residuals(TorqueByAngle(episode.spec), episode, torques, np.ones(2))
    np.testing.assert_allclose(found, expected.iloc[-len(found) :], rtol=1e-6)
    assert 0 < len(found) < 200


def test_residuals_are_printed_for_arms_with_torques(folder):
    records = examined(Job("ur10", "friction_rule", 0, 0), folder)
    own = [record for record in records if record["kind"] == RESIDUAL]
    assert [record["joint"] for record in own] == ["1", "2"]
    assert residual_table(pd.DataFrame(records)).rows[0][0] == "friction_rule"


def test_a_quarter_without_a_threshold_is_left_out(folder, monkeypatch, caplog):
    def refuse(monitor, episodes, **rates):
        raise ValueError("the threshold came to 1e+09")

    monkeypatch.setattr(CalibratedMonitor, "calibrate", refuse)
    assert examined(Job("ur10", "kalman", 0, 3), folder) == []
    assert "kalman on quarter 3 of ur10: the threshold came to 1e+09" in caplog.text


def test_a_run_of_servos_is_cut_at_a_glitch_and_marked_rows_are_of_a_heated_servo(tmp_path):
    rng = np.random.default_rng(0)
    for run, faulty in (("20240101_000001", False), ("20240101_000002", True)):
        folder = tmp_path / "matlab_ros_2024" / run
        folder.mkdir(parents=True)
        for motor in range(1, 7):
            ranges = {"position": (100, 900), "temperature": (20, 60), "voltage": (7000, 7500)}
            data = pd.DataFrame({name: rng.integers(*r, 400) for name, r in ranges.items()})
            data["label"] = 0
            if motor == 3 and faulty:
                data.loc[100:149, "label"] = 1
            if motor == 5:  # each reading is a glitch
                data.loc[200, "position"] = 4096 + 500
                data.loc[201, "temperature"] = 255
                data.loc[202, "voltage"] = -25514
            data.to_csv(folder / f"data_motor_{motor}.csv", index=False)
    runs = arm_recordings.armpi_runs(tmp_path)
    assert [len(run["position[0]"]) for run in runs.healthy] == [150, 147]
    assert [int(run["label"].sum()) for run in runs.faulty["glitch"]] == [3, 3]
    assert [int(run["label"].sum()) for run in runs.faulty["heated"]] == [50]
    assert max(run["position[4]"].max() for run in runs.healthy) < 1000


def test_runs_of_hiro_hold_one_row_in_four_of_angles_force_and_torque(tmp_path):
    t = np.arange(40)[:, None] / 200
    for group, rows in (("success", 40), ("error", 32)):
        folder = tmp_path / group / "run-01"
        folder.mkdir(parents=True)
        np.savetxt(folder / "R_Angles.dat", np.hstack([t[:rows], t[:rows] + np.arange(6)]))
        np.savetxt(folder / "R_Torques.dat", np.hstack([t, 10 * t + np.arange(6)]), delimiter="\t")
    runs = arm_recordings.hiro_runs(tmp_path)
    good, failed = runs.healthy[0], runs.faulty["failed"][0]
    np.testing.assert_allclose(good["position[2]"], t[::4, 0] + 2)
    np.testing.assert_allclose(good["torque[1]"], 10 * t[::4, 0] + 4)
    assert len(failed["force[0]"]) == 8  # of the shorter file


def test_the_noise_of_runs_of_another_campaign_is_printed_beside_that_of_the_others(tmp_path):
    rng = np.random.default_rng(0)
    for group, noise in (("success", 0.01), ("error", 0.1)):
        folder = tmp_path / ARMS["hiro"].place / group / "run-01"
        folder.mkdir(parents=True)
        t = np.arange(8000)[:, None] / 200
        angles = np.sin(t * np.arange(1, 7) / 20)
        np.savetxt(folder / "R_Angles.dat", np.hstack([t, angles]))
        wrench = noise * rng.normal(size=(8000, 6))
        np.savetxt(folder / "R_Torques.dat", np.hstack([t, wrench]))
    table = noise_table(ARMS["hiro"], tmp_path)
    force = table.headings.index("force")
    assert float(table.rows[0][force]) == pytest.approx(0.01, rel=0.3)
    assert float(table.rows[1][force]) == pytest.approx(0.1, rel=0.3)


def test_pieces_are_dealt_out_once_and_no_more_is_learned_than_asked_for(folder):
    runs, _ = ARMS["ur10"].episodes(folder)
    tested = []
    for fold in range(4):
        use = split(Job("ur10", "kalman", 0, fold), runs)
        parts = [*use.learned, *use.calibration, *use.tested]
        assert len({piece.stream.tobytes() for piece in parts}) == len(parts) == 15
        tested += use.tested
    assert len({piece.stream.tobytes() for piece in tested}) == 15
    few = split(Job("ur10", "kalman", 0, 0, minutes=3.01 / 60), runs)
    assert len(few.learned) == 3
    assert len(few.tested) == 4


def test_a_fault_is_found_only_after_its_onset_and_without_an_alarm_before():
    class Unit:
        threshold = 1.0

    class Score:
        def __init__(self, value):
            self.value = np.array(value)

    spec = Episode.from_table(pendulum_columns(5)).spec
    is_faulty = np.array([False, False, False, True, True])
    clip = Episode.from_stream(np.zeros((5, spec.size), np.float32), spec, faults=is_faulty)
    found = fault_result(Unit(), "step", clip, Score([0, 0, 0.5, 0.9, 2]))
    assert found["found"]
    assert found["delay"] == pytest.approx(0.02)
    assert not fault_result(Unit(), "step", clip, Score([0, 2, 0.5, 0.9, 2]))["found"]


def test_labelled_stretches_are_told_from_those_found_by_chance():
    healthy = {"kind": "", "alarms": 6, "alarm_s": 0.0, "seconds": 3600.0, "excess": 0.5}
    labelled = {"kind": "heated", "added": False, "found": True, "seconds": 600.0, "excess": 2.0}
    common = {"promised": 6.0, "learned_min": 1.0, "delay": np.nan}
    records = pd.DataFrame([common | healthy, common | labelled, common | labelled])
    expected = 2 * (1 - np.exp(-1.0))  # six false alarms an hour, ten minutes each
    assert monitor_row("any", records, 0)["heated"] == f"2 of 2 ({expected:.1f} by chance)"


def test_from_more_minutes_a_monitor_finds_as_many_steps_or_more(monkeypatch, tmp_path):
    monkeypatch.setattr(arm_recordings, "SYNTHETIC_EPISODES", 160)
    arm_recordings.synthetic_runs.cache_clear()
    found = []
    for minutes in (0.5, 0.0):
        job = Job("synthetic", "association_values", 0, 0, minutes=minutes)
        records = pd.DataFrame(examined(job, tmp_path))
        steps = records[records.kind == "step 20%"]
        found.append(steps.found.mean())
    arm_recordings.synthetic_runs.cache_clear()
    assert found[1] >= found[0]
    assert found[1] > 0.5
