"""Surprise of a model of the tasks of ``workspace``, by the energy of each group of senses.

F_g = (Σ_i (v_i/q_i)^(κ_i p))^(1/p)   v_i: evidence in the errors ε/σ of group g, see ``detection.evidence``
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.detector import BOUND
from asm_gym.detection.evidence import Evidence, bounded, pool, strength, whitening, worst_case
from asm_gym.scaling import ScaledRows, StreamScaler
from asm_gym.scripts.reproduce.workspace import GROUP_OF, GROUPS, Floats


class EnergyParts(NamedTuple):
    """Parts of the energy, of which an ablation leaves some out."""

    # whether the variance of an error is learned for each state; else it is the same in all
    by_state: bool = True
    # whether errors are whitened, and evidence is a share of its worst
    calibrated: bool = True
    # a, weights of the newest row in the evidence
    gains: tuple[float, ...] = (0.8, 0.2, 0.05)


WHOLE = EnergyParts()


class Reading(NamedTuple):
    """A model's state, error and energy at a row; of T rows, each with a first axis T."""

    state: Floats  # (H,) of a network f(μ)
    error: Floats  # (N,) of senses, changes and commands [σ]
    energy: Floats  # (G,) of ``GROUPS`` [ceiling]


class Prediction(NamedTuple):
    """What a model made of a row."""

    state: Floats  # (H,)
    error: Floats  # (N,) [σ]; 0 in the first row, and where nothing is seen
    seen: NDArray[np.bool_]  # (N,)


class GroupEnergy:
    """The energy of each group of senses: the evidence in its errors, as a share of the worst of healthy episodes.

    Args:
        episodes: errors (T, N) of healthy episodes [σ].
        members: (G, N) which errors belong to which group.
        parts: of the energy; ``by_state`` has no meaning here.
    """

    def __init__(
        self,
        episodes: Sequence[Floats],
        members: NDArray[np.bool_],
        parts: EnergyParts = WHOLE,
    ) -> None:
        count = members.shape[1]
        self.members = members
        self.gains = np.array(parts.gains)
        self.whitening = np.eye(count)
        self.worst = np.ones((len(self.gains), count))
        self.tail = np.ones_like(self.worst)
        if parts.calibrated:
            self.whitening = whitening(np.concatenate(episodes))
            strongest = [self.strengths(errors).max(axis=0) for errors in episodes]
            self.worst, self.tail = worst_case(np.array(strongest))

    def strengths(self, errors: Floats) -> Floats:
        """Return the evidence in each error (T, gains, N) at each row of an episode (T, N)."""
        self.begin()
        all_seen = np.ones(errors.shape[1], np.bool_)
        return np.array([self._strength(error, all_seen) for error in errors])

    def begin(self) -> None:
        """Forget the past."""
        self.evidence = Evidence.start(1, len(self.gains), self.members.shape[1])

    def _strength(self, error: Floats, seen: NDArray[np.bool_]) -> Floats:
        before = self.evidence
        white = bounded(error[None] @ self.whitening, BOUND)
        vector = before.vector + self.gains[:, None] * (white[:, None] - before.vector)
        vector = np.where(seen, vector, 0.0)
        self.evidence = before._replace(vector=vector, steps=before.steps + 1)
        return strength(self.evidence, self.gains)[0]

    def add(self, error: Floats, seen: NDArray[np.bool_]) -> Floats:
        """Return the energy of each group (G,) after a row's errors (N,); what is not seen has none."""
        ratios = (self._strength(error, seen) / self.worst) ** self.tail
        energies = [pool(ratios[:, own].reshape(1, -1))[0][0] for own in self.members]
        return np.array(energies)


class SurprisedModel(ABC):
    """A model that predicts each row from the rows before it, and is surprised by energies.

    Args:
        reader: how it reads a row.

    Attributes:
        ceiling: energy from which a group counts; 1 until the caller sets it.
    """

    energy: GroupEnergy

    def __init__(self, reader: StreamScaler) -> None:
        self.reader = reader
        spec = reader.spec
        self.columns = np.concatenate(
            [spec.sensory, reader.slow, spec.commanded]
        )  # (N,) of each error
        self.ceiling = 1.0
        self.rows: list[Floats] = []

    def _forget(self) -> None:
        """Forget the past."""
        self.rows = []

    def _read(self, row: Floats) -> ScaledRows:
        """Return a row (D,) as the model reads it, after the rows before it."""
        now = row[None]
        if not self.rows:
            self.rows = [now, now]
        earlier, before = self.rows
        self.rows = [before, now]
        return self.reader.read(now, before, earlier)

    @abstractmethod
    def _step(self, row: Floats) -> Prediction:
        """Read a row (D,), NaN where left out."""

    def calibrate(self, episodes: Sequence[Floats], parts: EnergyParts = WHOLE) -> None:
        """Learn how much evidence there is in the errors (T, N) of healthy episodes."""
        members = GROUP_OF[self.columns] == np.array(GROUPS)[:, None]  # (G, N)
        self.energy = GroupEnergy(episodes, members, parts)

    def steps(self, stream: NDArray[Any]) -> list[Prediction]:
        """Return the predictions of all rows of a stream (T, D)."""
        self._forget()
        return [self._step(row) for row in np.asarray(stream, np.float64)]

    def errors(self, stream: NDArray[Any]) -> Floats:
        """Return the errors (T, N) along a stream (T, D) [σ]."""
        return np.array([step.error for step in self.steps(stream)])

    def begin(self) -> None:
        """Forget the past."""
        self._forget()
        self.energy.begin()

    def read(self, row: Floats) -> Reading:
        """Read a row (D,), NaN where left out; nothing surprises in the first."""
        step = self._step(row)
        energy = self.energy.add(step.error, step.seen)
        return Reading(step.state, step.error, energy / self.ceiling)

    def read_stream(self, stream: NDArray[Any]) -> Reading:
        """Return the reading of all rows of a stream (T, D)."""
        self.begin()
        readings = [self.read(row) for row in np.asarray(stream, np.float64)]
        return Reading._make(map(np.array, zip(*readings, strict=True)))


def values_of(scaled: ScaledRows) -> Floats:
    """Return the senses, changes and commands (N,) of a row."""
    return np.hstack([scaled.senses, scaled.commands[:, :-1]])[0].astype(np.float64)


def rescaled(reader: StreamScaler, action: NDArray[Any]) -> Floats:
    """Return a standardised action (A,) in its own units."""
    motor = reader.spec.motor
    return np.asarray(reader.mean[motor] + reader.spread[motor] * action, np.float64)
