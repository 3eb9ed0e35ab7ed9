"""Learning by local rules: what each synapse does, and what comes of it."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.memory.energy import energy
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
from tests.problems import CHANGES, problem, some_association


def schedule(**changes) -> Schedule:
    return Schedule(
        **{
            "epochs": 3,
            "batch_size": 4,
            "learning_rate": 1e-3,
            "iterations": 10,
            "prior_precision": 1.0,
            "sensory_precision": 1.0,
            "free_running_probability": 0.0,
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


def trained_on(episodes: list[Trajectory], hidden: int, how: Schedule, rng: np.random.Generator):
    return train(episodes, np.arange(5), CHANGES, hidden, 20, how, rng)


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
