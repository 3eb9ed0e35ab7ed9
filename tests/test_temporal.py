"""The temporal network: inference, learning, recall and readout, against their oracles."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asm_gym.memory.energy import (
    STRIDE,
    Inference,
    activate,
    energy_gradient,
    feedback,
    infer,
    outward,
)
from asm_gym.memory.learning import (
    LONGEST_CUE,
    Practice,
    Synapse,
    Trajectory,
    cosine_decay,
    one_after_another,
)
from asm_gym.memory.recall import follow, run_on
from asm_gym.memory.recurrent import RecurrentNetwork, advance
from asm_gym.memory.recurrent_learning import (
    RecurrentLearner,
    Wiring,
    initial_recurrent_weights,
    learn_recurrent,
)
from asm_gym.memory.temporal import unassociated
from asm_gym.monitors import MemoryConfig, NeuralASM
from asm_gym.monitors.memory_skills import recall
from tests.problems import called, energy, problem, schedule, some_rows, trajectory
from tests.streams import sine_episodes, sine_spec

H, S, A = 7, 4, 2


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
    np.testing.assert_allclose(
        called(feedback)(a, x, W, pi), (pi * (x - a @ W.T)) @ W, rtol=1e-12, atol=1e-12
    )


def test_energy_gradient_is_that_of_finite_differences():
    z, *rest = problem(0, dtype=np.float64)
    gradient, _ = called(energy_gradient)(z, *rest)
    for index in np.ndindex(z.shape):
        step = np.zeros_like(z)
        step[index] = 1e-5
        slope = (energy(z + step, *rest) - energy(z - step, *rest))[index[0]] / 2e-5
        assert gradient[index] == pytest.approx(slope, rel=1e-5, abs=1e-5)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), weight=st.floats(0.01, 30.0), reach=st.floats(0.01, 100.0))
def test_energy_never_rises_during_inference(seed, weight, reach):
    _, mu, x, W_F, pi_z, pi_x = problem(seed, dtype=np.float64)
    W_F, x = W_F * weight, x * reach
    curvature = pi_z + pi_x.max() * np.linalg.norm(W_F, 2) ** 2
    energies = [
        energy(infer(mu, x, W_F, pi_x, Inference(pi_z, 1.0, curvature, k)), mu, x, W_F, pi_z, pi_x)
        for k in range(15)
    ]
    assert (np.diff(energies, axis=0) / (1.0 + energies[0])).max() <= 1e-6


def test_inference_is_gradient_descent_that_unseen_senses_do_not_move():
    _, mu, x, W_F, pi_z, pi_x = problem(2, dtype=np.float64)
    z = mu.copy()
    for _ in range(6):
        f = np.tanh(z)
        back = (pi_x * (x - f @ W_F.T)) @ W_F
        bend = 0.77 * np.abs(back).max(axis=1, keepdims=True)
        z = z - float(STRIDE) / (9.0 + bend) * (pi_z * (z - mu) - (1 - f**2) * back)
    np.testing.assert_allclose(infer(mu, x, W_F, pi_x, Inference(pi_z, 1.0, 9.0, 6)), z, atol=1e-5)
    seen, other = np.ones_like(x), x.copy()
    seen[:, 1], other[:, 1] = 0, 77.0
    a, b = (infer(mu, v, W_F, seen, Inference(pi_z, 1.0, 20.0, 5)) for v in (x, other))
    assert a.tobytes() == b.tobytes()


def test_a_unit_is_the_exponentially_weighted_sum_of_all_rows():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(30, 2, S + A + 1)).astype(np.float32)
    weights = initial_recurrent_weights(H, S, A, rng)
    weights.reads[1] = 0.0
    carried = np.zeros((2, weights.W_C.shape[1]), np.float32)
    for row in rows:
        carried = advance(carried, row, weights)
    multiplier = np.exp(-np.exp(weights.decay.astype(float)) + 1j * weights.turn)  # (N,)
    powers = multiplier[:, None] ** np.arange(len(rows))[::-1]  # (N, T)
    drive = (rows * weights.reads) @ (weights.B_re + 1j * weights.B_im).T  # (T, B, N)
    units = np.einsum("nt,tbn->bn", powers, drive) * weights.gain
    expected = np.hstack([units.real, units.imag, rows[-1]])
    np.testing.assert_allclose(carried, expected, atol=1e-4)


def test_a_synapse_steps_as_adam_does_along_a_cosine():
    rng = np.random.default_rng(0)
    synapse = Synapse(np.ones((2, 3), np.float32))
    W, m, s = np.ones((2, 3)), 0.0, 0.0
    for t, c in enumerate(rng.normal(size=(5, 2, 3)).astype(np.float32), start=1):
        synapse.learn(c, 0.01)
        m, s = 0.9 * m + 0.1 * c, 0.999 * s + 0.001 * c**2
        W = W + 0.01 * (m / (1 - 0.9**t)) / (np.sqrt(s / (1 - 0.999**t)) + 1e-8)
    np.testing.assert_allclose(synapse.W, W, rtol=1e-5)
    assert [cosine_decay(2.0, p) for p in (0.0, 0.5, 1.0)] == pytest.approx([2.0, 1.0, 0.0])


def sines(count: int, motor: int = 2) -> list[Trajectory]:
    rng = np.random.default_rng(0)
    out = []
    for n in range(count):
        T = 20 + n % 3
        time = np.arange(T)[:, None] * rng.uniform(0.1, 0.3, size=5)
        commands = np.concatenate([rng.normal(size=(T, motor)), np.ones((T, 1))], axis=1)
        out.append(trajectory(np.sin(time).astype(np.float32), commands.astype(np.float32)))
    return out


def test_learning_lowers_the_energy_and_is_reproducible():
    episodes = sines(12)
    first, again = (
        learn_recurrent(episodes, 32, schedule(epochs=60), np.random.default_rng(7), lambda: None)
        for _ in range(2)
    )
    assert first.energy[-1] < 0.6 * first.energy[0]  # two of seven numbers are noise
    pairs = zip(first.network.weights, again.network.weights, strict=True)
    assert all(a.tobytes() == b.tobytes() for a, b in pairs)


def test_a_bit_that_was_seen_long_ago_is_recalled():
    rng, delay = np.random.default_rng(0), 12
    episodes = []
    for n in range(24):
        senses = 0.05 * rng.standard_normal((delay + 4, 2))
        senses[0, 0], senses[delay:, 1] = (1.0 if n % 2 else -1.0,) * 2
        episodes.append(trajectory(senses.astype(np.float32), np.ones((delay + 4, 1), np.float32)))
    how = schedule(epochs=100, batch_size=8, learning_rate=5e-3, prior_precision=30.0)
    network, right = learn_recurrent(episodes, 32, how, rng, lambda: None).network, []
    for episode in episodes:
        cued = follow(
            network,
            network.at_rest(1),
            episode.senses[:delay, None],
            episode.commands[:delay, None],
        )
        right.append(run_on(network, cued.carried, 1).senses[0, 0, 1] * episode.senses[0, 0])
    assert min(right) > 0
    assert np.mean(right) > 0.4


def network(scale: float = 1.0, iterations: int = 20) -> RecurrentNetwork:
    rng = np.random.default_rng(0)
    weights = initial_recurrent_weights(H, S, A, rng)
    weights.W_F[:] = scale * rng.normal(size=weights.W_F.shape)
    weights.W_D[:] = 0.1 * rng.normal(size=weights.W_D.shape) * Wiring.of(weights).W_D
    return RecurrentNetwork(weights, unassociated(), iterations, 1.0, 1.0)


def test_running_on_is_following_the_own_predictions():
    net, (senses, commands) = network(scale=0.3, iterations=50), some_rows(5, 3, S, A)
    c = follow(net, net.at_rest(3), senses, commands).carried
    alone = run_on(net, c, 8)
    fed_back = np.concatenate([alone.commands, np.ones((8, 3, 1), np.float32)], axis=2)
    along = follow(net, c, alone.senses, fed_back)
    np.testing.assert_allclose(along.senses, alone.senses, atol=1e-3)
    np.testing.assert_allclose(along.carried, alone.carried, atol=1e-3)


def test_a_missing_sense_is_inferred_from_the_others():
    # Two senses that always agree: where one is missing, the other tells it.
    rng = np.random.default_rng(0)
    rows = rng.choice([-1.0, 1.0], size=(40, 30, 1)).repeat(2, axis=2).astype(np.float32)
    episodes = [Trajectory(r, np.ones((30, 1), np.float32), r) for r in rows]
    net = learn_recurrent(
        episodes, 16, schedule(epochs=40, batch_size=8), rng, lambda: None
    ).network.with_iterations(50)
    for r in rows[:20]:
        step = net.follow(
            net.at_rest(1), np.ones((1, 1), np.float32), r[:1], np.array([[1.0, 0.0]], np.float32)
        )
        assert step.senses[0, 1] * r[0, 1] > 0


def phases(count: int) -> list[Trajectory]:
    senses, commands = some_rows(40, count, S, A)
    return [
        Trajectory(senses[: 30 + n, n], commands[: 30 + n, n], senses[: 30 + n, n])
        for n in range(count)
    ]


@pytest.mark.parametrize("free", [0.0, 1.0])
def test_after_the_cue_what_is_carried_takes_up_predictions(free):
    episode, weights, rng = phases(1)[0], network().weights, np.random.default_rng(0)
    streams = Practice(
        RecurrentLearner(weights, schedule(batch_size=1, iterations=20), rng), 1, rng
    )
    moments = one_after_another([episode], 1, np.random.default_rng(0))
    streams.run([next(m for m in moments if m.begins.all())], 0.0, free)
    length = int(streams.cue[0, 0])
    assert 1 <= length < LONGEST_CUE
    streams.run(itertools.islice(moments, len(episode.senses) - 1), 0.0, free)
    net = RecurrentNetwork(weights, unassociated(), 20, 1.0, 1.0)
    read = len(episode.senses) if free == 0.0 else length
    cued = follow(net, net.at_rest(1), episode.senses[:read, None], episode.commands[:read, None])
    carried = cued.carried
    if free:
        carried = run_on(net, carried, len(episode.senses) - read).carried
    np.testing.assert_allclose(streams.state, carried, rtol=1e-3, atol=1e-3)


@pytest.fixture(scope="module")
def asm() -> NeuralASM:
    memory = NeuralASM(sine_spec(), 64, 10, 80, 0.95, config=MemoryConfig(iterations=10))
    return memory.fit(sine_episodes(24, steps=(60, 60)))


def test_recall_is_in_the_units_of_the_stream_and_better_than_standing_still(asm, tmp_path):
    errors, spread = [], asm.senses_.spread[asm.spec.sensory]
    for episode in sine_episodes(10, seed=9, steps=(60, 60)):
        true = episode.stream[20:35, asm.spec.sensory]
        recalled = recall(asm, episode.stream[:20], 15)[:, asm.spec.sensory]
        errors.append(
            [np.mean(((x - true) / spread) ** 2) for x in (recalled, true[:1] + 0 * true)]
        )
    recalled, held = np.mean(errors, axis=0)
    assert recalled < 0.6 * held
    asm.save(tmp_path / "a.asm")
    cue = sine_episodes(1, seed=3)[0].stream[:10]
    np.testing.assert_array_equal(
        recall(NeuralASM.load(tmp_path / "a.asm"), cue, 6), recall(asm, cue, 6)
    )


@pytest.mark.parametrize(
    ("rows", "steps", "message"),
    [
        (np.zeros((1, 14)), 5, "at least 2 rows.*got 1"),
        (np.zeros(14), 5, r"shape \(T, 14\), got \(14,\)"),
        (np.zeros((5, 13)), 5, r"14 numbers a step.*\(5, 13\)"),
        (np.full((5, 14), np.nan), 5, r"cue row 0, joint_position\[0\] must be finite, got nan"),
        (np.zeros((5, 14)), 0, "steps must be a whole number in .*, got 0"),
        (np.zeros((5, 14)), 10**10, "steps must be a whole number in .*, got 10000000000"),
    ],
)
def test_a_cue_that_cannot_be_recalled_from_is_refused(asm, rows, steps, message):
    with pytest.raises(ValueError, match=message):
        recall(asm, rows, steps)
