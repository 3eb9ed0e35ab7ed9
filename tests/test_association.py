"""Association and its precision, against gradients and known noise."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.memory.association import (
    ROWS_PER_INPUT,
    Association,
    association_change,
    complete,
    hidden_units,
    learn_association,
    synapses,
)
from asm_gym.memory.crossfit import trust
from asm_gym.memory.energy import energy
from asm_gym.memory.inference import direct_synapses
from asm_gym.memory.learning import hebbian_change
from asm_gym.memory.network import Network, initial_weights
from asm_gym.memory.precision import (
    BATCH,
    BATCHES,
    LARGEST,
    SMALLEST,
    learn_precision,
    log_variance,
    unbounded,
    usual_span,
)
from asm_gym.scaling import ScaledRows
from tests.problems import CHANGES, some_association


@pytest.mark.parametrize("rows", [8000, 3 * BATCH * BATCHES])
def test_precision_recovers_noise_that_depends_on_context(rows):
    rng = np.random.default_rng(0)
    context = rng.uniform(-1, 1, size=(rows, 6))
    truth = np.stack([2.0 * context[:, 0] - 3.0, -1.0 - context[:, 1] + context[:, 2]], axis=1)
    error = rng.normal(size=truth.shape) * np.exp(truth / 2)
    f, W_S, b_S = context.astype(np.float32), np.ones((2, 6), np.float32), np.zeros(2, np.float32)
    learn_precision(f, error.astype(np.float32), W_S, b_S, rng, rate=3e-3)
    learned = log_variance(f, W_S, b_S, unbounded(2))
    np.testing.assert_allclose(learned.mean(axis=0), truth.mean(axis=0), atol=0.1)
    assert np.sqrt(np.mean((learned - truth) ** 2)) < 0.15  # against 1.15 and 0.8 for the best constant


def test_log_variance_stays_in_bounds():
    f = np.ones((2, 3), np.float32)
    for sign, bound in ((1, LARGEST), (-1, SMALLEST)):
        W_S = np.full((2, 3), sign * 100, np.float32)
        assert np.all(log_variance(f, W_S, np.zeros(2, np.float32), unbounded(2)) == bound)


def test_no_context_makes_errors_more_usual_than_nominal_ones_did():
    rng = np.random.default_rng(0)
    f = np.tanh(rng.normal(size=(20_000, 3))).astype(np.float32)
    W_S, b_S = np.array([[1.0, 0, 0], [0, 2.0, -1.0]], np.float32), np.array([0.5, -1.0], np.float32)
    span = usual_span(f, W_S, b_S)
    driven = f @ W_S.T + b_S
    np.testing.assert_allclose(np.mean(driven < span[0], axis=0), 0.0005, atol=1e-4)
    np.testing.assert_allclose(np.mean(driven > span[1], axis=0), 0.0005, atol=1e-4)
    beyond = log_variance(np.array([[9.0, 9.0, -9.0], [-9.0, -9.0, 9.0]], np.float32), W_S, b_S, span)
    np.testing.assert_array_equal(beyond, span[::-1])


def test_network_reports_the_errors_of_association_in_the_spread_that_is_expected_of_them():
    rng = np.random.default_rng(0)
    association = some_association(rng, 13, 6, 5)
    network = Network(initial_weights(8, 5, 2, rng), association, 20, 1.0, 1.0)
    u, x, inputs = (rng.normal(size=(2, n)).astype(np.float32) for n in (3, 5, 13))
    seen = np.ones_like(x)
    seen[1, 3] = 0
    whole = seen.min(axis=1, keepdims=True)
    found, units = network.associate(ScaledRows(x, seen, u, inputs, inputs[:, CHANGES], whole, np.ones((2, 7), bool)))
    V, U, D, W_S, b_S, _, remainder = association
    f = np.tanh(inputs @ V.T)
    error = (inputs[:, CHANGES] - f @ U.T - inputs @ D.T) / remainder
    np.testing.assert_allclose(units, f, atol=1e-5)
    np.testing.assert_allclose(found, whole * error * np.exp(-0.5 * (f @ W_S.T + b_S)), atol=1e-4)


def test_nothing_is_predicted_from_its_own_group():
    groups = np.array([0, 0, 1, 2, 2])
    exists = synapses(groups, CHANGES, 13, size=4)
    reaches = (exists.U @ exists.V > 0) | (exists.D > 0)  # (X, I)
    assert np.array_equal(reaches[:, CHANGES], groups[:, None] != groups)
    assert reaches[:, :5].all()
    assert reaches[:, 10:].all()


def test_hidden_units_are_believed_as_far_as_fresh_rows_bear_them_out():
    rng = np.random.default_rng(4)
    expected = rng.normal(size=(4000, 4)).astype(np.float32)
    left = expected * np.array([1.0, 0.5, 0.0, -1.0], np.float32) + 0.1 * rng.normal(size=expected.shape)
    np.testing.assert_allclose(trust(left, expected), [1.0, 0.5, 0.0, 0.0], atol=0.02)
    assert np.array_equal(trust(left, np.zeros_like(expected)), np.zeros(4))


def test_what_is_linear_is_known_exactly_and_noise_is_not_learned_by_heart():
    rng = np.random.default_rng(5)
    N = 400
    cause = rng.normal(size=(N, 2))
    delta = np.column_stack([cause, cause @ [0.6, -0.8], rng.normal(size=N)]).astype(np.float32)
    inputs = np.hstack([delta, np.ones((N, 1), np.float32)])
    w = learn_association(inputs, delta, np.array([0, 0, 1, 2]), slice(0, 4), 32, rng, updates=100)
    np.testing.assert_allclose(w.D[2, :2], [0.6, -0.8], atol=1e-4)
    assert w.remainder[2] < 2e-4  # tied to the others exactly
    error = inputs[:, 3] - complete(hidden_units(inputs, w.V), inputs, w.U, w.D)[:, 3]
    assert error.std() > 0.9 * delta[:, 3].std()  # tied to nothing


def few(rows: int) -> Association:
    """Association from rows of two groups with one cause, each change a line of the past and of noise they share."""
    rng = np.random.default_rng(6)
    past = rng.normal(size=(rows, 3))
    noise = rng.normal(size=(rows, 1))
    delta = past @ np.array([[0.5, 0.0], [0.0, -0.7], [0.2, 0.2]]) + 0.3 * noise
    inputs = np.hstack([past, delta, np.ones((rows, 1))]).astype(np.float32)
    return learn_association(inputs, inputs[:, 3:5], np.array([0, 1]), slice(3, 5), 8, rng, updates=20)


def test_from_few_rows_changes_are_expected_from_the_past_alone_and_by_a_line():
    w = few(ROWS_PER_INPUT * 6 - 1)
    for nothing in (w.U, w.W_S, w.b_S):
        assert not nothing.any()
    assert not w.D[:, 3:5].any()  # what the others do now
    np.testing.assert_allclose(w.D[:, :3], [[0.5, 0.0, 0.2], [0.0, -0.7, 0.2]], atol=0.12)
    np.testing.assert_allclose(w.remainder, 0.3, rtol=0.2)
    assert w.V.any()  # units that names can be read from


def test_from_more_rows_what_one_sense_tells_of_another_is_known():
    w = few(ROWS_PER_INPUT * 6)
    np.testing.assert_allclose([w.D[0, 4], w.D[1, 3]], 1.0, atol=0.05)
    assert w.U.any() or w.W_S.any()


def test_where_nothing_is_linear_the_others_change_as_by_synapses_of_nothing():
    rng = np.random.default_rng(4)
    a, delta = rng.normal(size=(4, 13)).astype(np.float32), rng.normal(size=(4, 5)).astype(np.float32)
    V, U, D, *_ = some_association(rng, 13, 6, 5)
    nothing, spread = np.zeros_like(D), np.ones(5, np.float32)
    change, error = association_change(a, delta, spread, V, U, nothing[:, :0])
    expected, errors = association_change(a, delta, spread, V, U, nothing)
    np.testing.assert_array_equal(change.V, expected.V)
    np.testing.assert_array_equal(change.U, expected.U)
    np.testing.assert_array_equal(error, errors)


def test_association_changes_are_the_gradient_of_half_the_squared_error():
    rng = np.random.default_rng(3)
    a, delta = rng.normal(size=(4, 13)).astype(np.float32), rng.normal(size=(4, 5)).astype(np.float32)
    V, U, D, *_ = some_association(rng, 13, 6, 5)
    spread = np.full(5, 1e3, np.float32)  # no error is so large that it is cut off
    change, error = association_change(a, delta, spread, V, U, D)

    def loss(V, U, D):
        e = delta - np.tanh(a @ V.T) @ U.T - a @ D.T
        return 0.5 * np.sum(e**2) / len(a)

    np.testing.assert_allclose(error, delta - np.tanh(a @ V.T) @ U.T - a @ D.T, atol=1e-5)
    exact = [W.astype(np.float64) for W in (V, U, D)]
    for n, found in enumerate(change):
        for place in [(0, 0), (2, 3), (4, 5)]:
            up, down = ([W.copy() for W in exact] for _ in range(2))
            up[n][place] += 1e-5
            down[n][place] -= 1e-5
            slope = (loss(*up) - loss(*down)) / 2e-5
            assert found[place] * spread[0] == pytest.approx(-slope, rel=1e-2, abs=1e-4)


def test_association_learns_what_ties_the_senses_together_and_how_sure_that_is():
    rng = np.random.default_rng(0)
    N = 6000
    cause = rng.normal(size=(N, 2))
    noise = 0.05 * rng.normal(size=(N, 2)) * np.where(cause[:, :1] > 0, 4.0, 1.0)
    delta = np.stack([cause[:, 0], cause[:, 1], *(np.sin(2 * cause) + noise).T], axis=1).astype(np.float32)
    inputs = np.hstack([delta, np.ones((N, 1), np.float32)])
    w = learn_association(inputs, delta, np.array([0, 0, 1, 1]), slice(0, 4), 32, rng)
    f = hidden_units(inputs, w.V)
    error = (delta - complete(f, inputs, w.U, w.D))[:, 2:]
    deviation = (w.remainder * np.exp(0.5 * log_variance(f, w.W_S, w.b_S, w.span_S)))[:, 2:]
    assert error.std() < 0.25  # 0.15 is the noise alone, 0.66 the best that a line could do
    rough = cause[:, 0] > 0.5
    calm = cause[:, 0] < -0.5
    assert deviation[rough].mean() > 1.8 * deviation[calm].mean()


def test_both_parts_of_the_memory_descend_one_energy():
    rng = np.random.default_rng(3)
    B, H, S, A, units, inputs = 4, 6, 5, 2, 7, 13
    w = initial_weights(H, S, A, rng)
    W = {"W_C": w.W_C, "W_F": 3 * w.W_F, "W_D": 0.1 * rng.normal(size=w.W_D.shape) * direct_synapses(S, A)}
    W |= {"V": rng.normal(size=(units, inputs)), "U": rng.normal(size=(S, units)), "D": rng.normal(size=(S, inputs))}
    W = {name: np.asarray(array, np.float64) for name, array in W.items()}
    c, u, x, z = (rng.normal(size=(B, n)) for n in (w.W_C.shape[1], A + 1, S, H))
    a, delta, spread = rng.normal(size=(B, inputs)), rng.normal(size=(B, S)), rng.uniform(1.0, 4.0, S)

    def left(W):
        return np.hstack([x, u[:, :-1]]) - np.hstack([c, u]) @ W["W_D"].T

    def total(W):
        r = (delta - a @ W["D"].T - np.tanh(a @ W["V"].T) @ W["U"].T) / spread
        rho = np.where(np.abs(r) <= 1, 0.5 * r**2, np.abs(r) - 0.5)
        assert 0.1 < np.mean(np.abs(r) > 1) < 0.9  # both branches are there
        temporal = energy(z, c @ W["W_C"].T, left(W), W["W_F"], 30.0, np.ones((B, S + A)))
        return float(np.mean(temporal) + np.mean(np.sum(spread * rho, axis=1)))

    settled = left(W) - np.tanh(z) @ W["W_F"].T
    rules = hebbian_change(c, u, c @ W["W_C"].T, z, settled, 30.0)._asdict()
    rules |= association_change(a, delta, spread, W["V"], W["U"], W["D"])[0]._asdict()
    exists = {"W_D": direct_synapses(S, A)}
    for name, array in W.items():
        for index in zip(*(rng.integers(n, size=6) for n in array.shape), strict=True):
            if not exists.get(name, np.ones(array.shape))[index]:
                continue
            ends = []
            for step in (1e-5, -1e-5):
                moved = array.copy()
                moved[index] += step
                ends.append(total({**W, name: moved}))
            assert rules[name][index] == pytest.approx(-(ends[0] - ends[1]) / 2e-5, rel=1e-3, abs=1e-4), name
