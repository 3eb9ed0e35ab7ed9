"""The network as a whole: two ways to expect, one memory, one energy.

time          c_t → μ_t → z_t      what is going on: traces of what was sensed and done, and the state they lead to
association   a_t → Δ̂_t, σ_t       what each sense should do: from what came before and what the others do now

    F = ½ Π_z ‖z - μ‖² + ½ Π_x ‖[x, a] - [x̂, â](z)‖² + Σ_i σ_i ρ(e_i/σ_i),     e = Δ - D a - U f(V a)
    ρ(r) = ½ r² for |r| ≤ 1, |r| - ½ beyond;    ΔW ∝ -∂F/∂W, σ held;    D in closed form, for ρ(r) = ½ r²

z descends F, and so does every synapse. But the two sums share rows and not a state: ∂F/∂z knows nothing of
association, whose units h = V a follow the row without settling, as if their own precision were infinite. Only names
are read from both. The precision of association is learned after it, by a likelihood of its own, and so is the motor
association. ``docs/decisions/memory.md`` says why association stands apart.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association import ALL_TICKS, Association, Feedback, learn_association, normalised_errors, spans
from asm_gym.memory.energy import Array, Scalar
from asm_gym.memory.inference import Weights, carry, direct, expect, infer, sense, weight_shapes
from asm_gym.memory.learning import Schedule, Trajectory, passes
from asm_gym.memory.scheduled_sampling import learn
from asm_gym.memory.traces import DECAYS, advance, at_rest, fit_gains
from asm_gym.scaling import ScaledRows


def initial_weights(hidden: int, sensory: int, motor: int, rng: np.random.Generator) -> Weights:
    """Random weights of about unit gain into the state, faint ones out of it; none past it, and traces as they are."""
    weights = {n: np.zeros(shape, np.float32) for n, shape in weight_shapes(hidden, sensory, motor).items()}
    for name, gain in (("W_C", 1.0), ("W_F", 0.1)):
        W = weights[name]
        W[:] = gain * rng.standard_normal(W.shape) / np.sqrt(W.shape[1])
    weights["gains"][:] = np.float32(1) - DECAYS
    return Weights(**weights)


class Step(NamedTuple):
    """What the network made of a row."""

    mu: Array  # (B, H) the state expected before it was read
    expected: Array  # (B, S + A) x̂_t and â_t, expected then
    z: Array  # (B, H) the state inferred from what was read of it
    traces: Array  # (B, I) c_t, in which what was unseen is as the rest has it


class Network:
    """Weights that no longer change, and what is needed to run them.

    Args:
        weights: the synapses through time.
        association: the synapses between senses.
        iterations: inference steps per control step.
        prior_precision: Π_z.
        sensory_precision: Π_x.
    """

    def __init__(
        self,
        weights: Weights,
        association: Association,
        iterations: int,
        prior_precision: float,
        sensory_precision: float,
    ) -> None:
        self.weights, self.association, self.spans = weights, association, spans(association.U)
        self.iterations = iterations
        # Of single precision all of them, or the compiled loops would compute in double.
        self.prior_precision, self.sensory_precision = np.float32(prior_precision), np.float32(sensory_precision)
        norm = float(np.linalg.norm(weights.W_F.astype(np.float64), 2))
        self.curvature = np.float32(prior_precision + sensory_precision * norm**2)

    def with_association(self, association: Association) -> Self:
        """The same network with other synapses between senses; this one keeps its own."""
        other = copy.copy(self)
        other.association, other.spans = association, spans(association.U)
        return other

    @property
    def hidden_size(self) -> int:
        return self.weights.W_C.shape[0]

    def associate(self, reading: ScaledRows) -> tuple[Array, Array]:
        """(Δ_t - Δ̂_t)/σ_t (B, X), 0 where a row was not whole; and f(h_t) (B, M) of association."""
        error, units = normalised_errors(reading.inputs, reading.changes, reading.whole, *self.association, self.spans)
        return error, units

    def at_rest(self, batch: int) -> NDArray[np.float32]:
        """c_0 (B, I), the traces before the first row."""
        return at_rest(batch, self.weights.W_F.shape[0] + 1)

    def follow(self, c: Array, u: Array, x: Array, seen: Array) -> Step:
        """A row is expected, then read, and its state inferred.

        Args:
            c: (B, I) the traces so far.
            u: (B, A + 1) the action as commanded, standardised, and a constant 1.
            x: (B, S) what was sensed, standardised.
            seen: (B, S) 1 where ``x`` is a measurement, 0 where it is to be ignored.
        """
        w = self.weights
        mu, past = expect(c, w.W_C), direct(c, u, w.W_D)
        precision = self.sensory_precision * np.hstack([seen, np.ones_like(u[:, :-1])])
        left = np.hstack([x, u[:, :-1]]) - past
        z = infer(mu, left, w.W_F, self.prior_precision, precision, self.curvature, self.iterations)
        whole = np.where(seen > 0, x, (past + sense(z, w.W_F))[:, : x.shape[1]])
        return Step(mu, past + sense(mu, w.W_F), z, advance(c, np.hstack([whole, u]), w.gains))

    def carry_on(self, c: Array, u: Array, x: Array, seen: Array) -> tuple[Array, Array]:
        """f(μ_t) (B, H) and c_t (B, I): what of ``follow`` is needed to watch."""
        expected, traces = carry(c, u, x, seen, *self.weights, *self.inference, True)
        return expected, traces

    @property
    def inference(self) -> tuple[Scalar, Scalar, Scalar, int]:
        """Π_z, Π_x, the curvature, and iterations."""
        return self.prior_precision, self.sensory_precision, self.curvature, self.iterations

    def run_on(self, c: Array) -> Step:
        """A row that is not read: the action is the network's own, and so are the senses it leads to."""
        w = self.weights
        S, A = w.W_F.shape[0] - self.motor, self.motor
        mu = expect(c, w.W_C)
        state = sense(mu, w.W_F)
        u = np.zeros((len(c), A + 1), np.float32)
        u[:, -1] = 1.0
        u[:, :A] = (direct(c, u, w.W_D) + state)[:, S:]  # no synapse leads from an action to itself
        expected = direct(c, u, w.W_D) + state
        return Step(mu, expected, mu, advance(c, np.hstack([expected[:, :S], u]), w.gains))

    @property
    def motor(self) -> int:
        """A."""
        w = self.weights
        return w.W_D.shape[1] - w.W_C.shape[1] - 1


