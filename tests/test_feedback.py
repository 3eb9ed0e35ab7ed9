"""Ways for errors to come back to the hidden units of association, against the gradient."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.memory.association import association_change, complete, hidden_units, learn_association, synapses
from asm_gym.memory.feedback import FEEDBACK, Learned, Random, Settled
from asm_gym.memory.linear import learn_by_delta, learn_linear
from asm_gym.monitors import NeuralASM
from tests.problems import some_association
from tests.streams import sine_episodes


def tied(rng):
    """Inputs (N, 6) and changes (N, 4): two causes, and their sines."""
    cause = rng.normal(size=(3000, 2))
    delta = np.hstack([cause, np.sin(2 * cause) + 0.05 * rng.normal(size=cause.shape)]).astype(np.float32)
    return np.hstack([delta, np.ones((len(delta), 2))]).astype(np.float32), delta


def left_by(feedback):
    """The deviation of what hidden units leave that were taught so; a line leaves 0.65, the noise alone is 0.05."""
    a, delta = tied(np.random.default_rng(0))
    layout = np.array([0, 0, 1, 1]), slice(0, 4), 20
    w = learn_association(a, delta, *layout, np.random.default_rng(1), updates=500, feedback=feedback)
    return w, float((delta - complete(hidden_units(a, w.V), a, w.U, w.D))[:, 2:].std())


def test_learned_feedback_comes_to_the_weights_that_predict_and_random_feedback_stays():
    learned, random = Learned(), Random()
    w, _ = left_by(learned)
    U = w.U / w.remainder[:, None]
    assert np.sum(U * learned.B) > 0.9 * np.linalg.norm(U) * np.linalg.norm(learned.B)
    other, _ = left_by(random)
    aligned = np.sum(other.U * random.B) / (np.linalg.norm(other.U) * np.linalg.norm(random.B))
    assert aligned < 0.6
    assert not (learned.B[U == 0] != 0).any()  # no synapse where there is none forth


@pytest.mark.parametrize("way", FEEDBACK)
def test_hidden_units_learn_what_no_line_can_and_best_by_errors_that_know_the_weights(way):
    _, left = left_by(FEEDBACK[way]())
    assert left < (0.62 if way == "random" else 0.45)


def test_the_delta_rule_comes_to_the_closed_form():
    rng = np.random.default_rng(2)
    a = np.hstack([rng.normal(size=(4000, 6)) @ rng.normal(size=(6, 6)), np.ones((4000, 1))]).astype(np.float32)
    groups, changes = np.array([0, 0, 1]), slice(0, 3)
    exists = synapses(groups, changes, 7, 1).D
    exact, local = learn_linear(a, groups, changes), learn_by_delta(a, changes, exists, rng)
    left = [np.std(a[:, changes] - a @ D.T, axis=0) for D in (local, exact)]
    assert (left[0] < 1.02 * left[1]).all()
    assert not local[exists == 0].any()
    by = FEEDBACK["local"]().linear(a, groups, changes, exists, np.random.default_rng(5))
    np.testing.assert_array_equal(by, learn_by_delta(a, changes, exists, np.random.default_rng(5)))


def test_what_is_given_nothing_else_is_taught_by_the_transposed_weights():
    for one, other in zip(left_by(None)[0], left_by(FEEDBACK["transported"]())[0], strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_memory_remembers_how_it_was_taught(tmp_path):
    episodes = sine_episodes(16)
    taught = NeuralASM(episodes[0].spec, hidden_size=8, association_size=16, epochs=1).fit(episodes)
    how = {"hidden_size": 8, "association_size": 16, "epochs": 1, "feedback": "transported"}
    plain = NeuralASM(episodes[0].spec, **how).fit(episodes)
    assert not np.array_equal(taught.learned_["V"], plain.learned_["V"])
    taught.save(tmp_path / "taught.asm")
    again = NeuralASM.load(tmp_path / "taught.asm")
    assert again.feedback == again.model.feedback == "learned"
    np.testing.assert_array_equal(again.score(episodes[0]).value, taught.score(episodes[0]).value)
    with pytest.raises(ValueError, match="transported, learned"):
        NeuralASM(episodes[0].spec, feedback="none")


def test_units_that_settle_under_a_firm_prior_learn_along_the_gradient_and_with_less_energy_than_they_began():
    rng = np.random.default_rng(3)
    a, delta = rng.normal(size=(64, 13)).astype(np.float32), rng.normal(size=(64, 5)).astype(np.float32)
    V, U, D, *_ = some_association(rng, 13, 6, 5)
    spread, settled = np.full(5, 2.0, np.float32), Settled(FEEDBACK["transported"](), 1e4, 60)
    settled.begin(np.ones_like(U), rng)
    for _ in range(20):
        found, error = settled.change(a, delta, spread, V, U, D)
    exact, expected = association_change(a, delta, spread, V, U, D)
    np.testing.assert_allclose(error, expected, atol=1e-5)
    for mine, theirs in ((found.V, exact.V), (found.U, exact.U)):
        assert np.sum(mine * theirs) > 0.999 * np.linalg.norm(mine) * np.linalg.norm(theirs)


def test_units_settle_where_the_energy_is_least():
    rng = np.random.default_rng(4)
    a, delta = rng.normal(size=(1, 13)).astype(np.float32), rng.normal(size=(1, 5)).astype(np.float32)
    V, U, D, *_ = some_association(rng, 13, 6, 5)
    drive, left, spread = a @ V.T, delta - a @ D.T, np.full(5, 0.5)

    def energy(h):
        r = np.abs(left - np.tanh(h) @ U.T) / spread
        return 0.5 * 2.0 * np.sum((h - drive) ** 2) + np.sum(spread * np.where(r <= 1, 0.5 * r**2, r - 0.5))

    settled = Settled(FEEDBACK["transported"](), 2.0, 400)
    settled.begin(np.ones_like(U), rng)
    for _ in range(20):
        found, _ = settled.change(a, delta, spread.astype(np.float32), V, U, D)
    h = drive + found.V[:, [-1]].T / (2.0 * a[0, -1])  # ε_h aᵀ of a single row
    assert energy(h) < energy(drive) - 0.01
    for step in 1e-3 * np.vstack([np.eye(6), -np.eye(6)]):
        assert energy(h) <= energy(h + step) + 1e-7
