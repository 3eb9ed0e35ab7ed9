"""Recall against its oracles: a linear system in closed form, following itself, and what was learned by running on."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from asm_gym.memory.association import Association, association_shapes
from asm_gym.memory.inference import motor_prediction
from asm_gym.memory.learning import Learner, Schedule, Trajectory
from asm_gym.memory.network import Network, initial_weights
from asm_gym.memory.recall import at_rest, follow, run_on, to_rows
from asm_gym.memory.scheduled_sampling import LONGEST_CUE, ScheduledSampling, one_after_another
from asm_gym.monitors import NeuralASM
from tests.streams import sine_episodes, sine_spec

H, S, A = 7, 4, 2


def network(scale: float = 1.0, iterations: int = 20) -> Network:
    rng = np.random.default_rng(0)
    weights = initial_weights(H, S, A, rng)
    weights.W_U[:, -1] *= scale
    weights.b_F[:] = rng.normal(size=S)
    nothing = Association(*(np.zeros(s, np.float32) for s in association_shapes(1, 0, 0).values()))
    return Network(weights, nothing, iterations, 1.0, 1.0)


def cue(steps: int, batch: int = 3, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    commands = scale * rng.normal(size=(steps, batch, A + 1))
    commands[:, :, -1] = 1.0
    return rng.normal(size=(steps, batch, S)).astype(np.float32), commands.astype(np.float32)


def schedule(**changes) -> Schedule:
    default = Schedule(
        epochs=1,
        batch_size=4,
        learning_rate=1e-3,
        iterations=10,
        prior_precision=1.0,
        sensory_precision=1.0,
        free_running_probability=0.5,
    )
    return default._replace(**changes)


def test_offline_recall_of_a_linear_enough_network_is_the_power_of_its_matrix():
    small = 1e-3
    net = network(scale=small)
    w = net.weights._replace(W_H=net.weights.W_H * np.float32(0.8))
    net = Network(w, net.association, 20, 1.0, 1.0)
    z = small * np.random.default_rng(2).normal(size=(2, H)).astype(np.float32)
    recalled = run_on(net, z, 12)
    # Where tanh is linear: z_t = M z_{t-1} + c with M = (1 + W_U W_A) W_H and c = (1 + W_U W_A) b.
    W_H, W_A = w.W_H.astype(float), w.W_A.astype(float)
    loop = np.eye(H) + w.W_U[:, :-1].astype(float) @ W_A
    M, c = loop @ W_H, loop @ w.W_U[:, -1].astype(float)
    fixed = np.linalg.solve(np.eye(H) - M, c)
    for t in range(12):
        state = fixed + (z - fixed) @ np.linalg.matrix_power(M, t + 1).T
        before = fixed + (z - fixed) @ np.linalg.matrix_power(M, t).T
        np.testing.assert_allclose(recalled.hidden[t], state, atol=2e-6)
        np.testing.assert_allclose(recalled.senses[t], state @ w.W_F.T + w.b_F, atol=5e-6)
        np.testing.assert_allclose(recalled.commands[t], (before @ W_H.T + w.W_U[:, -1]) @ W_A.T, atol=2e-6)


def test_online_recall_carries_on_the_states_that_following_infers():
    net, (senses, commands) = network(), cue(9)
    recalled = follow(net, at_rest(net, 3), senses, commands)
    z = at_rest(net, 3)
    for t in range(9):
        mu, z = net.follow(z, commands[t], senses[t], np.ones_like(senses[t]))
        np.testing.assert_array_equal(recalled.hidden[t], z)
        np.testing.assert_allclose(recalled.senses[t], np.tanh(mu) @ net.weights.W_F.T + net.weights.b_F, atol=1e-5)


def test_online_recall_of_a_step_does_not_know_the_senses_of_that_step():
    net, (senses, commands) = network(), cue(6)
    other = senses.copy()
    other[4] += 10.0
    a, b = (follow(net, at_rest(net, 3), x, commands) for x in (senses, other))
    np.testing.assert_array_equal(a.senses[:5], b.senses[:5])
    assert np.abs(a.senses[5] - b.senses[5]).max() > 0.1


def test_running_on_is_following_the_own_predictions():
    net, (senses, commands) = network(iterations=50), cue(5)
    z = follow(net, at_rest(net, 3), senses, commands).hidden[-1]
    alone = run_on(net, z, 8)
    fed_back = np.concatenate([alone.commands, np.ones((8, 3, 1), np.float32)], axis=2)
    along = follow(net, z, alone.senses, fed_back)
    np.testing.assert_allclose(along.hidden, alone.hidden, atol=1e-4)
    np.testing.assert_allclose(along.commands, alone.commands, atol=1e-4)


def test_what_is_unseen_is_recalled_as_if_alone():
    net, (senses, commands) = network(), cue(5)
    blind = follow(net, at_rest(net, 3), np.full_like(senses, np.nan), commands)
    z = at_rest(net, 3)
    for t in range(5):
        z = np.tanh(z) @ net.weights.W_H.T + commands[t] @ net.weights.W_U.T
        np.testing.assert_allclose(blind.hidden[t], z, atol=1e-5)


@pytest.fixture(scope="module")
def asm() -> NeuralASM:
    return NeuralASM(sine_spec(), 64, association_size=10, iterations=10, epochs=80, free_running_probability=0.95).fit(
        sine_episodes(24, steps=(60, 60))
    )


def test_recalled_rows_are_the_expected_ones_in_the_units_of_the_stream(asm):
    episode = sine_episodes(1, seed=9, steps=(60, 60))[0]
    rows, reader, net = asm.recall(episode.stream[:20], 5), asm.senses_, asm.network_
    reading = reader.read_episode(episode.stream[:20])
    z = at_rest(net, 1)
    for x, u in zip(reading.senses, reading.commands, strict=True):
        _, z = net.follow(z, u[None], x[None], np.ones((1, len(x)), np.float32))
    recalled = run_on(net, z, 5)
    spec = asm.spec
    np.testing.assert_allclose(
        rows[:, spec.sensory],
        reader.mean[spec.sensory] + reader.spread[spec.sensory] * recalled.senses[:, 0, : len(spec.sensory)],
        rtol=1e-6,
    )
    np.testing.assert_allclose(
        rows[:, spec.motor], reader.mean[spec.motor] + reader.spread[spec.motor] * recalled.commands[:, 0], rtol=1e-6
    )
    np.testing.assert_array_equal(rows, to_rows(reader, recalled)[:, 0])


def test_what_was_learned_by_running_on_is_recalled_better_than_by_standing_still(asm):
    errors = []
    for episode in sine_episodes(10, seed=9, steps=(60, 60)):
        true, spread = episode.stream[20:35, asm.spec.sensory], asm.senses_.spread[asm.spec.sensory]
        recalled = asm.recall(episode.stream[:20], 15)[:, asm.spec.sensory]
        held = np.repeat(episode.stream[19:20, asm.spec.sensory], 15, axis=0)
        errors.append([np.mean(((x - true) / spread) ** 2) for x in (recalled, held)])
    recalled, held = np.mean(errors, axis=0)
    assert recalled < 0.6 * held


def test_a_memory_that_was_loaded_recalls_the_same(asm, tmp_path):
    cue_rows = sine_episodes(1, seed=3)[0].stream[:10]
    asm.save(tmp_path / "a.asm")
    np.testing.assert_array_equal(NeuralASM.load(tmp_path / "a.asm").recall(cue_rows, 6), asm.recall(cue_rows, 6))


@pytest.mark.parametrize(
    ("rows", "steps", "message"),
    [
        (np.zeros((1, 14)), 5, "at least 2 rows long.*got 1"),
        (np.zeros(14), 5, r"shape \(T, 14\), got \(14,\)"),
        (np.zeros((5, 13)), 5, r"14 numbers a step.*\(5, 13\)"),
        (np.full((5, 14), np.nan), 5, r"cue row 0, joint_position\[0\] must be finite, got nan"),
        (np.full((5, 14), np.inf), 5, "must be finite, got inf"),
        (np.zeros((5, 14)), 0, "steps must be at least 1, got 0"),
    ],
)
def test_a_cue_that_cannot_be_recalled_from_is_refused(asm, rows, steps, message):
    with pytest.raises(ValueError, match=message):
        asm.recall(rows, steps)


def test_an_unfitted_memory_recalls_nothing():
    with pytest.raises(RuntimeError, match="call fit"):
        NeuralASM(sine_spec()).recall(np.zeros((5, 14)), 3)


def some_trajectories(count: int) -> list[Trajectory]:
    senses, commands = cue(40, count)
    return [Trajectory(senses[: 30 + n, n], commands[: 30 + n, n], senses[: 30 + n, n]) for n in range(count)]


def test_streams_play_whole_episodes_one_after_another_at_different_phases():
    episodes = some_trajectories(3)
    moments = list(itertools.islice(one_after_another(episodes, 5, np.random.default_rng(0)), 200))
    assert len({int(np.argmax([m.begins[n, 0] for m in moments])) for n in range(5)}) >= 4
    for n in range(5):
        begins = [t for t, m in enumerate(moments) if m.begins[n, 0]]
        for start, stop in itertools.pairwise(begins):
            rows = np.stack([m.senses[n] for m in moments[start:stop]])
            assert any(e.senses.shape == rows.shape and (e.senses == rows).all() for e in episodes)


@pytest.mark.parametrize("free", [0.0, 1.0])
def test_after_the_cue_the_expected_state_and_action_are_handed_on(free):
    episode = some_trajectories(1)[0]
    weights, rng = initial_weights(H, S, A, np.random.default_rng(3)), np.random.default_rng(0)
    sampling = ScheduledSampling(Learner(weights, schedule(iterations=20), rng), 1)
    stream = (m for m in one_after_another([episode], 1, np.random.default_rng(0)))
    first = next(m for m in stream if m.begins.all())
    sampling.run([first], 0.0, free)
    length = int(sampling.carried.cue[0, 0])
    assert 1 <= length < LONGEST_CUE
    sampling.run(itertools.islice(stream, len(episode.senses) - 1), 0.0, free)
    net = Network(weights, network().association, 20, 1.0, 1.0)
    read = len(episode.senses) if free == 0.0 else length
    z = at_rest(net, 1)
    for t, (x, u) in enumerate(zip(episode.senses[:, None], episode.commands[:, None], strict=True)):
        if t < read - (free > 0):
            _, z = net.follow(z, u, x, np.ones_like(x))
            continue
        # From the last row of the cue on the expected state is kept, and the next action is the memory's own.
        h, action = motor_prediction(z, weights)
        taken = u[:, :-1] if t == read - 1 else action
        z = h + taken @ weights.W_U[:, :-1].T
    np.testing.assert_allclose(sampling.carried.z, z, atol=1e-4)


def test_a_broken_episode_is_refused_before_it_is_learned():
    episode = sine_episodes(1)[0]
    stream = episode.stream.copy()
    stream[3, 2] = np.nan
    with pytest.raises(ValueError, match="must be finite, got nan"):
        NeuralASM(sine_spec(), free_running_probability=0.5).fit([replace(episode, stream=stream)])
