"""Association, its linear part, precision, cross-fitting and adaptation, against gradients and known noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asm_gym.data.episode import Episode
from asm_gym.memory import association_learning
from asm_gym.memory.association import (
    ChangeLayout,
    Wiring,
    complete,
    hidden_units,
    leverage,
    log_variance,
    normalised_errors,
    spans,
    synapses,
    unbounded,
)
from asm_gym.memory.association_learning import (
    PRECISION_BATCH,
    PRECISION_BATCHES,
    association_change,
    crossfit,
    learn_association,
    learn_leverage_scale,
    learn_precision,
    thirds,
)
from asm_gym.memory.linear_association import LEAST_VARIANCE, conditional, inverse_of, moments
from asm_gym.memory.recurrent import RecurrentWeights
from asm_gym.memory.recurrent_learning import (
    Eligibility,
    Errors,
    initial_recurrent_weights,
    local_change,
)
from asm_gym.memory.recurrent_learning import Wiring as RecurrentWiring
from asm_gym.monitors import NeuralASM, make_monitor
from asm_gym.scaling import ScaledRows
from tests.problems import CHANGES, called, energy
from tests.streams import frozen, sine_episodes, sine_spec

GROUPS = np.array([0, 0, 1, 2, 2])
LAYOUT = ChangeLayout(13, CHANGES, GROUPS, units=4)


@pytest.mark.parametrize("rows", [8000, 3 * PRECISION_BATCH * PRECISION_BATCHES])
def test_precision_recovers_noise_that_depends_on_context(rows, monkeypatch):
    rng = np.random.default_rng(0)
    context = rng.uniform(-1, 1, size=(rows, 6))
    truth = np.stack([2.0 * context[:, 0] - 3.0, -1.0 - context[:, 1] + context[:, 2]], axis=1)
    error = rng.normal(size=truth.shape) * np.exp(truth / 2)
    f = context.astype(np.float32)
    monkeypatch.setattr(association_learning, "PRECISION_RATE", 3e-3)
    W_S, b_S = learn_precision(f, error.astype(np.float32), rng)
    learned = log_variance(f, W_S, b_S, unbounded(2))
    np.testing.assert_allclose(learned.mean(axis=0), truth.mean(axis=0), atol=0.1)
    # against 1.15 and 0.8 for the best constant
    assert np.sqrt(np.mean((learned - truth) ** 2)) < 0.15


def test_no_group_predicts_itself():
    exists = synapses(LAYOUT)
    reaches = (exists.U @ exists.V > 0) | (exists.D > 0)  # (X, I)
    assert np.array_equal(reaches[:, CHANGES], GROUPS[:, None] != GROUPS)
    assert reaches[:, :5].all()
    assert reaches[:, 10:].all()


def test_all_rules_of_the_memory_descend_one_energy():
    rng = np.random.default_rng(3)
    B, H, S, A, units, inputs = 4, 6, 5, 2, 7, 13
    w = initial_recurrent_weights(H, S, A, rng)
    wiring = RecurrentWiring.of(w)
    W = {
        "W_C": w.W_C,
        "W_F": 3 * w.W_F,
        "W_D": 0.1 * rng.normal(size=w.W_D.shape) * wiring.W_D,
    }
    W |= {
        "V": rng.normal(size=(units, inputs)),
        "U": rng.normal(size=(S, units)),
        "D": rng.normal(size=(S, inputs)),
    }
    W = {name: np.asarray(array, np.float64) for name, array in W.items()}
    c, u, x, z = (rng.normal(size=(B, n)) for n in (w.W_C.shape[1], A + 1, S, H))
    a, delta, spread = (
        rng.normal(size=(B, inputs)),
        rng.normal(size=(B, S)),
        rng.uniform(1.0, 4.0, S),
    )

    def left(W):
        return np.hstack([x, u[:, :-1]]) - np.hstack([c, u]) @ W["W_D"].T

    def total(W):
        r = (delta - a @ W["D"].T - np.tanh(a @ W["V"].T) @ W["U"].T) / spread
        rho = np.where(np.abs(r) <= 1, 0.5 * r**2, np.abs(r) - 0.5)
        assert 0.1 < np.mean(np.abs(r) > 1) < 0.9  # both branches are there
        temporal = energy(z, c @ W["W_C"].T, left(W), W["W_F"], 30.0, np.ones((B, S + A)))
        return float(np.mean(temporal) + np.mean(np.sum(spread * rho, axis=1)))

    settled = left(W) - np.tanh(z) @ W["W_F"].T
    weights = RecurrentWeights._make(array.astype(np.float64) for array in w)
    weights = weights._replace(**{name: W[name] for name in ("W_C", "W_F", "W_D")})
    rules = local_change(
        m=c,
        u=u,
        z=z,
        errors=Errors(30.0 * (z - c @ W["W_C"].T), settled),
        eligible=Eligibility.none(B, weights),
        weights=weights,
        wiring=wiring,
    )._asdict()
    rules |= association_change(a, delta, spread, W["V"], W["U"], W["D"])[0]._asdict()
    exists = {"W_D": wiring.W_D}
    for name, array in W.items():
        for index in zip(*(rng.integers(n, size=6) for n in array.shape), strict=True):
            if not exists.get(name, np.ones(array.shape))[index]:
                continue
            ends = []
            for step in (1e-5, -1e-5):
                moved = array.copy()
                moved[index] += step
                ends.append(total({**W, name: moved}))
            assert rules[name][index] == pytest.approx(
                -(ends[0] - ends[1]) / 2e-5, rel=1e-3, abs=1e-4
            ), name


def test_hidden_units_learn_what_is_not_linear():
    rng = np.random.default_rng(0)
    cause = rng.normal(size=(3000, 2))
    delta = np.hstack([cause, np.sin(2 * cause) + 0.05 * rng.normal(size=cause.shape)]).astype(
        np.float32
    )
    a = np.hstack([delta, np.ones((len(delta), 2))]).astype(np.float32)
    layout = ChangeLayout(6, slice(0, 4), np.array([0, 0, 1, 1]), units=20)
    w, _ = learn_association(a, layout, np.random.default_rng(1))
    left = (delta - complete(hidden_units(a, w.V), a, w.U, w.D))[:, 2:].std()
    assert left < 0.45  # 0.65 by a line, 0.05 by the noise alone


def test_the_leverage_scale_is_learned_from_how_errors_grow_with_leverage():
    rng = np.random.default_rng(0)
    far = np.exp(rng.normal(size=(20_000, 3)) + 3.0).astype(np.float32)
    truth = np.array([0.0, 0.1, 1.0])
    errors = rng.normal(size=far.shape) * np.sqrt(
        (1 + truth * far / np.median(far, axis=0)) / (1 + truth)
    )
    steady, slope, most = learn_leverage_scale(errors.astype(np.float32), far)
    np.testing.assert_allclose(1 / steady - 1, truth, rtol=0.5, atol=0.02)
    np.testing.assert_allclose(steady + slope * np.median(far, axis=0), 1.0, rtol=1e-4)
    # a fault that takes the body further is excused no more
    np.testing.assert_array_equal(most, far.max(axis=0))


def test_errors_of_learned_rows_are_those_of_a_memory_that_had_not_seen_them():
    rng = np.random.default_rng(0)
    cause = rng.normal(size=(1500, 96))
    caused = cause @ rng.normal(size=(96, 4)) + rng.normal(size=(1500, 4))
    a = np.hstack([caused, cause, np.ones((1500, 1))]).astype(np.float32)
    layout = ChangeLayout(a.shape[1], slice(0, 4), np.arange(4), units=1)
    w, errors = learn_association(a, layout, np.random.default_rng(1))
    rows = ScaledRows(
        senses=a,
        seen=np.ones_like(a),
        commands=a,
        inputs=a,
        changes=np.ascontiguousarray(a[:, :4]),
        whole=np.ones((1500, 1), np.float32),
        precision=np.ones((1500, 4), np.float32),
        finite=np.ones(a.shape, bool),
    )
    wiring = Wiring(spans(w.U), layout.groups, layout.changes_last)
    shown, _ = called(normalised_errors)(rows, w, wiring)
    assert np.mean(errors**2) > 1.05 * np.mean(shown**2)
    assert 0.8 < np.mean(errors**2) < 1.2


@pytest.mark.parametrize("batch", [1, 40])
def test_leverage_is_the_distance_of_each_group_s_inputs_by_an_inverse_of_their_own(batch):
    a = mixed_rows()
    found = leverage(a[:batch], *inverse_of(a, LAYOUT), GROUPS, LAYOUT.changes_last)
    for g in range(3):
        others = np.setdiff1d(np.arange(13), np.arange(5, 10)[g == GROUPS])
        b = a[:, others].astype(np.float64)
        C = b.T @ b / len(b) + LEAST_VARIANCE * np.eye(len(others))
        by_hand = np.sum(b[:batch] @ np.linalg.inv(C) * b[:batch], axis=1)
        np.testing.assert_allclose(
            found[:, g == GROUPS], np.repeat(by_hand[:, None], sum(g == GROUPS), 1), rtol=2e-3
        )


def test_crossfit_predicts_every_row_without_it():
    rng = np.random.default_rng(1)
    truth = rng.normal(size=(60, 2)).astype(np.float32)
    third = thirds(60, [6] * 10, rng)

    def mean(learned_from, asked):
        assert (learned_from != asked).all()
        return np.repeat(truth[learned_from].mean(axis=0, keepdims=True), asked.sum(), axis=0)

    by_hand = np.array([truth[third != third[n]].mean(axis=0) for n in range(60)])
    np.testing.assert_allclose(crossfit(mean, third, 2), by_hand, atol=1e-6)


@pytest.mark.parametrize("penalty", [1e-6, 0.1, 10.0])
def test_one_inverse_gives_the_ridge_regression_of_every_group_on_all_else(penalty):
    a = mixed_rows().astype(np.float64)
    D = conditional(moments(a), penalty, LAYOUT)
    for g in range(3):
        own = np.arange(5, 10)[g == GROUPS]
        others = np.setdiff1d(np.arange(12), own)
        X, Y = a[:, others] - a[:, others].mean(axis=0), a[:, own] - a[:, own].mean(axis=0)
        W = np.linalg.solve(X.T @ X / len(X) + penalty * np.eye(len(others)), X.T @ Y / len(X))
        np.testing.assert_allclose(D[g == GROUPS][:, others], W.T, atol=1e-6)
        assert not D[g == GROUPS][:, own].any()
        np.testing.assert_allclose(a @ D[g == GROUPS].T - a[:, own], X @ W - Y, atol=1e-5)


def mixed_rows(N: int = 500) -> np.ndarray:
    """(N, 13) inputs that depend on each other, with means, the last a constant 1."""
    rng = np.random.default_rng(0)
    mixed = rng.normal(size=(N, 12)) @ rng.normal(size=(12, 12)) + rng.normal(size=12)
    return np.hstack([mixed, np.ones((N, 1))]).astype(np.float32)


SIZES = {"hidden_size": 8, "association_size": 24, "epochs": 2}


@pytest.fixture(scope="module")
def body():
    """A memory of sines, calibrated."""
    memory = NeuralASM(sine_spec(), **SIZES).fit(sine_episodes(40))
    memory.about = {"name": "sines"}
    return memory.calibrate(sine_episodes(40, seed=1), 0.1)


def worn(episodes: list[Episode], gain: float = 0.6) -> list[Episode]:
    """The same with a sense of smaller gain."""
    gains = np.where(np.arange(sine_spec().size) == 3, gain, 1.0).astype(np.float32)
    return [replace(e, stream=e.stream * gains) for e in episodes]


def test_a_specialised_memory_is_calm_where_the_body_alarms_and_finds_what_freezes(body):
    asm = body.with_threshold(body.threshold)  # a copy
    asm.fit(worn(sine_episodes(20, seed=5)), warm_start=True)
    for name, learned in body.detection.learned_.items():
        np.testing.assert_array_equal(asm.detection.learned_[name], learned)
    with pytest.raises(RuntimeError, match="no threshold"):
        _ = asm.threshold
    asm.calibrate(worn(sine_episodes(20, seed=6)), 0.1)
    fresh = worn(sine_episodes(30, seed=7))
    assert np.mean([(s.value > asm.threshold).any() for s in asm.score_episodes(fresh)]) < 0.35
    assert np.mean([(s.value > body.threshold).any() for s in body.score_episodes(fresh)]) > 0.8
    stuck = asm.score_episodes([frozen(e, 5, 20) for e in fresh])
    assert np.mean([(s.value[20:] > asm.threshold).any() for s in stuck]) > 0.9
    assert asm.about == {"name": "sines", "specialised_on": 20}
    assert body.about == {"name": "sines"}


def test_a_warm_start_needs_a_memory_that_has_learned(body):
    with pytest.raises(RuntimeError, match="learned nothing"):
        NeuralASM(sine_spec(), **SIZES).fit(sine_episodes(4), warm_start=True)
    kalman = make_monitor("kalman", sine_spec()).fit(sine_episodes(4))
    with pytest.raises(TypeError, match="warm_start"):
        kalman.fit(sine_episodes(4), warm_start=True)
    with pytest.raises(ValueError, match="at least one episode"):
        body.fit([], warm_start=True)
