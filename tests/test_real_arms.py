"""The study of real arms, on files of the same shape; and its kinematics, against finite differences and energy."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asm_gym.data.selection import pieces
from asm_gym.detection import EvidenceDetection
from asm_gym.detection.scores import Largest
from asm_gym.episode import Episode
from asm_gym.monitors import CalibratedMonitor, NeuralASM, load_monitor, make_monitor
from asm_gym.monitors.base import Surprise
from asm_gym.monitors.baselines.arm_inputs import forces, motion, speeds
from asm_gym.monitors.baselines.association_values import ValueAssociation
from asm_gym.monitors.baselines.friction_rule import FrictionRule
from asm_gym.monitors.monitor import MonitorState
from asm_gym.monitors.values import Values
from asm_gym.scripts.cli import main
from asm_gym.scripts.reproduce.arm_recordings import ARMS, read_cobot, read_executions
from asm_gym.scripts.reproduce.pushed import FAULTS, NEWTONS, SLIP, TABLES, _about_x, _about_z, jacobian
from asm_gym.scripts.reproduce.real_arms import Config, Job, on_an_arm
from asm_gym.spec import Channel, StreamSpec

REAL = Path(os.environ.get("ASM_GYM_REAL", "/nowhere"))
real = pytest.mark.skipif(not REAL.is_dir(), reason="ASM_GYM_REAL names no folder of recordings of real arms")


def arm(rows: int = 6000, rate: float = 100.0, seed: int = 0) -> dict[str, np.ndarray]:
    """A pendulum of two joints: friction with a sign, weight, inertia, noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows) / rate
    w = np.array([[1.1, 2.3], [0.7, 1.9]])
    q = sum(np.sin(np.outer(t, w[:, k]) + k) for k in range(2))
    dq = sum(w[:, k] * np.cos(np.outer(t, w[:, k]) + k) for k in range(2))
    ddq = -sum(w[:, k] ** 2 * np.sin(np.outer(t, w[:, k]) + k) for k in range(2))
    effort = 5 * np.sin(q) + 2 * np.tanh(dq / 0.02) + 0.3 * dq + 0.2 * ddq
    return {
        "time": t,
        "position": q + 1e-4 * rng.normal(size=q.shape),
        "velocity": dq + 1e-3 * rng.normal(size=q.shape),
        "effort": effort + 0.05 * rng.normal(size=q.shape),
    }


def tiago(folder: Path, rows: int = 1500) -> Path:
    """Three files, as TIAGo's."""
    columns = arm(rows)
    (folder / "tiago_figaroh").mkdir(parents=True)
    for kind in ("position", "velocity", "effort"):
        lines = [f"{t},{a},{b}" for t, (a, b) in zip(columns["time"], columns[kind], strict=True)]
        text = "\n".join([f"t,- arm_1_joint_{kind},- arm_2_joint_{kind}", *lines])
        (folder / "tiago_figaroh" / f"tiago_{kind}.csv").write_text(text + "\n")
    return folder


@pytest.mark.parametrize("model", TABLES)
def test_a_jacobian_is_the_change_of_the_hand_by_each_joint(model):
    table = TABLES[model]

    def hand(q: np.ndarray) -> np.ndarray:
        pose = np.eye(4)
        for a, d, alpha, angle in zip(table.a, table.d, table.alpha, q, strict=True):
            turn, link = _about_z(angle, d), _about_x(alpha, a)
            pose = pose @ link @ turn if table.modified else pose @ turn @ link
        return pose[:3, 3]

    q = np.random.default_rng(0).uniform(-1.5, 1.5, len(table.a))
    h = 1e-6
    numeric = np.stack([(hand(q + h * e) - hand(q - h * e)) / (2 * h) for e in np.eye(len(q))], axis=1)
    np.testing.assert_allclose(jacobian(table, q), numeric, atol=1e-8)


