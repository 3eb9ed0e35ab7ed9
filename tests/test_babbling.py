"""Motor babbling: its curriculum, what of it is healthy, the command, and the examination of a memory."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.episode import Episode, EpisodeLabel, load_episode
from asm_gym.evaluation.ideal import detectability_of
from asm_gym.evaluation.metrics import DetectionMetrics
from asm_gym.evaluation.scored_episode import ScoredEpisode, onset_row
from asm_gym.monitors import NeuralASM, Surprise
from asm_gym.policies.network import NetworkPolicy
from asm_gym.policies.registry import SHIPPED
from asm_gym.policies.scripted.base import ObservationReader
from asm_gym.rollouts import harmless
from asm_gym.rollouts.pretraining import babbling
from asm_gym.rollouts.pretraining.babbling import (
    ALONE,
    DRIVEN,
    HELD,
    LEADING,
    LED,
    NOISE,
    PRESS,
    PRESSING,
    REACHING,
    Babbler,
    Lesson,
    curriculum,
    record_lesson,
)
from asm_gym.rollouts.pretraining.exam import Alarms, Exam, Marks, examine, summary, usual_force
from asm_gym.rollouts.pretraining.healthy import KNOWN, healthy, held_out
from asm_gym.rollouts.pretraining.reaching import AROUND, PACE, TURNED, Reaching
from asm_gym.rollouts.run_folder import make_missing
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.scripts.babble import Args, main
from asm_gym.spec import Channel, StreamSpec
from tests.fakes import FakeEnv


def test_fewer_lessons_are_the_first_of_more():
    few, many = curriculum(["Lift", "Door"], 5, seed=3), curriculum(["Door", "Lift"], 9, seed=3)
    assert set(few) <= set(many)
    assert len({lesson.seed for lesson in many}) == len(many)
    assert not set(few) & set(curriculum(["Lift", "Door"], 5, seed=4))


def test_each_task_has_the_experts_own_course_disturbed_courses_and_noise_alone():
    for task in ("Lift", "Door"):
        lessons = [lesson for lesson in curriculum(["Lift", "Door"], 40, seed=0) if lesson.task == task]
        kinds = [ALONE if not n.guide else LED if n.noise == 0 else DRIVEN for n in lessons]
        assert kinds[2::3] == [LED] * 13  # the threshold is set on those
        assert [k for n, k in enumerate(kinds) if not held_out(n)] == [
            k for n, k in enumerate(LEADING * 8) if not held_out(n)
        ]
        assert [n.drift > 0 for n in lessons] == [n.noise > 0 for n in lessons]
        driven = [n.noise for n in lessons if n.noise]
        assert min(driven) < 0.04
        assert 0.15 < max(driven) <= 0.2
        assert {n.pause > 0 for n in lessons} == {n.weight == 1 for n in lessons} == {True, False}


def test_hands_reach_where_noise_alone_would_lead():
    usual, reaching = (curriculum(["Lift"], 60, seed=0, reaching=r)[:60] for r in (False, True))
    kinds = [REACHING if n.guide == REACHING else LED if n.noise == 0 else DRIVEN for n in reaching]
    assert [kinds.count(kind) for kind in (LED, DRIVEN, REACHING)] == [36, 16, 8]
    assert reaching == [n._replace(guide=n.guide or REACHING) for n in usual]  # all else stays


def test_where_the_hand_reaches_one_lesson_more_for_each_three_presses_and_none_of_them_is_held_out():
    usual, reaching = (curriculum(["Lift", "Stack"], 20, seed=0, reaching=r) for r in (False, True))
    pressing = [n for n in reaching if n.press]
    assert reaching[len(usual) :] == pressing
    assert [n.number for n in pressing if n.task == "Stack"] == list(range(0, 20, 3))
    assert not any(held_out(n.number) for n in pressing)
    assert len({n.seed for n in reaching}) == len(reaching)
    assert {(n.guide, n.noise, n.drift) for n in pressing} == {("scripted", NOISE[0], 0.0)}
    assert set(curriculum(["Lift"], 8, seed=0, reaching=True)) <= set(reaching)


def test_agents_take_turns_with_the_expert_of_their_own_task():
    lessons = curriculum(["Lift", "Door"], 40, seed=0, guides=["lift_sac"])
    guides = {task: {n.guide for n in lessons if n.task == task} for task in ("Lift", "Door")}
    assert guides == {"Lift": {"scripted", "lift_sac", ""}, "Door": {"scripted", ""}}
    with pytest.raises(ValueError, match="episodes must be at least 1, got 0"):
        curriculum(["Lift"], 0, seed=0)


def test_a_file_of_an_agent_leads_as_one_that_is_shipped_and_acts_as_it_does(tmp_path):
    file = tmp_path / "half_trained.npz"
    agent = NetworkPolicy.load(SHIPPED / "lift_sac.npz")
    agent.layers[-1] = (0.5 * agent.layers[-1][0], agent.layers[-1][1])
    agent.save(file)
    lessons, shipped = (curriculum(["Lift", "Door"], 10, seed=0, guides=[g]) for g in (str(file), "lift_sac"))
    assert [n._replace(guide="") for n in lessons] == [n._replace(guide="") for n in shipped]
    assert [n.guide == str(file) for n in lessons] == [n.guide == "lift_sac" for n in shipped]
    env = gym.make("asm_gym/Lift-v0")
    observation, _ = env.reset(seed=1)
    led = next(n for n in lessons if n.guide == str(file) and not n.noise)._replace(pause=0.0)
    action, _ = Babbler(env, led).predict(observation)
    np.testing.assert_array_equal(action, agent.fit_to(env, "the agent").predict(observation)[0])
    env.close()
    with pytest.raises(FileNotFoundError):
        curriculum(["Lift"], 10, seed=0, guides=[str(tmp_path / "none.npz")])


@pytest.mark.parametrize("robot", ["Panda", "IIWA"])
def test_a_hand_that_reaches_comes_near_one_place_after_another_and_turns(robot):
    env = gym.make("asm_gym/Lift-v0", robot=robot)
    reach, read, state = Reaching(env, seed=5), ObservationReader(env), None
    observation, _ = env.reset(seed=5)
    aims, progress = [], []
    for _ in range(95):
        action, state = reach.predict(observation, state)
        assert np.linalg.norm(action[:3]) <= PACE * (1 + 1e-6)
        if not aims or state.place is not aims[-1].place:
            far = np.linalg.norm(read(observation, "hand_position") - state.place)
            aims.append(state)
            progress.append(0.0)
        observation = env.step(action)[0]
        progress[-1] = max(progress[-1], 1 - np.linalg.norm(read(observation, "hand_position") - state.place) / far)
    env.close()
    assert len(aims) >= 2
    assert progress[0] > 0.3  # of the way
    away = np.array([a.place - a.began for a in aims])
    assert (away >= AROUND[0]).all()
    assert (away <= AROUND[1]).all()
    assert {a.grip for a in aims} <= {-1.0, 1.0}
    turned = [np.arccos(np.clip((np.trace(a.upright.T @ a.turned) - 1) / 2, -1, 1)) for a in aims]
    assert 0 < min(turned) <= max(turned) <= np.linalg.norm(TURNED)


@pytest.mark.parametrize("smoothness", [0.0, 0.9])
def test_noise_is_as_strong_and_as_smooth_as_the_lesson_says(smoothness):
    env = FakeEnv()
    babbler = Babbler(env, Lesson("Lift", 0, seed=1, guide="", noise=0.1, smoothness=smoothness))
    actions = np.array([babbler.predict(None)[0] for _ in range(20_000)])
    assert actions.std() == pytest.approx(0.1, rel=0.05)
    assert np.corrcoef(actions[1:, 0], actions[:-1, 0])[0, 1] == pytest.approx(smoothness, abs=0.02)


def test_an_arm_that_pauses_keeps_its_grip():
    babbler = Babbler(FakeEnv(), Lesson("Lift", 0, seed=2, guide="", noise=0.5, pause=1.0))
    actions = np.array([babbler.predict(None)[0] for _ in range(200)])
    resting = (actions[:, :2] == 0).all(axis=1)
    assert 0.8 < resting.mean() < 1.0  # between two pauses it moves
    assert (actions[:, 2] != 0).all()  # the gripper of a FakeEnv


class Holding:
    """Grips from its tenth step on."""

    steps = 0

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.steps += 1
        return np.array([0.01, 0.01, 0.01, 1.0 if self.steps > 10 else -1.0]), state


def test_what_is_held_is_pressed_down_or_aside_for_a_while_and_the_grip_is_kept():
    env = FakeEnv()
    env.action_space, env.gripper_actions = gym.spaces.Box(-1.0, 1.0, (4,), np.float32), (3,)
    babbler = Babbler(env, Lesson("Lift", 0, seed=2, guide="", noise=1e-6, press=PRESS))
    babbler._guide = Holding()
    actions = np.array([babbler.predict(None)[0] for _ in range(3000)])
    pressed = np.abs(actions[:, :3]).max(axis=1) > 0.05
    assert not pressed[: 10 + HELD].any()  # nothing was held for long
    assert 0.3 < pressed.mean() < 0.7
    assert PRESSING[1] >= np.abs(actions[pressed, :3]).max() > 0.4
    starts = actions[1:][pressed[1:] & ~pressed[:-1]]
    down = (starts[:, 2] < 0) & (starts[:, :2] == 0).all(axis=1)
    assert 0.35 < down.mean() < 0.65
    assert ((starts[:, 2] == 0) & (starts[:, 0] != 0)).any()
    assert (starts[:, 2] > 0).any()
    assert (actions[11:, 3] > 0).all()


def test_an_arm_that_drifts_goes_on_in_one_direction_and_keeps_its_grip():
    lesson = Lesson("Lift", 0, seed=2, guide="", noise=0.01, smoothness=0.9, drift=1.0)
    babbler = Babbler(FakeEnv(), lesson)
    actions = np.array([babbler.predict(None)[0] for _ in range(2000)])
    same = (np.diff(actions[:, :2], axis=0) == 0).all(axis=1)
    assert 0.8 < same.mean() < 1.0  # between two drifts it is led
    courses = np.abs(np.unique(actions[1:][same][:, :2], axis=0))
    assert len(courses) > 20
    assert courses.max() > 10 * lesson.noise
    assert (np.diff(actions[:, 2]) != 0).all()  # the gripper of a FakeEnv


def test_a_disturbed_guides_grip_is_commanded_more_or_less_firmly_and_never_the_other_way(monkeypatch):
    monkeypatch.setattr(babbling, "_guide", lambda lesson, env: always(np.array([0.3, -0.3, -1.0])))
    for noise in (0.0, 0.01):
        babbler = Babbler(FakeEnv(), Lesson("Lift", 0, seed=3, noise=noise))
        babbler._noisy_grip = False
        actions = np.array([babbler.predict(None)[0] for _ in range(2000)])
        assert (actions[:, 2] < 0).all()
        assert (np.abs(actions[:, 2]).min() < 0.1) == (noise > 0)
        assert 20 < len(np.unique(actions[:, 2])) < 200 or not noise
        np.testing.assert_allclose(actions[:, :2].mean(axis=0), [0.3, -0.3], atol=0.01)


def always(action):
    """A policy that does the same in every step."""
    return SimpleNamespace(predict=lambda observation, state, episode_start: (action, state))


def test_a_recorded_lesson_is_the_same_again_and_leaves_the_simulator_as_it_was(tmp_path):
    lesson = next(n for n in curriculum(["Lift"], 40, seed=0) if n.noise and n.guide and n.weight != 1)
    make = partial(record_lesson, config=RolloutConfig())
    first = load_episode(make(lesson, folder=tmp_path / "a"))
    make(replace_weight(lesson), folder=tmp_path / "b")
    again = load_episode(make(lesson, folder=tmp_path / "c"))
    np.testing.assert_array_equal(first.stream, again.stream)
    assert first.contact_force.shape == (len(first),)
    assert first.label == EpisodeLabel("Lift", "babble", seed=lesson.seed)
    assert not first.faults.size
    made = []
    make_missing(made.append, [lesson], lambda n: tmp_path / "a" / n.path, 1)
    assert made == []  # it is there already


def replace_weight(lesson):
    """The lesson with a heavier thing."""
    return lesson._replace(weight=1.4, seed=lesson.seed + 1)


ARM = StreamSpec((Channel("external_torque_peak", 2, "N m"), Channel("action", 1, group="action")), dt=0.05)


def lesson_of(forces, torques, noise=0.0, number=0, task="Lift", rows=1, guide="scripted"):
    """A recorded lesson that felt these forces [N] in its steps, and these torques [N m] in its rows."""
    stream = np.zeros((len(torques), 3), np.float32)
    stream[:, 0] = np.negative(torques)
    assert len(stream) == rows * len(forces)
    lesson = Lesson(task, number, seed=number, noise=noise, guide=guide)
    about = {"skill": task, "lesson": lesson._asdict()}
    return Episode(
        stream, ARM, success=True, contact_force=np.array(forces, np.float32), label=lesson.trial.label, info=about
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
        ({"tasks": ()}, "at least one task"),
        ({"exam_episodes": -1}, "exam_episodes must be at least 0, got -1"),
        ({"false_alarms_per_hour": 1.0, "healthy_episodes": 0, "tasks": ("Lift",)}, "1 false alarms an hour need"),
    ],
)
def test_the_command_refuses_what_makes_no_sense(given, why):
    with pytest.raises(ValueError, match=why):
        Args(**given)


def test_agents_are_examined_where_they_were_trained_and_nowhere_else():
    panda = {(e.task, e.policy): e.known for e in Args().exams}
    assert panda["Lift", "lift_sac"] is False
    assert panda["PickPlaceMilk", "scripted"] is False
    assert panda["PickPlaceCan", "scripted"] is True
    assert {e.policy for e in Args(robot="Sawyer").exams} == {"scripted"}


def test_other_arms_babble_where_their_experts_succeed():
    assert {"Door", "NutAssemblySquare"} < set(Args().shown)
    iiwa = Args(robot="IIWA")
    assert iiwa.shown == ("Lift", "Stack", "PickPlaceCan", "PickPlaceBread", "PickPlaceCereal")
    assert [e.task for e in iiwa.exams if not e.known] == ["PickPlaceMilk"]
    assert Args(robot="IIWA", tasks=("Lift",) * 4).shown == ("Lift",) * 4


@pytest.mark.slow  # 36 episodes of two tasks, and a fit
def test_the_command_makes_a_memory_of_a_body_and_goes_on_where_it_was(tmp_path):
    folder = tmp_path / "run"
    assert main(["--quick", "--workers", "1", "--out", str(folder)]) == 0
    memory = NeuralASM.load(folder / "panda.asm")
    assert memory.about["controller"] == "OSC_POSE"
    assert memory.threshold > 0
    written = {f: f.stat().st_mtime_ns for f in folder.rglob("*.npz")}
    assert len(written) == 2 * 18
    assert main(["--quick", "--workers", "1", "--out", str(folder)]) == 0
    assert {f: f.stat().st_mtime_ns for f in folder.rglob("*.npz")} == written
    assert main(["--quick", "--workers", "1", "--robot", "Sawyer", "--out", str(folder)]) == 2  # it is another's


def test_an_exam_pairs_every_fault_with_a_healthy_twin():
    labels = Exam("Lift", "scripted", known=False).trials(3, ["push", "slip"], seed=5)
    nominal = [n for n in labels if n.role == "nominal"]
    assert [n.seed for n in nominal] == [n.seed for n in Exam("Lift", "lift_sac", known=True).trials(3, [], 5)]
    faulty = [n for n in labels if n.role == "faulty"]
    assert [n.kind for n in faulty] == ["push", "push", "slip", "slip"]
    assert {n.seed for n in faulty} == {n.seed for n in nominal}
    assert all(n.onset is not None and n.onset >= 10 for n in faulty)


def test_pushes_are_tried_in_the_last_scenes_and_none_twice():
    labels = Exam("Lift", "scripted", known=False).trials(3, ["push"], seed=5, pushes=3)
    scenes = [n.seed for n in labels[:3]]
    assert [(n.kind, n.severity, n.seed) for n in labels[3:]] == [
        ("push", "medium", scenes[0]),
        ("push", "strong", scenes[1]),
        ("push", "medium", scenes[2]),
        ("push", "medium", scenes[1]),
    ]


def test_the_summary_counts_alarms_faults_and_prompt_pushes():
    def trace(kind, severity, *surprise):
        onset = None if kind == "nominal" else 1
        return ScoredEpisode(kind, 0, 0.05, 4.0, np.array(surprise), onset, severity)

    solved = [trace("nominal", "", 1, 1, 3, 1), trace("nominal", "", 1, 1, 1, 1)]
    pushes = [trace("push", "medium", 0, 0, 5, 5), trace("push", "medium", 0, 0, 3, 5)]
    marks = Marks(
        "Lift", solved, [], pushes, DetectionMetrics("Lift", [trace("slip", "strong", 0, 0, 0, 3)], solved, 1.0)
    )
    assert "0 of 1 faults found, 1 of 2 pushes" in summary([marks])
    assert "1 of 1 faults found, 2 of 2 pushes" in summary([marks.at(2.0)])


def test_knocks_and_stops_are_counted_apart_and_added_up():
    def trace(fault, knock, stop):
        rows = [np.repeat(value, 36) for value in (fault, knock, stop)]
        excused = {"knock": rows[1], "stop": rows[2]}
        return ScoredEpisode("nominal", 0, 1.0, 4.0, rows[0], excused=excused)

    many = (
        [trace(5.0, 150.0, 0.0)] + 2 * [trace(3.0, 90.0, 0.0)] + 3 * [trace(2.0, 0.0, 60.0)] + 94 * [trace(1.0, 0, 0)]
    )
    found = Alarms.of(many)
    assert [rate.k for rate in found] == [1, 2, 3]  # what is a fault is no knock beside it
    assert found.fault.hours == pytest.approx(1.0)


def test_an_agent_that_crashes_in_most_of_its_episodes_does_not_say_what_is_usual():
    def nominal(seed, force, success=True):
        label = EpisodeLabel("Lift", "nominal", seed=seed)
        return replace(lesson_of([0, force, 0] * 20, [0] * 60), label=label, success=success)

    agents_own = [nominal(0, 9), nominal(1, 80), nominal(2, 90), nominal(3, 500, success=False)]
    assert usual_force(agents_own) == 80
    memory = SimpleNamespace(threshold=1.0, spec=ARM, score_episodes=lambda episodes: [quiet(e) for e in episodes])
    marks = examine(memory, "Lift", agents_own, 1.0, usual=10.0)
    assert [[t.seed for t in own] for own in (marks.solved, marks.failed)] == [[0, 1, 2], [3]]


def quiet(episode):
    """No surprise at all."""
    return Surprise(np.zeros(len(episode)), np.zeros_like(episode.stream))


@pytest.mark.parametrize("rows", [1, 5])
def test_a_fault_begins_in_the_row_of_its_step_where_a_step_has_several(rows):
    label = EpisodeLabel("Lift", "faulty", "push", "strong", seed=1, onset=12)
    jump = replace(lesson_of([0] * 40, [0] * (40 * rows), rows=rows), label=label)
    jump.stream[12 * rows :, 0] += 5.0
    twin = replace(lesson_of([0] * 40, [0] * (40 * rows), rows=rows), label=replace(label, role="nominal", onset=None))
    assert onset_row(jump) == 12 * rows
    assert onset_row(twin) is None
    assert onset_row(replace(jump, contact_force=np.zeros(0, np.float32))) == 12  # nobody says otherwise
    (seen,) = detectability_of([twin], [jump], window_s=0.05)
    assert seen.delay == pytest.approx(0.05)
