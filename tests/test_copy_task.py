"""The copy task: a symbol must be said again many steps later, so that an error has to teach what is long past."""

from __future__ import annotations

import numpy as np

from asm_gym.scripts.reproduce.sequences import copies, said_again


def test_every_order_is_shown_and_comes_again_after_nothing():
    rows = copies(4, 2, 3)
    assert rows.shape == (16, 7, 4)
    np.testing.assert_array_equal(rows[:, :2], rows[:, -2:])
    assert not rows[:, 2:5].any()
    assert len({tuple(order) for order in rows[:, :2].argmax(axis=2)}) == 16


def test_traces_carry_a_symbol_over_a_delay_and_a_state_that_one_step_teaches_does_not():
    shown = copies(8, 1, 30)
    assert said_again("traces", shown, 1, 2500, np.random.default_rng(0)) == 1.0
    assert said_again("settling", shown, 1, 2500, np.random.default_rng(0)) < 0.7


def test_a_network_trained_through_time_carries_a_symbol_too():
    assert said_again("gru", copies(8, 1, 5), 1, 2500, np.random.default_rng(0)) == 1.0
