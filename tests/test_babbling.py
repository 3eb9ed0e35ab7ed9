"""Motor babbling: what its curriculum holds, and how it acts."""

from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.episode import EpisodeLabel, load_episode
from asm_gym.policies.network import NetworkPolicy
from asm_gym.policies.registry import SHIPPED
from asm_gym.policies.scripted.base import ObservationReader
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
from asm_gym.rollouts.pretraining.healthy import held_out
from asm_gym.rollouts.pretraining.reaching import AROUND, PACE, TURNED, Reaching
from asm_gym.rollouts.run_folder import make_missing
from asm_gym.rollouts.trial import RolloutConfig
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
    aims, came = [], []
    for _ in range(95):
        action, state = reach.predict(observation, state)
        assert np.linalg.norm(action[:3]) <= PACE * (1 + 1e-6)
        if not aims or state.place is not aims[-1].place:
            far = np.linalg.norm(read(observation, "hand_position") - state.place)
            aims.append(state)
            came.append(0.0)
        observation = env.step(action)[0]
        came[-1] = max(came[-1], 1 - np.linalg.norm(read(observation, "hand_position") - state.place) / far)
    env.close()
    assert len(aims) >= 2
    assert came[0] > 0.3  # of the way
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
        babbler._fumbles = False
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
