"""The memory against its oracles: finite differences, closed forms, known noise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asm_gym.memory.association import (
    Association,
    association_change,
    association_shapes,
    complete,
    hidden_units,
    learn_association,
    synapses,
)
from asm_gym.memory.checkpoint import read_checkpoint, write_checkpoint
from asm_gym.memory.energy import activate, energy, energy_gradient, feedback, outward
from asm_gym.memory.inference import STRIDE, expect, infer, sense
from asm_gym.memory.learning import (
    Learner,
    Schedule,
    Synapse,
    Trajectory,
    batches,
    cosine_decay,
    hebbian_change,
    learn,
    power_iteration,
    side_by_side,
)
from asm_gym.memory.network import Network, initial_weights, train
from asm_gym.memory.precision import LARGEST, SMALLEST, learn_precision, log_variance
from asm_gym.memory.senses import Reading


def problem(seed: int, batch: int = 3, hidden: int = 8, sensory: int = 5, scale: float = 1.0, dtype=np.float32):
    """Random (z, mu, x, W_F, b_F, pi_z, pi_x) of an energy."""
    rng = np.random.default_rng(seed)
    arrays = [
        rng.normal(size=s) * scale
        for s in ((batch, hidden), (batch, hidden), (batch, sensory), (sensory, hidden), (sensory,))
    ]
    pi_x = rng.uniform(0.0, 3.0, size=(batch, sensory))
    return *(a.astype(dtype) for a in arrays), 1.5, pi_x.astype(dtype)


def schedule(**changes) -> Schedule:
    return Schedule(
        **{
            "epochs": 3,
            "batch_size": 4,
            "learning_rate": 1e-3,
            "iterations": 10,
            "prior_precision": 1.0,
            "sensory_precision": 1.0,
            "carry_prior": 0.0,
            **changes,
        }
    )


def trajectories(count: int, seed: int = 0, sensory: int = 5, motor: int = 2, steps: int = 20) -> list[Trajectory]:
    rng = np.random.default_rng(seed)
    out = []
    for n in range(count):
        T = steps + n % 3
        time = np.arange(T)[:, None] * rng.uniform(0.1, 0.3, size=sensory)
        commands = np.concatenate([rng.normal(size=(T, motor)), np.ones((T, 1))], axis=1)
        out.append(trajectory(np.sin(time).astype(np.float32), commands.astype(np.float32)))
    return out


def trajectory(senses: np.ndarray, commands: np.ndarray) -> Trajectory:
    """With inputs of association made from the senses: each before, each one's change, and the commands."""
    before = np.vstack([senses[:1], senses[:-1]])
    return Trajectory(senses, commands, np.hstack([before, senses - before, commands]))


CHANGES = slice(5, 10)


def trained_on(episodes: list[Trajectory], hidden: int, how: Schedule, rng: np.random.Generator):
    return train(episodes, np.arange(5), CHANGES, hidden, 20, how, rng)


def some_association(rng: np.random.Generator, inputs: int, units: int, changes: int) -> Association:
    shapes = association_shapes(inputs, units, changes).values()
    return Association(*(rng.normal(scale=0.3, size=s).astype(np.float32) for s in shapes))


def test_activation_is_tanh():
    z = np.linspace(-30, 30, 100_001, dtype=np.float32)[None]
    np.testing.assert_allclose(activate(z), np.tanh(z), atol=5e-7)


@pytest.mark.parametrize("batch", [1, 2, 7])
@pytest.mark.parametrize("senses", [1, 4, 11])
def test_products_along_synapses_and_back_are_matrix_products(batch, senses):
    rng = np.random.default_rng(0)
    a, W = rng.normal(size=(batch, 6)), rng.normal(size=(senses, 6))
    np.testing.assert_allclose(outward(a, W), a @ W.T, rtol=1e-12)
    x, b, pi = rng.normal(size=(batch, senses)), rng.normal(size=senses), rng.uniform(size=(batch, senses))
    np.testing.assert_allclose(feedback(a, x, W, b, pi), (pi * (x - a @ W.T - b)) @ W, rtol=1e-12, atol=1e-12)


def test_energy_is_the_sum_of_both_weighted_squares():
    z, mu = np.zeros((1, 2)), np.array([[3.0, 4.0]])  # tanh(0) = 0, so the prediction is the bias
    x, W_F, b_F = np.array([[2.0, 5.0]]), np.ones((2, 2)), np.array([1.0, 1.0])
    # 1/2 * 2 * 25 + 1/2 * (1 * 1 + 0.5 * 16)
    np.testing.assert_allclose(energy(z, mu, x, W_F, b_F, 2.0, np.array([[1.0, 0.5]])), [29.5])


