"""The network that settles: its energy against finite differences, a linear observer, and what a user may ask of it."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.checkpoint import read_checkpoint
from asm_gym.data.episode import Episode
from asm_gym.memory.energy import Inference, infer
from asm_gym.memory.learning import Schedule, Turn
from asm_gym.memory.recall import follow, run_on
from asm_gym.memory.settling import (
    SettlingErrors,
    SettlingLearner,
    SettlingNetwork,
    SettlingWeights,
    initial_settling_weights,
    settling_change,
)
from asm_gym.memory.temporal import unassociated
from asm_gym.monitors import MemoryConfig, NeuralASM, load_monitor
from asm_gym.monitors.memory_skills import name_skills, recall
from tests.problems import some_rows
from tests.streams import frozen, sine_episodes, sine_spec

H, S, A = 7, 4, 2
SCHEDULE = Schedule(8, 4, 3e-3, 20, 1.0, 1.0, 0.0)


def network(iterations: int = 20) -> SettlingNetwork:
    return SettlingNetwork(
        initial_settling_weights(H, S, A, np.random.default_rng(0)),
        unassociated(),
        iterations,
        1,
        1,
    )


def rows(steps: int, batch: int = 3) -> tuple[np.ndarray, np.ndarray]:
    return some_rows(steps, batch, S, A)


def total_energy(w: SettlingWeights, before, u, x, z, pi_z, pi_x) -> float:
    """F of a step, written out; a mean over the batch."""
    carried = np.tanh(before) @ w.W_H.T
    state, senses = z - carried - u @ w.W_U.T, x - np.tanh(z) @ w.W_F.T - w.b_F
    action = u[:, :-1] - np.tanh(carried + w.W_U[:, -1]) @ w.W_A.T
    return (
        0.5 * float(pi_z * np.sum(state**2) + pi_x * np.sum(senses**2) + np.sum(action**2)) / len(z)
    )


def problem(settled: bool):
    """Weights, what a step reads, and z: anywhere, or where inference settles; of double precision."""
    rng = np.random.default_rng(3)
    w = SettlingWeights(
        *(np.asarray(W, np.float64) for W in initial_settling_weights(H, S, A, rng))
    )
    w.b_F[:] = rng.normal(size=S)
    before, u, x = (
        rng.normal(size=(3, H)),
        np.hstack([rng.normal(size=(3, A)), np.ones((3, 1))]),
        rng.normal(size=(3, S)),
    )
    return (
        w,
        before,
        u,
        x,
        settle_in_double(w, before, u, x) if settled else rng.normal(size=(3, H)),
    )


def settle_in_double(w: SettlingWeights, before, u, x, pi_z=2.0, pi_x=1.5):
    mu, curvature = (
        np.tanh(before) @ w.W_H.T + u @ w.W_U.T,
        pi_z + pi_x * np.linalg.norm(w.W_F, 2) ** 2,
    )
    inference = Inference(pi_z, pi_x, curvature, 3000)
    return infer(mu, x - w.b_F, w.W_F, np.full_like(x, pi_x), inference)


def changes(w: SettlingWeights, before, u, x, z, pi_z=2.0, pi_x=1.5) -> SettlingWeights:
    carried = np.tanh(before) @ w.W_H.T
    mu, h = carried + u @ w.W_U.T, carried + w.W_U[:, -1]
    errors = SettlingErrors(
        state=pi_z * (z - mu),
        senses=pi_x * (x - w.b_F - np.tanh(z) @ w.W_F.T),
        action=u[:, :-1] - np.tanh(h) @ w.W_A.T,
    )
    return settling_change(before, u, h, errors, z, w.W_A)


@pytest.mark.parametrize("settled", [False, True])
def test_every_rule_is_the_slope_of_the_energy(settled):
    w, before, u, x, z = problem(settled)
    delta = changes(w, before, u, x, z)
    for name in SettlingWeights._fields:
        rng = np.random.default_rng(0)
        way = rng.normal(size=getattr(w, name).shape)

        def energy(step, name=name, way=way):
            moved = w._replace(**{name: getattr(w, name) + step * way})
            # Where z has settled F is flat in it, so that letting it settle anew changes nothing: a total derivative.
            at = settle_in_double(moved, before, u, x) if settled else z
            return total_energy(moved, before, u, x, at, 2.0, 1.5)

        slope = (energy(1e-4) - energy(-1e-4)) / 2e-4
        assert slope == pytest.approx(-np.sum(getattr(delta, name) * way), rel=2e-3, abs=1e-5), name


def test_where_it_is_linear_it_is_the_observer_of_a_constant_gain():
    # Small states, for which tanh is linear: z = μ + K (x - C μ),  K = Cᵀ (C Cᵀ + Π_z/Π_x)⁻¹
    rng, small = np.random.default_rng(0), 1e-3
    w = initial_settling_weights(3, 3, 1, rng)
    net = SettlingNetwork(w, unassociated(), 500, 0.5, 2.0)
    C = w.W_F.astype(float)
    K = C.T @ np.linalg.inv(C @ C.T + 0.25 * np.eye(3))
    z, state = net.at_rest(1), np.zeros((1, 3))
    for _ in range(30):
        x = small * rng.normal(size=(1, 3))
        u = np.append(small * rng.normal(size=1), 0.0)[None]
        z = net.follow(
            z, u.astype(np.float32), x.astype(np.float32), np.ones((1, 3), np.float32)
        ).carried
        mu = state @ w.W_H.T + u @ w.W_U.T
        state = mu + (x - mu @ C.T) @ K.T
        np.testing.assert_allclose(z, state, atol=1e-3 * small)


class Published:
    """The papers' network, written from their equations; inference takes steps of 0.01 from the prediction.

    μ = W_R f(z') + W_in u,  dz = -ε_z + f'(z) ⊙ W_outᵀ ε_x,  ΔW_R = ε_z f(z')ᵀ,  ΔW_in = ε_z uᵀ,  ΔW_out = ε_x f(z)ᵀ
    (Tang, Barron and Bogacz 2023; Millidge et al. 2024), and the motor prediction â = W_A f(h), h = W_R f(z') + b.
    """

    def __init__(self, w: SettlingWeights, steps: int) -> None:
        self.W = {name: np.array(W, np.float64) for name, W in w._asdict().items()}
        self.adam = {name: (np.zeros_like(W), np.zeros_like(W)) for name, W in self.W.items()}
        self.steps, self.count = steps, 0

    def prediction(self, z, u):
        return np.tanh(z) @ self.W["W_H"].T + u @ self.W["W_U"].T

    def senses(self, z):
        return np.tanh(z) @ self.W["W_F"].T + self.W["b_F"]

    def hidden(self, z):
        return np.tanh(z) @ self.W["W_H"].T + self.W["W_U"][:, -1]

    def action(self, z):
        return np.tanh(self.hidden(z)) @ self.W["W_A"].T

    def inferred(self, before, u, x):
        mu = z = self.prediction(before, u)
        for _ in range(self.steps):
            z = z + 0.01 * (mu - z + (1 - np.tanh(z) ** 2) * ((x - self.senses(z)) @ self.W["W_F"]))
        return mu, z

    def energy(self, before, u, x, z):
        return 0.5 * np.sum((z - self.prediction(before, u)) ** 2) + 0.5 * np.sum(
            (x - self.senses(z)) ** 2
        )

    def learn(self, before, u, x, rate):
        """Take a step of Adam along the Hebbian changes, and return the state."""
        mu, z = self.inferred(before, u, x)
        e_z, e_x, e_a = z - mu, x - self.senses(z), u[:, :-1] - self.action(before)
        e_h = (1 - np.tanh(self.hidden(before)) ** 2) * (e_a @ self.W["W_A"])
        constant = np.append(np.zeros(u.shape[1] - 1), 1.0)
        changes = {
            "W_H": (e_z + e_h).T @ np.tanh(before),
            "W_U": e_z.T @ u + np.outer(e_h.sum(axis=0), constant),
            "W_F": e_x.T @ np.tanh(z),
            "b_F": e_x.sum(axis=0),
            "W_A": e_a.T @ np.tanh(self.hidden(before)),
        }
        self.count += 1
        for name, change in changes.items():
            (m, s), g = self.adam[name], change / len(x)
            m += 0.1 * (g - m)
            s += 0.001 * (g**2 - s)
            scaled = m / (1 - 0.9**self.count), s / (1 - 0.999**self.count)
            self.W[name] += rate * scaled[0] / (np.sqrt(scaled[1]) + 1e-8)
        return z


def exact_problem(seed: int, steps: int = 6):
    """Random weights, and random rows (T, B, ...), of double precision, in which kernels then compute too."""
    rng = np.random.default_rng(seed)
    w = SettlingWeights(
        *(np.asarray(W, np.float64) for W in initial_settling_weights(H, S, A, rng))
    )
    w.b_F[:] = rng.normal(size=S)
    return (
        w,
        rng.normal(size=(steps, 3, S)),
        np.dstack([rng.normal(size=(steps, 3, A)), np.ones((steps, 3, 1))]),
    )


@pytest.mark.parametrize("seed", range(2))
def test_inference_and_both_recalls_are_those_of_the_published_equations(seed):
    w, senses, commands = exact_problem(seed)
    ours, theirs = SettlingNetwork(w, unassociated(), 3000, 1, 1), Published(w, 8000)
    z, expected = np.zeros((3, H)), []
    for x, u in zip(senses, commands, strict=True):
        mu, after = theirs.inferred(z, u, x)
        expected.append(np.hstack([theirs.senses(mu), theirs.action(z)]))
        z = after
    online = follow(ours, np.zeros((3, H)), senses, commands)
    np.testing.assert_allclose(online.carried, z, atol=1e-6)
    np.testing.assert_allclose(np.dstack([online.senses, online.commands]), expected, atol=1e-6)
    expected = []
    for _ in range(6):  # the network's own predictions stand in for senses and actions
        u = np.hstack([theirs.action(z), np.ones((3, 1))])
        mu, after = theirs.inferred(z, u, theirs.senses(theirs.prediction(z, u)))
        np.testing.assert_allclose(after, mu, atol=1e-9)  # nothing is left to infer
        expected.append(np.hstack([theirs.senses(mu), u[:, :-1]]))
        z = after
    offline = run_on(ours, online.carried, 6)
    np.testing.assert_allclose(np.dstack([offline.senses, offline.commands]), expected, atol=2e-6)


@pytest.mark.parametrize("seed", range(2))
def test_learning_is_that_of_the_published_equations(seed):
    w, senses, commands = exact_problem(seed)
    theirs = Published(w, 8000)
    schedule = SCHEDULE._replace(iterations=3000)
    learner = SettlingLearner(w, schedule, np.random.default_rng(0))
    never = np.zeros((3, 1), np.bool_)
    ours = z = np.zeros((3, H))
    for x, u in zip(senses, commands, strict=True):
        ours, _ = learner.practise(ours, Turn(x, u, own=never, alone=never, begins=never), 1e-3)
        z = theirs.learn(z, u, x, 1e-3)
    np.testing.assert_allclose(ours, z, atol=1e-6)
    for name, W in theirs.W.items():
        np.testing.assert_allclose(getattr(w, name), W, atol=1e-6, err_msg=name)


def test_few_of_our_steps_of_inference_go_at_least_as_far_as_a_hundred_published_ones():
    w, senses, commands = exact_problem(0)
    theirs, before = Published(w, 100), np.zeros((3, H))
    for x, u in zip(senses, commands, strict=True):
        _, z = theirs.inferred(before, u, x)
        ours = SettlingNetwork(w, unassociated(), 20, 1, 1).follow(before, u, x, np.ones_like(x)).z
        assert theirs.energy(before, u, x, ours) <= theirs.energy(before, u, x, z) + 1e-6


@pytest.fixture(scope="module")
def asm() -> NeuralASM:
    memory = NeuralASM(
        sine_spec(), 32, 48, epochs=30, free_running_probability=0.6, dynamics="settling"
    )
    return memory.fit(sine_episodes(40)).calibrate(sine_episodes(60, 1), 0.05)


def test_a_memory_that_settles_is_used_by_the_same_names(asm, tmp_path):
    asm.save(tmp_path / "settling.asm")
    loaded, episode = load_monitor(tmp_path / "settling.asm"), sine_episodes(1, 5)[0]
    assert isinstance(loaded, NeuralASM)
    assert loaded.get_params() == asm.get_params()
    assert (loaded.dynamics, loaded.config.iterations, loaded.config.prior_precision) == (
        "settling",
        20,
        1.0,
    )
    assert loaded.score(episode).value.tobytes() == asm.score(episode).value.tobytes()
    cue, after = episode.stream[:20].astype(float), episode.stream[20:30]
    np.testing.assert_array_equal(recall(loaded, cue, 10), recall(asm, cue, 10))
    apart = (
        np.abs(recall(asm, cue, 10) - after)[:, :12].mean(),
        np.abs(cue[-1] - after)[:, :12].mean(),
    )
    assert apart[0] < 0.9 * apart[1]  # 0.5 to 0.8, by the rounding of what it learned
    alarms = [asm.score(frozen(e, 3, 15)).value.max() > asm.threshold for e in sine_episodes(20, 7)]
    assert np.mean(alarms) > 0.9
    named = [
        Episode.from_stream(e.stream, e.spec, info={"skill": str(n % 2)})
        for n, e in enumerate(sine_episodes(8))
    ]
    copy = load_monitor(tmp_path / "settling.asm")
    assert set(name_skills(copy, named).score(episode).skill) <= {"0", "1"}
    state = asm.initial_state()
    for row in episode.stream:
        state, _ = asm.observe(state, row[None])
    assert asm.expected_action(state).shape == (1, 2)


def test_what_cannot_be_is_refused_in_a_line(asm, tmp_path):
    with pytest.raises(
        ValueError,
        match=r"^unknown dynamics 'setling'; known: recurrent, settling; did you mean",
    ):
        NeuralASM(sine_spec(), dynamics="setling")
    with pytest.raises(
        ValueError, match=r"^iterations must be a whole number in \[1, 1000\], got 0$"
    ):
        NeuralASM(sine_spec(), dynamics="settling", config=MemoryConfig(iterations=0))
    asm.save(tmp_path / "settling.asm")
    saved = read_checkpoint(tmp_path / "settling.asm", NeuralASM.kind)
    with pytest.raises(
        ValueError,
        match=r"^this is a memory of dynamics='settling', .* cannot be loaded as 'recurrent'$",
    ):
        NeuralASM(sine_spec(), 32, 48).restore(saved)
    recurrent = NeuralASM(sine_spec(), 8, 8, epochs=1).fit(sine_episodes(5))
    recurrent.save(tmp_path / "recurrent.asm")
    with pytest.raises(
        ValueError,
        match=r"^this is a memory of dynamics='recurrent', .* cannot be loaded as 'settling'$",
    ):
        NeuralASM(sine_spec(), 8, 8, dynamics="settling").restore(
            read_checkpoint(tmp_path / "recurrent.asm", recurrent.kind)
        )
