"""What models share, and running them over many episodes side by side."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.episode import Episode
from asm_gym.monitors.base import Model, State, Told
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, shown

HELD_OUT = 5
"""One in so many training episodes is not learned by the model, but shows how surprised it usually is."""

AT_ONCE = 64
"""Episodes run side by side; with more the arrays no longer fit the cache."""


class StreamModel:
    """What most models have in common: an error for each sense, and arrays that are used as they are.

    Args:
        spec: the stream it is to expect.
    """

    kind: str
    shortest: int = 2
    held_out: int = HELD_OUT

    def __init__(self, spec: StreamSpec) -> None:
        self.spec = spec
        self.learned_: Arrays = {}
        self.skills_: tuple[str, ...] = ()

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return self.spec.sensory

    def state(self) -> Arrays:
        """Arrays of floats that a file keeps and ``restore`` is given; what learned anything else has its own."""
        return self.learned_

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        self.learned_, self.skills_ = learned, skills
        return self


class ErrorPlaces:
    """Where in the stream each error belongs.

    Args:
        columns: (X,) of the stream; -1 for none, of which all senses have a share.
        spec: of the stream.
    """

    def __init__(self, columns: NDArray[np.intp], spec: StreamSpec) -> None:
        self._nowhere, self._senses = columns < 0, spec.sensory
        self._places = np.zeros((len(columns), spec.size))  # (X, D)
        self._places[np.flatnonzero(~self._nowhere), columns[~self._nowhere]] = 1.0

    def __call__(self, parts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Each number's share (B, D), from each error's (B, X)."""
        found: NDArray[np.float64] = parts @ self._places
        if self._nowhere.any():
            common = np.where(self._nowhere, parts, 0.0).sum(axis=1, keepdims=True)
            found[:, self._senses] += common / len(self._senses)
        return found


def parameter_names(kind: Callable[..., Any]) -> tuple[str, ...]:
    """The hyperparameters of a model, a detection or a monitor: what its constructor takes beside the spec."""
    taken = inspect.signature(kind).parameters.values()
    return tuple(p.name for p in taken if p.name != "spec" and p.kind is p.POSITIONAL_OR_KEYWORD)


def skills_of(episodes: Sequence[Episode]) -> list[str]:
    """What each says of its skill; empty where it says nothing."""
    return [str(e.info.get("skill", "")) for e in episodes]


def running(episode: Episode) -> NDArray[np.str_]:
    """(T,) the skill that runs in each row, by what the episode says of itself.

    ``info["skill"]`` names the one that runs all through it. Where one follows another, ``info["skills"]`` names them
    in order, and ``info["changed"]`` says in which row each next one begins.

    Raises:
        ValueError: it says neither; or of not as many skills where they begin; or they cannot begin there.
    """
    told = episode.info.get("skills")
    if told is None:
        (name,) = skills_of([episode])
        if not name:
            raise ValueError("does not say its skill: set info['skill']")
        return np.repeat(name, len(episode))
    if not isinstance(told, list | tuple) or not told or not all(isinstance(name, str) and name for name in told):
        raise ValueError(f"must name its skills in order, info['skills'], got {shown(told)}")
    changed = episode.info.get("changed", [])
    rows = changed if isinstance(changed, list | tuple) else [changed]
    begins = [0, *(check_number("info['changed']", row, low=1, whole=True) for row in rows)]
    if len(begins) != len(told):
        raise ValueError(f"names {len(told)} skills, and says of {len(begins) - 1} where they begin: info['changed']")
    lengths = np.diff([*begins, len(episode)])
    if (lengths < 1).any():
        raise ValueError(f"has {len(episode)} rows, in which skills cannot begin at {', '.join(map(str, begins))}")
    return np.repeat(told, lengths)


def model_outputs(model: Model, episodes: Sequence[Episode]) -> list[ModelOutput]:
    """What a model says of each episode, whose numbers are finite: errors (T, X) and contexts (T, C).

    Raises:
        ValueError: it says anything else, as a model of others may.
    """
    outputs: dict[int, ModelOutput] = {}
    for group, steps in side_by_side(episodes, model.start, partial(_predicted, model)):
        for n, i in enumerate(group):
            mine = steps[: len(episodes[i])]
            outputs[i] = ModelOutput(np.array([s.errors[n] for s in mine]), np.array([s.contexts[n] for s in mine]))
    return [outputs[i] for i in range(len(episodes))]


def _predicted(model: Model, state: State, rows: NDArray[np.float64]) -> tuple[State, ModelOutput]:
    said: Any = model.predict(state, rows)
    asked, wanted = f"predict of {model.kind} must give", (len(rows), len(model.error_columns))
    if not isinstance(said, tuple) or len(said) != 2 or not isinstance(said[1], ModelOutput):
        got = [type(part).__name__ for part in (said if type(said) is tuple else [said])]
        raise ValueError(f"{asked} a state and a ModelOutput, got {', '.join(got)}")
    errors, contexts = said[1]
    if np.shape(errors) != wanted:
        raise ValueError(f"{asked} errors {wanted}, got {np.shape(errors)}")
    if np.ndim(contexts) != 2 or len(contexts) != len(rows):
        raise ValueError(f"{asked} contexts ({len(rows)}, C), got {np.shape(contexts)}")
    if not np.isfinite(errors).all():
        raise ValueError(f"{asked} errors that are finite where the rows are")
    return said[0], said[1]


def side_by_side(
    episodes: Sequence[Episode],
    start: Callable[[int, Sequence[Told]], State],
    advance: Callable[[State, NDArray[np.float64]], tuple[State, Any]],
) -> Iterator[tuple[list[int], list[Any]]]:
    """Runs many episodes together, the longest first; those that have ended are left out.

    Yields, for each group of episodes, their indices and what ``advance`` said of each step.
    """
    order = sorted(range(len(episodes)), key=lambda i: -len(episodes[i]))
    for first in range(0, len(order), AT_ONCE):
        group = order[first : first + AT_ONCE]
        state, said = start(len(group), [episodes[i].info for i in group]), []
        for t in range(len(episodes[group[0]])):
            rows = np.stack([episodes[i].stream[t] for i in group if t < len(episodes[i])]).astype(np.float64)
            state, step = advance(first_of(state, len(rows)), rows)
            said.append(step)
        yield group, said


def first_of(state: State, count: int) -> State:
    """The state of the first ``count`` streams."""
    if not isinstance(state, tuple):
        return state[:count]
    return type(state)(*(first_of(s, count) for s in state))


def batch_of(state: State) -> int:
    """B."""
    return batch_of(state[0]) if isinstance(state, tuple) else len(state)
