"""The memory against its oracles: finite differences and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asm_gym.memory.energy import activate, energy, energy_gradient, feedback, outward
from asm_gym.memory.inference import STRIDE, direct, direct_synapses, expect, infer, sense
from asm_gym.memory.network import initial_weights
from tests.problems import problem


def test_activation_is_tanh():
    z = np.linspace(-30, 30, 100_001, dtype=np.float32)[None]
    np.testing.assert_allclose(activate(z), np.tanh(z), atol=5e-7)


@pytest.mark.parametrize("batch", [1, 2, 7])
@pytest.mark.parametrize("senses", [1, 4, 11])
def test_products_along_synapses_and_back_are_matrix_products(batch, senses):
    rng = np.random.default_rng(0)
    a, W = rng.normal(size=(batch, 6)), rng.normal(size=(senses, 6))
    np.testing.assert_allclose(outward(a, W), a @ W.T, rtol=1e-12)
    x, pi = rng.normal(size=(batch, senses)), rng.uniform(size=(batch, senses))
    np.testing.assert_allclose(feedback(a, x, W, pi), (pi * (x - a @ W.T)) @ W, rtol=1e-12, atol=1e-12)


def test_energy_is_the_sum_of_both_weighted_squares():
    z, mu = np.zeros((1, 2)), np.array([[3.0, 4.0]])  # tanh(0) = 0, so nothing is predicted
    x, W_F = np.array([[1.0, 4.0]]), np.ones((2, 2))
    # 1/2 * 2 * 25 + 1/2 * (1 * 1 + 0.5 * 16)
    np.testing.assert_allclose(energy(z, mu, x, W_F, 2.0, np.array([[1.0, 0.5]])), [29.5])


def test_energy_gradient_is_that_of_finite_differences():
    z, *rest = problem(0, dtype=np.float64)
    gradient, _ = energy_gradient(z, *rest)
    for index in np.ndindex(z.shape):
        step = np.zeros_like(z)
        step[index] = 1e-5
        slope = (energy(z + step, *rest) - energy(z - step, *rest))[index[0]] / 2e-5
        assert gradient[index] == pytest.approx(slope, rel=1e-5, abs=1e-5)


def test_bend_bounds_the_curvature_that_the_activation_adds():
    z, mu, x, W_F, pi_z, pi_x = problem(3, batch=1, dtype=np.float64)
    _, bend = energy_gradient(z, mu, x, W_F, pi_z, pi_x)
    hessian = np.zeros((z.shape[1], z.shape[1]))
    for j in range(z.shape[1]):
        step = np.zeros_like(z)
        step[0, j] = 1e-4
        up, _ = energy_gradient(z + step, mu, x, W_F, pi_z, pi_x)
        down, _ = energy_gradient(z - step, mu, x, W_F, pi_z, pi_x)
        hessian[j] = (up - down)[0] / 2e-4
    curvature = pi_z + pi_x.max() * np.linalg.norm(W_F, 2) ** 2 + bend[0]
    assert np.linalg.eigvalsh((hessian + hessian.T) / 2)[-1] <= curvature


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), weight=st.floats(0.01, 30.0), reach=st.floats(0.01, 100.0))
def test_energy_never_rises_during_inference(seed, weight, reach):
    _, mu, x, W_F, pi_z, pi_x = problem(seed, dtype=np.float64)
    W_F, x = W_F * weight, x * reach
    curvature = pi_z + pi_x.max() * np.linalg.norm(W_F, 2) ** 2
    energies = [energy(infer(mu, x, W_F, pi_z, pi_x, curvature, k), mu, x, W_F, pi_z, pi_x) for k in range(15)]
    rises = np.diff(energies, axis=0) / (1.0 + energies[0])
    assert rises.max() <= 1e-6


def test_converged_inference_is_the_closed_form_where_the_activation_is_linear():
    _, mu, x, W_F, pi_z, _ = problem(1, dtype=np.float64)
    mu, x = mu * 1e-3, x * 1e-3  # small enough that tanh(z) = z to 1e-6
    pi_x = np.full_like(x, 2.0)
    z = infer(mu, x, W_F, pi_z, pi_x, pi_z + 2.0 * np.linalg.norm(W_F, 2) ** 2, 3000)
    # Π_z (z - μ) = W_Fᵀ Π_x (x - W_F z)
    exact = np.linalg.solve(pi_z * np.eye(8) + 2.0 * W_F.T @ W_F, (pi_z * mu + 2.0 * x @ W_F).T).T
    np.testing.assert_allclose(z, exact, atol=1e-7)


def test_inference_is_gradient_descent():
    _, mu, x, W_F, pi_z, pi_x = problem(2, dtype=np.float64)
    z = mu.copy()
    for _ in range(6):
        f = np.tanh(z)
        feedback = (pi_x * (x - f @ W_F.T)) @ W_F
        bend = 0.77 * np.abs(feedback).max(axis=1, keepdims=True)
        z = z - float(STRIDE) / (9.0 + bend) * (pi_z * (z - mu) - (1 - f**2) * feedback)
    np.testing.assert_allclose(infer(mu, x, W_F, pi_z, pi_x, 9.0, 6), z, atol=1e-5)


def test_what_is_not_seen_does_not_move_the_state():
    _, mu, x, W_F, pi_z, _ = problem(2)
    seen = np.ones_like(x)
    seen[:, 1] = 0
    other = x.copy()
    other[:, 1] = 77.0
    a, b = (infer(mu, v, W_F, pi_z, seen, 20.0, 5) for v in (x, other))
    assert a.tobytes() == b.tobytes()
    c, d = (infer(mu, v, W_F, pi_z, np.ones_like(x), 20.0, 5) for v in (x, other))
    assert not np.allclose(c, d)


def test_expectation_and_prediction_follow_their_equations():
    rng = np.random.default_rng(0)
    w = initial_weights(8, 5, 2, rng)
    c, u = rng.normal(size=(3, w.W_C.shape[1])).astype(np.float32), rng.normal(size=(3, 3)).astype(np.float32)
    z, W_D = rng.normal(size=(3, 8)).astype(np.float32), rng.normal(size=w.W_D.shape).astype(np.float32)
    np.testing.assert_allclose(expect(c, w.W_C), c @ w.W_C.T, atol=1e-4)
    np.testing.assert_allclose(sense(z, w.W_F), np.tanh(z) @ w.W_F.T, atol=1e-5)
    np.testing.assert_allclose(direct(c, u, W_D), np.hstack([c, u]) @ W_D.T, atol=1e-4)


def test_no_action_predicts_itself():
    exists = direct_synapses(5, 2)
    W_D = np.ones_like(exists) * exists
    c = np.zeros((1, W_D.shape[1] - 3), np.float32)
    still, moving = (direct(c, np.array([[a, a, 1.0]], np.float32), W_D) for a in (0.0, 7.0))
    np.testing.assert_array_equal(still[:, 5:], moving[:, 5:])
    assert (still[:, :5] != moving[:, :5]).all()


def test_filtering_a_linear_gaussian_system_comes_close_to_the_kalman_filter():
    # z_t = 0.95 R z_{t-1} + q w, x_t = C z_t + r v, small enough for tanh to be linear. The steady-state Kalman
    # filter is optimal; predictive coding keeps no covariance, and with Π_z the inverse of the filter's own steady
    # prior variance it should lose little.
    rng = np.random.default_rng(0)
    q, r, angle, T = 1e-3, 1e-3, 0.2, 4000
    A = 0.95 * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    C = rng.normal(size=(3, 2))
    P = np.eye(2) * q**2
    for _ in range(500):
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + r**2 * np.eye(3))
        P = A @ (P - K @ C @ P) @ A.T + q**2 * np.eye(2)
    pi_z, pi_x = 2.0 / np.trace(P) * r**2, np.ones((1, 3))
    curvature = pi_z + np.linalg.norm(C, 2) ** 2
    state, kalman, z = np.zeros(2), np.zeros(2), np.zeros((1, 2))
    errors = []
    for _ in range(T):
        state = A @ state + q * rng.normal(size=2)
        x = C @ state + r * rng.normal(size=3)
        prior = A @ kalman
        kalman = prior + K @ (x - C @ prior)
        z = infer(np.tanh(z) @ A.T, x[None], C, pi_z, pi_x, curvature, 200)
        errors.append((np.sum((kalman - state) ** 2), np.sum((z[0] - state) ** 2), np.sum(state**2)))
    best, ours, blind = np.mean(errors, axis=0)
    assert best <= ours < 1.1 * best
    assert ours < 0.2 * blind