def test_a_panda_that_is_stretched_out_reaches_as_far_as_its_data_sheet_says():
    # At q = 0 the flange of a Panda stands 0.088 m before its base; its shoulder is 0.333 m up.
    table = TABLES["panda"]
    pose = np.eye(4)
    for a, d, alpha in zip(table.a, table.d, table.alpha, strict=True):
        pose = pose @ _about_x(alpha, a) @ _about_z(0.0, d)
    np.testing.assert_allclose(pose[:3, 3], [0.088, 0.0, 0.333 + 0.316 + 0.384 - 0.107 - 0.1034], atol=1e-9)


def test_faults_change_what_they_say_from_the_onset_on_and_nothing_else():
    whole = Episode.from_table(arm(200))
    piece = replace(whole, info={"effort_range": [5.0, 5.0]})
    without = replace(ARMS["tiago"], model="")
    rng = np.random.default_rng(0)
    slices = piece.spec.slices
    for kind, channel in (("frozen", "position"), ("slipped", "position"), ("late", "effort"), ("step", "effort")):
        found = FAULTS[kind](piece, 100, without, rng)
        changed = found.stream != piece.stream
        assert not changed[:100].any()
        assert changed[100:, slices[channel]].any(axis=0).sum() == 1
        assert not np.delete(changed, np.arange(piece.spec.size)[slices[channel]], axis=1).any()
        np.testing.assert_array_equal(found.faults, np.arange(200) >= 100)
    assert FAULTS["push"](piece, 100, without, rng) is None
    slid = FAULTS["slipped"](piece, 100, without, rng).stream - piece.stream
    assert np.abs(slid).max() == pytest.approx(SLIP, rel=1e-3)


def test_a_push_does_the_work_of_its_force():
    q = np.tile(np.array([0.3, -0.4, 0.2, -1.8, 0.1, 1.5, 0.6]), (100, 1)) + 0.01 * np.arange(100)[:, None]
    columns = {"position": q, "velocity": q, "effort": np.zeros_like(q)}
    piece = Episode.from_table(columns, rate=50.0)
    found = FAULTS["push"](piece, 50, ARMS["panda"], np.random.default_rng(0))
    torque = found.stream[-1, piece.spec.slices["effort"]].astype(float)
    J = jacobian(TABLES["panda"], q[-1])
    force = np.linalg.lstsq(J.T, torque, rcond=None)[0]
    assert np.linalg.norm(force) == pytest.approx(NEWTONS, rel=1e-4)
    assert force[2] == pytest.approx(0.0, abs=1e-3)


def test_values_are_told_from_the_others_with_friction_and_sines_and_not_without():
    whole = Episode.from_table(arm())
    cut = pieces(whole, 1.0)
    effort = slice(4, 6)

    def told(**options: bool) -> np.ndarray:
        model = ValueAssociation(whole.spec, **options)
        model.fit(cut, np.random.default_rng(0), lambda done, total: None)
        return model.learned_["R2_values"][effort]

    assert told().min() > 0.99
    assert told(friction=False).max() < told().min()
    assert told(body=False).max() < told().min()


def test_a_held_push_is_found_by_values_and_explained_away_by_changes():
    whole = Episode.from_table(arm())
    cut = pieces(whole, 1.0)
    faulty = [pushed(piece, 1.0) for piece in cut[45:]]
    found = {}
    for name in ("association_values+evidence", "association_linear+evidence"):
        monitor = make_monitor(name, whole.spec).fit(cut[:30]).calibrate(cut[30:45], 0.07)
        scores = monitor.score_episodes(faulty)
        found[name] = np.mean([(s.value[90:] > monitor.threshold).any() for s in scores])
    assert found["association_values+evidence"] > 0.9
    assert found["association_linear+evidence"] < found["association_values+evidence"]


def pushed(piece: Episode, size: float) -> Episode:
    """From its middle on the first torque is so much more [N m], in a fifth of a second."""
    stream, half = piece.stream.copy(), len(piece) // 2
    stream[half:, 4] += size * np.minimum(1.0, np.arange(len(piece) - half) / 20)
    return Episode.from_stream(stream, piece.spec)


