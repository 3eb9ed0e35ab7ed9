"""Harmless exploration: who explores, and up to where it is harmless."""

import numpy as np
from asm_gym.rollouts.training.exploration import Explorer, Gentle, until_contact

from asm_gym.episode import Episode
from asm_gym.spec import Channel, StreamSpec


def test_exploration_ends_before_the_first_hard_contact():
    spec = StreamSpec((Channel("position", 1, "m"), Channel("external_torque_peak", 2, "N m")), dt=0.05)
    stream = np.zeros((6, 3), np.float32)
    stream[4] = 0.0, 1.0, -11.0
    arrays = {"actions": np.zeros((6, 3)), "observations": np.zeros((7, 2)), "rewards": np.zeros(6)}
    episode = Episode(stream, spec, faults=np.zeros(6, bool), **arrays)
    cut = until_contact(episode, np.array([1.0, 19, 20, 21, 0, 0]), Gentle(20.0, 10.0))
    assert [len(getattr(cut, n)) for n in ("stream", "actions", "rewards", "faults")] == [3] * 4
    assert len(cut.observations) == 4
    assert len(until_contact(episode, np.zeros(6), Gentle(20.0, 10.0))) == 4
    assert len(until_contact(episode, np.zeros(6), Gentle(20.0, 12.0))) == 6


def test_explorers_differ_by_seed_and_pause_with_their_grip_kept(lift):
    observation, _ = lift.reset(seed=1)

    def actions(seed, steps=60):
        explorer, state = Explorer(lift, seed), None
        taken = []
        for t in range(steps):
            action, state = explorer.predict(observation, state, np.array([t == 0]))
            taken.append(action)
        return np.array(taken)

    np.testing.assert_array_equal(actions(3), actions(3))
    assert not np.array_equal(actions(3), actions(4))
    taken = np.concatenate([actions(seed) for seed in range(12)])
    rest = (taken[:, :6] == 0).all(axis=1)
    assert 0.05 < rest.mean() < 0.5
    paused = taken[rest]
    assert (paused[:, 6] != 0).mean() > 0.9
