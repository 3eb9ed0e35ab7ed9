"""The base class of models, and running one over many episodes side by side."""

from __future__ import annotations

import inspect
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.memory.temporal import RowHistory
from asm_gym.monitors.monitor_protocol import Progress, State
from asm_gym.scaling import ScaledRows, StreamScaler
from asm_gym.spec import StreamSpec

STRETCH_ROWS = 4096  # rows of an episode that are computed at once
SIDE_BY_SIDE = 64  # episodes that run together; with more the arrays no longer fit the cache


class StreamModel:
    """Base class of models: predicts each row of a stream, and returns its errors.

    A detection makes surprise of them. Arguments of ``__init__`` beside the stream's spec are
    hyperparameters, kept under their own names.
    """

    kind: str  # its name, in ``make_monitor`` and in checkpoints
    shortest: int = 2  # fewest steps of an episode to learn from
    # One in so many episodes is not learned, but shows how large errors usually are; 0 for none.
    held_out: int = 5

    def __init__(self, spec: StreamSpec) -> None:
        self.spec = spec
        self.learned_: Arrays = {}  # by name, once it is fitted
        self.skills_: tuple[str, ...] = ()  # names of the skills it knows
        self.crossfitted: dict[int, NDArray[np.floating[Any]]] = {}
        """Errors (T, X) of learned episodes by what was learned without them, by id, while it is fitted."""

    @property
    def error_columns(self) -> NDArray[np.intp]:
        """Column (X,) of the stream that each error belongs to; -1 for an error that all senses share."""
        return self.spec.sensory

    @abstractmethod
    def fit(
        self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress
    ) -> Self:
        """Learn from whole nominal episodes."""

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        """Take over learned arrays. Raises ValueError where they do not fit together."""
        self.learned_ = learned
        self.skills_ = skills
        return self

    @abstractmethod
    def start(self, batch: int) -> State:
        """Return the state before the first row of ``batch`` streams: a NamedTuple of arrays whose first axis is B."""

    @abstractmethod
    def predict(self, state: Any, rows: NDArray[np.float64]) -> tuple[Any, ModelOutput]:
        """Return the new state after the next rows (B, D), perhaps not all finite, and the errors."""


class ScaledModel(StreamModel):
    """Base class of models that read rows as the memory does: values, and their changes over ``lag`` rows."""

    senses_: StreamScaler  # reads rows

    def __init__(self, spec: StreamSpec, lag: int = 1) -> None:
        super().__init__(spec)
        self.lag = lag
        self.shortest = 1 + lag

    def read_nominal(self, episodes: Sequence[Episode]) -> list[ScaledRows]:
        """Learn the scale of nominal episodes, and read all of their rows."""
        streams = [episode.stream for episode in episodes]
        self.senses_ = StreamScaler.fit(self.spec, streams, self.lag)
        return [self.senses_.read_episode(stream) for stream in streams]

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        self.senses_ = StreamScaler.of(self.spec, learned, self.lag)
        return super().restore(learned, skills)

    def start(self, batch: int) -> Any:
        return RowHistory.empty(batch, self.lag, self.spec.size)


def require_arrays(learned: Arrays, names: Iterable[str]) -> None:
    """Raise ValueError unless a file, perhaps of an earlier release, holds all arrays of these names."""
    missing = [name for name in names if name not in learned]
    if missing:
        raise ValueError(
            f"this memory has no {', '.join(missing)}: make it anew, "
            "by asm-gym fit or asm-gym babble"
        )


def error_shares(columns: NDArray[np.intp], spec: StreamSpec) -> NDArray[np.float64]:
    """Return the share (X, D) that each number of the stream has in each error.

    ``columns`` (X,) are those of the errors; -1 for an error that all senses share.
    """
    shares = np.zeros((len(columns), spec.size))
    for share, column in zip(shares, columns, strict=True):
        if column >= 0:
            share[column] = 1.0
        else:
            share[spec.sensory] = 1.0 / len(spec.sensory)
    return shares


def read_next(
    senses: StreamScaler, history: RowHistory, rows: NDArray[np.float64]
) -> tuple[RowHistory, ScaledRows, NDArray[np.float32]]:
    """Read the next rows (B, D).

    Returns:
        The new history, what was read, and 1 (B, 1) where all is known that a change is predicted from, else 0.
    """
    before, earlier = history.past(rows)
    reading = senses.read(rows, before, earlier)
    known = (reading.whole * (history.steps >= senses.lag)[:, None]).astype(np.float32)
    return history.followed_by(rows), reading, known


def rows_after(lag: int, readings: Sequence[ScaledRows]) -> ScaledRows:
    """Return the rows of episodes without the first ``lag`` of each, before which nothing is known."""
    trimmed = [[array[lag:] for array in reading] for reading in readings]
    return ScaledRows._make(map(np.concatenate, zip(*trimmed, strict=True)))


class Stretch(NamedTuple):
    """Consecutive rows of one stream, after some that came before them."""

    rows: slice  # of the stream
    lead: int  # rows that came before
    reading: ScaledRows  # of all
    known: NDArray[np.float32]  # (N, 1) of all, as of ``read_next``


