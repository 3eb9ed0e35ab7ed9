"""The interface between a model's errors and a detection."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode

Array = NDArray[np.floating[Any]]
Floats = NDArray[np.float64]
Arrays = Mapping[str, NDArray[Any]]
State = Any
Place = Callable[[Floats], Floats]
"""Maps each error's share (B, X) to each number's in the stream (B, D)."""


class ModelOutput(NamedTuple):
    """A model's output for N rows: one each of N streams, or all of one episode."""

    errors: Array  # (N, X) in standard deviations, where the model knows them
    contexts: Array  # (N, C) the model's state; C may be 0


class Nominal(NamedTuple):
    """Nominal episodes to fit a detection on, and the fitted model's outputs."""

    episodes: Sequence[Episode]  # all, in the order given
    learned: Sequence[Episode]  # those that the model has learned
    held_out: Sequence[Episode]  # the others, if any
    outputs: Callable[[Sequence[Episode]], list[ModelOutput]]


class Detection(Protocol):
    """Turns a model's errors into surprise, attributed to the numbers of the stream.

    Arguments of ``__init__`` beside the spec are hyperparameters, kept as attributes of the same names.

    Attributes:
        name: in ``make_monitor`` and in checkpoints.
        arrays: names of what ``fit`` learns, which no other detection and no model may use.
        learned_: learned arrays; empty before ``fit``.
    """

    name: str
    arrays: tuple[str, ...]
    learned_: Arrays

    @property
    def reach(self) -> float:
        """Largest surprise by errors in a context of 0; a threshold above it would hardly ever alarm."""

    def fit(self, nominal: Nominal, rng: np.random.Generator) -> Self:
        """Learn which errors are usual."""

    def restore(self, learned: Arrays) -> Self:
        """Take over what another has learned."""

    def start(self, batch: int, errors: int) -> State:
        """Return the state before the first row of ``batch`` streams: arrays with a first axis B, or tuples of them."""

    def attribute_step(
        self, state: State, output: ModelOutput, rows: Floats, place: Place
    ) -> tuple[State, Floats]:
        """Return the new state, and each number's share (B, D), perhaps not finite, of the surprise at rows (B, D)."""

    def reset(self, state: State) -> State:
        """Return the state without accumulated evidence."""