def test_energy_gradient_is_that_of_finite_differences():
    z, *rest = problem(0, dtype=np.float64)
    gradient, _ = energy_gradient(z, *rest)
    for index in np.ndindex(z.shape):
        step = np.zeros_like(z)
        step[index] = 1e-5
        slope = (energy(z + step, *rest) - energy(z - step, *rest))[index[0]] / 2e-5
        assert gradient[index] == pytest.approx(slope, rel=1e-5, abs=1e-5)


def test_bend_bounds_the_curvature_that_the_activation_adds():
    z, mu, x, W_F, b_F, pi_z, pi_x = problem(3, batch=1, dtype=np.float64)
    _, bend = energy_gradient(z, mu, x, W_F, b_F, pi_z, pi_x)
    hessian = np.zeros((z.shape[1], z.shape[1]))
    for j in range(z.shape[1]):
        step = np.zeros_like(z)
        step[0, j] = 1e-4
        up, _ = energy_gradient(z + step, mu, x, W_F, b_F, pi_z, pi_x)
        down, _ = energy_gradient(z - step, mu, x, W_F, b_F, pi_z, pi_x)
        hessian[j] = (up - down)[0] / 2e-4
    curvature = pi_z + pi_x.max() * np.linalg.norm(W_F, 2) ** 2 + bend[0]
    assert np.linalg.eigvalsh((hessian + hessian.T) / 2)[-1] <= curvature


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), weight=st.floats(0.01, 30.0), reach=st.floats(0.01, 100.0))
def test_energy_never_rises_during_inference(seed, weight, reach):
    _, mu, x, W_F, b_F, pi_z, pi_x = problem(seed, dtype=np.float64)
    W_F, x = W_F * weight, x * reach
    curvature = pi_z + pi_x.max() * np.linalg.norm(W_F, 2) ** 2
    energies = [
        energy(infer(mu, x, W_F, b_F, pi_z, pi_x, curvature, k), mu, x, W_F, b_F, pi_z, pi_x) for k in range(15)
    ]
    rises = np.diff(energies, axis=0) / (1.0 + energies[0])
    assert rises.max() <= 1e-6


def test_converged_inference_is_the_closed_form_where_the_activation_is_linear():
    _, mu, x, W_F, _, pi_z, _ = problem(1, dtype=np.float64)
    mu, x, b_F = mu * 1e-3, x * 1e-3, np.zeros(5)  # small enough that tanh(z) = z to 1e-6
    pi_x = np.full_like(x, 2.0)
    z = infer(mu, x, W_F, b_F, pi_z, pi_x, pi_z + 2.0 * np.linalg.norm(W_F, 2) ** 2, 3000)
    # Π_z (z - μ) = W_Fᵀ Π_x (x - W_F z)
    exact = np.linalg.solve(pi_z * np.eye(8) + 2.0 * W_F.T @ W_F, (pi_z * mu + 2.0 * x @ W_F).T).T
    np.testing.assert_allclose(z, exact, atol=1e-7)


def test_inference_is_gradient_descent():
    _, mu, x, W_F, b_F, pi_z, pi_x = problem(2, dtype=np.float64)
    z = mu.copy()
    for _ in range(6):
        f = np.tanh(z)
        feedback = (pi_x * (x - f @ W_F.T - b_F)) @ W_F
        bend = 0.77 * np.abs(feedback).max(axis=1, keepdims=True)
        z = z - float(STRIDE) / (9.0 + bend) * (pi_z * (z - mu) - (1 - f**2) * feedback)
    np.testing.assert_allclose(infer(mu, x, W_F, b_F, pi_z, pi_x, 9.0, 6), z, atol=1e-5)


def test_what_is_not_seen_does_not_move_the_state():
    _, mu, x, W_F, b_F, pi_z, _ = problem(2)
    seen = np.ones_like(x)
    seen[:, 1] = 0
    other = x.copy()
    other[:, 1] = 77.0
    a, b = (infer(mu, v, W_F, b_F, pi_z, seen, 20.0, 5) for v in (x, other))
    assert a.tobytes() == b.tobytes()
    c, d = (infer(mu, v, W_F, b_F, pi_z, np.ones_like(x), 20.0, 5) for v in (x, other))
    assert not np.allclose(c, d)


