"""Hands go faster where they have passed freely before, and lose that at the places of a contact or an alarm."""

import gymnasium as gym
import numpy as np
import pytest

from asm_gym import NeuralASM, NeuralASMSafety
from asm_gym.detection.hand_speed_map import HandSpeedMap
from asm_gym.guard.earned_speed import EarnedSpeed
from asm_gym.guard.robot_table import ROBOT
from asm_gym.spec import Channel, StreamSpec

SPEC = StreamSpec(
    channels=(
        Channel("hand_position", 3),
        Channel("hand_velocity", 3),
        Channel("hand_angular_velocity", 3),
    ),
    dt=0.05,
)
HERE = np.array([0.5, 0.1, 0.3])
ALONG_X = np.array([1.0, 0, 0, 0, 0, 0])
FASTEST = 0.3  # healthy hands elsewhere [m/s]
ONE = np.ones(1, bool)


@pytest.fixture
def earned():
    cells = np.zeros((1, 16))
    cells[0, :4] = 0, 30, 30, 30
    cells[0, 4:] = FASTEST
    return EarnedSpeed(SPEC, 1, HandSpeedMap(cells))


def pass_by(earned, speed, trouble="", steps=30, place=HERE):
    """Let an episode pass a place at a speed, and end; say whether anything changed."""
    robots = np.zeros(1, ROBOT)
    robots["active"] = True
    for step in range(steps):
        robots["alarm"] = trouble == "alarm" and step == 10
        robots["overridden"] = trouble == "override" and step == 10
        robots["contact_force"] = {"contact": 60.0, "unknown": np.nan}.get(trouble, 5.0)
        row = np.concatenate([place, speed * ALONG_X]).astype(np.float32)
        earned.follow(row[None], robots)
    before = earned.speed_map
    earned.end_episodes(ONE)
    return earned.speed_map is not before


def fastest(earned, place=HERE):
    """Return how fast a hand may be counted on along x."""
    return earned.speed_map.fastest_near(0, place)[0, 0]


def test_a_place_that_two_episodes_have_passed_freely_is_earned(earned):
    assert not pass_by(earned, 0.15)
    assert fastest(earned) == 0.0
    assert pass_by(earned, 0.2)
    assert fastest(earned) == pytest.approx(0.15)
    pass_by(earned, 0.2)
    assert fastest(earned) == pytest.approx(0.2)
    assert fastest(earned, HERE - 0.3) == 0.0
    backwards = earned.speed_map.fastest_near(0, HERE)[1]
    assert not backwards.any()


def test_nothing_faster_is_earned_than_healthy_hands_went_anywhere(earned):
    for _ in range(3):
        pass_by(earned, 5.0)
    assert fastest(earned) == pytest.approx(FASTEST)


@pytest.mark.parametrize("trouble", ["alarm", "override", "contact", "unknown"])
def test_trouble_earns_nothing_and_takes_back_what_was_earned_there(earned, trouble):
    elsewhere = np.add(HERE, (0, 0.2, 0))
    for _ in range(2):
        pass_by(earned, 0.2)
        pass_by(earned, 0.2, place=elsewhere)
    assert pass_by(earned, 0.2, trouble)
    assert fastest(earned) == 0.0
    assert fastest(earned, elsewhere) == pytest.approx(0.2)
    assert not pass_by(earned, 0.2, trouble)


def test_only_the_second_before_trouble_counts_against_a_place(earned):
    elsewhere = np.add(HERE, (0, 0.2, 0))
    for _ in range(2):
        pass_by(earned, 0.2)
        pass_by(earned, 0.2, place=elsewhere)
    robots = np.zeros(1, ROBOT)
    robots["active"] = True
    robots["contact_force"] = 5.0
    for place in [HERE] * 5 + [elsewhere] * 21:
        earned.follow(np.float32([*place, *np.zeros(6)])[None], robots)
    robots["alarm"] = True
    earned.follow(np.float32([*elsewhere, *np.zeros(6)])[None], robots)
    earned.end_episodes(ONE)
    assert fastest(earned) == pytest.approx(0.2)
    assert fastest(earned, elsewhere) == 0.0


