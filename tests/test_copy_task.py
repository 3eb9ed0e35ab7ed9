"""The copy task: a symbol must be said again many steps later, so that an error has to teach what is long past."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.memory.dynamics import DYNAMICS
from asm_gym.memory.energy import Array
from asm_gym.memory.learning import Schedule, Trajectory

SYMBOLS, HIDDEN, UPDATES = 8, 32, 2500


def sequences(delay: int) -> Array:
    """(SYMBOLS, T, SYMBOLS): each symbol is shown, then there is nothing for ``delay`` steps, then it comes again."""
    rows = np.zeros((SYMBOLS, delay + 2, SYMBOLS), np.float32)
    for symbol in range(SYMBOLS):
        rows[symbol, [0, -1], symbol] = 2.0
    return rows


def said_again(dynamics: str, shown: Array, rng: np.random.Generator) -> float:
    """Share of the symbols that are expected rightly when they come again; (N, T, SYMBOLS)."""
    one, how = np.ones((shown.shape[1], 1), np.float32), DYNAMICS[dynamics]
    episodes = [Trajectory(rows, one, one) for rows in shown]
    passes = round(UPDATES * 16 / (len(shown) * len(one)))
    schedule = Schedule(passes, 16, 3e-3, how.iterations, how.prior_precision, 1.0, 0.0)
    network = how.learn(episodes, HIDDEN, schedule, rng, lambda: None).network
    c, u, seen = network.at_rest(SYMBOLS), np.ones((SYMBOLS, 1), np.float32), np.ones((SYMBOLS, SYMBOLS), np.float32)
    for x in shown.transpose(1, 0, 2):
        expected = network.predict(c, u)
        c = network.follow(c, u, x, seen).traces
    return float(np.mean(expected.argmax(axis=1) == np.arange(SYMBOLS)))


@pytest.mark.parametrize("delay", [10, 30])
def test_traces_carry_a_symbol_over_the_delay_and_a_state_that_one_step_teaches_does_not(delay):
    shown = sequences(delay)
    assert said_again("traces", shown, np.random.default_rng(0)) == 1.0
    assert said_again("settling", shown, np.random.default_rng(0)) < 0.7