class Trained(NamedTuple):
    """A finished network, and how its energy fell."""

    network: Network
    energy: Array  # (epochs,) mean energy of a step in each epoch


def train(
    trajectories: Sequence[Trajectory],
    groups: NDArray[np.intp],
    changes: slice,
    hidden: int,
    units: int,
    schedule: Schedule,
    rng: np.random.Generator,
    progress: Callable[[int, int], object] | None = None,
    feedback: Feedback | None = None,
) -> Trained:
    """Learns both kinds of synapses from whole episodes.

    Args:
        groups: (X,) the group of each change.
        changes: where the changes stand among the inputs of association.
        hidden: H.
        units: hidden units of association for each group.
        feedback: how errors come back to them; by the transposed weights where None.
    """
    done = 0

    def tick() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    sensory, commands = trajectories[0].senses.shape[1], trajectories[0].commands.shape[1]
    weights = initial_weights(hidden, sensory, commands - 1, rng)
    total = passes(trajectories, schedule) + ALL_TICKS
    weights.gains[:] = fit_gains([np.hstack([t.senses, t.commands]) for t in trajectories])
    energy = learn(weights, trajectories, schedule, rng, tick)
    inputs, lengths = np.concatenate([t.inputs for t in trajectories]), [len(t.inputs) for t in trajectories]
    deltas, layout = np.ascontiguousarray(inputs[:, changes]), (groups, changes, units)
    association = learn_association(inputs, deltas, *layout, rng, tick, feedback=feedback, lengths=lengths)
    how = schedule.iterations, schedule.prior_precision, schedule.sensory_precision
    return Trained(Network(weights, association, *how), energy)
