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

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association import ALL_TICKS, Feedback, learn_association
from asm_gym.memory.energy import Array
from asm_gym.memory.inference import Weights, carry, direct, expect, infer, sense, weight_shapes
from asm_gym.memory.learning import Schedule, Trajectory, passes
from asm_gym.memory.scheduled_sampling import learn
from asm_gym.memory.temporal import Learn, Step, TemporalNetwork, Trained, unassociated
from asm_gym.memory.traces import DECAYS, advance, at_rest, fit_gains


def initial_weights(hidden: int, sensory: int, motor: int, rng: np.random.Generator) -> Weights:
    """Random weights of about unit gain into the state, faint ones out of it; none past it, and traces as they are."""
    weights = {n: np.zeros(shape, np.float32) for n, shape in weight_shapes(hidden, sensory, motor).items()}
    for name, gain in (("W_C", 1.0), ("W_F", 0.1)):
        W = weights[name]
        W[:] = gain * rng.standard_normal(W.shape) / np.sqrt(W.shape[1])
    weights["gains"][:] = np.float32(1) - DECAYS
    return Weights(**weights)


class Network(TemporalNetwork):
    """The temporal network by traces, and association beside it.

    The arguments are those of ``TemporalNetwork``.
    """

    weights: Weights

    @property
    def hidden_size(self) -> int:
        return self.weights.W_C.shape[0]

    def at_rest(self, batch: int) -> NDArray[np.float32]:
        return at_rest(batch, self.weights.W_F.shape[0] + 1)

    def predict(self, c: Array, u: Array) -> Array:
        w = self.weights
        found: Array = direct(c, u, w.W_D) + sense(expect(c, w.W_C), w.W_F)
        return found

    def follow(self, c: Array, u: Array, x: Array, seen: Array) -> Step:
        w = self.weights
        mu, past = expect(c, w.W_C), direct(c, u, w.W_D)
        precision = self.sensory_precision * np.hstack([seen, np.ones_like(u[:, :-1])])
        left = np.hstack([x, u[:, :-1]]) - past
        z = infer(mu, left, w.W_F, self.prior_precision, precision, self.curvature, self.iterations)
        whole = np.where(seen > 0, x, (past + sense(z, w.W_F))[:, : x.shape[1]])
        return Step(mu, past + sense(mu, w.W_F), z, advance(c, np.hstack([whole, u]), w.gains))

    def carry_on(self, c: Array, u: Array, x: Array, seen: Array) -> tuple[Array, Array]:
        expected, traces = carry(c, u, x, seen, *self.weights, *self.inference, True)
        return expected, traces

    def run_on(self, c: Array) -> Step:
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
        w = self.weights
        return w.W_D.shape[1] - w.W_C.shape[1] - 1


def learn_traces(
    trajectories: Sequence[Trajectory],
    hidden: int,
    schedule: Schedule,
    rng: np.random.Generator,
    tick: Callable[[], None],
) -> Trained:
    """Learns the synapses from the traces; see ``temporal.Learn``."""
    sensory, commands = trajectories[0].senses.shape[1], trajectories[0].commands.shape[1]
    weights = initial_weights(hidden, sensory, commands - 1, rng)
    weights.gains[:] = fit_gains([np.hstack([t.senses, t.commands]) for t in trajectories])
    energy = learn(weights, trajectories, schedule, rng, tick)
    how = schedule.iterations, schedule.prior_precision, schedule.sensory_precision
    return Trained(Network(weights, unassociated(), *how), energy)


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
    learn_temporal: Learn = learn_traces,
) -> Trained:
    """Learns both kinds of synapses from whole episodes.

    Args:
        groups: (X,) the group of each change.
        changes: where the changes stand among the inputs of association.
        hidden: H.
        units: hidden units of association for each group.
        feedback: how errors come back to them; by the transposed weights where None.
        learn_temporal: how the synapses through time are learned.
    """
    done = 0

    def tick() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    total = passes(trajectories, schedule) + ALL_TICKS
    network, energy = learn_temporal(trajectories, hidden, schedule, rng, tick)
    inputs, lengths = np.concatenate([t.inputs for t in trajectories]), [len(t.inputs) for t in trajectories]
    deltas, layout = np.ascontiguousarray(inputs[:, changes]), (groups, changes, units)
    apart = sum(len(t.senses) for t in trajectories)  # changes over several rows overlap
    association = learn_association(inputs, deltas, *layout, rng, tick, feedback=feedback, lengths=lengths, apart=apart)
    return Trained(network.with_association(association), energy)
