"""The temporal networks by name, and the training of a whole memory.

    recurrent   units that learn how long to remember are carried on, and the state follows from them
    settling    the state is carried on by learned synapses, and is inferred on every row

Every synapse descends its own term of

    F = ½ Π_z ‖z - μ‖² + ½ Π_x ‖[x, a] - [x̂, â](z)‖² + Σ_i σ_i ρ(e_i/σ_i),     e = Δ - D a - U f(V a)
    ρ(r) = ½ r² for |r| ≤ 1, |r| - ½ beyond;     D in closed form, for ρ(r) = ½ r²

A further network is a file like ``settling``: its weights with their shapes, a compiled step for the row kernel
(``monitors.row_kernel.follow``), a ``TemporalNetwork``, a ``Learner``, a ``Learn`` function, and an entry below.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from itertools import count
from typing import Any, NamedTuple

import numpy as np

from asm_gym.memory.association import ChangeLayout
from asm_gym.memory.association_learning import ALL_TICKS, learn_association
from asm_gym.memory.learning import Schedule, Trajectory, passes, row_count
from asm_gym.memory.recurrent import RecurrentNetwork, RecurrentWeights, recurrent_shapes
from asm_gym.memory.recurrent_learning import learn_recurrent
from asm_gym.memory.settling import (
    SettlingNetwork,
    SettlingWeights,
    learn_settling,
    settling_shapes,
)
from asm_gym.memory.temporal import Learn, TemporalNetwork, Trained

RECURRENT = "recurrent"
SETTLING = "settling"

ITERATIONS = 20  # most steps of inference, by default
PRIOR_PRECISION = 1.0  # Π_z, by default


class Dynamics(NamedTuple):
    """A kind of temporal network."""

    shapes: Callable[
        [int, int, int], dict[str, tuple[int, ...]]
    ]  # of its weights by name, for H, S and A
    weights: Callable[..., Any]  # the record of its weights, built by keywords
    network: Callable[..., TemporalNetwork]
    learn: Learn


DYNAMICS = {
    RECURRENT: Dynamics(
        shapes=recurrent_shapes,
        weights=RecurrentWeights,
        network=RecurrentNetwork,
        learn=learn_recurrent,
    ),
    SETTLING: Dynamics(
        shapes=settling_shapes,
        weights=SettlingWeights,
        network=SettlingNetwork,
        learn=learn_settling,
    ),
}


def dynamics_of(names: Collection[str]) -> str:
    """Return the dynamics whose arrays have these names."""
    if "W_H" in names:
        return SETTLING
    return RECURRENT


def train(
    trajectories: Sequence[Trajectory],
    layout: ChangeLayout,
    hidden: int,
    schedule: Schedule,
    rng: np.random.Generator,
    progress: Callable[[int, int], object] | None = None,
    dynamics: str = RECURRENT,
) -> Trained:
    """Learn the synapses through time, then those of association, from whole episodes.

    Args:
        trajectories: the episodes.
        layout: of the inputs of association.
        hidden: units H of the temporal network.
        schedule: how the temporal network learns.
        rng: draws initial weights and the order of the rows.
        progress: is called with steps done and their total.
        dynamics: name of the temporal network, one of ``DYNAMICS``.
    """
    total = passes(trajectories, schedule) + ALL_TICKS
    steps = count(1)

    def tick() -> None:
        if progress is not None:
            progress(next(steps), total)

    trained = DYNAMICS[dynamics].learn(trajectories, hidden, schedule, rng, tick)
    association, errors = learn_association(
        np.concatenate([t.inputs for t in trajectories]),
        layout,
        rng,
        tick,
        lengths=[len(t.inputs) for t in trajectories],
        independent=row_count(trajectories),  # changes over several rows overlap
    )
    network = trained.network.with_association(association)
    return Trained(network, trained.energy, errors)
