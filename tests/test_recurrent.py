"""Recurrent units: their local changes are the gradient through all of an episode."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.memory.energy import Inference, infer, outward
from asm_gym.memory.recurrent import RecurrentWeights, advance, direct, sense
from asm_gym.memory.recurrent_learning import (
    Change,
    Eligibility,
    Errors,
    Wiring,
    follow_eligibility,
    initial_recurrent_weights,
    local_change,
)

HIDDEN = 6
SENSES = 3
MOTOR = 2
FELT = 1  # the sense that reaches no unit
STREAMS = 4
PRIOR = 2.0


def double(weights: RecurrentWeights) -> RecurrentWeights:
    return RecurrentWeights._make(array.astype(np.float64) for array in weights)


def random_weights(rng: np.random.Generator) -> RecurrentWeights:
    weights = double(initial_recurrent_weights(HIDDEN, SENSES, MOTOR, rng))
    weights.reads[FELT] = 0.0
    wiring = Wiring.of(weights)
    return weights._replace(
        W_C=weights.W_C * wiring.W_C,
        W_F=rng.normal(size=weights.W_F.shape) / 3,
        W_D=wiring.W_D * rng.normal(size=weights.W_D.shape) / 4,
    )


def local_total(
    weights: RecurrentWeights, rows: np.ndarray, forget: bool = False
) -> dict[str, np.ndarray]:
    """The sum of local changes along rows (T, B, R), with the weights held still."""
    norm = np.linalg.norm(weights.W_F, 2)
    inference = Inference(PRIOR, 1.0, PRIOR + norm**2, 4000)
    m = np.zeros((STREAMS, weights.W_C.shape[1]))
    eligible = Eligibility.none(STREAMS, weights)
    wiring = Wiring.of(weights)
    total = {name: np.zeros(getattr(weights, name).shape) for name in Change._fields}
    for row in rows:
        action = np.ascontiguousarray(row[:, SENSES:])
        mu = outward(m, weights.W_C)
        left = row[:, :-1] - direct(m, action, weights.W_D)
        z = infer(mu, left, weights.W_F, np.ones_like(left), inference)
        errors = Errors(PRIOR * (z - mu), left - sense(z, weights.W_F))
        change = local_change(
            m=m, u=action, z=z, errors=errors, eligible=eligible, weights=weights, wiring=wiring
        )
        for name in total:
            total[name] += getattr(change, name)
        if forget:
            eligible = Eligibility.none(STREAMS, weights)
        follow_eligibility(eligible, m, row, weights)
        m = advance(m, row, weights)
    return total


def gradient_through_time(weights: RecurrentWeights, rows: np.ndarray) -> dict[str, np.ndarray]:
    """-∂/∂w of the mean over streams of Σ_t min_z F_t, by automatic differentiation through every row."""
    torch = pytest.importorskip("torch")
    w = {
        n: torch.tensor(a, requires_grad=n in Change._fields) for n, a in weights._asdict().items()
    }
    size = torch.exp(-torch.exp(w["decay"]))
    re = size * torch.cos(w["turn"])
    im = size * torch.sin(w["turn"])
    c_re = torch.zeros(STREAMS, len(re), dtype=torch.float64)
    c_im = torch.zeros_like(c_re)
    last = torch.zeros(STREAMS, SENSES + MOTOR + 1, dtype=torch.float64)
    energy = torch.zeros((), dtype=torch.float64)
    for row in torch.tensor(rows):
        m = torch.cat([c_re, c_im, last], dim=1)
        mu = m @ w["W_C"].T
        left = row[:, :-1] - torch.cat([m, row[:, SENSES:]], dim=1) @ w["W_D"].T
        z = mu
        for _ in range(400):  # inference, which is differentiated too
            f = torch.tanh(z)
            error = left - f @ w["W_F"].T
            z = z - 0.1 * (PRIOR * (z - mu) - (1 - f**2) * (error @ w["W_F"]))
        error = left - torch.tanh(z) @ w["W_F"].T
        energy = energy + 0.5 * (PRIOR * (z - mu) ** 2).sum() + 0.5 * (error**2).sum()
        read = row * w["reads"]
        drive_re = w["gain"] * (read @ w["B_re"].T)
        drive_im = w["gain"] * (read @ w["B_im"].T)
        c_re, c_im = re * c_re - im * c_im + drive_re, re * c_im + im * c_re + drive_im
        last = row
    (-energy / STREAMS).backward()
    wiring = Wiring.of(weights)
    w["W_C"].grad *= torch.tensor(wiring.W_C)
    w["W_D"].grad *= torch.tensor(wiring.W_D)
    return {name: w[name].grad.numpy() for name in Change._fields}


@pytest.mark.parametrize("seed", range(3))
def test_the_sum_of_local_changes_is_the_gradient_through_time(seed: int) -> None:
    rng = np.random.default_rng(seed)
    weights = random_weights(rng)
    rows = rng.normal(size=(25, STREAMS, SENSES + MOTOR + 1))
    rows[:, :, -1] = 1.0
    local = local_total(weights, rows)
    exact = gradient_through_time(weights, rows)
    for name, gradient in exact.items():
        assert np.abs(gradient).max() > 1e-3, name
        error = np.linalg.norm(local[name] - gradient) / np.linalg.norm(gradient)
        assert error < 1e-5, name


def test_without_eligibility_it_is_not_the_gradient() -> None:
    """So the test above can fail: changes that know one row only are off by more than a tenth."""
    rng = np.random.default_rng(0)
    weights = random_weights(rng)
    rows = rng.normal(size=(25, STREAMS, SENSES + MOTOR + 1))
    exact = gradient_through_time(weights, rows)["B_re"]
    forgetful = local_total(weights, rows, forget=True)["B_re"]
    assert np.linalg.norm(forgetful - exact) > 0.1 * np.linalg.norm(exact)
