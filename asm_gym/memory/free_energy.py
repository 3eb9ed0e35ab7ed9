"""One energy over everything that the memory expects.

    F(x, u, z) = [½ Π_z ‖z - μ‖² + ½ Π_x ‖ε‖²]/τ² + N log τ           time: the state, and its prediction of the row
               + Σ_i ½ (e_i/σ_i)² + log σ_i                           association: each group of senses from the rest

    surprise      F rises where x is not what was expected
    inference     z ← argmin F at given x and u; the second sum does not depend on z
    completion    x_M ← argmin F over missing senses M, and z with it
    reaction      (x, u) ← argmin F over the command and the row that it will lead to
    learning      ΔW ∝ -∂F/∂W of every synapse, in its own term

ε and μ are those of ``traces`` or ``settling``, e and σ of ``association`` at usual leverage. τ is the spread left in
healthy rows, so that both sums are in nats.

Sources: Friston 2005 (Phil. Trans. R. Soc. B) for the sum and its precisions; Millidge et al. 2024 for the part through
time; Adams, Shipp and Friston 2013 (Brain Struct. Funct.) for actions that descend the energy of their outcome.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association import Association
from asm_gym.memory.settling import SettlingWeights
from asm_gym.memory.temporal import Step, TemporalNetwork
from asm_gym.memory.traces import Weights
from asm_gym.scaling import FARTHEST, StreamScaler

Floats = NDArray[np.float64]

STEPS = 200  # largest number of L-BFGS steps for a row
SMALLEST_SPREAD = 1e-3  # τ


class Terms(NamedTuple):
    """The parts of F [nats]."""

    time: float
    association: float

    @property
    def total(self) -> float:
        """F."""
        return self.time + self.association


class Before(NamedTuple):
    """State and rows before a row."""

    c: NDArray[np.float32]  # (1, I) the carried state of the temporal network
    before: Floats  # (1, D) the row l rows before
    earlier: Floats  # (1, D) the row 2 l rows before
    last: Floats  # (1, D) the last row


class _Given(NamedTuple):
    """Consequences of ``Before``, whatever the row is."""

    moment: Before
    carried: tuple[Floats, ...]  # by traces μ and W_D's part of c; by settling W_H f(c)


Through = tuple[float, Floats, Floats, Floats]  # the sum through time, and its gradients by x, u (A,) and z


@dataclass(frozen=True, eq=False)
class FreeEnergy:
    """F of a memory."""

    network: TemporalNetwork  # its synapses
    senses: StreamScaler  # how it reads a row
    tau: float = 1.0  # τ of the temporal network

    @classmethod
    def of(cls, network: TemporalNetwork, senses: StreamScaler, streams: Sequence[NDArray[Any]]) -> Self:
        """Return F with τ from healthy ``streams`` (T, D). Raises ValueError where they are too short."""
        raw, numbers = cls(network, senses), senses.size + len(senses.spec.motor)
        read = [(moment, row) for stream in streams for moment, row in raw.moments(stream)]
        time = sum(raw.terms(moment, row, raw.inferred(moment, row)).time for moment, row in read)
        if not read:
            raise ValueError("no healthy row is long enough to learn the spreads of")
        return replace(raw, tau=max(SMALLEST_SPREAD, float(np.sqrt(2.0 * time / (len(read) * numbers)))))

    def moments(self, stream: NDArray[np.floating[Any]]) -> list[tuple[Before, Floats]]:
        """Return each row (D,) of an episode (T, D) from the ``2 lag``-th on, with its ``Before``."""
        rows, lag = np.asarray(stream, np.float64), self.senses.lag
        c, found = self.network.at_rest(1), []
        for t in range(len(rows)):
            moment = Before(c, *(rows[None, max(0, t - k)] for k in (lag, 2 * lag, 1)))
            if t >= 2 * lag:
                found.append((moment, rows[t]))
            if t % lag == 0:
                c = self._followed(moment, rows[t]).traces
        return found

    def inferred(self, moment: Before, row: Floats) -> Floats:
        """Return the state z (H,) that the temporal network infers from a row (D,)."""
        return np.asarray(self._followed(moment, row).z[0], np.float64)

    def _followed(self, moment: Before, row: Floats) -> Step:
        read = self.senses.read(row[None], moment.before, moment.earlier)
        return self.network.follow(moment.c, read.commands, read.senses, read.seen)

    def terms(self, moment: Before, row: Floats, z: Floats) -> Terms:
        """Return the parts of F for a row (D,) and a state (H,)."""
        return self._of(self._given(moment), row, z)[0]

    def settled(self, moment: Before, row: Floats, free: NDArray[np.bool_]) -> tuple[Floats, Terms]:
        """Return the row (D,) of lowest F over its ``free`` (D,) numbers, which begin near it, and F there."""
        from scipy.optimize import minimize  # takes a third of a second to import

        spread, count = self.senses.spread, int(free.sum())
        start, given = np.concatenate([np.zeros(count), self.inferred(moment, row)]), self._given(moment)

        def at(offset: Floats) -> tuple[float, Floats]:
            tried = row.copy()
            tried[free] += spread[free] * offset[:count]
            terms, by_row, by_z = self._of(given, tried, offset[count:])
            return terms.total, np.concatenate([by_row[free], by_z])

        found = minimize(at, start, jac=True, method="L-BFGS-B", options={"maxiter": STEPS, "maxcor": 20})
        settled = row.copy()
        settled[free] += spread[free] * found.x[:count]
        return settled, self._of(given, settled, found.x[count:])[0]

    def reaction(self, moment: Before) -> Floats:
        """Return the command (A,) of lowest F over itself and the row that it leads to."""
        settled, _ = self.settled(moment, moment.last[0], np.ones(self.senses.spec.size, np.bool_))
        return settled[self.senses.spec.motor]

    @cached_property
    def _weights(self) -> tuple[Any, Association]:
        """All synapses in double precision, as differences of F are small."""
        exact = [[np.asarray(W, np.float64) for W in w] for w in (self.network.weights, self.network.association)]
        return type(self.network.weights)(*exact[0]), Association(*exact[1])

    def _read(self, moment: Before, row: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Return senses (S,), command (A + 1,), inputs (I,) and changes (X,) of a row, unrounded for L-BFGS."""
        senses, spec, before = self.senses, self.senses.spec, moment.before[0]
        value, moved = (row - senses.mean) / senses.spread, (row - before) / senses.change
        x = np.concatenate([value[spec.sensory], moved[senses.slow]])
        u, changes = np.append(value[spec.motor], 1.0), moved[spec.sensory]
        past = (before - moment.earlier[0])[senses.slow] / senses.change[senses.slow]
        inputs = np.concatenate([(before - senses.mean) / senses.spread, changes, past, u])
        return x, u, np.where(np.abs(inputs) < FARTHEST, inputs, 0.0), changes

    def _given(self, moment: Before) -> _Given:
        (w, _), c = self._weights, moment.c[0].astype(np.float64)
        settling = isinstance(w, SettlingWeights)
        return _Given(moment, (w.W_H @ np.tanh(c),) if settling else (w.W_C @ c, w.W_D[:, : len(c)] @ c))

    def _of(self, given: _Given, row: Floats, z: Floats) -> tuple[Terms, Floats, Floats]:
        """Return F, and its gradients by (x, u) (D,), for each spread of a number, and by z (H,)."""
        senses, spec, (w, association) = self.senses, self.senses.spec, self._weights
        x, u, a, changes = self._read(given.moment, row)
        precisions = float(self.network.prior_precision), float(self.network.sensory_precision)
        through = _by_settling if isinstance(w, SettlingWeights) else _by_traces
        raw, of_x, of_u, of_z = through(w, given.carried, u, x, z, *precisions)
        numbers, scale = senses.size + len(spec.motor), 1.0 / self.tau**2
        time = raw / self.tau**2 + numbers * np.log(self.tau)
        between, of_a, of_changes = _between(association, a, changes)
        D, X, L, A = len(row), len(spec.sensory), len(senses.slow), len(spec.motor)
        slope = np.zeros(D)
        by_change = senses.spread / senses.change  # spreads of a change for each spread of the number
        within = (np.abs(changes) < FARTHEST) * 1.0
        slope[spec.sensory] += scale * of_x[:X]
        slope[spec.sensory] += by_change[spec.sensory] * (of_changes + within * of_a[D : D + X])
        slope[senses.slow] += scale * by_change[senses.slow] * of_x[X:]
        slope[spec.motor] += scale * of_u + of_a[D + X + L : D + X + L + A]
        return Terms(time, between), slope, scale * of_z