def stretches(
    senses: StreamScaler, stream: NDArray[np.floating[Any]], past: int
) -> Iterator[Stretch]:
    """Read all rows of a stream (T, D), as ``read_next`` does one after another, each with ``past`` rows before it."""
    for start in range(0, len(stream), STRETCH_ROWS):
        rows = slice(start, start + STRETCH_ROWS)
        lead = min(start, past)
        reading = senses.read_episode(stream[start - lead : rows.stop])
        known = reading.whole.copy()
        known[: senses.lag] = 0.0
        yield Stretch(rows, lead, reading, known)


def zero_unless_finite(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values with 0 for those that are not finite."""
    return np.where(np.isfinite(values), values, 0.0)


def no_context(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the contexts (B, 0) of a model that knows none."""
    return np.zeros((len(rows), 0))


def parameter_names(kind: Callable[..., Any]) -> tuple[str, ...]:
    """Return the hyperparameters of a model, a detection or a monitor: arguments of its constructor beside the spec.

    Of a class with a ``config_class``, the fields of that stand for the argument ``config``.
    """
    names = []
    for name, parameter in inspect.signature(kind).parameters.items():
        is_named = parameter.kind is parameter.POSITIONAL_OR_KEYWORD
        if is_named and name not in ("spec", "config"):
            names.append(name)
    return (*names, *_config_names(kind))


def _config_names(kind: Callable[..., Any]) -> list[str]:
    """Return the fields of the ``config_class`` of a class; empty where it has none."""
    if not hasattr(kind, "config_class"):
        return []
    return [field.name for field in fields(kind.config_class)]


def made(kind: Callable[..., Any], spec: StreamSpec, parameters: Mapping[str, Any]) -> Any:
    """Return an object of a class with these hyperparameters. Raises TypeError for a name that it does not take."""
    unknown = sorted(parameters.keys() - set(parameter_names(kind)))
    if unknown:
        raise TypeError(f"{kind.__name__} has no hyperparameter {', '.join(unknown)}")
    arguments = dict(parameters)
    if hasattr(kind, "config_class"):
        names = [name for name in _config_names(kind) if name in arguments]
        config = {name: arguments.pop(name) for name in names}
        arguments["config"] = kind.config_class(**config)
    return kind(spec, **arguments)


def model_outputs(model: StreamModel, episodes: Sequence[Episode]) -> list[ModelOutput]:
    """Return errors (T, X) and contexts (T, C) of each episode; raise ValueError where the model gives others."""
    outputs: dict[int, ModelOutput] = {}
    predict = partial(_checked_prediction, model)
    for group, steps in side_by_side(episodes, model.start, predict):
        for stream, index in enumerate(group):
            own_steps = steps[: len(episodes[index])]
            outputs[index] = ModelOutput(
                errors=np.array([step.errors[stream] for step in own_steps]),
                contexts=np.array([step.contexts[stream] for step in own_steps]),
            )
    return [outputs[index] for index in range(len(episodes))]


def _checked_prediction(
    model: StreamModel, state: State, rows: NDArray[np.float64]
) -> tuple[State, ModelOutput]:
    """Return the model's ``predict``. Raises ValueError where it gives anything else."""
    result: Any = model.predict(state, rows)
    rule = f"predict of {model.kind} must give"
    is_pair = isinstance(result, tuple) and len(result) == 2
    if not is_pair or not isinstance(result[1], ModelOutput):
        raise ValueError(f"{rule} a state and a ModelOutput, got {type(result).__name__}")
    errors, contexts = result[1]
    shape = (len(rows), len(model.error_columns))
    if np.shape(errors) != shape:
        raise ValueError(f"{rule} errors {shape}, got {np.shape(errors)}")
    if not np.isfinite(errors).all():
        raise ValueError(f"{rule} errors that are finite where the rows are")
    if np.ndim(contexts) != 2 or len(contexts) != len(rows):
        raise ValueError(f"{rule} contexts ({len(rows)}, C), got {np.shape(contexts)}")
    return result


def side_by_side(
    episodes: Sequence[Episode],
    start: Callable[[int], State],
    advance: Callable[[State, NDArray[np.float64]], tuple[State, Any]],
) -> Iterator[tuple[list[int], list[Any]]]:
    """Run many episodes together, the longest first, each until it ends.

    Yields, for each group of episodes, their indices and what ``advance`` returned beside the state in each step.
    """
    for group in groups_side_by_side(episodes):
        streams = [episodes[index].stream for index in group]
        state = start(len(group))
        steps = []
        for t in range(len(streams[0])):
            rows = np.stack([stream[t] for stream in streams if t < len(stream)])
            running = first_of(state, len(rows))
            state, step = advance(running, rows.astype(np.float64))
            steps.append(step)
        yield group, steps


def groups_side_by_side(episodes: Sequence[Episode]) -> list[list[int]]:
    """Return the indices of episodes that run together, the longest first."""
    longest_first = sorted(range(len(episodes)), key=lambda index: -len(episodes[index]))
    firsts = range(0, len(episodes), SIDE_BY_SIDE)
    return [longest_first[first : first + SIDE_BY_SIDE] for first in firsts]


def first_of(state: State, count: int) -> State:
    """Return the state of the first ``count`` streams."""
    if not isinstance(state, tuple):
        return state[:count]
    return type(state)(*(first_of(part, count) for part in state))


def batch_of(state: State) -> int:
    """Return the number of streams B of a state."""
    while isinstance(state, tuple):
        state = state[0]
    return len(state)
