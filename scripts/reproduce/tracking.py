"""Tracking: the network that settles against the Kalman filter, as the paper that it comes from has it.

    z_t = A z_{t-1} + B u_t + q_t,   y_t = C z_t + r_t          position, velocity and acceleration; q, r ~ N(0, I)
    predictive coding    F = ½ ‖z - A ẑ - B u‖² + ½ ‖y - C z‖², descended by so many steps of so many lengths
    settled              ẑ_t = A ẑ + B u + Cᵀ (C Cᵀ + I)⁻¹ (y - C (A ẑ + B u)), where that ends
    Kalman filter        the same with Cᵀ from P, which it carries on and predictive coding does not

System, noise, lengths of steps and numbers of steps are those of the authors' script for Fig 3, C too. Their inference
begins at the last state; that of this package at the expected one, and it is asked as it is: its tanh is linear for
states as small as these are made. Then a network learns the system by its local rules, from recordings of observations
alone, and is asked for the next one: Fig 4 has that for a network as large as the system, which is told B.

Source: Millidge et al. 2024 (PLOS Comput Biol 20(4), e1011183), Figs 3 and 4, and the scripts that they name; Kalman
1960 (J. Basic Eng. 82(1)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from asm_gym.memory.inference import STRIDE
from asm_gym.memory.learning import Schedule, Trajectory
from asm_gym.memory.settling import SettlingNetwork, SettlingWeights
from asm_gym.memory.settling_learning import learn_settling
from asm_gym.memory.temporal import unassociated
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.scripts.reproduce.tracking_report import drawn, tables
from asm_gym.validation import check_number

Floats = NDArray[np.float64]

DT = 1e-3
A = np.array([[1.0, DT, 0.5 * DT**2], [0.0, 1.0, DT], [0.0, 0.0, 1.0]])
B = np.array([0.0, 0.0, 1.0])
C = np.array([[-0.6014, -1.0122, -0.3023], [-1.2277, 0.9198, -0.3485], [-0.8692, -0.9582, -1.1920]])
"""Drawn by the authors' script, ``torch.randn`` from seed 10."""

SCALE = 3e4
"""States and observations are divided by it, so that tanh is linear."""

SETTLED = 1000
"""Steps of inference after which nothing moves any more."""

LEARNED_STEPS = 400
"""Observations in a recording that is learned from."""

FAINT = 5.0
"""Spreads of an observation that are read as 1, so that what is learned stays where tanh is nearly linear."""


def _converges(length: float) -> None:
    if not 0 < length < 0.4:
        raise ValueError(f"lengths must be in (0, 0.4), beyond which inference diverges, got {length}")


@dataclass(frozen=True)
class Config(kit.Config):
    """How near predictive coding comes to the Kalman filter."""

    seeds: int = option(10, quick=2, least=1)
    """How often it repeats itself; the paper has 10."""
    steps: int = option(2000, least=600)  # up to which the figure shows them
    """Time steps of the system."""
    iterations: tuple[int, ...] = option(
        (1, 2, 4, 6, 10, 14, 20), quick=(1, 2, 6, 20), least=1, check=partial(check_number, "iterations", low=1)
    )
    """Steps of inference; the paper has 2 to 20."""
    lengths: tuple[float, ...] = option(
        (0.12, 0.16, 0.2, 0.24, 0.28, 0.32), quick=(0.12, 0.32), least=1, check=_converges
    )
    """Lengths of a step of inference; the paper has 0.12 to 0.32."""
    hidden: int = option(16, least=1)
    """Hidden units of the network that learns."""
    updates: int = option(12000, quick=500, least=1)
    """Steps in which its synapses change."""


class Recording(NamedTuple):
    """A run of the system."""

    states: Floats  # (T, 3)
    controls: Floats  # (T,)
    observed: Floats  # (T, 3)


def recording(steps: int, rng: np.random.Generator) -> Recording:
    """So many steps from rest."""
    controls, state = np.exp(-0.01 * np.arange(steps)), np.zeros(3)
    states = np.zeros((steps, 3))
    for t, noise in enumerate(rng.standard_normal((steps, 3))):
        state = A @ state + B * controls[t] + noise
        states[t] = state
    return Recording(states, controls, states @ C.T + rng.standard_normal((steps, 3)))


def kalman(run: Recording) -> tuple[Floats, Floats]:
    """The estimates (T, 3), and what was expected of the observations before they were read (T, 3)."""
    state, P, found, expected = np.zeros(3), np.eye(3), np.zeros_like(run.states), np.zeros_like(run.observed)
    for t, (u, y) in enumerate(zip(run.controls, run.observed, strict=True)):
        prior, P = A @ state + B * u, A @ P @ A.T + np.eye(3)
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + np.eye(3))
        expected[t] = C @ prior
        state, P = prior + K @ (y - expected[t]), P - K @ C @ P
        found[t] = state
    return found, expected


def usual_variance() -> float:
    """Of a number of the state before it is read, as the Kalman filter ends up: what Π_z could be one over."""
    return float(np.trace(solve_discrete_are(A.T, C.T, np.eye(3), np.eye(3)))) / 3


def settled(run: Recording, variance: float = 1.0) -> Floats:
    """(T, 3) where inference ends, in closed form, for Π_z = 1/variance."""
    K, state = C.T @ np.linalg.inv(C @ C.T + np.eye(3) / variance), np.zeros(3)
    found = np.zeros_like(run.states)
    for t, (u, y) in enumerate(zip(run.controls, run.observed, strict=True)):
        prior = A @ state + B * u
        state = prior + K @ (y - C @ prior)
        found[t] = state
    return found