def test_torques_are_judged_however_well_they_are_told_and_where_an_arm_may_go_is_not():
    columns = arm(3000)
    columns["effort"][:, 1] = 0.05 * np.random.default_rng(1).normal(size=3000)  # nothing tells it
    cut = pieces(Episode.from_table(columns), 1.0)
    model = ValueAssociation(cut[0].spec, changes=False).fit(cut, np.random.default_rng(0), lambda done, total: None)
    assert forces(cut[0].spec).tolist() == model.error_columns.tolist() == [4, 5]
    assert motion(cut[0].spec).tolist() == [0, 1, 2, 3]
    assert model.learned_["R2_values"][5] < 0.5


def test_an_error_far_from_what_was_learned_counts_for_less():
    whole = Episode.from_table(arm(3000))
    cut = pieces(whole, 1.0)
    model = ValueAssociation(whole.spec, changes=False).fit(cut, np.random.default_rng(0), lambda done, total: None)
    state = model.start(1)
    for row in whole.stream[:20].astype(np.float64):
        state, _ = model.predict(state, row[None])
    inside = np.ones((1, model.learned_["D"].shape[1]))
    inside[:, :-1] = 0.0  # the middle of all that was shown
    assert model._farther(inside).max() == 1.0
    z = np.hstack([np.full((1, inside.shape[1] - 1), 30.0), np.ones((1, 1))])
    far = model.learned_["far"][0]
    assert model._farther(z)[0, 0] == pytest.approx(np.sqrt(z[0] @ far @ z[0]))
    assert model._farther(2 * z)[0, 0] == pytest.approx(2 * model._farther(z)[0, 0])


def test_a_memory_judges_values_beside_changes_and_keeps_both(tmp_path):
    cut = pieces(Episode.from_table(arm()), 1.0)
    faulty = [pushed(piece, 1.0) for piece in cut[45:]]
    found = {}
    for values in (False, True):
        asm = NeuralASM(cut[0].spec, hidden_size=16, association_size=32, epochs=2, values=values)
        asm.fit(cut[:30]).calibrate(cut[30:45], 0.07)
        found[values] = np.mean([(s.value[90:] > asm.threshold).any() for s in asm.score_episodes(faulty)])
        asm.save(tmp_path / "x.asm")
        again = load_monitor(tmp_path / "x.asm")
        np.testing.assert_array_equal(again.score(faulty[0]).value, asm.score(faulty[0]).value)
    assert found[True] > 0.9 > found[False]
    score = asm.score(faulty[0])
    np.testing.assert_allclose(score.attribution.sum(axis=1), score.value)
    assert np.argmax(score.attribution[-1]) == 4
    assert asm.values_.monitor is not None
    body = asm.values_.monitor.score(faulty[0]).value
    assert (score.value >= body).all()


def test_changes_count_for_less_as_the_variance_of_a_regression_in_a_fresh_row_says():
    cut = pieces(Episode.from_table(arm(3000)), 1.0)
    values = Values.learned(cut[:20], seed=0)
    assert values.monitor is not None
    senses = values.monitor.model.senses_
    z = [np.hstack([senses.read_episode(e.stream).inputs, np.ones((len(e), 1))]) for e in (*cut[:20], cut[25])]
    shown, asked = np.concatenate(z[:-1]).astype(np.float64), z[-1].astype(np.float64)
    inverse = np.linalg.inv(shown.T @ shown + 1e-2 * len(shown) * np.eye(shown.shape[1]))
    h, usual = (np.einsum("ni,ij,nj->n", rows, inverse, rows) for rows in (asked, shown))
    root = np.sqrt(np.maximum(1.0, (1.0 + 10 * h) / (1.0 + 10 * np.median(usual))))  # a tenth of a second is 10 rows
    one = Surprise(np.ones(1), np.full((1, 6), 1 / 6))
    state, found = values.start(1), []
    for row in cut[25].stream.astype(np.float64):
        found.append(values._farther(state, row[None])[0])
        now, judged = values.step(state, row[None], MonitorState((), ()), one)
        state = now.values
        assert judged.value[0] >= 1 / found[-1] - 1e-12
    lag = senses.lag
    np.testing.assert_allclose(found[:lag], 1.0)  # no change is known yet
    np.testing.assert_allclose(found[lag:], root[lag:], rtol=1e-4)
    arrays = {name.removeprefix("values."): array for name, array in values.arrays.items()}
    again = Values.found(cut[0].spec, arrays, seed=0)
    np.testing.assert_array_equal(again.far, values.far)
    older = Values.found(cut[0].spec, {n: a for n, a in arrays.items() if n not in ("leverage", "usual")}, seed=0)
    assert older._farther(older.start(1), cut[0].stream[:1].astype(np.float64)) == pytest.approx([1.0])
    with pytest.raises(ValueError, match="the leverage of values should be of shape"):
        Values.found(cut[0].spec, arrays | {"leverage": np.eye(3)}, seed=0)