def _between(association: Association, a: Floats, changes: Floats) -> tuple[float, Floats, Floats]:
    """Return Σ ½(e/σ)² + log σ for inputs (I,) and changes (X,), and its gradients by both."""
    V, U, D, W_S, b_S, span, s = association[:7]
    f = np.tanh(V @ a)
    raw = W_S @ f + b_S
    log_variance = np.clip(raw, span[0], span[1])
    e = (changes - D @ a - U @ f) / s
    squares = e**2 * np.exp(-log_variance)
    of_changes = e * np.exp(-log_variance) / s
    of_variance = np.where((raw > span[0]) & (raw < span[1]), 0.5 * (1.0 - squares), 0.0)
    of_f = W_S.T @ of_variance - U.T @ of_changes
    of_a = V.T @ ((1.0 - f**2) * of_f) - D.T @ of_changes
    return float(np.sum(0.5 * squares + 0.5 * log_variance)), of_a, of_changes


def _by_traces(
    w: Weights, carried: tuple[Floats, ...], u: Floats, x: Floats, z: Floats, pi_z: float, pi_x: float
) -> Through:
    """Return ½ Π_z ‖z - μ‖² + ½ Π_x ‖[x, u] - W_F f(z) - W_D [c, u, 1]‖², with its gradients."""
    mu, past = carried
    W_F, of_action = w.W_F, w.W_D[:, -len(u) :]
    f, off, S = np.tanh(z), z - mu, len(x)
    error = np.concatenate([x, u[:-1]]) - W_F @ f - past - of_action @ u
    of_u = pi_x * (error[S:] - of_action[:, :-1].T @ error)
    of_z = pi_z * off - pi_x * (1.0 - f**2) * (W_F.T @ error)
    return float(0.5 * pi_z * off @ off + 0.5 * pi_x * error @ error), pi_x * error[:S], of_u, of_z


def _by_settling(
    w: SettlingWeights, carried: tuple[Floats, ...], u: Floats, x: Floats, z: Floats, pi_z: float, pi_x: float
) -> Through:
    """Return ½ Π_z ‖z - μ‖² + ½ Π_x ‖x - W_F f(z) - b_F‖² + ½ ‖u - W_A f(h)‖², with its gradients."""
    _, W_U, W_F, b_F, W_A = w
    known, f = carried[0], np.tanh(z)
    off, error = z - known - W_U @ u, x - b_F - W_F @ f
    action = u[:-1] - W_A @ np.tanh(known + W_U[:, -1])
    of_z = pi_z * off - pi_x * (1.0 - f**2) * (W_F.T @ error)
    of_u = action - pi_z * W_U[:, :-1].T @ off
    whole = 0.5 * pi_z * off @ off + 0.5 * pi_x * error @ error + 0.5 * action @ action
    return float(whole), pi_x * error, of_u, of_z
