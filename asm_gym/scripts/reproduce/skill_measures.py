"""One seed of the study of six skills: learn the networks; measure how they predict and name skills."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from sklearn.ensemble import RandomForestClassifier

from asm_gym.data.episode import Episode, load_episode
from asm_gym.memory.learning import Schedule
from asm_gym.memory.readout import KEPT, certainty, learn_readout
from asm_gym.memory.recurrent_learning import learn_recurrent
from asm_gym.memory.settling import learn_settling
from asm_gym.memory.temporal import Learn, TemporalNetwork
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.reproduce.backpropagation import Batch, Training
from asm_gym.scripts.reproduce.closed_loop import LocalNetwork
from asm_gym.scripts.reproduce.expression import (
    Backpropagated,
    Expresser,
    ExpressionMemory,
    fit_reader,
    read,
    trajectories,
)
from asm_gym.scripts.reproduce.kit import Record
from asm_gym.scripts.reproduce.skill_claims import (
    FEW,
    FOREST,
    MANY,
    RECURRENT,
    ROWS,
    SETTLING,
)
from asm_gym.scripts.reproduce.skill_surprise import set_ceiling
from asm_gym.scripts.reproduce.workspace import (
    EVENT,
    GROUP_OF,
    GROUPS,
    HAND,
    SECOND,
    SKILLS,
    SPEC,
    Floats,
)

if TYPE_CHECKING:
    from asm_gym.scripts.reproduce.six_skills import Config


def felt_senses(reader: StreamScaler) -> NDArray[np.bool_]:
    """Return which senses and changes (S,) are of forces and torques."""
    columns = np.concatenate([SPEC.sensory, reader.slow])
    return np.isin(GROUP_OF[columns], FELT)


class LocalSettings(NamedTuple):
    """A network that learns by local rules, and its settings, which were chosen on the seeds 100 to 102."""

    learn: Learn
    hidden: int
    schedule: Schedule


# All networks have about 130,000 weights.
LOCAL = {
    RECURRENT: LocalSettings(
        learn_recurrent,
        hidden=256,
        schedule=Schedule(
            epochs=40,
            batch_size=64,
            learning_rate=3e-3,
            iterations=8,
            prior_precision=1.0,
            sensory_precision=1.0,
            free_running_probability=0.0,
            noise=0.3,
        ),
    ),
    SETTLING: LocalSettings(
        learn_settling,
        hidden=320,
        schedule=Schedule(
            epochs=40,
            batch_size=64,
            learning_rate=2e-3,
            iterations=8,
            prior_precision=1.0,
            sensory_precision=1.0,
            free_running_probability=0.0,
        ),
    ),
}
CELL_UNITS = {"GRU": 164, "LSTM": 139}
FELT = ("torque", "wrench")  # groups that reach no unit of the recurrent network
BEFORE_CHANGE = 40  # rows of another skill before the one that is to be named
HIDDEN_SHARE = 0.3  # of the rows, in which a group of senses is missing
UNSEEN = -9.0  # what the forest reads for a sense that is left out
ALIKE = ("PickPlaceCan", "PickPlaceMilk")


class Repetition:
    """One seed: its episodes, its networks, and its records.

    Args:
        seed: of all random draws.
        config: of the study.
        files: recorded episodes, by skill or kind of fault.
    """

    def __init__(self, seed: int, config: Config, files: dict[str, list[Path]]) -> None:
        self.seed = seed
        self.config = config
        self.files = files
        self.rng = np.random.default_rng(seed)
        self.records: list[Record] = []
        self.networks: dict[str, LocalNetwork] = {}
        self.rivals: dict[str, Backpropagated] = {}
        self.train: list[Episode] = []
        self.tests: list[Episode] = []
        self.calibration: list[Episode] = []  # they set the ceilings
        for skill in SKILLS:
            solved = [episode for episode in self.load(skill) if episode.success]
            shuffled = [solved[i] for i in self.rng.permutation(len(solved))]
            sixth = max(1, len(solved) // 6)
            self.train += shuffled[: -2 * sixth]
            self.calibration += shuffled[-2 * sixth : -sixth]
            self.tests += shuffled[-sixth:]

    def learn(self) -> None:
        """Train the networks."""
        self.reader = fit_reader(self.train)
        taught = trajectories(self.reader, self.train)
        for name, settings in LOCAL.items():
            schedule = settings.schedule._replace(epochs=self.config.epochs)
            start = time.process_time()
            learn = settings.learn
            if name == RECURRENT:
                learn = partial(learn_recurrent, felt=felt_senses(self.reader))
            trained = learn(taught, settings.hidden, schedule, self.rng, lambda: None)
            self.note("time to learn [s]", name, "one core", time.process_time() - start)
            local = LocalNetwork(self.reader, trained.network, self.train)
            set_ceiling(local, self.calibration)
            self.networks[name] = local

    def learn_rivals(self) -> None:
        """Train the rivals that learn through time."""
        for cell, hidden in CELL_UNITS.items():
            training = Training(cell, hidden, self.config.updates)
            start = time.process_time()
            self.rivals[cell] = Backpropagated.learned(self.train, training, self.rng)
            self.note("time to learn [s]", cell, "one core", time.process_time() - start)

    def load(self, name: str) -> list[Episode]:
        """Return the episodes recorded of a skill or of a kind of fault."""
        return list(map(load_episode, self.files[name]))

    def note(self, measure: str, model: str, at: object, value: Any) -> None:
        """Keep a measure of a model in a condition."""
        self.records.append(
            {
                "seed": self.seed,
                "measure": measure,
                "model": model,
                "at": str(at),
                "value": float(value),
            }
        )


# ------------------------------------------------------------------ prediction


def predict(repetition: Repetition) -> None:
    """Measure the error of the next row, and how far off the hand is when it is predicted from memory."""
    rows = EVENT + SECOND
    long_enough = [e for e in repetition.tests if len(e) >= rows]
    streams = np.stack([e.stream[:rows] for e in long_enough], axis=1)  # (T, B, D)
    reader = repetition.reader
    batch = read(reader, streams)
    alone: dict[str, Expresser] = dict(repetition.rivals)
    for name, local in repetition.networks.items():
        alone[name] = ExpressionMemory(reader, local.network)
        for steps in (FEW, MANY):
            network = local.network.with_iterations(steps)
            error = next_row_error(ExpressionMemory(reader, network), batch)
            repetition.note("next row", f"{name}, {steps}", "error", error)
            missing = completion_error(network, batch, repetition.seed)
            repetition.note("missing senses", f"{name}, {steps}", "error", missing)
    for name, rival in repetition.rivals.items():
        repetition.note("next row", name, "error", next_row_error(rival, batch))

    true = streams[EVENT:, :, HAND]
    last = streams[EVENT - 1, :, HAND].astype(np.float64)
    paths = {}
    for name, model in alone.items():
        moves = hand_moves(model, batch)
        paths[name] = last + np.cumsum(moves, axis=0)
    paths["stands still"] = last
    for name, path in paths.items():
        distance = np.linalg.norm(path - true, axis=2)
        repetition.note("from memory", name, "cm", 100 * distance.mean())


def next_row_error(model: Expresser, batch: Batch) -> float:
    """Return the squared error of the next row, over that of repeating the last row.

    A network predicts all senses, then the changes of the slow ones; a slow sense is the last row's plus its change.
    """
    reader = model.reader
    S = len(SPEC.sensory)
    last = batch.senses[1:-1, :, :S]
    true = batch.senses[2:, :, :S]
    recalled = model.expect(batch, cue=len(batch.senses))
    expected = recalled.senses[2:]
    changes = expected[:, :, S:]
    predicted = expected[:, :, :S].copy()
    slow = np.searchsorted(SPEC.sensory, reader.slow)
    gain = (reader.change / reader.spread)[reader.slow]
    predicted[:, :, slow] = last[:, :, slow] + gain * changes
    error = np.mean((predicted - true) ** 2)
    error_of_last = np.mean((true - last) ** 2)
    return error / error_of_last


def completion_error(network: TemporalNetwork, batch: Batch, seed: int) -> float:
    """Return the squared error of senses that are missing and inferred from the rest of the row [variance].

    In some rows a group of senses is missing, another one each time.
    """
    rng = np.random.default_rng([seed, 3])
    groups = GROUP_OF[SPEC.sensory]
    names = [name for name in GROUPS if name in groups]
    sensed = np.zeros(batch.senses.shape[2], np.bool_)
    sensed[: len(groups)] = True
    c = network.at_rest(batch.senses.shape[1])
    squares = []
    for x, u in zip(batch.senses, batch.commands, strict=True):
        missing = np.zeros(len(sensed), np.bool_)
        if rng.random() < HIDDEN_SHARE:
            group = names[rng.integers(len(names))]
            missing[: len(groups)] = groups == group
        seen = np.broadcast_to(~missing, x.shape).astype(np.float32)
        known = np.where(missing, np.float32(0), x)
        step = network.follow(c, u, known, seen)
        c = step.carried
        squares.append((step.senses - x)[:, missing & sensed] ** 2)
    return float(np.concatenate([s.ravel() for s in squares]).mean())


def hand_moves(model: Expresser, batch: Batch) -> Floats:
    """Return the moves of the hand [m] (T, B, 3) that are expected from memory after row ``EVENT``."""
    reader = model.reader
    hand_columns = np.arange(SPEC.size)[HAND]
    hand = np.flatnonzero(np.isin(reader.slow, hand_columns))
    recalled = model.expect(batch, cue=EVENT)
    changes = recalled.senses[EVENT:, :, len(SPEC.sensory) + hand]
    return reader.change[HAND] * changes


# ------------------------------------------------------------------ names of skills

Namer = Callable[[Floats], Floats]
"""Returns how likely each skill is at each row (T, K) of a stream (T, D)."""


def without_objects(stream: NDArray[Any], until: int | None) -> Floats:
    """Return a stream (T, D) whose objects are not seen before row ``until``; None for never."""
    rows = np.array(stream, np.float64)
    rows[:until, GROUP_OF == "object"] = np.nan
    return rows


def labels_of(episodes: Sequence[Episode]) -> list[int]:
    """Return the index of each episode's skill."""
    return [SKILLS.index(e.info["skill"]) for e in episodes]


