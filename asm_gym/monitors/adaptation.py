"""Adaptation of a fitted memory: to wear, to fewer inference steps, to fewer bits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.adaptation import followed
from asm_gym.memory.association import existing
from asm_gym.memory.inference import iterations_within
from asm_gym.monitors import packing
from asm_gym.monitors.base import LearnsOnTheJob, Surprise
from asm_gym.monitors.calibrated_monitor import MonitorState
from asm_gym.monitors.memory_config import MOST_ITERATIONS
from asm_gym.monitors.neural_asm import NeuralASM
from asm_gym.validation import check_number, typed


@typed
def adapt(
    memory: NeuralASM,
    before: MonitorState,
    stream: NDArray[np.floating[Any]],
    surprise: Surprise,
    rate: float = 0.1,
    below: float = 0.5,
) -> NDArray[np.bool_]:
    """Learn from rows that were just observed, where they were not surprising: for a body that slowly wears.

    It changes this memory for everybody who watches with it. The promise of ``calibrate`` holds for the weights it was
    made with, so calibrate anew now and then.

    Args:
        memory: calibrated; it is changed.
        before: the state that ``observe`` was given.
        stream: (B, D) the rows that ``observe`` was given.
        surprise: what ``observe`` returned for them.
        rate: share of an error that one step takes away, in (0, 1].
        below: only rows whose surprise is under this share of the threshold are learned from.

    Returns:
        (B,) which rows were learned from.

    Raises:
        RuntimeError: there is no threshold yet.
    """
    rate = check_number("rate", rate, above=0.0, high=1.0)
    below = check_number("below", below, above=0.0, high=1.0)
    normal = surprise.value < below * memory.threshold
    rows, model, history = memory._rows(before, stream), memory.model, before.model.history
    reading = model.senses_.read(rows, history.before[:, 0], history.earlier[:, 0])
    learned: NDArray[np.bool_] = normal & (history.steps >= 2 * model.lag) & (reading.whole[:, 0] > 0)
    if learned.any():
        association = model.network.association
        now = followed(association, existing(association), reading.inputs[learned], reading.changes[learned], rate)
        model.learned_ = {**model.learned_, "U": now.U, "D": now.D}
        model.network_ = model.network.with_association(now)
    return learned


@dataclass(frozen=True)
class Learner:
    """The adaptation of one memory."""

    memory: NeuralASM

    def adapt(
        self, before: MonitorState, stream: NDArray[np.floating[Any]], surprise: Surprise, rate: float = 0.1
    ) -> NDArray[np.bool_]:
        """Return which of the rows (B, D) were learned from (B,)."""
        return adapt(self.memory, before, stream, surprise, rate)


def learner_of(monitor: object) -> LearnsOnTheJob | None:
    """Return what learns from a monitor's rows; None where it cannot."""
    if isinstance(monitor, NeuralASM):
        return Learner(monitor)
    return monitor if isinstance(monitor, LearnsOnTheJob) else None


def with_budget(memory: NeuralASM, budget: float) -> NeuralASM:
    """Return the same memory with as many inference steps a row as ``budget`` steps a second allow.

    It has no threshold: ``calibrate`` sets that of its new predictions. By traces a row that is seen takes no step.

    Raises:
        ValueError: a row would have none.
        RuntimeError: the memory has not learned anything yet.
    """
    memory._require_fitted()
    other = memory._copy()
    inferred_each = memory.spec.dt * memory.model.lag  # one row in l
    most = min(iterations_within(budget, inferred_each), MOST_ITERATIONS)
    other.config = replace(memory.config, iterations=most)
    other.model.schedule = memory.model.schedule._replace(iterations=most)
    other.model.network_ = memory.model.network.with_iterations(most)
    other._uncalibrate()
    return other


def rounded(memory: NeuralASM) -> NeuralASM:
    """Return the same memory in fewer bits, weights in 8, which takes a quarter of the space when it is saved.

    It has no threshold: ``calibrate`` sets that of the rounded weights.
    """
    memory._require_fitted()
    other = memory._copy()
    other.model.restore(packing.rounded(memory.model.learned_), memory.skills_)
    other._uncalibrate()
    return other
