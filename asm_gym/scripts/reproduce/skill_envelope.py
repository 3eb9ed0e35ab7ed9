"""Skill memories of robotics as rivals on the Panda: a probabilistic movement primitive, and the envelope of a DMP.

    y_t = m_t + U_t a + noise,   a ~ N(0, I)     row t of a skill: senses, changes and commands, standardised
    ProMP       p(a | y_1..t) and p(skill | y_1..t), row by row, by Bayes' rule
    envelope    no a: the mean row and its spread, as associated with the phase of a dynamic movement primitive

Both are told which demonstration is of which skill, and that row t is at the same phase in every movement. They are
surprised by what the likeliest skill did not predict.

Sources: Paraschos et al. 2013 (NeurIPS); Pastor et al. 2012 (Humanoids), for envelopes of the senses.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from scipy.ndimage import uniform_filter1d

from asm_gym.data.episode import Episode
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.reproduce.expression import skills_of, trajectories
from asm_gym.scripts.reproduce.group_energy import (
    Prediction,
    SurprisedModel,
    rescaled,
    values_of,
)
from asm_gym.scripts.reproduce.movement_primitives import RIDGE, radial_bases
from asm_gym.scripts.reproduce.workspace import Floats

MODES = 10  # R of a ProMP; of 5 and 10, the better on seed 100
NOISE_ROWS = 5  # rows over which noise is averaged
LEAST_NOISE = 0.05  # least standard deviation of the noise [of the training rows]


class SkillDistribution(NamedTuple):
    """How the rows of a skill are distributed; see the module."""

    mean: Floats  # (T, N) m
    modes: Floats  # (T, N, R) U
    variance: Floats  # (T, N) of the noise

    @classmethod
    def of(cls, episodes: Sequence[Floats], modes: int) -> Self:
        """Learn from demonstrations (T, N), the shorter of which stand still at their end."""
        longest = max(map(len, episodes))
        rows = np.array([standing_still(own, longest) for own in episodes])  # (E, T, N)
        bases = radial_bases(longest)
        normal = bases.T @ bases + RIDGE * np.eye(bases.shape[1])
        smoother = bases @ np.linalg.solve(normal, bases.T)  # (T, T)
        smooth = smoother @ rows
        mean = smooth.mean(axis=0)
        flat = (smooth - mean).reshape(len(rows), -1)
        weights, sizes, directions = np.linalg.svd(flat, full_matrices=False)
        count = min(modes, len(rows) - 1)
        scale = np.sqrt(max(1, len(rows) - 1))
        scaled = (sizes[:count, None] * directions[:count]).reshape(count, *mean.shape) / scale
        explained = np.tensordot(scale * weights[:, :count], scaled, axes=1)
        squares = (rows - mean - explained) ** 2
        variance = uniform_filter1d(squares.mean(axis=0), NOISE_ROWS, axis=0)
        return cls(mean, np.moveaxis(scaled, 0, -1), variance + LEAST_NOISE**2)


def standing_still(rows: Floats, length: int) -> Floats:
    """Return rows (length, N): rows (T, N), and then the last of them."""
    return np.pad(rows, ((0, length - len(rows)), (0, 0)), "edge")


class Belief:
    """What the rows so far tell of a movement, if it is of this skill."""

    def __init__(self, skill: SkillDistribution) -> None:
        modes = skill.modes.shape[2]
        self.skill = skill
        self.precision = np.eye(modes)  # of a
        self.weighted = np.zeros(modes)  # precision times mean of a
        self.log_likelihood = 0.0

    def expected(self, row: int) -> tuple[Floats, Floats]:
        """Return the mean and the variance (N,) of a row."""
        mean, modes, variance = self._at(row)
        covariance = np.linalg.inv(self.precision)
        of_modes = np.sum((modes @ covariance) * modes, axis=1)
        return mean + modes @ (covariance @ self.weighted), variance + of_modes

    def add(self, row: int, values: Floats) -> None:
        """Take in the values (N,) of a row."""
        expected, variance = self.expected(row)
        squares = (values - expected) ** 2 / variance
        self.log_likelihood -= 0.5 * float(np.sum(squares + np.log(variance)))
        mean, modes, noise = self._at(row)
        by_noise = modes.T / noise
        self.precision = self.precision + by_noise @ modes
        self.weighted = self.weighted + by_noise @ (values - mean)

    def _at(self, row: int) -> tuple[Floats, Floats, Floats]:
        last = min(row, len(self.skill.mean) - 1)
        return self.skill.mean[last], self.skill.modes[last], self.skill.variance[last]


class SkillEnvelope(SurprisedModel):
    """Distributions of the rows of each skill.

    Args:
        reader: how it reads a row.
        episodes: demonstrations.
        modes: R; 0 for an envelope alone.
    """

    def __init__(self, reader: StreamScaler, episodes: Sequence[Episode], modes: int) -> None:
        super().__init__(reader)
        self.cue = sys.maxsize  # rows that are read; it goes on from memory after them
        taught = trajectories(reader, episodes)
        rows = [np.hstack([t.senses, t.commands[:, :-1]]).astype(np.float64) for t in taught]
        skills = skills_of(episodes)
        self.skills = []
        for name in np.unique(skills):
            own = [rows[n] for n in np.flatnonzero(skills == name)]
            self.skills.append(SkillDistribution.of(own, modes))
        self._forget()

    @classmethod
    def learned(cls, reader: StreamScaler, episodes: Sequence[Episode], modes: int) -> Self:
        """Learn from episodes, and the spread of errors from each half of them by the other half."""
        errors = []
        halves = episodes[::2], episodes[1::2]
        for half, other in (halves, halves[::-1]):
            model = cls(reader, other, modes)
            errors += [model.errors(episode.stream) for episode in half]
        model = cls(reader, episodes, modes)
        model.calibrate(errors)
        return model

    def after(self, cue: int) -> Self:
        """Return the same memory, which goes on from memory after so many rows."""
        model = copy.copy(self)
        model.cue = cue
        return model

    def _forget(self) -> None:
        super()._forget()
        self.beliefs = [Belief(skill) for skill in self.skills]
        self.row = 0

    def _likeliest(self) -> Belief:
        return max(self.beliefs, key=lambda belief: belief.log_likelihood)

    def _step(self, row: Floats) -> Prediction:
        values = values_of(self._read(row))
        is_first = self.row == 0
        expected, variance = self._likeliest().expected(self.row)
        error = (values - expected) / np.sqrt(variance)
        if self.row < self.cue:
            for belief in self.beliefs:
                belief.add(self.row, values)
        self.row += 1
        if is_first:
            error[:] = 0.0
        likelihoods = np.array([belief.log_likelihood for belief in self.beliefs])
        return Prediction(likelihoods, error, np.full(len(error), not is_first))

    def command(self) -> Floats:
        """Return the action (A,) that the likeliest skill gives next."""
        expected, _ = self._likeliest().expected(self.row)
        return rescaled(self.reader, expected[self.reader.size :])
