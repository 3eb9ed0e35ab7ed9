"""Traces against their closed form."""

from __future__ import annotations

import numpy as np

from asm_gym.memory.traces import DECAYS, advance, at_rest, fit_gains


def test_a_trace_is_the_exponentially_weighted_sum_of_all_rows():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(30, 2, 3)).astype(np.float32)
    gains = rng.uniform(0.1, 1.0, len(DECAYS)).astype(np.float32)
    traces = at_rest(2, 3)
    for row in rows:
        traces = advance(traces, row, gains)
    age = np.arange(len(rows))[::-1]
    weights = DECAYS[:, None].astype(float) ** age  # (K, T); 0⁰ is 1: the fastest trace is the row itself
    expected = np.einsum("kt,tbr->bkr", weights, rows) * gains[:, None]
    np.testing.assert_allclose(traces, expected.reshape(2, -1), atol=1e-4)


def test_gains_give_every_trace_a_mean_square_of_one():
    rng = np.random.default_rng(1)
    episodes = [np.cumsum(rng.normal(size=(T, 4)), axis=0).astype(np.float32) for T in (60, 20, 90)]
    gains = fit_gains(episodes)
    squares = []
    for rows in episodes:
        traces = at_rest(1, 4)
        for row in rows:
            traces = advance(traces, row[None], gains)
            squares.append(traces.reshape(len(DECAYS), 4) ** 2)
    np.testing.assert_allclose(np.mean(squares, axis=(0, 2)), 1.0, rtol=1e-3)


def test_traces_of_nothing_stay_at_rest_and_a_batch_is_its_streams():
    gains = fit_gains([np.zeros((5, 2), np.float32)])
    assert np.isfinite(gains).all()
    assert not advance(at_rest(1, 2), np.zeros((1, 2), np.float32), gains).any()
    rng = np.random.default_rng(2)
    c, rows = rng.normal(size=(4, len(DECAYS) * 2)).astype(np.float32), rng.normal(size=(4, 2)).astype(np.float32)
    one_by_one = np.concatenate([advance(c[n : n + 1], rows[n : n + 1], gains) for n in range(4)])
    np.testing.assert_array_equal(advance(c, rows, gains), one_by_one)