def test_what_is_kept_is_where_the_next_one_begins(earned):
    for _ in range(2):
        pass_by(earned, 0.2)
    healthy = HandSpeedMap(np.array([[0, 30, 30, 30, *[0.1] * 12]]))
    again = EarnedSpeed(SPEC, 1, healthy, earned.cells)
    assert fastest(again) == pytest.approx(0.1)  # these healthy hands were slower
    same = EarnedSpeed(
        SPEC, 1, HandSpeedMap(np.array([[0, 30, 30, 30, *[1.0] * 12]])), earned.cells
    )
    assert fastest(same) == pytest.approx(0.2)


def test_what_one_robot_loses_another_does_not_keep_in_its_next_episode():
    healthy = HandSpeedMap(np.array([[0, 30, 30, 30, *[FASTEST] * 12]]))
    earned = EarnedSpeed(SPEC, 2, healthy)
    robots = np.zeros(2, ROBOT)
    robots["active"] = True
    robots["contact_force"] = 5.0
    row = np.concatenate([HERE, 0.2 * ALONG_X]).astype(np.float32)
    earned.follow(np.tile(row, (2, 1)), robots)
    earned.end_episodes(np.ones(2, bool))
    assert fastest(earned) == pytest.approx(0.2)
    robots["alarm"] = [True, False]
    earned.follow(np.tile(row, (2, 1)), robots)
    earned.end_episodes(np.array([True, False]))
    assert fastest(earned) == 0.0


def test_an_endless_episode_earns_by_the_minute_and_keeps_no_more_rows(earned):
    robots = np.zeros(1, ROBOT)
    robots["active"] = True
    robots["contact_force"] = 5.0
    row = np.concatenate([HERE, 0.2 * ALONG_X]).astype(np.float32)[None]
    for _ in range(2 * 1200):
        earned.follow(row, robots)
    assert fastest(earned) == pytest.approx(0.2)


def slow_circles(env, episodes, seed=0):
    """Move the hand to and fro above the table; return the greatest share that was slowed in each episode."""
    slowed = []
    for _ in range(episodes):
        env.reset(seed=seed)
        shares = []
        for step in range(40):
            action = np.zeros(7, np.float32)
            action[:2] = 1.0 if step % 20 < 10 else -1.0
            *_, info = env.step(action)
            shares.append(info["asm"]["slowed"])
        slowed.append(float(np.mean(shares)))
    env.reset(seed=seed)
    return slowed


def test_a_guard_lets_hands_go_faster_from_episode_to_episode_and_a_memory_keeps_it(tmp_path):
    memory = NeuralASM.pretrained("panda")
    env = NeuralASMSafety(gym.make("asm_gym/NutAssemblyRound-v0"), memory)
    slowed = slow_circles(env, 6)
    assert slowed[0] > 0.1
    assert slowed[-1] < 0.6 * slowed[0]

    env.keep_earned_speed()
    memory.save(tmp_path / "round.asm")
    kept = NeuralASM.load(tmp_path / "round.asm")
    again = NeuralASMSafety(env.env, kept)
    assert slow_circles(again, 1)[0] < 0.7 * slowed[0]
    never = NeuralASMSafety(env.env, kept, earns_speed=False)
    assert slow_circles(never, 2)[1] == pytest.approx(slowed[0], abs=0.02)
    with pytest.raises(ValueError, match="earns_speed"):
        never.keep_earned_speed()
    env.close()


def test_in_a_task_whose_pace_is_known_nothing_is_earned():
    env = NeuralASMSafety(gym.make("asm_gym/Lift-v0"))
    assert slow_circles(env, 2)[0] == slow_circles(env, 2)[1]
    with pytest.raises(ValueError, match="pace"):
        env.keep_earned_speed()
    env.close()
