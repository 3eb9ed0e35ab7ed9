"""Repertoire: what a reviewer would ask of a network that memorises letters.

    capacity          error of recall by letters and units
    one step          recurrent units whose eligibility is of the last row alone: what is learned is not the gradient
    one by one        letters learned one after another, and what is left of each in the end
    told              the row also says which letter it is of
    primitives        probabilistic and dynamic movement primitives, which are told the letter in training

Everything is recalled from a cue, on letters of seeds other than those that chose the settings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from asm_gym.data.episode import Episode
from asm_gym.evaluation.figures import figure
from asm_gym.memory.energy import Array
from asm_gym.memory.learning import practise
from asm_gym.memory.recurrent import RecurrentNetwork
from asm_gym.memory.recurrent_learning import (
    RecurrentLearner,
    initial_recurrent_weights,
    near_gradient,
)
from asm_gym.memory.temporal import unassociated
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import backpropagation, kit
from asm_gym.scripts.reproduce.expression import (
    PEN,
    Backpropagated,
    Expresser,
    ExpressionMemory,
    fit_reader,
    mean_demonstrations,
    recalled,
    schedule_of,
    skills_of,
    trajectories,
)
from asm_gym.scripts.reproduce.handwriting import (
    DT,
    NAMES,
    NOISE,
    Letter,
    check_letters,
    copybook,
    repertoire,
)
from asm_gym.scripts.reproduce.kit import Findings, Record, curves
from asm_gym.scripts.reproduce.memorise_and_recall import AGAINST_NOISE, BACKPROPAGATION
from asm_gym.scripts.reproduce.movement_primitives import DMP, ProMP, recalled_paths
from asm_gym.spec import Channel, StreamSpec

CUE = 30  # rows that are read before recall begins


@dataclass(frozen=True)
class Config(kit.Config):
    """Capacity, forgetting, labels and movement primitives on letters."""

    repertoires: tuple[int, ...] = option((8, 16, 32), quick=(4,), least=1, check=check_letters)
    """Letters that one network learns."""
    units: tuple[int, ...] = option((120, 60, 30, 15), quick=(32,), least=1)
    """Hidden units; with the first, which has as many weights as a GRU of 64, all but capacity is measured."""
    letters: int = option(8, quick=3, least=2, check=check_letters)
    """Letters that are learned one after another, or with their names."""
    steps: int = option(16000, quick=600, least=1)
    """Batches of 64 rows."""
    updates: int = option(1200, quick=40, least=1)
    """Batches of 16 letters for the GRU, which learns one letter after another."""
    writings: int = option(8, quick=4, least=2)
    """Writings of each letter to learn from."""


def run(config: Config) -> Findings:
    """Run every seed."""
    work = partial(one_seed, config=config)
    records = kit.records_of("learning letters", work, config.repetitions, config)
    frame = pd.DataFrame(records)
    tables = []
    for question, own in frame.groupby("question", sort=False):
        caption = f"{question}: error [cm] after a cue of {CUE} rows; mean ± SD over seeds"
        tables.append(kit.grid(caption, own, "error_cm", "model", "at"))
    return Findings(records, tables, errors_figure(frame))


def one_seed(seed: int, config: Config) -> list[Record]:
    """Return the error of each model in each condition, with one seed."""
    rng = np.random.default_rng([seed, 4])
    letters = repertoire(len(NAMES), rng)
    records: list[Record] = []

    def note(question: str, model: str, at: object, error: float) -> None:
        """Keep an error [cm]."""
        kept = {"seed": seed, "question": question, "model": model, "at": at, "error_cm": error}
        records.append(kept)

    for count in config.repertoires:
        train = copybook(letters[:count], config.writings, rng)
        tests = copybook(letters[:count], 4, rng)
        for units in config.units:
            memory = learned(train, units, config, rng)
            note("capacity", f"recurrent, {units} units", count, error_of(memory, tests))
        units = config.units[0]
        cut = learned_in_turn([train], units, config, rng, OneStepLearner)
        note("capacity", f"recurrent, {units} units, one step", count, error_of(cut, tests))
        for name, error in errors_of_primitives(train, tests).items():
            note("capacity", name, count, error)

    few = letters[: config.letters]
    train = copybook(few, config.writings, rng)
    tests = copybook(few, 4, rng)
    units = config.units[0]
    together = learned(train, units, config, rng)
    models: dict[str, Expresser] = {
        "recurrent, all at once": together,
        "recurrent": learned_in_turn(by_letter(train), units, config, rng),
        "GRU": gru_one_by_one(train, config, rng),
    }
    for name, model in models.items():
        for place, letter in enumerate(few, start=1):
            own = [test for test in tests if test.info["skill"] == letter.name]
            note("one by one", name, place, error_of(model, own))
    note("labels", "recurrent, unlabelled", config.letters, error_of(together, tests))
    told = learned(with_names(train, few), units, config, rng)
    note("labels", "recurrent, told", config.letters, error_of(told, with_names(tests, few)))
    return records


def error_of(model: Expresser, tests: Sequence[Episode]) -> float:
    """Return the mean distance of the recalled pen [cm]."""
    error, _ = recalled(model, tests, mean_demonstrations(tests), CUE)
    return error


# ------------------------------------------------------------------ learning


def learned(
    train: Sequence[Episode], units: int, config: Config, rng: np.random.Generator
) -> ExpressionMemory:
    """Return a network of recurrent units that has learned all writings together."""
    settings = replace(AGAINST_NOISE, hidden=units, steps=config.steps)
    return ExpressionMemory.learned(train, settings, rng)


def by_letter(train: Sequence[Episode]) -> list[list[Episode]]:
    """Return the writings of each letter, in the order in which letters come."""
    parts: dict[str, list[Episode]] = {}
    for episode in train:
        parts.setdefault(episode.info["skill"], []).append(episode)
    return list(parts.values())


class OneStepLearner(RecurrentLearner):
    """Recurrent units whose eligibility is of the last row alone."""

    def mark_eligible(self, state: Array, rows: Array) -> None:
        for array in self.eligible:
            array[:] = 0.0
        super().mark_eligible(state, rows)


def learned_in_turn(
    parts: Sequence[Sequence[Episode]],
    units: int,
    config: Config,
    rng: np.random.Generator,
    learner_type: type[RecurrentLearner] = RecurrentLearner,
) -> ExpressionMemory:
    """Return a network of recurrent units that has learned one part after another, with as many batches in all."""
    reader = fit_reader([episode for part in parts for episode in part])
    settings = replace(AGAINST_NOISE, steps=config.steps // len(parts))
    schedule = schedule_of(settings, sum(map(len, parts[0])))
    taught = [trajectories(reader, part) for part in parts]
    sensory = taught[0][0].senses.shape[1]
    motor = taught[0][0].commands.shape[1] - 1
    weights = initial_recurrent_weights(units, sensory, motor, rng)
    learner = learner_type(weights, near_gradient(schedule), rng)
    for own in taught:
        practise(learner, own, rng, lambda: None)
    network = RecurrentNetwork(weights, unassociated(), schedule.iterations, 1.0, 1.0)
    return ExpressionMemory(reader, network)


def gru_one_by_one(
    train: Sequence[Episode], config: Config, rng: np.random.Generator
) -> Backpropagated:
    """Return a GRU that has learned one letter after another, with as many batches in all."""
    reader = fit_reader(train)
    parts = by_letter(train)
    settings = replace(BACKPROPAGATION, updates=max(1, config.updates // len(parts)))
    network = None
    for own in parts:
        network = backpropagation.train(trajectories(reader, own), settings, rng, network)
    return Backpropagated(reader, network)


def with_names(episodes: Sequence[Episode], letters: Sequence[Letter]) -> list[Episode]:
    """Return the writings with a sense that says which letter it is."""
    names = [letter.name for letter in letters]
    spec = episodes[0].spec
    channels = (*spec.channels[:1], Channel("letter", len(names)), *spec.channels[1:])
    told = StreamSpec(channels, spec.dt, spec.source)
    named = []
    for episode in episodes:
        which = np.zeros((len(episode), len(names)), np.float32)
        which[:, names.index(episode.info["skill"])] = 1.0
        columns = spec.channels[0].size
        stream = np.hstack([episode.stream[:, :columns], which, episode.stream[:, columns:]])
        named.append(Episode.from_stream(stream, told, info=dict(episode.info)))
    return named


# ------------------------------------------------------------------ movement primitives


def errors_of_primitives(train: Sequence[Episode], tests: Sequence[Episode]) -> dict[str, float]:
    """Return the mean distance of the recalled pen [cm], of each kind of movement primitive."""
    paths = np.array([episode.stream[:, PEN] for episode in train], np.float64)
    skills = skills_of(train)
    true = np.array([episode.stream[:, PEN] for episode in tests], np.float64)
    errors = {}
    for name, memory in (
        ("ProMP, told", ProMP(paths, skills, NOISE)),
        ("DMP, told", DMP(paths, skills, DT)),
    ):
        recalled_rows = recalled_paths(memory, true, CUE)[:, CUE:]
        distance = np.linalg.norm(recalled_rows - true[:, CUE:], axis=2)
        errors[name] = float(distance.mean())
    return errors


def errors_figure(records: pd.DataFrame) -> Figure:
    """Draw the error over the number of letters, and of each letter once all are learned one by one."""
    with figure(height=3.4, width=8) as fig:
        left, right = fig.subplots(1, 2)
        for ax, question, label in (
            (left, "capacity", "letters in the repertoire"),
            (right, "one by one", "place in the order of learning"),
        ):
            curves(ax, records[records.question == question], "error_cm", "at", "model")
            ax.set(xlabel=label, ylabel="error of recall [cm]", yscale="log")
            ax.legend(fontsize=7)
    return fig
