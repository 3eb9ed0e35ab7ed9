"""Tracking: the settling network against the Kalman filter.

    z_t = A z_{t-1} + B u_t + q_t,   y_t = C z_t + r_t          position, velocity and acceleration; q, r ~ N(0, I)
    predictive coding    descends F = ½ ‖z - A ẑ - B u‖² + ½ ‖y - C z‖²
    converged            ẑ_t = A ẑ + B u + Cᵀ (C Cᵀ + I)⁻¹ (y - C (A ẑ + B u))
    Kalman filter        the same with a covariance P, which it carries on and predictive coding does not

Claim: with more inference predictive coding comes ever closer to the filter, up to the closed form. System and noise
are those of the authors' script for Fig 3, C too. Then a network learns the system by its local rules from recorded
observations, and predicts the next observation (as Fig 4, for a larger network that is not told B).

Sources: Millidge et al. 2024 (PLOS Comput Biol 20(4), e1011183); Kalman 1960 (J. Basic Eng. 82(1)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from asm_gym.evaluation.figures import figure
from asm_gym.evaluation.tables import Table
from asm_gym.memory.learning import Schedule, Trajectory
from asm_gym.memory.settling import SettlingNetwork, SettlingWeights
from asm_gym.memory.settling_learning import learn_settling
from asm_gym.memory.temporal import unassociated
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.curves import points
from asm_gym.scripts.reproduce.kit import Findings, Record, over_seeds, shown
from asm_gym.validation import check_number

Floats = NDArray[np.float64]

DT = 1e-3
A = np.array([[1.0, DT, 0.5 * DT**2], [0.0, 1.0, DT], [0.0, 0.0, 1.0]])
B = np.array([0.0, 0.0, 1.0])
C = np.array([[-0.6014, -1.0122, -0.3023], [-1.2277, 0.9198, -0.3485], [-0.8692, -0.9582, -1.1920]])
"""As drawn by the authors' script, ``torch.randn`` from seed 10."""

SCALE = 3e4
"""Divides states and observations, so that tanh is linear."""

CONVERGED = 1000
"""Inference steps after which nothing moves."""

LEARNED_STEPS = 400
"""Observations in a recording that is learned from."""

FAINT = 5.0
"""Spreads of an observation that count as 1, so that tanh is nearly linear in what is learned."""

ERRORS = {
    "kalman": "Kalman filter",
    "converged": "predictive coding, converged",
    "aware": "converged, with the Π_z that the filter ends with",
    "observation": "each observation by itself",
    "kalman_fresh": "Kalman filter, short recordings",
    "learned": "learned by local rules, short recordings",
    "last_fresh": "last observation, short recordings",
}


@dataclass(frozen=True)
class Config(kit.Config):
    """How near predictive coding comes to the Kalman filter."""

    seeds: int = option(10, quick=2, least=1)
    """Repetitions."""
    steps: int = option(2000, least=600)
    """Time steps of the system."""
    iterations: tuple[int, ...] = option(
        (1, 2, 4, 6, 10, 14, 20), quick=(1, 2, 6, 20), least=1, check=partial(check_number, "iterations", low=1)
    )
    """Steps of inference."""
    hidden: int = option(16, least=1)
    """Hidden units of the network that learns."""
    updates: int = option(12000, quick=500, least=1)
    """Batches of 64 rows."""


class Recording(NamedTuple):
    """A run of the system."""

    states: Floats  # (T, 3)
    controls: Floats  # (T,)
    observed: Floats  # (T, 3)


def recording(steps: int, rng: np.random.Generator) -> Recording:
    """Run the system from rest."""
    controls, state = np.exp(-0.01 * np.arange(steps)), np.zeros(3)
    states = np.zeros((steps, 3))
    for t, noise in enumerate(rng.standard_normal((steps, 3))):
        state = A @ state + B * controls[t] + noise
        states[t] = state
    return Recording(states, controls, states @ C.T + rng.standard_normal((steps, 3)))


def kalman(run: Recording) -> tuple[Floats, Floats]:
    """Return the filter's estimates (T, 3), and its predictions of the observations (T, 3)."""
    state, P, found, expected = np.zeros(3), np.eye(3), np.zeros_like(run.states), np.zeros_like(run.observed)
    for t, (u, y) in enumerate(zip(run.controls, run.observed, strict=True)):
        prior, P = A @ state + B * u, A @ P @ A.T + np.eye(3)
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + np.eye(3))
        expected[t] = C @ prior
        state, P = prior + K @ (y - expected[t]), P - K @ C @ P
        found[t] = state
    return found, expected


def usual_variance() -> float:
    """Return the mean variance of the state before it is observed, as the Kalman filter ends up: 1/Π_z."""
    return float(np.trace(solve_discrete_are(A.T, C.T, np.eye(3), np.eye(3)))) / 3


def converged(run: Recording, variance: float = 1.0) -> Floats:
    """Return the states (T, 3) where inference ends, in closed form, for Π_z = 1/variance."""
    K, state = C.T @ np.linalg.inv(C @ C.T + np.eye(3) / variance), np.zeros(3)
    found = np.zeros_like(run.states)
    for t, (u, y) in enumerate(zip(run.controls, run.observed, strict=True)):
        prior = A @ state + B * u
        state = prior + K @ (y - C @ prior)
        found[t] = state
    return found


