"""Recall of robosuite skills: where the hand goes after a cue, one network for three of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from asm_gym.episode import Episode
from asm_gym.scripts.reproduce.expression import Backpropagated, Expresser, Hopfield, Library, Memory, Rows
from asm_gym.scripts.reproduce.kit import Record

RECALLED = {"Lift": 65, "Stack": 115, "PickPlaceCan": 145}
"""Steps recalled of the robosuite skills."""

ROBOT_CUE = 15

Express = Callable[[str, Rows], Rows]
"""The hand's positions (T, B or 1, 3), for a task and its streams (T, B, D) of which the cue may be read."""


def learned(
    seed: int, train: Sequence[Episode], tests: Sequence[Episode], hidden: int, steps: int, updates: int
) -> list[Record]:
    """Every model that learns, in one network each.

    Args:
        hidden: units.
        steps: in which the synapses of the memory change.
        updates: of the others, by backpropagation through time.
    """
    rng = np.random.default_rng(seed)
    models: dict[str, Expresser] = {
        "memory": Memory.learned(train, hidden, rng, steps),
        # Of noise from 0 to 1, a standard deviation was best here; less was better for letters.
        "gru": Backpropagated.learned(train, "gru", hidden, rng, updates, noise=1.0, rate=3e-3),
        "rnn": Backpropagated.learned(train, "rnn", hidden, rng, updates, noise=1.0, rate=3e-3),
        "gru_one_step": Backpropagated.learned(
            train, "gru", hidden, rng, updates, noise=1.0, rate=3e-3, truncated=True
        ),
    }
    hand = train[0].spec.slices["hand_position"]
    expressed = {name: partial(_hand, model, hand) for name, model in models.items()}
    return errors(expressed, tests, {"seed": seed, "hidden": hidden})


def stored(train: Sequence[Episode], tests: Sequence[Episode], where: Record) -> list[Record]:
    """Every model that only keeps what it has seen: nothing is drawn, so that it is the same whatever the seed."""
    hand = train[0].spec.slices["hand_position"]

    def told(task: str, streams: Rows) -> Rows:
        return _hand(Library.learned(train, [task] * streams.shape[1]), hand, task, streams)

    def mean(task: str, streams: Rows) -> Rows:
        shown_ones = [e.stream[: len(streams), hand] for e in long_enough(train, task)]
        return np.asarray(np.mean(shown_ones, axis=0)[:, None])

    expressed: dict[str, Express] = {
        "hopfield": partial(_hand, Hopfield.learned(train), hand),
        "library": told,
        "mean": mean,
    }
    return errors(expressed, tests, where)


def errors(expressed: Mapping[str, Express], tests: Sequence[Episode], where: Record) -> list[Record]:
    """How far off the hand is after the cue.

    Args:
        expressed: each model, by name.
        where: what the records are to say beside it.
    """
    records = []
    for task, steps in RECALLED.items():
        own = long_enough(tests, task)
        streams = np.stack([e.stream[: ROBOT_CUE + steps] for e in own], axis=1).astype(np.float64)
        true = streams[:, :, own[0].spec.slices["hand_position"]]
        for name, hand in expressed.items():
            error = 100 * float(np.linalg.norm(hand(task, streams) - true, axis=2)[ROBOT_CUE:].mean())
            fields = {"domain": task, "model": name, **where, "skills": len(RECALLED), "cue": ROBOT_CUE}
            records.append({**fields, "online": False, "error_cm": error})
    return records


def long_enough(episodes: Sequence[Episode], task: str) -> list[Episode]:
    """Those of a task that go on for as long as is recalled. Raises ValueError where there is none."""
    steps = ROBOT_CUE + RECALLED[task]
    own = [e for e in episodes if e.info["skill"] == task and len(e) >= steps]
    if not own:
        raise ValueError(f"no successful episode of {task} is {steps} steps long: record more of them")
    return own


def _hand(model: Expresser, hand: slice, task: str, streams: Rows) -> Rows:
    return model.express(streams, ROBOT_CUE)[:, :, hand]
