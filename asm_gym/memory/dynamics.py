"""The ways to carry on what was, by name: what each is made of, how it learns, and what it learns best with.

traces      what was sensed and done is carried on, decaying at fixed rates; a state follows from it     ``network``
settling    the state itself is carried on, by learned synapses, and is inferred on every row           ``settling``
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any, NamedTuple

from asm_gym.memory.inference import Weights, weight_shapes
from asm_gym.memory.network import Network, learn_traces
from asm_gym.memory.settling import SettlingNetwork, SettlingWeights, settling_shapes
from asm_gym.memory.settling_learning import learn_settling
from asm_gym.memory.temporal import Learn, TemporalNetwork

TRACES, SETTLING = "traces", "settling"


class Dynamics(NamedTuple):
    """One way to carry on what was."""

    shapes: Callable[[int, int, int], dict[str, tuple[int, ...]]]  # of the synapses, by name, for H, S and A
    weights: Callable[..., Any]  # all synapses together
    network: Callable[..., TemporalNetwork]  # what runs by them
    learn: Learn
    iterations: int  # unless asked otherwise
    prior_precision: float


DYNAMICS = {
    TRACES: Dynamics(weight_shapes, Weights, Network, learn_traces, iterations=5, prior_precision=30.0),
    SETTLING: Dynamics(
        settling_shapes, SettlingWeights, SettlingNetwork, learn_settling, iterations=20, prior_precision=1.0
    ),
}


def dynamics_of(names: Collection[str]) -> str:
    """Which dynamics the arrays of these names are of: one alone has synapses from state to state."""
    return SETTLING if "W_H" in names else TRACES