def informed(iterations: int) -> SettlingNetwork:
    """Return a settling network with the system's own matrices."""
    single = partial(np.asarray, dtype=np.float32)
    weights = SettlingWeights(
        single(A), single(np.stack([B, 0 * B], axis=1)), single(C), *map(single, ([0.0] * 3, [[0.0] * 3]))
    )
    return SettlingNetwork(weights, unassociated(), iterations, 1.0, 1.0)


def tracked(network: SettlingNetwork, run: Recording) -> Floats:
    """Return the states (T, 3) that such a network infers."""
    z, seen, found = network.at_rest(1), np.ones((1, 3), np.float32), np.zeros_like(run.states)
    observed, controls = ((x / SCALE).astype(np.float32) for x in (run.observed, run.controls))
    for t, y in enumerate(observed):
        z = network.carry_on(z, np.array([[controls[t], 0.0]], np.float32), y[None], seen)[1]
        found[t] = z[0]
    return found * SCALE


def learned(runs: Sequence[Recording], config: Config, rng: np.random.Generator) -> tuple[SettlingNetwork, Floats]:
    """Return a network that has learned these recordings, and the divisor (3,) of its observations."""
    spread = FAINT * np.concatenate([r.observed for r in runs]).std(axis=0)
    episodes = [_read(run, spread) for run in runs]
    rows = sum(len(e.senses) for e in episodes)
    schedule = Schedule(max(1, round(config.updates * 64 / rows)), 64, 1e-2, 20, 1.0, 1.0, 0.0)
    network = learn_settling(episodes, config.hidden, schedule, rng, lambda: None).network
    assert isinstance(network, SettlingNetwork)
    return network, spread


def _read(run: Recording, spread: Floats) -> Trajectory:
    commands = np.stack([run.controls, np.ones_like(run.controls)], axis=1).astype(np.float32)
    senses = (run.observed / spread).astype(np.float32)
    return Trajectory(senses, commands, senses)


def observations(network: SettlingNetwork, spread: Floats, run: Recording) -> Floats:
    """Return its predictions (T, 3) of the observations."""
    read, c, found = _read(run, spread), network.at_rest(1), []
    for x, u in zip(read.senses, read.commands, strict=True):
        step = network.follow(c, u[None], x[None], np.ones((1, 3), np.float32))
        c = step.traces
        found.append(step.expected[0, :3])
    return np.array(found, np.float64) * spread


def squared(a: Floats, b: Floats) -> float:
    """Return the mean squared difference."""
    return float(np.mean((a - b) ** 2))


def one_seed(seed: int, config: Config) -> list[Record]:
    """Measure every estimate of one recording."""
    rng = np.random.default_rng(seed)
    run = recording(config.steps, rng)
    best, expected = kalman(run)
    floor, end = squared(best, run.states), converged(run)
    states = {"kalman": best, "converged": end, "aware": converged(run, usual_variance())}
    states["observation"] = run.observed @ np.linalg.inv(C).T
    records: list[Record] = [{"seed": seed, "by": by, "mse": squared(x, run.states)} for by, x in states.items()]
    records.append({"seed": seed, "by": "kalman", "observed": squared(expected, run.observed)})
    for count in (*config.iterations, CONVERGED):
        found = tracked(informed(count), run)
        own = {"more": squared(found, run.states) - floor, "from_converged": squared(found, end)}
        records.append({"seed": seed, "by": "inference", "iterations": count, **own})
    network, spread = learned([recording(LEARNED_STEPS, rng) for _ in range(64)], config, rng)
    later = slice(LEARNED_STEPS // 2, None)  # the first half finds the state
    for fresh in [recording(LEARNED_STEPS, rng) for _ in range(8)]:
        asked = {"learned": observations(network, spread, fresh), "kalman_fresh": kalman(fresh)[1]}
        asked["last_fresh"] = np.vstack([np.zeros(3), fresh.observed[:-1]])
        for by, found in asked.items():
            records.append({"seed": seed, "by": by, "observed": squared(found[later], fresh.observed[later])})
    return records


def tables(records: Sequence[Record], config: Config) -> list[Table]:
    """Return errors by inference steps, and of every way."""
    counts = {"converged" if n == CONVERGED else str(n): {"iterations": n} for n in (*config.iterations, CONVERGED)}
    lines: dict[str, Record] = {"beyond the Kalman filter": {"by": "inference"}}
    return [
        kit.grid("Mean squared error of the state by inference steps", records, "more", lines, counts, 3),
        Table(
            "Mean squared error",
            ("", "of the state", "of the next observation"),
            [(n, shown(records, "mse", 3, by=by), shown(records, "observed", 3, by=by)) for by, n in ERRORS.items()],
        ),
    ]


def drawn(records: Sequence[Record], config: Config) -> Figure:
    """Draw the error beyond the filter's by inference steps."""
    with figure(height=3.0, width=5) as fig:
        ax = fig.subplots()
        found = [over_seeds(records, "more", by="inference", iterations=n) for n in config.iterations]
        points(ax, config.iterations, found, 0, "predictive coding")
        end = over_seeds(records, "more", by="inference", iterations=CONVERGED).mean
        ax.axhline(end, color="grey", linewidth=0.8, label="converged")
        ax.set(xlabel="steps of inference", ylabel="MSE beyond the Kalman filter's", xscale="log", yscale="log")
        ax.legend(fontsize=7)
    return fig


def run(config: Config) -> Findings:
    """Run every seed."""
    records = kit.together(kit.each("tracking", partial(one_seed, config=config), config.repetitions, config))
    return Findings(records, tables(records, config), drawn(records, config), {"C": C.tolist()})
