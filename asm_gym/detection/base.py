"""What a model says of rows, and what can be made of it: the two sides of every detection."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.episode import Episode

Array = NDArray[np.floating[Any]]
Arrays = Mapping[str, NDArray[Any]]
State = Any
Place = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""From each error's share (B, X) to each number's in the stream (B, D)."""


class ModelOutput(NamedTuple):
    """What a model said of N rows: one each of as many streams, or all of one episode."""

    errors: Array  # (N, X) in standard deviations, where the model knows them
    contexts: Array  # (N, C) what the model took to be going on; C may be 0


class Nominal(NamedTuple):
    """Nominal episodes to fit a detection on, and what the fitted model says of any of them."""

    episodes: Sequence[Episode]  # all, in the order given
    learned: Sequence[Episode]  # those that the model has learned
    held_out: Sequence[Episode]  # those that it has not; where there are none, those that it has
    outputs: Callable[[Sequence[Episode]], list[ModelOutput]]


class Detection(Protocol):
    """Turns a model's errors into surprise, shared out among the numbers of the stream.

    Arguments of ``__init__`` beside the stream's spec are hyperparameters, kept under their own names.

    Attributes:
        name: in ``make_monitor`` and in checkpoints.
        arrays: names of all that ``fit`` finds; no other detection and no model may use them.
        learned_: what it has found; empty before.
    """

    name: str
    arrays: tuple[str, ...]
    learned_: Arrays

    @property
    def reach(self) -> float:
        """What errors alone can make of surprise, in a context of 0: a threshold above it would hardly ever alarm."""
        ...

    def fit(self, nominal: Nominal, rng: np.random.Generator) -> Self:
        """Learns what is usual of errors."""
        ...

    def restore(self, learned: Arrays) -> Self:
        """Takes what another has learned."""
        ...

    def start(self, batch: int, errors: int) -> State:
        """Before the first row of ``batch`` streams: arrays whose first axis is B, in tuples or not."""
        ...

    def attribute_step(
        self, state: State, output: ModelOutput, rows: NDArray[np.float64], place: Place
    ) -> tuple[State, NDArray[np.float64]]:
        """The new state, and each number's share (B, D) of the surprise at the next rows (B, D), perhaps not finite."""
        ...

    def reset(self, state: State) -> State:
        """The state with what has added up so far forgotten."""
        ...
