"""Recall against its oracles: a linear system in closed form, following itself, and what was rehearsed."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from asm_gym.memory.association import Association, association_shapes
from asm_gym.memory.inference import direct, direct_synapses
from asm_gym.memory.learning import Learner, Schedule, Trajectory
from asm_gym.memory.network import Network, initial_weights
from asm_gym.memory.recall import follow, run_on, to_rows
from asm_gym.memory.scheduled_sampling import LONGEST_CUE, ScheduledSampling, learn, one_after_another
from asm_gym.memory.traces import DECAYS, advance, fit_gains
from asm_gym.monitors import NeuralASM
from tests.streams import sine_episodes, sine_spec

H, S, A = 7, 4, 2


def network(scale: float = 1.0, iterations: int = 20) -> Network:
    rng = np.random.default_rng(0)
    weights = initial_weights(H, S, A, rng)
    weights.W_F[:] = scale * rng.normal(size=weights.W_F.shape)
    weights.W_D[:] = 0.1 * rng.normal(size=weights.W_D.shape) * direct_synapses(S, A)
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


def test_offline_recall_without_a_state_is_the_power_of_its_matrix():
    net = network(scale=0.0)  # what is left is linear: r_t = P c_{t-1} + p,  c_t = Λ c_{t-1} + G [r_t, 1]
    w = net.weights
    size, R = w.W_C.shape[1], S + A + 1
    D, to_senses = w.W_D[:, :size].astype(float), w.W_D[:S, size : size + A].astype(float)
    P, p = D.copy(), w.W_D[:, -1].astype(float)
    P[:S] += to_senses @ D[S:]
    p[:S] += to_senses @ p[S:]
    take_up = np.kron(w.gains[:, None].astype(float), np.eye(R))  # (size, R)
    M = np.diag(np.repeat(DECAYS.astype(float), R)) + take_up[:, : S + A] @ P
    constant = take_up @ np.append(p, 1.0)
    c = 0.1 * np.random.default_rng(2).normal(size=(2, size)).astype(np.float32)
    recalled = run_on(net, c, 12)
    state = c.astype(float)
    for t in range(12):
        np.testing.assert_allclose(
            np.hstack([recalled.senses[t], recalled.commands[t]]), state @ P.T + p, rtol=2e-3, atol=1e-4
        )
        state = state @ M.T + constant
    np.testing.assert_allclose(recalled.traces, state, rtol=2e-3, atol=1e-4)


def test_online_recall_carries_on_the_traces_that_following_leaves():
    net, (senses, commands) = network(), cue(9)
    recalled = follow(net, net.at_rest(3), senses, commands)
    c = net.at_rest(3)
    for t in range(9):
        step = net.follow(c, commands[t], senses[t], np.ones_like(senses[t]))
        c = step.traces
        np.testing.assert_array_equal(recalled.hidden[t], step.z)
        np.testing.assert_array_equal(recalled.senses[t], step.expected[:, :S])
    np.testing.assert_array_equal(recalled.traces, c)


def test_watching_and_following_agree_where_all_is_seen_and_where_something_is_not():
    net, (senses, commands) = network(), cue(3)
    for seen in (np.ones((3, S), np.float32), np.array([[1, 0, 1, 1]] * 3, np.float32)):
        step = net.follow(net.at_rest(3), commands[0], senses[0], seen)
        expected, traces = net.carry_on(net.at_rest(3), commands[0], senses[0], seen)
        np.testing.assert_allclose(expected, np.tanh(step.mu), atol=1e-6)
        np.testing.assert_array_equal(traces, step.traces)


def test_online_recall_of_a_step_does_not_know_the_senses_of_that_step():
    net, (senses, commands) = network(), cue(6)
    other = senses.copy()
    other[4] += 10.0
    a, b = (follow(net, net.at_rest(3), x, commands) for x in (senses, other))
    np.testing.assert_array_equal(a.senses[:5], b.senses[:5])
    assert np.abs(a.senses[5] - b.senses[5]).max() > 0.1


def test_running_on_is_following_the_own_predictions():
    net, (senses, commands) = network(scale=0.3, iterations=50), cue(5)
    c = follow(net, net.at_rest(3), senses, commands).traces
    alone = run_on(net, c, 8)
    fed_back = np.concatenate([alone.commands, np.ones((8, 3, 1), np.float32)], axis=2)
    along = follow(net, c, alone.senses, fed_back)
    np.testing.assert_allclose(along.senses, alone.senses, atol=1e-3)
    np.testing.assert_allclose(along.traces, alone.traces, atol=1e-3)


def test_what_is_unseen_is_completed_by_what_was_expected_where_nothing_else_tells_of_it():
    net, (senses, commands) = network(scale=0.0), cue(5)  # without a state no sense tells of another
    blind = follow(net, net.at_rest(3), np.full_like(senses, np.nan), commands)
    c = net.at_rest(3)
    for t in range(5):
        expected = direct(c, commands[t], net.weights.W_D)[:, :S]
        c = advance(c, np.hstack([expected, commands[t]]), net.weights.gains)
    np.testing.assert_allclose(blind.traces, c, rtol=1e-4, atol=1e-5)


def test_a_missing_sense_is_inferred_from_the_others():
    # Two senses that always agree: where one is gone, what the other says now fills it in.
    rng = np.random.default_rng(0)
    rows = rng.choice([-1.0, 1.0], size=(40, 30, 1)).repeat(2, axis=2).astype(np.float32)
    episodes = [Trajectory(r, np.ones((30, 1), np.float32), r) for r in rows]
    weights = initial_weights(16, 2, 0, rng)
    weights.gains[:] = fit_gains([np.hstack([t.senses, t.commands]) for t in episodes])
    learn(weights, episodes, schedule(epochs=40, batch_size=8, free_running_probability=0.0), rng, lambda: None)
    net = Network(weights, network().association, 50, 1.0, 1.0)
    right = 0
    for r in rows[:20]:
        step = net.follow(net.at_rest(1), np.ones((1, 1), np.float32), r[:1], np.array([[1.0, 0.0]], np.float32))
        right += step.traces.reshape(len(DECAYS), 3)[0, 1] * r[0, 1] > 0  # the fastest trace holds the row itself
    assert right == 20


@pytest.fixture(scope="module")
def asm() -> NeuralASM:
    return NeuralASM(sine_spec(), 64, association_size=10, iterations=10, epochs=80, free_running_probability=0.95).fit(
        sine_episodes(24, steps=(60, 60))
    )


def test_recalled_rows_are_the_expected_ones_in_the_units_of_the_stream(asm):
    episode = sine_episodes(1, seed=9, steps=(60, 60))[0]
    rows, reader, net = asm.recall(episode.stream[:20], 5), asm.senses_, asm.network_
    reading = reader.read_episode(episode.stream[:20])
    c = net.at_rest(1)
    for x, u in zip(reading.senses, reading.commands, strict=True):
        c = net.follow(c, u[None], x[None], np.ones((1, len(x)), np.float32)).traces
    recalled = run_on(net, c, 5)
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


def test_what_was_rehearsed_is_recalled_better_than_by_standing_still(asm):
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
        (np.zeros((5, 14)), 0, "steps must be a whole number in .*, got 0"),
        (np.zeros((5, 14)), 10**10, "steps must be a whole number in .*, got 10000000000"),
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
def test_after_the_cue_the_traces_take_up_what_was_expected(free):
    episode = some_trajectories(1)[0]
    weights, rng = network().weights, np.random.default_rng(0)
    streams = ScheduledSampling(Learner(weights, schedule(iterations=20), rng), 1)
    moments = one_after_another([episode], 1, np.random.default_rng(0))
    first = next(m for m in moments if m.begins.all())
    streams.run([first], 0.0, free)
    length = int(streams.cue[0, 0])
    assert 1 <= length < LONGEST_CUE
    streams.run(itertools.islice(moments, len(episode.senses) - 1), 0.0, free)
    net = Network(weights, network().association, 20, 1.0, 1.0)
    read = len(episode.senses) if free == 0.0 else length
    cued = follow(net, net.at_rest(1), episode.senses[:read, None], episode.commands[:read, None])
    traces = run_on(net, cued.traces, len(episode.senses) - read).traces if free else cued.traces
    np.testing.assert_allclose(streams.traces, traces, rtol=1e-3, atol=1e-3)


def test_a_broken_episode_is_refused_before_it_is_learned():
    episode = sine_episodes(1)[0]
    stream = episode.stream.copy()
    stream[3, 2] = np.nan
    with pytest.raises(ValueError, match="must be finite, got nan"):
        NeuralASM(sine_spec(), free_running_probability=0.5).fit([replace(episode, stream=stream)])
