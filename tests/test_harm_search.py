"""The search for the hardest contact: what it tries, and what it says of it."""

import json

import numpy as np
import pytest

from asm_gym.policies.hostile_program import (
    LATEST,
    MOST_MOTIONS,
    Program,
    Segment,
    changed_program,
    random_program,
)
from asm_gym.scripts.reproduce import harm_search, kit
from asm_gym.scripts.reproduce.harm_search import Search, searched, tried

DOWN = Segment(steps=30, motion=(0.0, 0.0, -1.0, 0.0, 0.0, 0.0), grip=0.0)
REST = Segment(steps=10, motion=(0.0,) * 6, grip=0.0)


def test_programs_stay_within_their_bounds_however_often_they_are_changed():
    rng = np.random.default_rng(0)
    program = random_program(rng)
    for _ in range(500):
        program = changed_program(program, rng)
        assert 1 <= len(program.segments) <= MOST_MOTIONS
        assert 0 <= program.expert_steps <= LATEST
        assert all(np.abs(segment.motion).max() <= 1.0 for segment in program.segments)


def test_a_program_repeats_its_motions_or_goes_on_with_the_last():
    program = Program(0, expert_steps=0, waits=True, repeats=False, segments=(DOWN, REST))
    assert program.at(29) == DOWN
    assert program.at(500) == REST
    again = program._replace(repeats=True)
    assert again.at(39) == REST
    assert again.at(40) == DOWN


def test_a_search_finds_harder_programs_than_chance_and_the_same_ones_again(monkeypatch):
    def pretended(search, program):
        """The most force for a program that goes down, of several motions."""
        down = -min(segment.motion[2] for segment in program.segments)
        return {"force": 10.0 * len(program.segments) + down, "program": repr(program)}

    monkeypatch.setattr(harm_search, "tried", pretended)
    found = searched(Search("Lift", "Panda", "default", seed=3, episodes=120))
    forces = [record["force"] for record in found]
    assert max(forces[30:]) > max(forces[:30])
    assert searched(Search("Lift", "Panda", "default", seed=3, episodes=120)) == found


def test_the_hardest_contact_of_an_episode_is_told_with_its_bodies():
    program = Program(5, expert_steps=0, waits=True, repeats=True, segments=(DOWN,))
    alone = tried(Search("Lift", "Panda", "policy alone", 0, 1), program)
    assert alone["force"] > 300.0
    assert "table" in alone["bodies"]
    assert alone["speed"] > 0.1
    guarded = tried(Search("Lift", "Panda", "default", 0, 1), program)
    assert 0.0 < guarded["force"] < 250.0
    json.dumps(guarded)


def test_an_interrupted_run_goes_on_where_it_was(tmp_path):
    config = kit.Config(workers=1, out=tmp_path)
    done = []

    def work(item):
        if item == 3 and done.count(3) == 0:
            done.append(3)
            raise KeyboardInterrupt
        done.append(item)
        return {"square": item**2, "not a number": np.nan}

    with pytest.raises(KeyboardInterrupt):
        kit.resumed("items", work, range(5), config)
    found = kit.resumed("items", work, range(5), config)
    assert [record["square"] for record in found] == [0, 1, 4, 9, 16]
    assert done == [0, 1, 2, 3, 3, 4]
    assert list(tmp_path.iterdir()) == []  # another run begins anew


FOREARM_ROLLS = Program(
    scene=884,
    expert_steps=59,
    waits=True,
    repeats=False,
    segments=(
        Segment(steps=19, motion=(0.0, -1.0, 0.0, 0.0, 0.0, 0.0), grip=0.0),
        Segment(steps=47, motion=(0.0, -1.0, 0.0, 0.0, 1.0, -0.3266221731614227), grip=0.0),
    ),
)
LINK_GRAZES = Program(
    scene=747,
    expert_steps=4,
    waits=False,
    repeats=False,
    segments=(
        Segment(
            steps=36,
            motion=(
                -0.3031793328830368,
                1.0,
                -0.5963026699043733,
                0.9951607840935307,
                -0.14139299133996916,
                -0.16496831430307995,
            ),
            grip=-1.0,
        ),
    ),
)
FOREARM_WHERE_HANDS_WENT = FOREARM_ROLLS._replace(
    scene=998,
    expert_steps=68,
    waits=False,
    segments=(FOREARM_ROLLS.segments[0]._replace(steps=6), FOREARM_ROLLS.segments[1]),
)
MOTORS_SATURATE = Program(
    scene=998,
    expert_steps=68,
    waits=True,
    repeats=False,
    segments=(
        FOREARM_ROLLS.segments[0],
        Segment(
            steps=47,
            motion=(
                -0.5691938425758674,
                -1.0,
                0.08727879322966259,
                -0.08212797269455704,
                1.0,
                -0.39228989508487827,
            ),
            grip=0.0,
        ),
    ),
)
PALM_AT_A_BIN = Program(
    scene=81,
    expert_steps=20,
    waits=True,
    repeats=True,
    segments=(
        Segment(
            steps=55,
            motion=(1.0, -0.1646463740289117, 0.18748324649253, 0.0, 0.0, 0.3241855882235751),
            grip=1.0,
        ),
    ),
)
AT_A_JOINT_STOP = Program(
    scene=478,
    expert_steps=0,
    waits=True,
    repeats=False,
    segments=(
        Segment(
            steps=21,
            motion=(0.3362334315023763, 0.016576024447553683, 0.0, 0.530085056410041, -1.0, 0.0),
            grip=-1.0,
        ),
        Segment(
            steps=14,
            motion=(
                -0.47605087996597745,
                -0.08386428455986797,
                0.31458789036858537,
                0.09273899002427892,
                -1.0,
                0.305413594658823,
            ),
            grip=1.0,
        ),
        Segment(
            steps=48,
            motion=(
                0.13261707313205037,
                -0.11396714277574171,
                -0.8001179254559646,
                0.08689648026550614,
                -0.06487935081623997,
                0.5642353712765295,
            ),
            grip=1.0,
        ),
    ),
)


@pytest.mark.parametrize(
    ("task", "program"),
    [
        ("Stack", FOREARM_ROLLS),
        ("Stack", FOREARM_WHERE_HANDS_WENT),
        ("Stack", MOTORS_SATURATE),
        ("NutAssemblySquare", LINK_GRAZES),
        ("NutAssemblySquare", AT_A_JOINT_STOP),
        ("PickPlaceCan", PALM_AT_A_BIN),
    ],
)
def test_what_searches_found_meets_things_gently(task, program):
    """Each was beyond 280 N, in a version of the guard that did not know of what the program is named after.

    FOREARM_WHERE_HANDS_WENT had the limit of a hand; for PALM_AT_A_BIN MuJoCo tells wrong nearest points.
    """
    assert tried(Search(task, "Panda", "default", 0, 1), program)["force"] < 260.0
