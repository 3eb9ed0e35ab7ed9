"""Every scripted expert solves its task, keeps it solved, and varies."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest

import asm_gym  # noqa: F401
from asm_gym import collect
from asm_gym.policies import make_policy
from asm_gym.policies.registry import EXPERTS
from asm_gym.policies.scripted.base import Style, has_settled
from asm_gym.policies.scripted.geometry import (
    UP,
    Pose,
    about,
    flattest_side,
    gripping,
    matrix,
    rotation,
)
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.rollouts.seeds import episode_seeds
from tests.rates import attempt, failures, room_to_the_stops, too_few

QUICK = [
    "Lift",
    "Stack",
    "Door",
    "Wipe",
    "TwoArmLift",
    "NutAssemblySquare",
    "NutAssemblyRound",
    "PickPlaceCan",
    "PickPlaceMilk",
    "PickPlaceCereal",
]

RATE = {"NutAssembly": 0.85, "PickPlace": 0.55}
"""How often an expert solves its task, where that is not 98 %."""


@pytest.mark.floats
@pytest.mark.parametrize("task", QUICK)
def test_an_expert_solves_its_task_and_leaves_it_solved(task):
    env = gym.make(f"asm_gym/{task}-v0")

    def trial(seed: int) -> str:
        expert, state = make_policy("scripted", env, seed=seed), None
        observation, _ = env.reset(seed=seed)
        over, solved, room = False, False, np.inf
        while not over:
            action, state = expert.predict(observation, state)
            observation, _, _, over, info = env.step(action)
            solved |= info["success"]
            room = min(room, room_to_the_stops(env))
        if not info["success"]:
            return "not left solved" if solved else "not solved"
        return "" if room > 0.05 else "an arm's joint meets its stop"

    assert not failures(trial, range(10), 0.95)
    env.close()


@pytest.mark.floats
@pytest.mark.parametrize("robot", ["IIWA", "Sawyer"])
@pytest.mark.parametrize("task", ["Lift", "Stack", "PickPlaceCan"])
def test_other_arms_solve_it_too(task, robot):
    def trial(seed: int) -> str:
        return "" if attempt(seed, task, robot).held else "not left solved"

    assert not failures(trial, range(2, 10), 0.9, first=1)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["IIWA", "Sawyer"])
@pytest.mark.parametrize("task", ["Lift", "Stack", "PickPlaceCan"])
def test_other_arms_succeed_on_most_of_100_seeds(task, robot):
    # The IIWA, whose bin is at the end of its reach, solves 92 of 100.
    rate = 0.92 if (task, robot) == ("PickPlaceCan", "IIWA") else 0.97
    made = parallel_map(partial(attempt, task=task, robot=robot), episode_seeds(99, 100), 2)
    assert not too_few(sum(m.solved for m in made), 100, rate)


@pytest.mark.slow
@pytest.mark.parametrize("task", sorted(EXPERTS))
def test_an_expert_succeeds_on_nearly_all_of_100_seeds(task):
    made = collect(f"asm_gym/{task}-v0", episodes=100, seed=99, workers=2)
    assert not too_few(sum(e.success for e in made), 100, RATE.get(task, 0.98))


def test_speed_and_noise_change_the_course():
    env = gym.make("asm_gym/Stack-v0")

    def steps(**style):
        expert, state = make_policy("scripted", env, seed=0, style=Style(speed_spread=0.0, **style)), None
        observation, _ = env.reset(seed=0)
        for step in range(200):
            action, state = expert.predict(observation, state)
            observation, *_, info = env.step(action)
            if info["success"]:
                return step
        return 200

    slow, usual, fast = steps(speed=0.7), steps(), steps(speed=1.3)
    assert slow > usual > fast
    assert steps(noise=0.2) != usual
    env.close()


def test_rotations_are_made_orthonormal_again():
    exact = matrix(np.array([0.1, 0.2, 0.3, np.sqrt(1 - 0.14)]))
    noisy = rotation(np.concatenate([exact[:, 0], exact[:, 1]]) + 1e-3 * np.arange(6))
    np.testing.assert_allclose(noisy.T @ noisy, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(noisy, exact, atol=0.02)
    assert np.linalg.det(noisy) == pytest.approx(1.0)


@pytest.mark.parametrize("degrees", [0, 30, 44, 46, 80, 135])
def test_fingers_close_along_the_nearest_side_of_a_cube(degrees):
    angle = np.radians(degrees)
    cube = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    hand = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    target = gripping(hand, flattest_side(cube), np.pi / 2)
    np.testing.assert_allclose(target[:, 2], [0, 0, -1])
    assert np.linalg.det(target) == pytest.approx(1.0)
    sides = np.abs(cube.T @ target[:, 1])
    assert sides.max() == pytest.approx(1.0)
    assert hand[:, 1] @ target[:, 1] >= np.cos(np.pi / 4) - 1e-9  # never turned further than half a quarter


def test_a_grasp_takes_the_nearest_of_equal_directions():
    hand = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # fingers close along -y
    target = gripping(hand, np.array([0.1, 1.0, 0.0]))
    assert np.degrees(np.arccos(target[:, 1] @ hand[:, 1])) == pytest.approx(5.71, abs=0.01)
    np.testing.assert_allclose(target.T @ target, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("wrist", "turn", "first"),
    [(2.0, 2.5, 1.0), (2.0, -2.5, 1.0), (-2.0, 2.5, -1.0), (0.0, -2.5, -1.0), (2.8, -0.2, -0.2)],
)
def test_a_hand_is_not_turned_through_the_stops_of_its_last_joint(wrist, turn, first, monkeypatch):
    # The joint, which turns the other way than the hand, ends at `wrist - turn`, or at that and a full turn.
    env = gym.make("asm_gym/NutAssemblySquare-v0")
    expert = make_policy("scripted", env, seed=0)
    monkeypatch.setattr(expert, "_wrist", lambda observation: wrist)
    down = np.diag([1.0, -1.0, -1.0])
    turned = expert._turning(None, down, about(UP, turn) @ down)
    assert np.arctan2(turned[1, 0], turned[0, 0]) == pytest.approx(first)
    env.close()


@pytest.mark.parametrize("heading", np.linspace(-3.0, 3.0, 9))
def test_a_nut_is_held_so_that_the_last_joint_has_room_all_along(heading, monkeypatch):
    env = gym.make("asm_gym/NutAssemblySquare-v0")
    expert = make_policy("scripted", env, seed=0)
    observation, _ = env.reset(seed=0)
    data = env.unwrapped.simulation.data
    hand = expert.read.hand(observation).turned
    turned = about(UP, heading)
    monkeypatch.setattr(expert.read, "pose", lambda observation, name: Pose(np.array([-0.1, 0.1, 0.85]), turned))
    task = expert.next_task(observation)
    # Where nothing but the last joint turned the hand: the arm's bearing, small here, is left out.
    place = about(UP, task.headings[0] - heading) @ turned
    for held in (turned, place):
        closing = held @ task.closing
        turn = np.arctan2(closing[1], closing[0]) - np.arctan2(hand[1, 1], hand[0, 1])
        joint = data.joint("robot0_joint7").qpos[0] - turn
        assert abs((joint + np.pi) % (2 * np.pi) - np.pi) < 2.9 - 0.25
    env.close()


@pytest.mark.parametrize(
    ("joints", "velocity", "since", "settled"),
    [
        (2, 9.0, 5, False),
        (2, 9.0, 6, True),
        (6, 0.0, 11, False),
        (6, 0.0, 12, True),
        (6, 1.0, 29, False),
        (6, 1.0, 30, True),
    ],
)
def test_fingers_that_turn_are_waited_for_until_they_stand_still(joints, velocity, since, settled):
    assert has_settled(np.full(joints, velocity), since, 6) == settled
