"""The linear part of association, against ridge regression of each group by itself."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.episode import Episode
from asm_gym.memory.linear import FEW_PENALTY, PENALTIES, conditional, learn_from_past, learn_linear, moments
from asm_gym.monitors import make_monitor
from asm_gym.spec import Channel, StreamSpec

GROUPS = np.array([0, 0, 1, 2, 2])
CHANGES = slice(5, 10)


def rows(N: int = 500, seed: int = 0) -> np.ndarray:
    """(N, 13) inputs that depend on each other, with means, the last a constant 1."""
    rng = np.random.default_rng(seed)
    mixed = rng.normal(size=(N, 12)) @ rng.normal(size=(12, 12)) + rng.normal(size=12)
    return np.hstack([mixed, np.ones((N, 1))]).astype(np.float32)


@pytest.mark.parametrize("penalty", [1e-6, 0.1, 10.0])
def test_one_inverse_gives_the_ridge_regression_of_every_group_on_all_else(penalty):
    a = rows().astype(np.float64)
    D = conditional(moments(a), penalty, GROUPS, CHANGES)
    for g in range(3):
        own = np.arange(5, 10)[g == GROUPS]
        others = np.setdiff1d(np.arange(12), own)
        X, Y = a[:, others] - a[:, others].mean(axis=0), a[:, own] - a[:, own].mean(axis=0)
        W = np.linalg.solve(X.T @ X / len(X) + penalty * np.eye(len(others)), X.T @ Y / len(X))
        np.testing.assert_allclose(D[g == GROUPS][:, others], W.T, atol=1e-6)
        assert not D[g == GROUPS][:, own].any()
        np.testing.assert_allclose(a @ D[g == GROUPS].T - a[:, own], X @ W - Y, atol=1e-5)


def test_from_few_rows_each_change_is_the_ridge_regression_on_all_that_is_no_change():
    a = rows(60)
    D, exact = learn_from_past(a, CHANGES), a.astype(np.float64)
    past = np.setdiff1d(np.arange(12), np.arange(12)[CHANGES])
    X, Y = (exact[:, part] - exact[:, part].mean(axis=0) for part in (past, CHANGES))
    W = np.linalg.solve(X.T @ X / len(X) + FEW_PENALTY * np.eye(len(past)), X.T @ Y / len(X))
    np.testing.assert_allclose(D[:, past], W.T, atol=1e-5)
    assert not D[:, CHANGES].any()
    np.testing.assert_allclose((exact @ D.T).mean(axis=0), exact[:, CHANGES].mean(axis=0), atol=1e-4)


def test_each_sense_gets_the_penalty_that_fresh_rows_ask_for():
    rng = np.random.default_rng(1)
    N = 60
    noise = rng.normal(size=(N, 40))
    exact = noise[:, :3] @ [0.5, -1.0, 2.0]
    a = np.column_stack([noise, exact, rng.normal(size=N), np.ones(N)]).astype(np.float32)
    D = learn_linear(a, np.array([0, 1]), slice(40, 42))
    np.testing.assert_allclose(D[0, :3], [0.5, -1.0, 2.0], atol=1e-3)
    assert np.abs(D[1, :-1]).max() < 0.02  # fifty rows and forty inputs: by least squares it would be 0.5 and more


def test_few_rows_constants_and_copies_are_no_trouble():
    for N in (1, 2, 4, 5, 30):
        a = rows(N)
        a[:, 6] = a[:, 7]  # a copy in another group
        a[:, 8] = 3.0
        D = learn_linear(a, GROUPS, CHANGES)
        assert np.isfinite(D).all()
        np.testing.assert_allclose(a[:, 8] - a @ D[3], 0.0, atol=1e-3)
    assert D[1, 7] == pytest.approx(1.0, abs=1e-2)
    assert PENALTIES.min() > 0


@pytest.mark.parametrize("name", ["neural_asm", "association_linear"])
def test_a_stream_too_wide_for_all_against_all_is_refused_with_what_to_do(name):
    spec = StreamSpec((Channel("pixels", 10_000), Channel("action", 1, group="action")), dt=0.05)
    episode = Episode.from_stream(np.random.default_rng(0).normal(size=(4, 10_001)), spec)
    with pytest.raises(ValueError, match=r"at most 8192 of them .* makes \d+: leave channels out"):
        make_monitor(name, spec).fit([episode])