def with_changes(stream: Floats) -> Floats:
    """Return each row and its change over a quarter of a second (T, 2 D), as the forest reads it."""
    earlier_row = np.maximum(np.arange(len(stream)) - SECOND // 4, 0)
    changes = stream - stream[earlier_row]
    return np.nan_to_num(np.hstack([stream, changes]), nan=UNSEEN)


def learn_namers(repetition: Repetition) -> dict[str, Namer]:
    """Return a readout of each network's state and a random forest, learned with objects and without."""
    train = repetition.train
    rng = repetition.rng
    seen = [without_objects(e.stream, until=0) for e in train]
    blind = [without_objects(e.stream, until=None) for e in train]
    streams = seen + blind
    lengths = [len(stream) for stream in streams]
    labels = np.repeat(2 * labels_of(train), lengths)
    namers: dict[str, Namer] = {}
    for name, local in repetition.networks.items():
        readings = [local.read_stream(stream) for stream in streams]
        states = np.concatenate([reading.state for reading in readings]).astype(np.float32)
        namers[name] = state_namer(local, states, labels, rng)
    forest_seed = int(rng.integers(2**31))
    forest = RandomForestClassifier(100, min_samples_leaf=3, random_state=forest_seed)
    forest_rows = np.concatenate([with_changes(stream) for stream in streams])
    forest.fit(forest_rows[::3], labels[::3])

    def by_forest(stream: Floats) -> Floats:
        return forest.predict_proba(with_changes(stream))

    return namers | {FOREST: by_forest}


def state_namer(
    local: LocalNetwork, states: NDArray[np.float32], labels: Any, rng: np.random.Generator
) -> Namer:
    """Return a readout of the states (N, H), which learned their labels (N,)."""
    weights, bias = learn_readout(lambda rows: states[rows], labels, len(SKILLS), rng)

    def by_state(stream: Floats) -> Floats:
        state = local.read_stream(stream).state.astype(np.float32)
        return certainty(state, weights, bias).astype(np.float64)

    return by_state


def name_skills(repetition: Repetition) -> None:
    """Measure how soon the right skill is named: with all senses, blind, and after another skill."""
    tests = repetition.tests
    namers = learn_namers(repetition)
    labels = np.array(labels_of(tests))
    others = []
    for label in labels:
        of_other_skills = np.flatnonzero(labels != label)
        others.append(tests[repetition.rng.choice(of_other_skills)].stream)
    for model, namer in namers.items():
        for episode, other, label in zip(tests, others, labels, strict=True):
            name_skill(repetition, model, namer, episode.stream, label)
            name_after_another(repetition, model, namer, episode.stream, label, other)


def name_skill(
    repetition: Repetition, model: str, namer: Namer, stream: NDArray[Any], label: int
) -> None:
    """Measure whether the right skill is named after each of ``ROWS``, with objects and without."""
    seen = names_over_time(namer, without_objects(stream, until=0))
    blind = names_over_time(namer, without_objects(stream, until=None))
    for row in ROWS:
        repetition.note("named", model, row, seen[row - 1] == label)
        repetition.note("named blind", model, row, blind[row - 1] == label)


def name_after_another(
    repetition: Repetition,
    model: str,
    namer: Namer,
    stream: NDArray[Any],
    label: int,
    other: NDArray[Any],
) -> None:
    """Measure how soon the right skill is named after rows of another skill or without objects."""
    joined = np.concatenate([other[:BEFORE_CHANGE], stream[:60]])
    names = names_over_time(namer, without_objects(joined, until=0))
    right = names[BEFORE_CHANGE:] == label
    context = {
        "another skill begins: right after a second": right[SECOND - 1],
        "rows until right": rows_until(right),
    }
    if SKILLS[label] in ALIKE:
        names = names_over_time(namer, without_objects(stream, until=SECOND))
        name_unseen = names[SECOND - 1]
        context |= {
            "objects hidden for a second: one of Can and Milk": SKILLS[name_unseen] in ALIKE,
            "the right one": name_unseen == label,
            "rows until right, once seen": rows_until(names[SECOND:] == label),
        }
    for at, value in context.items():
        repetition.note("context", model, at, value)


def names_over_time(namer: Namer, stream: Floats) -> NDArray[np.intp]:
    """Return the index of the skill that is named at each row (T,), by evidence that fades."""
    evidence = np.log(namer(stream) + 1e-3)
    faded_sum = lfilter([1.0], [1.0, -float(KEPT)], evidence, axis=0)
    return faded_sum.argmax(axis=1)


def rows_until(right: NDArray[np.bool_]) -> int:
    """Return after how many rows it is right for good."""
    wrong = np.flatnonzero(~right)
    return int(wrong[-1]) + 2 if len(wrong) else 1