def test_expectation_and_prediction_follow_their_equations():
    rng = np.random.default_rng(0)
    w = initial_weights(8, 5, 2, rng)
    z, u = rng.normal(size=(3, 8)).astype(np.float32), rng.normal(size=(3, 3)).astype(np.float32)
    np.testing.assert_allclose(expect(z, u, w.W_H, w.W_U), np.tanh(z) @ w.W_H.T + u @ w.W_U.T, atol=1e-5)
    np.testing.assert_allclose(sense(z, w.W_F, w.b_F + 1), np.tanh(z) @ w.W_F.T + 1, atol=1e-5)


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
    W_U, u, b_F = np.zeros((2, 1)), np.ones((1, 1)), np.zeros(3)
    errors = []
    for _ in range(T):
        state = A @ state + q * rng.normal(size=2)
        x = C @ state + r * rng.normal(size=3)
        prior = A @ kalman
        kalman = prior + K @ (x - C @ prior)
        z = infer(expect(z, u, A, W_U), x[None], C, b_F, pi_z, pi_x, curvature, 200)
        errors.append((np.sum((kalman - state) ** 2), np.sum((z[0] - state) ** 2), np.sum(state**2)))
    best, ours, blind = np.mean(errors, axis=0)
    assert best <= ours < 1.1 * best
    assert ours < 0.2 * blind


