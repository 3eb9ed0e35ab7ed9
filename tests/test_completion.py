"""Missing senses are completed from all others, any set of them, and a policy sees what is completed."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from asm_gym.memory.completion import Completion
from asm_gym.monitors import Surprise
from asm_gym.wrappers import NeuralASMSafety
from asm_gym.wrappers.capabilities import robots_of
from tests.arms import MEMORY, SENSES, SPEC, STREAMS, Arm, Judge, Repaired, arm, offset


def missing(*columns: int) -> np.ndarray:
    mask = np.zeros(SPEC.size, bool)
    mask[list(columns)] = True
    return mask


@pytest.mark.parametrize("columns", [(0,), (1,), (2,), (0, 1), (2, 3)])
def test_whatever_is_missing_is_completed_from_the_rest_as_well_as_it_says(columns):
    filling, fresh = MEMORY.filling(missing(*columns)), arm(200, 99)
    broken = fresh.copy()
    broken[:, list(columns)] = 5.0  # what a missing sense says does not matter
    completed = MEMORY.complete(filling, MEMORY.lift(broken))
    left = np.sqrt(np.mean((completed - fresh[:, list(columns)]) ** 2, axis=0))
    assert (left < 2.0 * filling.error).all()
    assert (left < 0.1 * SENSES.spread[list(columns)]).all()


def test_completion_is_the_conditional_mean_of_a_gaussian():
    filling, y = MEMORY.filling(missing(0)), MEMORY.lift(STREAMS[0])[5]
    involved = MEMORY.involved(missing(0))
    P = np.linalg.inv(MEMORY.covariance + 1e-4 * np.eye(len(y)))
    # The energy ½ yᵀPy is least, over all that involves the missing sense, where its gradient there is 0.
    centred = y - MEMORY.centre
    inside = np.linalg.solve(
        P[np.ix_(involved, involved)], -P[np.ix_(involved, ~involved)] @ centred[~involved]
    )
    expected = SENSES.mean[0] + SENSES.spread[0] * (MEMORY.centre[0] + inside[0])
    np.testing.assert_allclose(MEMORY.complete(filling, y[None])[0, 0], expected, rtol=1e-6)
    alone = MEMORY.unexplained(y[None])[0, 0]
    np.testing.assert_allclose(centred[0] - alone, inside[0], rtol=1e-6)


def test_what_a_memory_saves_completes_the_same():
    again = Completion.found(MEMORY.named(), SENSES)
    values = [c.complete(c.filling(missing(0)), c.lift(STREAMS[1])) for c in (MEMORY, again)]
    np.testing.assert_allclose(*values, atol=1e-3)
    assert Completion.found({}, SENSES) is None
    with pytest.raises(ValueError, match="completion_centre"):
        Completion.found({**MEMORY.named(), "completion_centre": np.zeros(3)}, SENSES)


def test_a_sense_is_repaired_until_it_is_well_again():
    repair, rows = Repaired(), arm(120, 7)
    for t, row in enumerate(rows):
        faulty = row.copy()
        faulty[0] += 0.3 * (20 <= t < 60)
        seen = repair.read(faulty)
        if t == 22:
            seen = repair.suspect(np.array([0]))
        expected = 0.3 if 20 <= t < 22 else 0.0
        assert abs(seen[0] - row[0] - expected) < 0.05, t
        # whatever else is sensed is handed on to the bit
        np.testing.assert_array_equal(seen[1:], row[1:])
        assert repair.names == (("encoder[0]",) if 22 <= t < 79 else ()), t
    repair.rows.begin(np.ones(1, bool))
    assert not repair.names


def test_numbers_that_are_none_are_completed_at_once_and_several_together():
    repair, rows = Repaired(), arm(30, 8)
    for t, row in enumerate(rows):
        faulty = row.copy()
        if t >= 10:
            faulty[[0, 3]] = np.nan
        seen = repair.read(faulty)
        assert np.isfinite(seen).all()
        np.testing.assert_allclose(seen, row, atol=0.06)
    lost = np.full(SPEC.size, np.nan, np.float32)
    assert not np.isfinite(
        Repaired().read(lost)
    ).all()  # nothing is left to go by, and nobody pretends


def test_what_nothing_else_tells_of_is_trusted_for_a_second_only():
    repair, rows = Repaired(), arm(60, 9)
    trusted = []
    for t, row in enumerate(rows):
        faulty = row.copy()
        if t >= 10:
            faulty[4] = np.nan
        seen = repair.read(faulty)
        trusted.append(repair.trusted)
        if t >= 10:
            assert seen[4] == rows[9, 4]
    assert trusted == [True] * 30 + [False] * 30


def test_surprise_without_a_sense_is_what_the_others_add_to_it():
    attribution = np.array([[1.0, 2.0, 5.0], [0.0, 0.0, 4.0], [0.0, 0.0, 0.0]])
    surprise = Surprise(np.array([8.0, 4.0, np.inf]), attribution)
    left = surprise.without(np.array([False, False, True]))
    np.testing.assert_allclose(left.value, [3.0, 0.0, np.inf])  # what failed goes on to be an alarm
    np.testing.assert_allclose(left.attribution[:2].sum(axis=1), left.value[:2])
    assert surprise.without(np.zeros(3, bool)) is surprise


def played(env, steps):
    out = [env.reset(seed=0)]
    for _ in range(steps):
        observation, *_, info = env.step(np.zeros(2, np.float32))
        out.append((observation, info))
    return out


def test_a_policy_under_the_guard_sees_what_a_faulty_sense_should_say():
    truth = arm(120, 31)
    out = played(NeuralASMSafety(Arm(offset), Judge({21}), on_alarm="graded"), 60)
    for t, (observation, _) in enumerate(out):
        expected = 0.3 if 20 <= t < 22 else 0.0
        assert abs(observation[0] - truth[t, 0] - expected) < 0.05, t
        np.testing.assert_array_equal(observation[1:], truth[t, 1:5])
    assert out[-1][1]["asm"]["completed"] == ("observation[0]",)


def test_an_observation_that_a_wrapper_has_changed_is_refused():
    env = gym.make("asm_gym/Lift-v0")
    shorter = gym.wrappers.TransformObservation(
        env, lambda o: o[:5], spaces.Box(-100, 100, (5,), np.float32)
    )
    robots, places = robots_of(shorter, env.unwrapped.stream_spec, dt=0.05)
    assert places is None
    assert "has changed the observation" in robots.refused["complete"]
    env.close()


@pytest.mark.parametrize("observation", ["flat", "dict"])
def test_the_numbers_of_an_observation_are_found_in_the_stream(observation):
    env = gym.make("asm_gym/Lift-v0", observation=observation, horizon=5)
    spec = env.unwrapped.stream_spec
    seen, info = env.reset(seed=0)
    everything = np.ones(spec.size, bool)
    _, places = robots_of(env, spec, spec.dt)
    same = places.repaired(seen, info["stream"], everything)
    other = places.repaired(seen, info["stream"] + 1, everything)
    if observation == "flat":
        np.testing.assert_array_equal(same, seen)
        assert (other != seen).sum() == 7 + 7 + 3 + 6 + 2 + 2
    else:
        assert all((same[k] == seen[k]).all() for k in seen)
        np.testing.assert_allclose(other["joint_position"], seen["joint_position"] + 1, rtol=1e-6)
        np.testing.assert_array_equal(other["cube_pos"], seen["cube_pos"])
    env.close()
