"""An arm of two links that writes letters, in demonstrations and in closed loop.

    p = l₁ (cos q₁, sin q₁) + l₂ (cos(q₁ + q₂), sin(q₁ + q₂))      q̇ = u

Its senses are encoders and the position of the hand, its commands joint velocities. It has no mass. A letter takes 3 s,
in rows of 20 Hz. In closed loop a model reads a cue, commands the arm, and something may happen to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.memory.free_energy import Before, FreeEnergy
from asm_gym.monitors import NeuralASM
from asm_gym.scripts.reproduce.expression import Backpropagated
from asm_gym.scripts.reproduce.handwriting import DT as PEN_DT
from asm_gym.scripts.reproduce.handwriting import NOISE, Letter, written
from asm_gym.spec import MOTOR, Channel, StreamSpec

Floats = NDArray[np.float64]

LINKS = np.array([20.0, 20.0])  # lengths [cm]
START = np.array([16.0, 16.0])  # where the hand begins [cm]
DT = 0.05
ENCODER_NOISE = 1e-3  # standard deviation [rad]
SPEC = StreamSpec(
    (
        Channel("encoder", 2, "rad", ENCODER_NOISE, "joints"),
        Channel("hand_position", 2, "cm", NOISE, "hand", ("x", "y")),
        Channel("joint_command", 2, "rad/s", group=MOTOR),
    ),
    DT,
    "two links",
)
ENCODERS, HAND, COMMAND = slice(0, 2), slice(2, 4), slice(4, 6)

CUE, EVENT, WINDOW = 15, 30, 20  # rows that are read first; the row of the event; rows within which it is to be noticed
PUSH = 0.06  # displacement of both joints [rad], over two rows; about 2 cm at the hand
WAYS = ("left alone", "pushed", "pushed, lowest F", "stuck", "stuck, left out")
"""What happens, and how the memory reacts."""
JUDGED = (WAYS[0], WAYS[1], WAYS[3])  # ways in which F is computed, in the rows around the event


def hand(q: Floats) -> Floats:
    """Return the hand (..., 2) [cm] at angles (..., 2) [rad]."""
    first, both = q[..., 0], q[..., 0] + q[..., 1]
    along = LINKS[0] * np.cos(first) + LINKS[1] * np.cos(both)
    return np.stack([along, LINKS[0] * np.sin(first) + LINKS[1] * np.sin(both)], axis=-1)


def joints(p: Floats) -> Floats:
    """Return the angles (..., 2) [rad], the elbow below, of hands (..., 2) [cm] within reach."""
    cosine = (np.sum(p**2, axis=-1) - np.sum(LINKS**2)) / (2 * np.prod(LINKS))
    elbow = np.arccos(np.clip(cosine, -1.0, 1.0))
    turned = np.arctan2(LINKS[1] * np.sin(elbow), LINKS[0] + LINKS[1] * np.cos(elbow))
    return np.stack([np.arctan2(p[..., 1], p[..., 0]) - turned, elbow], axis=-1)


def measured(q: Floats, u: Floats, rng: np.random.Generator) -> Floats:
    """Return rows (..., 6) of an arm at q (..., 2) that was commanded u (..., 2)."""
    encoders = q + ENCODER_NOISE * rng.standard_normal(q.shape)
    return np.concatenate([encoders, hand(q) + NOISE * rng.standard_normal(q.shape), u], axis=-1)


def demonstrations(letters: Sequence[Letter], each: int, rng: np.random.Generator) -> list[Episode]:
    """Write every letter ``each`` times, a little differently each time."""
    made = []
    for letter in [letter for letter in letters for _ in range(each)]:
        path = START + np.cumsum(PEN_DT * written(letter, rng).stream[:, 2:].astype(np.float64), axis=0)
        q = joints(np.concatenate([START[None], path]))
        rows = measured(q[1:], np.diff(q, axis=0) / DT, rng)
        made.append(Episode.from_stream(rows, SPEC, info={"skill": letter.name}))
    return made


@dataclass
class Course:
    """A run in closed loop of B letters side by side."""

    path: Floats  # (T, B, 2) the hand [cm]
    surprise: Floats  # (T, B)
    energy: Floats  # (T, B) F; NaN where it was not computed
    alarm: NDArray[np.intp]  # (B,) the first row in alarm from the event on; T without one
    attributed: list[str]  # the most surprising sense in that row
    threshold: float  # of surprise


class MemoryDriver:
    """A memory that commands the arm by its own motor prediction.

    Attributes:
        attribution: (B, 6) of the last rows.
    """

    def __init__(self, asm: NeuralASM, batch: int) -> None:
        self.asm, self.state = asm, asm.initial_state(batch)
        self.attribution = np.zeros((batch, SPEC.size))

    def command(self) -> Floats:
        """Return the next joint velocities (B, 2) [rad/s]."""
        return self.asm.expected_action(self.state).astype(np.float64)

    def read(self, rows: Floats) -> Floats:
        """Read rows (B, 6), and return their surprise (B,)."""
        self.state, surprise = self.asm.observe(self.state, rows)
        self.attribution = surprise.attribution
        return surprise.value

    def before(self, n: int) -> Before:
        """Return what was known before the next row of stream ``n``."""
        at, memory = slice(n, n + 1), self.state.model
        last = memory.history.before[at, 0]
        return Before(memory.traces[at], last, memory.history.earlier[at, 0], last)


class RecurrentDriver:
    """A GRU that commands the arm, and has no surprise."""

    def __init__(self, gru: Backpropagated, batch: int) -> None:
        self.gru, self.h = gru, torch.zeros(1, batch, gru.network.cell.hidden_size)
        self.attribution = np.zeros((batch, SPEC.size))
        self.rows: list[Floats] = []

    def command(self) -> Floats:
        """Return the next joint velocities (B, 2) [rad/s]."""
        reader, motor = self.gru.reader, SPEC.motor
        action = self.gru.network.act(self.h[0]).numpy().astype(np.float64)
        return np.asarray(reader.mean[motor] + reader.spread[motor] * action)

    def read(self, rows: Floats) -> Floats:
        """Read rows (B, 6), and return zeros (B,)."""
        self.rows = [*self.rows[-2:], rows]
        before = self.rows[max(0, len(self.rows) - 2)]
        seen = self.gru.reader.read(rows, before, self.rows[0])
        now = torch.from_numpy(np.hstack([seen.senses, seen.commands[:, :-1]]))[None]
        _, self.h = self.gru.network.cell(now, self.h)
        return np.zeros(len(rows))


def closed_loop(
    driver: Any, cues: Floats, way: str, seed: int, energy: FreeEnergy | None = None, threshold: float = np.inf
) -> Course:
    """Write letters after cues (T, B, 6), in one of ``WAYS``; all draw the same noise.

    Args:
        driver: commands the arm, as ``MemoryDriver`` does.
        cues: demonstrations, of which the first rows are read.
        way: what happens.
        seed: of noise and pushes.
        energy: F of the memory that drives; not computed where None.
        threshold: of its surprise.
    """
    rng, (T, B, _) = np.random.default_rng(seed), cues.shape
    pushes = PUSH * rng.choice([-1.0, 1.0], (B, 2))
    found = Course(np.zeros((T, B, 2)), np.zeros((T, B)), np.full((T, B), np.nan), np.full(B, T), [""] * B, threshold)
    q, stuck = np.zeros((B, 2)), np.zeros(B)
    senses = {"encoder": ENCODERS, "hand_position": HAND}
    for t in range(T):
        if t < CUE:
            rows = cues[t].copy()
            q = rows[:, ENCODERS].copy()
        else:
            u = driver.command()
            if way == "pushed, lowest F" and energy is not None:
                for n in np.flatnonzero(found.alarm < t):
                    u[n] = energy.reaction(driver.before(n))
            q = q + DT * u + pushes / 2 * (way.startswith("pushed") and EVENT <= t < EVENT + 2)
            rows = measured(q, u, rng)
        if way.startswith("stuck") and t >= EVENT:
            rows[:, 0] = stuck
        else:
            stuck = rows[:, 0].copy()
        if way == "stuck, left out":
            for n in np.flatnonzero(found.alarm < t):
                rows[n, SPEC.slices[found.attributed[n]]] = np.nan
        if energy is not None and way in JUDGED and EVENT - 5 <= t < EVENT + WINDOW:
            for n in range(B):
                before = driver.before(n)
                found.energy[t, n] = energy.terms(before, rows[n], energy.inferred(before, rows[n])).total
        found.path[t], found.surprise[t] = hand(q), driver.read(rows)
        for n in np.flatnonzero((found.surprise[t] > threshold) & (found.alarm == T)) if t >= EVENT else ():
            shares = np.nan_to_num(driver.attribution[n])
            found.alarm[n], found.attributed[n] = t, max(senses, key=lambda name: shares[senses[name]].sum())
    return found
