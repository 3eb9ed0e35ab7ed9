"""The two temporal networks by name, and the training of a whole memory.

    traces      traces of senses and actions are carried on, and the state follows from them
    settling    the state is carried on by learned synapses, and is inferred on every row

Every synapse descends its own term of

    F = ½ Π_z ‖z - μ‖² + ½ Π_x ‖[x, a] - [x̂, â](z)‖² + Σ_i σ_i ρ(e_i/σ_i),     e = Δ - D a - U f(V a)
    ρ(r) = ½ r² for |r| ≤ 1, |r| - ½ beyond;     D in closed form, for ρ(r) = ½ r²
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association_learning import ALL_TICKS, learn_association
from asm_gym.memory.learning import Schedule, Trajectory, passes
from asm_gym.memory.settling import (
    SettlingNetwork,
    SettlingWeights,
    learn_settling,
    settling_shapes,
)
from asm_gym.memory.temporal import Learn, TemporalNetwork, Trained
from asm_gym.memory.traces import Network, Weights, learn_traces, weight_shapes

TRACES, SETTLING = "traces", "settling"


class Dynamics(NamedTuple):
    """A kind of temporal network."""

    # of its synapses by name, for H, S and A
    shapes: Callable[[int, int, int], dict[str, tuple[int, ...]]]
    weights: Callable[..., Any]  # all synapses together
    network: Callable[..., TemporalNetwork]
    learn: Learn
    iterations: int  # default
    prior_precision: float  # default


DYNAMICS = {
    TRACES: Dynamics(weight_shapes, Weights, Network, learn_traces, 5, 30.0),
    SETTLING: Dynamics(settling_shapes, SettlingWeights, SettlingNetwork, learn_settling, 20, 1.0),
}


def dynamics_of(names: Collection[str]) -> str:
    """Return the dynamics whose arrays have these names."""
    return SETTLING if "W_H" in names else TRACES


def train(
    trajectories: Sequence[Trajectory],
    groups: NDArray[np.intp],
    changes: slice,
    hidden: int,
    units: int,
    schedule: Schedule,
    rng: np.random.Generator,
    progress: Callable[[int, int], object] | None = None,
    dynamics: str = TRACES,
) -> Trained:
    """Learn the synapses through time, then those of association, from whole episodes.

    ``hidden`` and ``schedule`` are of the temporal network, one of ``DYNAMICS``; ``groups``, ``changes`` and ``units``
    are as in ``association.synapses``; ``progress`` is called with steps done and their total.
    """
    done, total = 0, passes(trajectories, schedule) + ALL_TICKS

    def tick() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    network, energy, _ = DYNAMICS[dynamics].learn(trajectories, hidden, schedule, rng, tick)
    inputs, lengths = (
        np.concatenate([t.inputs for t in trajectories]),
        [len(t.inputs) for t in trajectories],
    )
    deltas, layout = np.ascontiguousarray(inputs[:, changes]), (groups, changes, units)
    independent = sum(len(t.senses) for t in trajectories)  # changes over several rows overlap
    association, errors = learn_association(
        inputs, deltas, *layout, rng, tick, lengths, independent
    )
    return Trained(network.with_association(association), energy, errors)
