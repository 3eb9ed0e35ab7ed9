"""What of motor babbling a memory takes for healthy, and the command that makes one."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from asm_gym.episode import Episode
from asm_gym.monitors import NeuralASM
from asm_gym.policies.registry import SHIPPED
from asm_gym.rollouts import harmless
from asm_gym.rollouts.pretraining.babbling import (
    Lesson,
)
from asm_gym.rollouts.pretraining.healthy import KNOWN, healthy
from asm_gym.rollouts.run_folder import claimed
from asm_gym.scripts.babble import Args, check, main
from asm_gym.spec import Channel, StreamSpec

ARM = StreamSpec((Channel("external_torque_peak", 2, "N m"), Channel("action", 1, group="action")), dt=0.05)


def lesson_of(forces, torques, noise=0.0, number=0, task="Lift", rows=1, guide="scripted"):
    """A recorded lesson that felt these forces [N] in its steps, and these torques [N m] in its rows."""
    stream = np.zeros((len(torques), 3), np.float32)
    stream[:, 0] = np.negative(torques)
    assert len(stream) == rows * len(forces)
    lesson = Lesson(task, number, seed=number, noise=noise, guide=guide)
    about = {"skill": task, "lesson": lesson._asdict()}
    return Episode(
        stream, ARM, success=True, contact_force=np.array(forces, np.float32), label=lesson.label, info=about
    )


def test_the_expert_alone_says_what_is_usual():
    gentle = [lesson_of([5, 9, 0] * 20, [1, 2, 3] * 20, number=n) for n in (0, 4)]
    firm = [lesson_of([40] * 60, [30] * 60, number=n, guide="lift_sac") for n in (1, 5, 7, 8)]
    light = lesson_of([1] * 60, [1] * 60, number=11, guide="lift_sac")
    kept = healthy([*gentle, *firm, light, undisturbed()])
    assert [e.labelled.seed for e in kept.fit] == [0, 4]
    assert [e.labelled.seed for e in kept.calibration] == [11, 2]
    assert [e.labelled.seed for e in kept.whole] == [5, 8, 11, 2]


@pytest.mark.parametrize(("noise", "force", "torque"), [(0.0, 80, 40), (0.1, 40, 20)])
def test_what_presses_harder_than_is_learned_is_cut_out_with_what_is_near(noise, force, torque):
    calm = [lesson_of([5, 40, 0] * 20, [1, 20, 3] * 20, number=n) for n in (0, 4)]
    about = {"noise": noise, "guide": "lift_sac"}  # what is usual is not asked of an agent
    hits = lesson_of([force] * 27 + [force + 0.1] + [0] * 32, [torque] * 60, number=1, **about)
    at_stop = lesson_of([0] * 60, [torque] * 22 + [torque + 0.1] + [0] * 37, number=3, **about)
    assert [len(e) for e in healthy([*calm, hits, at_stop, undisturbed()]).fit] == [60, 60, 23, 28, 33]


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_some_contact_is_learned_however_careful_the_expert(noise):
    careful = lesson_of([5, 9, 0] * 20, [1, 2, 3] * 20)
    firm = lesson_of([KNOWN.force] * 27 + [KNOWN.force + 1] + [0] * 32, [KNOWN.torque] * 60, noise, number=1)
    assert [len(e) for e in healthy([careful, firm, undisturbed()]).fit] == [60, 23, 28]


def undisturbed(**about):
    """A lesson to calibrate on."""
    return replace(lesson_of([5, 9, 0] * 20, [1, 2, 3] * 20, number=2), **about)


def test_a_threshold_is_set_on_solved_lessons_that_nothing_disturbed_but_where_they_crash():
    learned = [lesson_of([9, 0] * 30, [3] * 60, number=n) for n in (0, 1, 3)]
    hard = lesson_of([9] * 10 + [18] * 15 + [18.1] + [0] * 34, [3] * 60, number=5)
    noisy = lesson_of([9] * 60, [3] * 60, noise=0.1, number=8)
    found = healthy([*learned, undisturbed(), hard, noisy, undisturbed(success=False)])
    assert [len(e) for e in found.calibration] == [60, 21, 30]
    assert [len(e) for e in found.whole] == [60, 60]
    assert len(found.fit) == 3


def test_forces_of_steps_cut_streams_of_many_rows_a_step():
    calm = [lesson_of([5] * 30, [1] * 90, number=n, rows=3) for n in (0, 2)]
    hits = lesson_of([0] * 25 + [31] * 5, [1] * 90, noise=0.5, number=1, rows=3)
    turned = lesson_of([0] * 30, [1] * 81 + [16] * 9, noise=0.5, number=4, rows=3)
    assert [len(e) for e in healthy([*calm, hits, turned]).fit] == [90, 72, 78]


def test_of_a_policys_own_episodes_crashes_are_left_out_and_what_is_kept_is_whole_stretches():
    calm = [lesson_of([5, 9, 0] * 20, [1, 2, 3] * 20) for _ in range(3)]
    crash = lesson_of([0] * 27 + [18.1] + [0] * 32, [3] * 60)
    assert [len(e) for e in harmless([*calm, crash])] == [60, 60, 60, 23, 28]
    unfelt = [
        replace(e, contact_force=np.zeros(0, np.float32)) for e in [*calm, lesson_of([0] * 60, [3] * 40 + [6.1] * 20)]
    ]
    assert [len(e) for e in harmless(unfelt)] == [60, 60, 60, 36]
    acted = replace(calm[0], actions=np.zeros((60, 1), np.float32), observations=np.zeros((61, 2), np.float32))
    np.testing.assert_array_equal(harmless([acted])[0].stream, acted.stream)


def test_a_task_needs_a_solved_lesson_without_noise_and_something_must_be_left():
    crashed = replace(lesson_of([1] * 30, [1] * 30, task="Door"), success=False)
    with pytest.raises(ValueError, match="no undisturbed lesson of Door was solved"):
        healthy([lesson_of([1] * 30, [1] * 30), crashed])
    with pytest.raises(ValueError, match="leave too little"):
        healthy([lesson_of([1] * 30, [1] * 30)])


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"robot": "Pandas"}, "did you mean 'Panda'"),
        ({"tasks": ("Wipe",)}, "unknown task of one arm with a gripper 'Wipe'"),
        ({"exam_tasks": ("TwoArmLift",)}, "unknown task of one arm with a gripper 'TwoArmLift'"),
        ({"tasks": ()}, "at least one task"),
        ({"guides": ("lift",)}, "unknown agent 'lift'"),
        ({"exam_faults": ("pushes",)}, "unknown kind of fault 'pushes'"),
        ({"exam_episodes": -1}, "exam_episodes must be at least 0, got -1"),
        ({"window": 0.0}, "window must be a number above 0, got 0"),
        ({"false_alarms_per_hour": 1.0, "healthy_episodes": 0, "tasks": ("Lift",)}, "1 false alarms an hour need"),
    ],
)
def test_the_command_refuses_what_makes_no_sense(given, why):
    with pytest.raises(ValueError, match=why):
        Args(**given)


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--guides", "none.npz"], "none.npz: no such file"),
        (["--guides", "lift_sac", "--robot", "Sawyer"], "Panda"),
        (["--guides", "damaged.npz"], "damaged.npz"),
    ],
)
def test_guides_that_cannot_lead_are_refused_when_the_command_starts(options, why, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "damaged.npz").write_bytes((SHIPPED / "lift_sac.npz").read_bytes()[:1000])
    Args(guides=("runs/of/somebody.npz",))  # a page's command is read where its files are not
    with pytest.raises(ValueError, match=r"Lift-v0.* only there.*: Door, Stack"):
        check(Args(guides=(str(SHIPPED / "lift_sac.npz"),), tasks=("Door", "Stack"), episodes=90))
    assert main([*options, "--episodes", "90", "--out", "run"]) == 2
    assert re.search(why, " ".join(capsys.readouterr().err.split()))
    assert not (tmp_path / "run").exists()


def test_agents_are_examined_where_they_were_trained_and_nowhere_else():
    panda = {(e.task, e.policy): e.known for e in Args(guides=("door_sac",)).exams}
    assert panda["Lift", "lift_sac"] is False
    assert panda["Door", "door_sac"] is True
    assert panda["PickPlaceMilk", "scripted"] is False
    assert panda["PickPlaceCan", "scripted"] is True
    assert {e.policy for e in Args(robot="Sawyer").exams} == {"scripted"}


def test_other_arms_babble_where_their_experts_succeed():
    assert {"Door", "NutAssemblySquare"} < set(Args().shown)
    iiwa = Args(robot="IIWA")
    assert iiwa.shown == ("Lift", "Stack", "PickPlaceCan", "PickPlaceBread", "PickPlaceCereal")
    assert iiwa.left_out == ("PickPlaceMilk",)
    assert Args(robot="IIWA", tasks=("Lift",) * 4).shown == ("Lift",) * 4


@pytest.mark.slow  # 36 episodes of two tasks, and a fit
def test_the_command_makes_a_memory_of_a_body_and_goes_on_where_it_was(tmp_path):
    folder = tmp_path / "run"
    assert main(["--quick", "--workers", "1", "--out", str(folder)]) == 0
    memory = NeuralASM.load(folder / "panda.asm")
    assert memory.about["controller"] == "OSC_POSE"
    assert memory.threshold > 0
    assert "healthy hours" in (folder / "card.md").read_text(encoding="utf-8")
    written = {f: f.stat().st_mtime_ns for f in folder.rglob("*.npz")}
    assert len(written) == 2 * (18 + 2)
    assert main(["--quick", "--workers", "1", "--out", str(folder)]) == 0
    assert {f: f.stat().st_mtime_ns for f in folder.rglob("*.npz")} == written
    assert main(["--quick", "--workers", "1", "--robot", "Sawyer", "--out", str(folder)]) == 2  # it is another's


@pytest.mark.parametrize("there", ["and pressing", True])
def test_a_folder_of_other_lessons_is_refused(tmp_path, capsys, there):
    with claimed(tmp_path, "babble.json", {"robot": "Panda", "guides": (), "stream_freq": None, "seed": 0}):
        pass  # of before any hand reached
    path = tmp_path / "babble.json"
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | {"reaching": there}), encoding="utf-8")
    assert main(["--quick", "--workers", "1", "--out", str(tmp_path)]) == 2
    assert f"reaching: {there!r} there, None here" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "episodes").exists()
