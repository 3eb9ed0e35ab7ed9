"""Motor babbling: its curriculum, what of it is healthy, the command, and the examination of a memory."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

from asm_gym import harmless
from asm_gym.data.episode import Episode, EpisodeLabel, load_episode
from asm_gym.evaluation.comparison import detectability_of
from asm_gym.evaluation.metrics import DetectionMetrics, hourly_alarms
from asm_gym.evaluation.scored_episode import ScoredEpisode, onset_row
from asm_gym.monitors import NeuralASM, Surprise
from asm_gym.policies.scripted.expert import ObservationReader
from asm_gym.rollouts.pretraining.body_evaluation import (
    EvaluationCase,
    Scores,
    evaluate_case,
    summary,
    usual_force,
)
from asm_gym.rollouts.pretraining.body_memory import KNOWN, healthy, held_out
from asm_gym.rollouts.pretraining.training_motions import (
    AROUND,
    DISTURBED,
    EXPERT,
    NOISE,
    NOISE_ALONE,
    PACE,
    PRESS,
    REACHING,
    STEPS_TO_GRIP,
    TURNED,
    MotionPolicy,
    ReachingPolicy,
    TrainingMotion,
    curriculum,
    record_motion,
)
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


@pytest.mark.parametrize("reaching", [False, True])
def test_a_task_has_the_experts_own_course_disturbed_courses_noise_alone_and_pressing(reaching):
    lessons = curriculum(["Lift", "Door"], 40, seed=0, reaching=reaching)
    lessons, limited = [n for n in lessons if not n.limit], [n for n in lessons if n.limit]
    own, pressing = (
        [n for n in lessons if n.task == "Door" and bool(n.press) is press]
        for press in (False, True)
    )
    alone = {"": NOISE_ALONE, "reaching": REACHING}
    kinds = [alone.get(n.guide, EXPERT if n.noise == 0 else DISTURBED) for n in own]
    assert kinds[2::3] == [EXPERT] * 13  # the threshold is set on those
    assert [
        kinds.count(kind) for kind in (EXPERT, DISTURBED, REACHING if reaching else NOISE_ALONE)
    ] == [
        23,
        12,
        5,
    ]
    assert [n.drift > 0 for n in own] == [n.noise > 0 for n in own]
    assert NOISE[0] <= min(n.noise for n in own if n.noise) < 0.04
    assert 0.15 < max(n.noise for n in own) <= NOISE[1]
    assert {n.pause > 0 for n in own} == {n.weight == 1 for n in own} == {True, False}
    assert [n.number for n in pressing] == (list(range(0, 40, 3)) if reaching else [])
    assert not any(held_out(n.number) for n in pressing)
    assert {(n.guide, n.noise, n.drift) for n in pressing} <= {("scripted", NOISE[0], 0.0)}
    assert [(n.task, n.number) for n in limited] == [
        (t, n) for t in ("Lift", "Door") for n in range(0, 40, 3)
    ]
    assert {bool(n.noise) for n in limited} == {True, False}
    assert len({n.seed for n in [*lessons, *limited]}) == len(lessons) + len(limited)


@pytest.mark.parametrize("robot", ["Panda", "IIWA"])
def test_a_hand_that_reaches_comes_near_one_place_after_another_and_turns(robot):
    env = gym.make("asm_gym/Lift-v0", robot=robot)
    reach, read, state = ReachingPolicy(env, seed=5), ObservationReader(env), None
    observation, _ = env.reset(seed=5)
    aims, progress = [], []
    for _ in range(95):
        action, state = reach.predict(observation, state)
        assert np.linalg.norm(action[:3]) <= PACE * (1 + 1e-6)
        if not aims or state.position is not aims[-1].position:
            far = np.linalg.norm(read(observation, "hand_position") - state.position)
            aims.append(state)
            progress.append(0.0)
        observation = env.step(action)[0]
        progress[-1] = max(
            progress[-1],
            1 - np.linalg.norm(read(observation, "hand_position") - state.position) / far,
        )
    env.close()
    assert len(aims) >= 2
    assert progress[0] > 0.3  # of the way
    away = np.array([a.position - a.first_position for a in aims])
    assert (away >= AROUND[0]).all()
    assert (away <= AROUND[1]).all()
    assert {a.grip for a in aims} <= {-1.0, 1.0}
    turns = [a.first_orientation.T @ a.orientation for a in aims]
    turned = [np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)) for turn in turns]
    assert 0 < min(turned) <= max(turned) <= np.linalg.norm(TURNED)


@pytest.mark.parametrize("smoothness", [0.0, 0.9])
def test_noise_is_as_strong_and_as_smooth_as_the_lesson_says(smoothness):
    env = FakeEnv()
    babbler = MotionPolicy(
        env, TrainingMotion("Lift", 0, seed=1, guide="", noise=0.1, smoothness=smoothness)
    )
    actions = np.array([babbler.predict(None)[0] for _ in range(20_000)])
    assert actions.std() == pytest.approx(0.1, rel=0.05)
    assert np.corrcoef(actions[1:, 0], actions[:-1, 0])[0, 1] == pytest.approx(smoothness, abs=0.02)


class Holding:
    """Grips from its tenth step on."""

    steps = 0

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.steps += 1
        return np.array([0.01, 0.01, 0.01, 1.0 if self.steps > 10 else -1.0]), state


def test_what_is_held_is_pressed_down_or_aside_for_a_while_and_the_grip_is_kept():
    env = FakeEnv()
    env.action_space, env.gripper_actions = gym.spaces.Box(-1.0, 1.0, (4,), np.float32), (3,)
    babbler = MotionPolicy(
        env, TrainingMotion("Lift", 0, seed=2, guide="", noise=1e-6, press=PRESS.probability)
    )
    babbler._guide = Holding()
    actions = np.array([babbler.predict(None)[0] for _ in range(3000)])
    pressed = np.abs(actions[:, :3]).max(axis=1) > 0.05
    assert not pressed[: 10 + STEPS_TO_GRIP].any()  # nothing was held for long
    assert 0.3 < pressed.mean() < 0.7
    assert PRESS.strength[1] >= np.abs(actions[pressed, :3]).max() > 0.4
    starts = actions[1:][pressed[1:] & ~pressed[:-1]]
    down = (starts[:, 2] < 0) & (starts[:, :2] == 0).all(axis=1)
    assert 0.35 < down.mean() < 0.65
    assert ((starts[:, 2] == 0) & (starts[:, 0] != 0)).any()
    assert (starts[:, 2] > 0).any()
    assert (actions[11:, 3] > 0).all()


def test_a_recorded_lesson_is_the_same_again_and_leaves_the_simulator_as_it_was(tmp_path):
    lesson = next(
        n for n in curriculum(["Lift"], 40, seed=0) if n.noise and n.guide and n.weight != 1
    )
    make = partial(record_motion, config=RolloutConfig())
    first = load_episode(make(lesson, folder=tmp_path / "a"))
    make(lesson._replace(weight=1.4, seed=lesson.seed + 1), folder=tmp_path / "b")
    again = load_episode(make(lesson, folder=tmp_path / "c"))
    np.testing.assert_array_equal(first.stream, again.stream)
    assert first.contact_force.shape == (len(first),)
    assert first.label == EpisodeLabel("Lift", "babble", seed=lesson.seed)
    assert not first.faults.size
    made = []
    make_missing(made.append, [lesson], lambda n: tmp_path / "a" / n.path, 1)
    assert made == []  # it is there already


def test_the_limit_of_a_hands_speed_changes_now_and_then_and_slows_it_down():
    env, found = gym.make("asm_gym/Lift-v0"), {}
    for limit in (0.0, 0.05):
        lesson = TrainingMotion("Lift", 0, seed=3, speed=1.5, limit=limit)
        found[limit] = [
            (info.get("braked", 0.0), env.unwrapped.contact_limits)
            for info in steps_of(env, lesson)
        ]
    env.close()
    assert {limits for _, limits in found[0.0]} == {None}
    speeds = [limits.hand_speed for _, limits in found[0.05]]
    assert len(set(speeds)) > 2
    assert 0.05 <= min(speeds) <= max(speeds) <= 1.0
    assert max(braked for braked, _ in found[0.05]) > 0.5


def steps_of(env, lesson):
    """Yield what is said of each step."""
    policy, (observation, _) = MotionPolicy(env, lesson), env.reset(seed=lesson.seed)
    for _ in range(90):
        observation, *_, info = env.step(policy.predict(observation)[0])
        yield info


ARM = StreamSpec(
    (Channel("external_torque_peak", 2, "N m"), Channel("action", 1, group="action")), dt=0.05
)


def lesson_of(forces, torques, noise=0.0, number=0, task="Lift", rows=1):
    """A recorded lesson that felt these forces [N] in its steps, and these torques [N m] in its rows."""
    stream = np.zeros((len(torques), 3), np.float32)
    stream[:, 0] = np.negative(torques)
    assert len(stream) == rows * len(forces)
    lesson = TrainingMotion(task, number, seed=number, noise=noise)
    about = {"skill": task, "lesson": lesson._asdict()}
    return Episode(
        stream,
        ARM,
        success=True,
        contact_force=np.array(forces, np.float32),
        label=lesson.trial.label,
        info=about,
    )


@pytest.mark.parametrize(("noise", "force", "torque"), [(0.0, 80, 40), (0.1, 40, 20)])
def test_what_presses_harder_than_is_learned_is_cut_out_with_what_is_near(noise, force, torque):
    calm = [lesson_of([5, 40, 0] * 20, [1, 20, 3] * 20, number=n) for n in (0, 4)]
    hits = lesson_of([force] * 27 + [force + 0.1] + [0] * 32, [torque] * 60, noise, number=1)
    hits = replace(hits, success=False)  # what is usual is asked of solved lessons
    at_stop = lesson_of([0] * 60, [torque] * 22 + [torque + 0.1] + [0] * 37, noise, number=3)
    at_stop = replace(at_stop, success=False)
    assert [len(e) for e in healthy([*calm, hits, at_stop, undisturbed()]).fit] == [
        60,
        60,
        23,
        28,
        33,
    ]
    careful = lesson_of([5, 9, 0] * 20, [1, 2, 3] * 20)
    firm = lesson_of(
        [KNOWN.force] * 27 + [KNOWN.force + 1] + [0] * 32, [KNOWN.torque] * 60, noise, number=1
    )
    firm = replace(firm, success=False)
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
        replace(e, contact_force=np.zeros(0, np.float32))
        for e in [*calm, lesson_of([0] * 60, [3] * 40 + [6.1] * 20)]
    ]
    assert [len(e) for e in harmless(unfelt)] == [60, 60, 60, 36]
    acted = replace(
        calm[0], actions=np.zeros((60, 1), np.float32), observations=np.zeros((61, 2), np.float32)
    )
    np.testing.assert_array_equal(harmless([acted])[0].stream, acted.stream)


def test_rows_with_a_missing_number_are_not_harmless():
    spec = StreamSpec((Channel("external_torque_peak", 1, "N m"), Channel("pose", 1, "m")), dt=0.05)
    stream = np.ones((100, 2))
    stream[50, 1] = np.nan
    pieces = harmless([Episode.from_stream(stream, spec)])
    assert [len(piece) for piece in pieces] == [46, 45]
    assert all(np.isfinite(piece.stream).all() for piece in pieces)


def test_a_task_needs_a_solved_lesson_without_noise_and_something_must_be_left():
    crashed = replace(lesson_of([1] * 30, [1] * 30, task="Door"), success=False)
    with pytest.raises(ValueError, match="no undisturbed motion of Door was solved"):
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
        (
            {"false_alarms_per_hour": 1.0, "healthy_episodes": 0, "tasks": ("Lift",)},
            "1 false alarms an hour need",
        ),
    ],
)
def test_the_command_refuses_what_makes_no_sense(given, why):
    with pytest.raises(ValueError, match=why):
        Args(**given)


def test_hours_are_the_same_in_each_task_and_episodes_fewer_where_they_are_longer():
    by_hours = Args(tasks=("Lift", "Stack"), healthy_hours=1.0)
    assert [by_hours.healthy(task) for task in by_hours.tasks] == [720, 360]  # of 5 and 10 s
    assert Args(tasks=("Lift", "Stack"), healthy_episodes=90).healthy("Stack") == 90
    with pytest.raises(ValueError, match="healthy_hours must be at least 0"):
        Args(healthy_hours=-1.0)


def test_agents_are_examined_where_they_were_trained_and_arms_where_their_experts_succeed():
    panda = {(e.task, e.policy): e.known for e in Args().cases}
    assert panda["Lift", "lift_sac"] is panda["PickPlaceMilk", "scripted"] is False
    assert panda["PickPlaceCan", "scripted"] is True
    assert {e.policy for e in Args(robot="Sawyer").cases} == {"scripted"}
    iiwa = Args(robot="IIWA")
    assert iiwa.shown == ("Lift", "Stack", "PickPlaceCan", "PickPlaceBread", "PickPlaceCereal")
    assert [e.task for e in iiwa.cases if not e.known] == ["PickPlaceMilk"]


@pytest.mark.slow  # 48 episodes of two tasks, and a fit
def test_the_command_makes_a_memory_of_a_body_and_goes_on_where_it_was(tmp_path):
    folder = tmp_path / "run"
    assert main(["--quick", "--workers", "1", "--out", str(folder)]) == 0
    memory = NeuralASM.load(folder / "panda.asm")
    assert memory.about["controller"] == "OSC_POSE"
    assert memory.threshold > 0
    written = {f: f.stat().st_mtime_ns for f in folder.rglob("*.npz")}
    assert len(written) == 2 * 24
    assert main(["--quick", "--workers", "1", "--out", str(folder)]) == 0
    assert {f: f.stat().st_mtime_ns for f in folder.rglob("*.npz")} == written
    # it is another's
    assert main(["--quick", "--workers", "1", "--robot", "Sawyer", "--out", str(folder)]) == 2


def test_an_exam_pairs_every_fault_with_a_healthy_twin():
    labels = EvaluationCase("Lift", "scripted", known=False).trials(3, ["push", "slip"], seed=5)
    nominal = [n for n in labels if n.role == "nominal"]
    assert [n.seed for n in nominal] == [
        n.seed for n in EvaluationCase("Lift", "lift_sac", known=True).trials(3, [], 5)
    ]
    faulty = [n for n in labels if n.role == "faulty"]
    assert [n.kind for n in faulty] == ["push", "push", "slip", "slip"]
    assert {n.seed for n in faulty} == {n.seed for n in nominal}
    assert all(n.onset is not None and n.onset >= 10 for n in faulty)


def test_alarms_are_counted_by_event_and_faults_at_any_threshold():
    def trace(fault, knock=0.0, stop=0.0, onset=None):
        rows = [np.repeat(value, 36).astype(float) for value in (fault, knock, stop)]
        rows[0][:onset] = 0.0 if onset else rows[0][0]
        kind = ("nominal", "") if onset is None else ("slip", "strong")
        excused = {"knock": rows[1], "stop": rows[2]}
        return ScoredEpisode(kind[0], 0, 1.0, 4.0, rows[0], onset, kind[1], excused=excused)

    solved = [
        trace(5.0, 150.0),
        *[trace(3.0, 90.0)] * 2,
        *[trace(2.0, stop=60.0)] * 3,
        *[trace(1.0)] * 94,
    ]
    found = [hourly_alarms(solved, *event) for event in ((), ("knock",), ("stop",))]
    assert [rate.k for rate in found] == [1, 2, 3]  # what is a fault is no knock beside it
    assert found[0].hours == pytest.approx(1.0)
    marks = Scores("Lift", solved, [], DetectionMetrics("Lift", [trace(3.5, onset=1)], solved, 1.0))
    assert summary([marks]).endswith("in 1.00 healthy hours, 0 of 1 faults found.")
    assert summary([marks.at(3.2)]).endswith("1 of 1 faults found.")
    # surprises less often than it may
    calm = marks._replace(solved=[trace(1.0)] * 100).adapted(20.0)
    assert summary([calm]).endswith("1 of 1 faults found.")
    louder = marks._replace(solved=[trace(5.0)] * 100)
    adapted = louder.adapted(5.0)
    assert (hourly_alarms(louder.solved).k, hourly_alarms(adapted.solved).k <= 8) == (100, True)
    assert summary([adapted]).endswith("0 of 1 faults found.")


def test_an_agent_that_crashes_in_most_of_its_episodes_does_not_say_what_is_usual():
    def nominal(seed, force, success=True):
        label = EpisodeLabel("Lift", "nominal", seed=seed)
        return replace(lesson_of([0, force, 0] * 20, [0] * 60), label=label, success=success)

    agents_own = [nominal(0, 9), nominal(1, 80), nominal(2, 90), nominal(3, 500, success=False)]
    assert usual_force(agents_own) == 80
    memory = SimpleNamespace(
        threshold=1.0, spec=ARM, score_episodes=lambda episodes: [quiet(e) for e in episodes]
    )
    marks = evaluate_case(memory, "Lift", agents_own, expert_force=10.0)
    assert [[t.seed for t in own] for own in (marks.solved, marks.failed)] == [[0, 1, 2], [3]]


def quiet(episode):
    """No surprise at all."""
    return Surprise(np.zeros(len(episode)), np.zeros_like(episode.stream))


@pytest.mark.parametrize("rows", [1, 5])
def test_a_fault_begins_in_the_row_of_its_step_where_a_step_has_several(rows):
    label = EpisodeLabel("Lift", "faulty", "push", "strong", seed=1, onset=12)
    jump = replace(lesson_of([0] * 40, [0] * (40 * rows), rows=rows), label=label)
    jump.stream[12 * rows :, 0] += 5.0
    twin = replace(
        lesson_of([0] * 40, [0] * (40 * rows), rows=rows),
        label=replace(label, role="nominal", onset=None),
    )
    assert onset_row(jump) == 12 * rows
    assert onset_row(twin) is None
    # nobody says otherwise
    assert onset_row(replace(jump, contact_force=np.zeros(0, np.float32))) == 12
    (seen,) = detectability_of([twin], [jump], window_s=0.05)
    assert seen.delay == pytest.approx(0.05)