def test_weight_changes_are_the_outer_products_of_what_is_local():
    rng = np.random.default_rng(0)
    w = initial_weights(8, 5, 2, rng)
    before, mu, after = (rng.normal(size=(3, 8)).astype(np.float32) for _ in range(3))
    u, x = rng.normal(size=(3, 3)).astype(np.float32), rng.normal(size=(3, 5)).astype(np.float32)
    u[:, -1] = 1.0
    change = hebbian_change(w, before, mu, after, u, x, 2.0, 0.5)

    def outer(post, pre):
        return np.mean([np.outer(a, b) for a, b in zip(post, pre, strict=True)], axis=0)

    f = np.tanh
    error_x = 0.5 * (x - f(after) @ w.W_F.T - w.b_F)
    without_action = f(mu - u[:, :2] @ w.W_U[:, :2].T)
    np.testing.assert_allclose(change.W_H, outer(2.0 * (after - mu), f(before)), atol=1e-6)
    np.testing.assert_allclose(change.W_U, outer(2.0 * (after - mu), u), atol=1e-6)
    np.testing.assert_allclose(change.W_F, outer(error_x, f(after)), atol=1e-6)
    np.testing.assert_allclose(change.b_F, error_x.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(change.W_A, outer(u[:, :2] - without_action @ w.W_A.T, without_action), atol=1e-6)


def test_hebbian_changes_lower_the_energy():
    _, mu, x, W_F, b_F, pi_z, pi_x = problem(5, batch=1, dtype=np.float64)
    w = initial_weights(8, 5, 2, np.random.default_rng(0))._replace(W_F=W_F, b_F=b_F)
    u = np.ones((1, 3))
    change = hebbian_change(w, mu, mu, mu + 0.1, u, x, pi_z, 1.0)
    args = (pi_z, np.ones_like(pi_x))
    slope = -np.sum(change.W_F**2) - np.sum(change.b_F**2)  # ΔW = -∂F/∂W
    lower = energy(mu + 0.1, mu, x, W_F + 1e-6 * change.W_F, b_F + 1e-6 * change.b_F, *args)
    assert (lower - energy(mu + 0.1, mu, x, W_F, b_F, *args))[0] / 1e-6 == pytest.approx(slope, rel=1e-3)


def test_a_synapse_steps_as_adam_does():
    rng = np.random.default_rng(0)
    changes = rng.normal(size=(5, 2, 3)).astype(np.float32)
    synapse = Synapse(np.ones((2, 3), np.float32))
    W, m, s = np.ones((2, 3)), 0.0, 0.0
    for t, c in enumerate(changes, start=1):
        synapse.learn(c, 0.01)
        m, s = 0.9 * m + 0.1 * c, 0.999 * s + 0.001 * c**2
        W = W + 0.01 * (m / (1 - 0.9**t)) / (np.sqrt(s / (1 - 0.999**t)) + 1e-8)
    np.testing.assert_allclose(synapse.W, W, rtol=1e-5)


def test_cosine_decay_goes_from_all_to_nothing():
    assert [cosine_decay(2.0, p) for p in (0.0, 0.5, 1.0)] == pytest.approx([2.0, 1.0, 0.0])


def test_power_iteration_finds_the_spectral_norm():
    W = np.random.default_rng(0).normal(size=(5, 9)).astype(np.float32)
    v = np.ones(9, np.float32)
    for _ in range(200):
        squared, v = power_iteration(W, v)
    assert squared == pytest.approx(np.linalg.norm(W, 2) ** 2, rel=1e-4)


def test_batches_hold_every_episode_once_and_let_short_ones_end():
    episodes = trajectories(11)
    made = batches(episodes, 4, np.random.default_rng(0))
    assert sum(b.active.sum() for b in made) == sum(len(t.senses) for t in episodes)
    assert max(b.senses.shape[1] for b in made) == 4
    batch = side_by_side(episodes[:3])  # 20, 21 and 22 steps
    assert list(batch.active[-3:]) == [3, 2, 1]
    np.testing.assert_array_equal(batch.senses[:, 0], episodes[2].senses)
    np.testing.assert_array_equal(batch.commands[:20, 2], episodes[0].commands)


def test_learning_lowers_the_energy_and_is_reproducible():
    episodes = trajectories(12)
    runs = []
    for _ in range(2):
        rng = np.random.default_rng(7)
        weights = initial_weights(32, 5, 2, rng)
        curve = learn(weights, episodes, schedule(epochs=15), rng, lambda: None)
        runs.append(weights)
    assert curve[-1] < 0.3 * curve[0]
    assert all(a.tobytes() == b.tobytes() for a, b in zip(*runs, strict=True))


def test_the_motor_prediction_learns_a_repeated_action():
    episodes = trajectories(12)
    for t in episodes:
        t.commands[:, 0] = np.sin(0.4 * np.arange(len(t.commands)))
    rng = np.random.default_rng(0)
    network = trained_on(episodes, 32, schedule(epochs=30, iterations=20), rng).network
    w, batch, z, states = network.weights, side_by_side(episodes[:1]), np.zeros((1, 32), np.float32), []
    for x, u in zip(batch.senses, batch.commands, strict=True):
        mu, z = network.follow(z, u, x, np.ones_like(x))
        states.append(mu)
    expected = np.concatenate(states)
    predicted = np.tanh(expected - batch.commands[:, 0, :2] @ w.W_U[:, :2].T) @ w.W_A.T
    error = np.mean((predicted - batch.commands[:, 0, :2]) ** 2, axis=0) / batch.commands[:, 0, :2].var(axis=0)
    assert error[0] < 0.5 < 0.8 < error[1]  # the second action is noise: nobody can predict it


def test_the_state_handed_on_is_the_inferred_one():
    rng = np.random.default_rng(0)
    w = initial_weights(16, 5, 2, rng)
    learner, batch = Learner(w, schedule(), rng), side_by_side(trajectories(3))
    z, total = np.zeros((3, 16), np.float32), 0.0
    network = Network(w, some_association(rng, 13, 6, 5), 10, 1.0, 1.0)
    for x, u, n in zip(batch.senses, batch.commands, batch.active, strict=True):
        mu, z = network.follow(z[:n], u[:n], x[:n], np.ones_like(x[:n]))
        total += energy(z, mu, x[:n], w.W_F, w.b_F, 1.0, np.ones_like(x[:n])).sum()
    assert learner.run(batch, rate=0.0) == pytest.approx(total, rel=1e-3)


def test_a_stream_without_actions_can_be_learned():
    episodes = [trajectory(t.senses, t.commands[:, 2:]) for t in trajectories(6)]
    rng = np.random.default_rng(0)
    trained = trained_on(episodes, 16, schedule(), rng)
    assert trained.network.weights.W_A.shape == (0, 16)
    assert trained.energy[-1] < trained.energy[0]


def test_precision_recovers_noise_that_depends_on_context():
    rng = np.random.default_rng(0)
    context = rng.uniform(-1, 1, size=(8000, 6))
    truth = np.stack([2.0 * context[:, 0] - 3.0, -1.0 - context[:, 1] + context[:, 2]], axis=1)
    error = rng.normal(size=truth.shape) * np.exp(truth / 2)
    f, W_S, b_S = context.astype(np.float32), np.ones((2, 6), np.float32), np.zeros(2, np.float32)
    learn_precision(f, error.astype(np.float32), W_S, b_S, rng, rate=3e-3)
    learned = log_variance(f, W_S, b_S)
    np.testing.assert_allclose(learned.mean(axis=0), truth.mean(axis=0), atol=0.1)
    assert np.sqrt(np.mean((learned - truth) ** 2)) < 0.15  # against 1.15 and 0.8 for the best constant


def test_log_variance_stays_in_bounds():
    f = np.ones((2, 3), np.float32)
    for sign, bound in ((1, LARGEST), (-1, SMALLEST)):
        W_S = np.full((2, 3), sign * 100, np.float32)
        assert np.all(log_variance(f, W_S, np.zeros(2, np.float32)) == bound)


def test_network_reports_the_errors_of_association_in_the_spread_that_is_expected_of_them():
    rng = np.random.default_rng(0)
    w, association = initial_weights(8, 5, 2, rng), some_association(rng, 13, 6, 5)
    network = Network(w, association, 20, 1.0, 1.0)
    z, u, x, inputs = (rng.normal(size=(2, n)).astype(np.float32) for n in (8, 3, 5, 13))
    seen = np.ones_like(x)
    seen[1, 3] = 0
    whole = seen.min(axis=1, keepdims=True)
    found, units = network.associate(Reading(x, seen, u, inputs, inputs[:, CHANGES], whole, np.ones((2, 7), bool)))
    expected, _ = network.follow(z, u, x, seen)
    np.testing.assert_allclose(expected, np.tanh(z) @ w.W_H.T + u @ w.W_U.T, atol=1e-5)
    V, U, D, W_S, b_S = association
    f = np.tanh(inputs @ V.T)
    error = inputs[:, CHANGES] - f @ U.T - inputs @ D.T
    np.testing.assert_allclose(units, f, atol=1e-5)
    np.testing.assert_allclose(found, whole * error * np.exp(-0.5 * (f @ W_S.T + b_S)), atol=1e-4)


def test_nothing_is_predicted_from_its_own_group():
    groups = np.array([0, 0, 1, 2, 2])
    exists = synapses(groups, CHANGES, 13, size=4)
    reaches = (exists.U @ exists.V > 0) | (exists.D > 0)  # (X, I)
    assert np.array_equal(reaches[:, CHANGES], groups[:, None] != groups)
    assert reaches[:, :5].all()
    assert reaches[:, 10:].all()


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
    deviation = np.exp(0.5 * log_variance(f, w.W_S, w.b_S))[:, 2:]
    assert error.std() < 0.25  # 0.15 is the noise alone, 0.66 the best that a line could do
    rough = cause[:, 0] > 0.5
    calm = cause[:, 0] < -0.5
    assert deviation[rough].mean() > 2 * deviation[calm].mean()


def test_checkpoint_keeps_every_bit(tmp_path):
    arrays = {"a": np.random.default_rng(0).normal(size=(3, 4)), "empty": np.zeros((0, 3), np.float32)}
    write_checkpoint(tmp_path / "new" / "x.asm", "test", {"n": 0.1, "none": None}, arrays)
    header, back = read_checkpoint(tmp_path / "new" / "x.asm", "test")
    assert header["n"] == 0.1
    assert header["none"] is None
    assert {k: (v.dtype, v.shape, v.tobytes()) for k, v in back.items()} == {
        k: (v.dtype, v.shape, v.tobytes()) for k, v in arrays.items()
    }
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["x.asm"]  # nothing temporary is left


def test_a_failed_write_leaves_the_old_checkpoint(tmp_path):
    path = tmp_path / "x.asm"
    write_checkpoint(path, "test", {"n": 1}, {"a": np.zeros(2)})
    with pytest.raises(ValueError, match="Object arrays"):
        write_checkpoint(path, "test", {"n": 2}, {"a": np.array([object()])})
    assert read_checkpoint(path, "test").header["n"] == 1
    assert len(list(tmp_path.iterdir())) == 1


def test_bad_checkpoints_are_refused(tmp_path):
    path = tmp_path / "x.asm"
    write_checkpoint(path, "test", {}, {"a": np.random.default_rng(0).normal(size=100)})
    good = path.read_bytes()
    middle = len(good) // 2
    flipped = bytes([*good[:middle], good[middle] ^ 1, *good[middle + 1 :]])
    for bad in (b"", b"not a zip", good[:middle], good[:-10], flipped):
        path.write_bytes(bad)
        with pytest.raises(ValueError, match="damaged"):
            read_checkpoint(path, "test")
    np.savez(tmp_path / "foreign.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match="not a checkpoint"):
        read_checkpoint(tmp_path / "foreign.npz", "test")
    with pytest.raises(FileNotFoundError):
        read_checkpoint(tmp_path / "missing", "test")
    path.write_bytes(good)
    with pytest.raises(ValueError, match="of 'test', not of 'other'"):
        read_checkpoint(path, "other")
    write_checkpoint(path, "test", {"version": 2}, {})
    with pytest.raises(ValueError, match="newer"):
        read_checkpoint(path, "test")
