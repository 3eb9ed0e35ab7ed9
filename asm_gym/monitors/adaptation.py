"""Adaptation of a fitted memory: to wear, to streams with fewer channels, to fewer inference steps, to fewer bits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import EvidenceDetection
from asm_gym.memory.adaptation import followed
from asm_gym.memory.association import existing
from asm_gym.memory.inference import iterations_within
from asm_gym.memory.marginalise import MOST_INPUTS, Kept, fewer_changes, fewer_settled, fewer_traces
from asm_gym.memory.network import Network
from asm_gym.monitors import packing
from asm_gym.monitors.base import LearnsOnTheJob, Surprise
from asm_gym.monitors.calibrated_monitor import MonitorState
from asm_gym.monitors.memory_config import MOST_ITERATIONS
from asm_gym.monitors.memory_model import MemoryModel
from asm_gym.monitors.neural_asm import NeuralASM
from asm_gym.monitors.skill_surprise import BODY
from asm_gym.monitors.stream_model import made
from asm_gym.scaling import StreamScaler
from asm_gym.spec import StreamSpec
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


@typed
def for_stream(memory: NeuralASM, spec: StreamSpec) -> NeuralASM:
    """Return a smaller memory, for a stream that lacks channels of this one; those that are left stand in for them.

    Commands that it does not know, as those of another controller, are not looked at. The threshold is the same, whose
    promise was not made for fewer senses: ``calibrate`` makes it anew.

    Args:
        memory: fitted.
        spec: of that stream; its channels may stand in another order.

    Raises:
        ValueError: it has senses that this memory never met (the message names them), or another rate; the memory
            has lost channels before.
        RuntimeError: the memory has not learned anything yet, or alarms on skills, which takes all senses.
    """
    memory._require_fitted()
    if memory.alarm_on_ != BODY:
        raise RuntimeError('skill surprise takes all senses: skills.with_alarm_on(memory, "body") does with fewer')
    evidence = memory.detections["evidence"]
    assert isinstance(evidence, EvidenceDetection)
    other: NeuralASM = made(type(memory), spec, memory.get_params())
    other.model, kept = _fewer_senses(memory.model, spec)
    other.detection = evidence.fewer(spec, kept.left, kept.widened, kept.narrower)
    other.detections = {other.detection.name: other.detection}
    other.threshold_, other.about = memory.threshold_, memory.about
    other._place_errors()
    return other


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


def _fewer_senses(model: MemoryModel, spec: StreamSpec) -> tuple[MemoryModel, Kept]:
    """Return the model of a stream that lacks senses, and what became of its errors; raises as ``for_stream``."""
    columns = spec.columns_in(model.spec)
    if "moments" not in model.learned_:
        raise ValueError(
            "this memory does not keep what its senses have in common (it has lost "
            f"senses before, or has more than {MOST_INPUTS} inputs), so that none of them can be left out"
        )
    C, old, known = model.learned_["moments"], model.senses_, columns >= 0
    scale = {
        name: np.where(known, getattr(old, name)[columns], nothing)
        for name, nothing in (("mean", 0.0), ("spread", 1.0), ("change", 1.0))
    }
    new = StreamScaler(spec, **scale, lag=model.lag)
    network, left = model.network, (old, new, columns)
    kept = fewer_changes(network.association, C, *left)
    traces = isinstance(network, Network)
    weights = fewer_traces(network.weights, C, *left) if traces else fewer_settled(network.weights, *left)
    skills = {name: model.learned_[name] for name in ("W_K", "b_K") if model.skills_}
    learned = {**scale, **skills, "energy": model.learned_["energy"]}
    sizes = model.hidden_size, model.association_size
    fewer = MemoryModel(spec, *sizes, model.schedule, model.feedback, model.dynamics)
    return fewer.restore({**learned, **weights._asdict(), **kept.association._asdict()}, model.skills_), kept
