"""Learning by local rules: what each synapse does, and what comes of it."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.memory.energy import energy
from asm_gym.memory.inference import direct, direct_synapses, infer
from asm_gym.memory.learning import (
    RECALL_UPDATES,
    UPDATES,
    Learner,
    Schedule,
    Synapse,
    Trajectory,
    batches,
    cosine_decay,
    hebbian_change,
    passes,
    power_iteration,
    side_by_side,
)
from asm_gym.memory.network import Network, initial_weights, train
from asm_gym.memory.scheduled_sampling import learn
from asm_gym.memory.traces import DECAYS, fit_gains
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
    traces = initial_weights(8, 5, 2, rng).W_C.shape[1]
    c, mu, z = (rng.normal(size=(3, n)).astype(np.float32) for n in (traces, 8, 8))
    u, error = rng.normal(size=(3, 3)).astype(np.float32), rng.normal(size=(3, 7)).astype(np.float32)
    change = hebbian_change(c, u, mu, z, error, 2.0)

    def outer(post, pre):
        return np.mean([np.outer(a, b) for a, b in zip(post, pre, strict=True)], axis=0)

    np.testing.assert_allclose(change.W_C, outer(2.0 * (z - mu), c), atol=1e-6)
    np.testing.assert_allclose(change.W_F, outer(error, np.tanh(z)), atol=1e-6)
    np.testing.assert_allclose(change.W_D, outer(error, np.hstack([c, u])) * direct_synapses(5, 2), atol=1e-6)


def test_hebbian_changes_are_the_slope_of_the_energy():
    rng = np.random.default_rng(0)
    z, _, x, W_F, pi_z, _ = problem(5, batch=1, dtype=np.float64)
    traces = len(DECAYS) * 6
    W_C, W_D = rng.normal(size=(8, traces)), rng.normal(size=(5, traces + 1))  # no actions: u is the constant 1
    c, u, pi_x = rng.normal(size=(1, traces)), np.ones((1, 1)), 0.5 * np.ones_like(x)

    def total(W_C, W_F, W_D):
        return energy(z, c @ W_C.T, x - np.hstack([c, u]) @ W_D.T, W_F, pi_z, pi_x)[0]

    error = 0.5 * (x - np.tanh(z) @ W_F.T - np.hstack([c, u]) @ W_D.T)
    change = hebbian_change(c, u, c @ W_C.T, z, error, pi_z)
    for name, W in {"W_C": W_C, "W_F": W_F, "W_D": W_D}.items():
        delta = getattr(change, name)
        slope = (total(**{**dict(W_C=W_C, W_F=W_F, W_D=W_D), name: W + 1e-6 * delta}) - total(W_C, W_F, W_D)) / 1e-6
        assert slope == pytest.approx(-np.sum(delta**2), rel=1e-3)  # ΔW = -∂F/∂W


def test_with_a_firm_prior_the_local_change_is_the_gradient_of_the_prediction_error():
    # Whittington and Bogacz 2017: with Π_z large, Π_z (z - μ) settles at what backpropagation sends to the state.
    rng = np.random.default_rng(1)
    W_C, W_F = rng.normal(size=(8, len(DECAYS) * 6)) / 7, rng.normal(size=(5, 8))
    c, x, pi_z = rng.normal(size=(3, len(DECAYS) * 6)), rng.normal(size=(3, 5)), 1e4
    mu = c @ W_C.T
    z = infer(mu, x, W_F, pi_z, np.ones_like(x), pi_z + np.linalg.norm(W_F, 2) ** 2, 50)
    change = hebbian_change(c, np.ones((3, 1)), mu, z, x - np.tanh(z) @ W_F.T, pi_z)
    f = np.tanh(mu)
    upstream = (1 - f**2) * ((x - f @ W_F.T) @ W_F)
    np.testing.assert_allclose(change.W_C, upstream.T @ c / 3, rtol=0.02, atol=0.01)


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


def test_very_many_episodes_are_passed_over_less_often_and_more_often_to_run_on_alone():
    episodes = trajectories(4)
    steps = sum(len(t.senses) for t in episodes) / 4
    assert passes(episodes, schedule(epochs=40)) == 40
    many = schedule(epochs=10**6)
    assert passes(episodes, many) * steps == pytest.approx(UPDATES, rel=0.01)
    assert passes(episodes, many._replace(free_running_probability=0.6)) * steps == pytest.approx(
        RECALL_UPDATES, rel=0.01
    )


def test_learning_lowers_the_energy_and_is_reproducible():
    episodes = trajectories(12)
    runs = []
    for _ in range(2):
        rng = np.random.default_rng(7)
        weights = initial_weights(32, 5, 2, rng)
        curve = learn(weights, episodes, schedule(epochs=15), rng, lambda: None)
        runs.append(weights)
    assert curve[-1] < 0.5 * curve[0]  # two of seven numbers are noise, which leaves 0.7
    assert all(a.tobytes() == b.tobytes() for a, b in zip(*runs, strict=True))


def test_the_motor_prediction_learns_a_repeated_action():
    episodes = trajectories(13)
    for t in episodes:
        t.commands[:, 0] = np.sin(0.4 * np.arange(len(t.commands)))
    rng = np.random.default_rng(0)
    network = trained_on(episodes[:12], 32, schedule(epochs=30, iterations=20), rng).network
    episode, c, predicted = episodes[12], network.at_rest(1), []
    for x, u in zip(episode.senses, episode.commands, strict=True):
        step = network.follow(c, u[None], x[None], np.ones((1, len(x)), np.float32))
        c = step.traces
        predicted.append(step.expected[0, 5:])
    error = np.mean((np.array(predicted) - episode.commands[:, :2]) ** 2, axis=0) / episode.commands[:, :2].var(axis=0)
    assert error[0] < 0.5 < 0.8 < error[1]  # the second action is noise: nobody can predict it


def test_what_the_past_told_long_ago_is_learned():
    # The copy task: a bit at the start is asked for after a delay, in which nothing tells it.
    rng, delay = np.random.default_rng(0), 12
    episodes = []
    for n in range(24):
        bit = 1.0 if n % 2 else -1.0
        senses = 0.05 * rng.standard_normal((delay + 4, 2))
        senses[0, 0], senses[delay:, 1] = bit, bit
        episodes.append(trajectory(senses.astype(np.float32), np.ones((delay + 4, 1), np.float32)))
    weights = initial_weights(32, 2, 0, rng)
    weights.gains[:] = fit_gains([np.hstack([t.senses, t.commands]) for t in episodes])
    learn(
        weights,
        episodes,
        schedule(epochs=100, batch_size=8, learning_rate=5e-3, prior_precision=30.0),
        rng,
        lambda: None,
    )
    network = Network(weights, some_association(rng, 6, 4, 2), 10, 30.0, 1.0)
    right = []
    for episode in episodes:
        c = network.at_rest(1)
        for x, u in zip(episode.senses[:delay], episode.commands[:delay], strict=True):
            c = network.follow(c, u[None], x[None], np.ones((1, 2), np.float32)).traces
        expected = network.follow(c, u[None], x[None], np.ones((1, 2), np.float32)).expected
        right.append(expected[0, 1] * episode.senses[0, 0])
    assert min(right) > 0
    assert np.mean(right) > 0.4


def test_learning_sees_the_energy_that_the_network_has():
    rng = np.random.default_rng(0)
    w = initial_weights(16, 5, 2, rng)
    episode = trajectories(1)[0]
    network = Network(w, some_association(rng, 13, 6, 5), 10, 1.0, 1.0)
    learner, c, u, x = Learner(w, schedule(), rng), network.at_rest(1), episode.commands[:1], episode.senses[:1]
    step = network.follow(c, u, x, np.ones_like(x))
    left = np.hstack([x, u[:, :-1]]) - direct(c, u, w.W_D)
    total = energy(step.z, step.mu, left, w.W_F, 1.0, np.ones_like(left)).sum()
    learned = learner.step(c, u, x, rate=0.0)
    assert learned.energy == pytest.approx(total, rel=1e-3)
    np.testing.assert_allclose(learned.expected, step.expected, atol=1e-5)


def test_a_stream_without_actions_can_be_learned():
    episodes = [trajectory(t.senses, t.commands[:, 2:]) for t in trajectories(6)]
    rng = np.random.default_rng(0)
    trained = trained_on(episodes, 16, schedule(), rng)
    assert trained.network.motor == 0
    assert trained.energy[-1] < trained.energy[0]
