"""The studies of the papers' network: closed forms, the Riccati equation, and sequences that cannot be told apart."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from asm_gym.scripts.reproduce import sequences, tracking
from asm_gym.scripts.reproduce.tracking import A, C, informed, kalman, recording, settled, squared, tracked


@pytest.fixture(scope="module")
def run():
    return recording(1500, np.random.default_rng(0))


def test_the_kalman_filter_is_as_far_off_as_the_riccati_equation_says(run):
    prior = solve_discrete_are(A.T, C.T, np.eye(3), np.eye(3))
    after = prior - prior @ C.T @ np.linalg.inv(C @ prior @ C.T + np.eye(3)) @ C @ prior
    found, expected = kalman(run)
    assert squared(found, run.states) == pytest.approx(np.trace(after) / 3, rel=0.1)
    # Innovations of a Kalman filter are white: none tells of the next.
    new = run.observed - expected
    assert squared(new, 0 * new) == pytest.approx(np.trace(C @ prior @ C.T + np.eye(3)) / 3, rel=0.1)
    assert np.abs(np.mean(new[1:] * new[:-1], axis=0)).max() < 0.15 * np.mean(new**2)


def test_inference_comes_nearer_to_the_kalman_filter_step_by_step_and_ends_at_the_closed_form(run):
    best, end = kalman(run)[0], settled(run)
    found = {n: tracked(informed(n), run) for n in (1, 2, 4, 10, 1000)}
    errors = [squared(x, run.states) for x in found.values()]
    assert all(later < sooner for sooner, later in itertools.pairwise(errors[:4]))
    apart = [squared(x, best) for x in found.values()]
    assert apart[0] > 2 * apart[1] > 2 * apart[2] > apart[3]
    assert squared(found[1000], end) < 1e-4
    assert squared(best, run.states) < squared(end, run.states) < 2 * squared(best, run.states)


def test_steps_as_long_as_the_authors_end_where_theirs_do_and_begin_nearer(run):
    for length in (0.12, 0.32):
        theirs, ours = (
            {n: f(n) for n in (2, 30)}
            for f in (
                lambda n, x=length: tracking.as_published(run, n, x),
                lambda n, x=length: tracked(informed(n, x), run),
            )
        )
        assert squared(ours[2], run.states) < squared(theirs[2], run.states)
        assert squared(ours[30], theirs[30]) < 0.02


def test_what_is_missing_from_predictive_coding_is_how_sure_it_was(run):
    assert tracking.usual_variance() == pytest.approx(np.trace(solve_discrete_are(A.T, C.T, np.eye(3), np.eye(3))) / 3)
    best = squared(kalman(run)[0], run.states)
    assert (
        squared(settled(run, tracking.usual_variance()), run.states) - best < squared(settled(run), run.states) - best
    )


def test_a_network_learns_what_is_observed_next_nearly_as_the_kalman_filter_knows_it():
    rng, args = np.random.default_rng(0), tracking.Config(updates=8000)
    network, spread = tracking.learned([recording(tracking.LEARNED_STEPS, rng) for _ in range(64)], args, rng)
    fresh = [recording(tracking.LEARNED_STEPS, rng) for _ in range(8)]
    errors = [
        (
            squared(tracking.observations(network, spread, r)[200:], r.observed[200:]),
            squared(kalman(r)[1][200:], r.observed[200:]),
        )
        for r in fresh
    ]
    ours, best = np.mean(errors, axis=0)
    assert best < ours < 1.25 * best


def test_one_that_settles_recalls_what_comes_twice_and_one_layer_cannot():
    args, rng = sequences.Config(updates=1500), np.random.default_rng(0)
    sequence = sequences.patterns(3, 100, 0.0, rng)[list(sequences.ALIASED["A B C B A"])]
    found = sequences.by_network(sequence, "settling", args, rng)
    assert sequences.recalled(found, sequence)[0] == 1.0
    for other in (sequences.by_one_layer(sequence), sequences.by_correlation(sequence)):
        assert sequences.recalled(other, sequence)[0] < 1.0  # B is followed by C and by A


def test_patterns_like_a_template_are_like_each_other_and_confuse_correlation_alone():
    rng = np.random.default_rng(0)
    made = sequences.patterns(200, 400, 0.5, rng)
    assert np.mean(made[:100] * made[100:]) == pytest.approx(0.25, abs=0.05)  # b²
    sequence = sequences.patterns(16, 100, 0.5, rng)
    assert sequences.recalled(sequences.by_one_layer(sequence), sequence)[0] == 1.0
    assert sequences.recalled(sequences.by_correlation(sequence), sequence)[0] < 0.5
    off = sequence.copy()
    off[3, :10] *= -1
    assert sequences.recalled(off, sequence) == (14 / 15, pytest.approx(4 * 10 / 1500))