def test_a_memory_of_what_nothing_tells_judges_changes_alone():
    rng = np.random.default_rng(0)
    spec = StreamSpec((Channel("a", 1), Channel("b", 1)), dt=0.05)
    episodes = [Episode.from_stream(rng.normal(size=(60, 2)), spec) for _ in range(10)]
    asm = NeuralASM(spec, hidden_size=8, association_size=8, epochs=1, values=True).fit(episodes)
    assert asm.values_.monitor is None


def test_it_is_saved_and_says_the_same_again(tmp_path):
    cut = pieces(Episode.from_table(arm(3000)), 1.0)
    monitor = make_monitor("association_values+evidence", cut[0].spec).fit(cut)
    monitor.save(tmp_path / "x.asm")
    again = load_monitor(tmp_path / "x.asm")
    np.testing.assert_array_equal(again.score(cut[3]).value, monitor.score(cut[3]).value)
    assert isinstance(monitor.detection, EvidenceDetection)


def test_speeds_are_known_by_name_or_are_changes_of_positions():
    spec = Episode.from_table(arm(100)).spec
    assert speeds(spec)[0].tolist() == [2, 3]
    columns = {"position": np.zeros((9, 2)), "current": np.zeros((9, 2))}
    assert speeds(Episode.from_table(columns, rate=10).spec) == (pytest.approx([0, 1]), True)


def test_the_rule_takes_friction_from_torque_and_needs_a_speed():
    columns = arm()
    columns["effort"] -= 5 * np.sin(columns["position"])  # gravity is none of its business
    whole = Episode.from_table(columns)
    cut = pieces(whole, 1.0)
    monitor = CalibratedMonitor(FrictionRule(whole.spec), Largest(whole.spec)).fit(cut[:30])
    quiet = max(float(s.value.max()) for s in monitor.score_episodes(cut[30:]))
    stream = cut[40].stream.copy()
    stream[50:, 4] += 5.0
    score = monitor.score(Episode.from_stream(stream, whole.spec))
    assert score.value[:50].max() <= quiet < score.value[70:].min()
    assert np.argmax(score.attribution[-1]) == 4
    with pytest.raises(ValueError, match="a rule of friction needs a torque and a speed of each joint"):
        FrictionRule(Episode.from_table({"q": np.zeros((9, 2))}, rate=10).spec)


def test_the_study_runs_on_files_of_the_same_shape_and_names_what_is_missing(tmp_path, capsys):
    folder = tiago(tmp_path / "arms")
    out = ["--out", str(tmp_path / "out"), "--monitors", "association_values+evidence", "friction_rule"]
    assert main(["reproduce", "real_arms", str(folder), *out, "--experiments", "tiago", "tx40"]) == 0
    text = (tmp_path / "out" / "real_arms.md").read_text()
    assert "PAL TIAGo" in text
    assert "tx40" in text
    assert "is missing: it is thanhndv212/figaroh-examples @ c0b5c7f0" in text
    assert main(["reproduce", "real_arms", str(tmp_path), *out]) == 2
    assert "is missing: it is unisa-acg/inverse-dynamics-solver" in capsys.readouterr().err