def as_published(run: Recording, iterations: int, length: float) -> Floats:
    """(T, 3) by the authors' steps, which begin at the last state."""
    state, found = np.zeros(3), np.zeros_like(run.states)
    for t, (u, y) in enumerate(zip(run.controls, run.observed, strict=True)):
        prior = A @ state + B * u
        for _ in range(iterations):
            state = state - length * (state - prior - C.T @ (y - C @ state))
        found[t] = state
    return found


def informed(iterations: int, length: float | None = None) -> SettlingNetwork:
    """This package's network, told the system. The length of a step is its own where None."""
    single = partial(np.asarray, dtype=np.float32)
    weights = SettlingWeights(
        single(A), single(np.stack([B, 0 * B], axis=1)), single(C), *map(single, ([0.0] * 3, [[0.0] * 3]))
    )
    network = SettlingNetwork(weights, unassociated(), iterations, 1.0, 1.0)
    if length is not None:
        network.curvature = np.float32(STRIDE / length)  # a step is as long as its inverse
    return network


def tracked(network: SettlingNetwork, run: Recording) -> Floats:
    """(T, 3) the states inferred by a network that was told the system."""
    z, seen, found = network.at_rest(1), np.ones((1, 3), np.float32), np.zeros_like(run.states)
    observed, controls = ((x / SCALE).astype(np.float32) for x in (run.observed, run.controls))
    for t, y in enumerate(observed):
        z = network.carry_on(z, np.array([[controls[t], 0.0]], np.float32), y[None], seen)[1]
        found[t] = z[0]
    return found * SCALE


def learned(runs: Sequence[Recording], config: Config, rng: np.random.Generator) -> tuple[SettlingNetwork, Floats]:
    """A network that knows what these recordings observed, and what (3,) they are divided by to be read."""
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
    """(T, 3) what it expects to be observed, before it is."""
    read, c, found = _read(run, spread), network.at_rest(1), []
    for x, u in zip(read.senses, read.commands, strict=True):
        step = network.follow(c, u[None], x[None], np.ones((1, 3), np.float32))
        c = step.traces
        found.append(step.expected[0, :3])
    return np.array(found, np.float64) * spread


def squared(a: Floats, b: Floats) -> float:
    """Mean squared difference."""
    return float(np.mean((a - b) ** 2))


def one_seed(seed: int, config: Config) -> list[Record]:
    """Every estimate of one recording."""
    rng = np.random.default_rng(seed)
    run = recording(config.steps, rng)
    best, expected = kalman(run)
    floor = squared(best, run.states)
    records: list[Record] = [
        {"seed": seed, "by": "kalman", "mse": floor, "observed": squared(expected, run.observed)},
        {"seed": seed, "by": "settled", "more": squared(settled(run), run.states) - floor},
        {"seed": seed, "by": "aware", "more": squared(settled(run, usual_variance()), run.states) - floor},
        {"seed": seed, "by": "observation", "mse": squared(run.observed @ np.linalg.inv(C).T, run.states)},
        {"seed": seed, "by": "last", "observed": squared(run.observed[:-1], run.observed[1:])},
    ]
    for count in (*config.iterations, SETTLED):
        where = {"seed": seed, "iterations": count}
        found = tracked(informed(count), run)
        away = squared(found, settled(run))
        records.append({**where, "by": "own", "more": squared(found, run.states) - floor, "from_settled": away})
        for length in config.lengths if count != SETTLED else ():
            for by, estimate in (
                ("ours", tracked(informed(count, length), run)),
                ("theirs", as_published(run, count, length)),
            ):
                records.append({**where, "by": by, "length": length, "more": squared(estimate, run.states) - floor})
    shown_to = [recording(LEARNED_STEPS, rng) for _ in range(64)]
    network, spread = learned(shown_to, config, rng)
    for fresh in [recording(LEARNED_STEPS, rng) for _ in range(8)]:
        asked = {"learned": observations(network, spread, fresh), "kalman_fresh": kalman(fresh)[1]}
        asked["last_fresh"] = np.vstack([np.zeros(3), fresh.observed[:-1]])
        later = slice(LEARNED_STEPS // 2, None)  # until then it may find out where it is
        for by, found in asked.items():
            records.append({"seed": seed, "by": by, "observed": squared(found[later], fresh.observed[later])})
    return records


def example(config: Config) -> dict[str, Floats]:
    """(T,) acceleration in the first recording, and estimates of it."""
    run, few, many = (
        recording(config.steps, np.random.default_rng(config.seed)),
        min(config.iterations),
        max(config.iterations),
    )
    found = {"true": run.states, "Kalman filter": kalman(run)[0]}
    found[f"steps of inference: {few}"] = tracked(informed(few, config.lengths[0]), run)
    found[f"steps of inference: {many}"] = tracked(informed(many, config.lengths[-1]), run)
    return {name: states[:, 2] for name, states in found.items()}


def run(config: Config) -> Findings:
    """Every seed."""
    records = kit.together(kit.each("tracking", partial(one_seed, config=config), config.repetitions, config))
    asked = config.iterations, config.lengths
    return Findings(records, tables(records, *asked), drawn(records, *asked, example(config)), {"C": C.tolist()})
