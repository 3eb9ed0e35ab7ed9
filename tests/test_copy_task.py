"""The copy task: a symbol must be said again many steps later, so that an error has to teach what is long past."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.memory.energy import Array
from asm_gym.memory.inference import direct, expect, infer, sense
from asm_gym.memory.learning import Schedule, Synapse, Trajectory, coincidence, cosine_decay
from asm_gym.memory.network import initial_weights
from asm_gym.memory.scheduled_sampling import learn
from asm_gym.memory.traces import advance, at_rest, fit_gains

SYMBOLS, HIDDEN, UPDATES = 8, 32, 2500


def sequences(delay: int) -> Array:
    """(SYMBOLS, T, SYMBOLS): each symbol is shown, then there is nothing for ``delay`` steps, then it comes again."""
    rows = np.zeros((SYMBOLS, delay + 2, SYMBOLS), np.float32)
    for symbol in range(SYMBOLS):
        rows[symbol, [0, -1], symbol] = 2.0
    return rows


def said_again(expected: Array) -> float:
    """Share of the symbols that were expected rightly when they came again; (N, T, SYMBOLS)."""
    return float(np.mean(expected[:, -1].argmax(axis=1) == np.arange(SYMBOLS)))


def by_traces(shown: Array, rng: np.random.Generator) -> float:
    """The memory as it learns now: the traces are carried on."""
    one = np.ones((shown.shape[1], 1), np.float32)
    episodes = [Trajectory(rows, one, one) for rows in shown]
    weights = initial_weights(HIDDEN, SYMBOLS, 0, rng)
    weights.gains[:] = fit_gains([np.hstack([e.senses, e.commands]) for e in episodes])
    passes = round(UPDATES * 16 / (len(shown) * len(one)))
    learn(weights, episodes, Schedule(passes, 16, 3e-3, 5, 30.0, 1.0, 0.0), rng, lambda: None)
    c, u, expected = at_rest(SYMBOLS, SYMBOLS + 1), np.ones((SYMBOLS, 1), np.float32), []
    for x in shown.transpose(1, 0, 2):
        expected.append(direct(c, u, weights.W_D) + sense(expect(c, weights.W_C), weights.W_F))
        c = advance(c, np.hstack([x, u]), weights.gains)
    return said_again(np.stack(expected, axis=1))


def by_a_carried_state(shown: Array, rng: np.random.Generator) -> float:
    """As it learned before: the inferred state is carried on, through synapses that learn from one step's error.

    μ_t = W_H f(z_{t-1}) + b,   x̂_t = W_F f(z_t),   ΔW_H ∝ Π_z (z_t - μ_t) f(z_{t-1})ᵀ,   ΔW_F ∝ ε_x f(z_t)ᵀ
    """
    W_H = (rng.standard_normal((HIDDEN, HIDDEN + 1)) / np.sqrt(HIDDEN)).astype(np.float32)
    W_F = (0.1 * rng.standard_normal((SYMBOLS + 1, HIDDEN))).astype(np.float32)  # the last row sees a constant 1
    into, out_of = Synapse(W_H), Synapse(W_F)

    def follow(rows: Array, rate: float) -> Array:
        z, expected = np.zeros((len(rows), HIDDEN), np.float32), []
        one = np.ones((len(rows), 1), np.float32)
        for x in rows.transpose(1, 0, 2):
            before = np.hstack([np.tanh(z), one])
            mu, now = before @ W_H.T, np.hstack([x, one])
            expected.append(sense(mu, W_F)[:, :SYMBOLS])
            curvature = np.float32(1.0 + np.linalg.norm(W_F, 2) ** 2)
            z = infer(mu, now, W_F, np.float32(1), np.ones_like(now), curvature, 20)
            if rate:
                into.learn(coincidence(z - mu, before), rate)
                out_of.learn(coincidence(now - sense(z, W_F), np.tanh(z)), rate)
        return np.stack(expected, axis=1)

    length = shown.shape[1]
    for n in range(UPDATES // length):
        follow(shown[rng.permutation(len(shown))], cosine_decay(3e-3, n * length / UPDATES))
    return said_again(follow(shown, 0.0))


@pytest.mark.parametrize("delay", [10, 30])
def test_traces_carry_a_symbol_over_the_delay_and_a_state_that_one_step_teaches_does_not(delay):
    shown = sequences(delay)
    assert by_traces(shown, np.random.default_rng(0)) == 1.0
    assert by_a_carried_state(shown, np.random.default_rng(0)) < 0.7