PENDULUMS = """<robot name="two"><link name="base"/><link name="upper"><inertial><origin xyz="0.4 0 0"/>
<mass value="1"/></inertial></link>
<link name="lower"><inertial><origin xyz="0.4 0 0"/><mass value="1"/></inertial></link>
<joint name="a" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
<joint name="b" type="continuous"><parent link="upper"/><child link="lower"/><origin xyz="0.4 0 0"/><axis xyz="0 1 0"/>
</joint></robot>"""


def test_the_study_gives_monitors_a_body_model_or_names_the_file_that_is_missing(tmp_path, capsys):
    folder = tiago(tmp_path / "arms")
    out = ["--out", str(tmp_path / "out"), "--experiments", "tiago", "tx40", "--monitors", "ridge, body"]
    command = ["reproduce", "real_arms", str(folder), *out, "association_values, body"]
    assert main(command) == 2
    assert "tiago.urdf is missing: it is in example-robot-data" in capsys.readouterr().err
    (folder / "urdf").mkdir()
    (folder / "urdf" / "tiago.urdf").write_text(PENDULUMS)
    assert main(command) == 0
    text = (tmp_path / "out" / "real_arms.md").read_text()
    assert "| association_values, body |" in text
    assert "| ridge, body |" in text


def test_every_monitor_meets_the_same_faults(tmp_path):
    folder = tiago(tmp_path / "arms")
    config = Config(folder=folder)

    def kinds(monitor: str) -> list[tuple[str, int]]:
        records = on_an_arm(Job("tiago", monitor, 0, 1), ARMS["tiago"], config)
        return [(r["kind"], r["piece"]) for r in records]

    assert kinds("channel_limit") == kinds("friction_rule")
    assert {"step", "frozen", "slipped", "late", ""} == {kind for kind, _ in kinds("channel_limit")}


def test_executions_are_read_and_damaged_ones_refused(tmp_path):
    rows = "\n".join("\t" + "\t".join(str(k) for k in range(6)) for _ in range(15))
    place = tmp_path / "uci_robot_execution_failures"
    place.mkdir()
    (place / "lp1.data").write_text(f"normal\n{rows}\n\n\ncollision\n{rows}\n\n")
    found = list(read_executions(tmp_path))
    assert [(problem, kind, a.shape) for problem, kind, a in found] == [
        *(("lp1", "normal", (15, 6)), ("lp1", "collision", (15, 6))),
    ]
    (place / "lp2.data").write_text("normal\n\t1\t2\n")
    with pytest.raises(ValueError, match=r"lp2\.data: an execution must be of 15 rows of 6"):
        list(read_executions(tmp_path))
    with pytest.raises(FileNotFoundError, match="UCI 963"):
        read_cobot(tmp_path)


@real
@pytest.mark.parametrize("name", ARMS)
def test_recordings_of_arms_are_streams_of_position_speed_and_effort(name):
    if not (REAL / ARMS[name].place).exists():
        pytest.skip(f"{ARMS[name].place} is not there")
    episode = ARMS[name].episode(REAL)
    assert {"position", "effort"} <= set(episode.spec.slices)
    sizes = {s.stop - s.start for s in episode.spec.slices.values()}
    assert len(sizes) == 1
    assert np.isfinite(episode.stream).all()


def test_a_body_model_is_one_more_column():
    columns = arm(3000)
    q = columns["position"]
    columns["effort"] += 4 * np.sin(q[:, :1] + q[:, 1:]) * np.array([1.0, np.cos(3 * q[:, 0]).mean()])
    exact = columns["effort"] - 2 * np.tanh(columns["velocity"] / 0.02)
    found = []
    for known in (columns, {**columns, "computed_torque": exact}):
        cut = pieces(Episode.from_table(known), 1.0)
        model = ValueAssociation(cut[0].spec, changes=False, body=False)
        model.fit(cut, np.random.default_rng(0), lambda done, total: None)
        found.append(model.learned_["R2_values"][4:6].min())
        assert forces(cut[0].spec).tolist() == [4, 5]
    assert found[1] > found[0] + 0.1
