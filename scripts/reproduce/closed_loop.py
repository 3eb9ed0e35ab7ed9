"""An arm of two links in closed loop: something commands it, reads what it feels, and something happens to it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from asm_gym.memory.free_energy import Before, FreeEnergy
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.monitor import MonitorState
from asm_gym.scripts.reproduce.expression import Backpropagated
from asm_gym.scripts.reproduce.two_links import COMMAND, DT, ENCODERS, SPEC, Floats, felt, hand

CUE, EVENT, WINDOW, RATE = 15, 30, 20, 0.05
"""Rows that are read first; the row in which something happens; rows within which it is to be noticed; the false alarms
that are asked for."""

PUSH = 0.06
"""How far both joints are displaced [rad], over two rows; about 2 cm at the hand."""

WAYS = ("left alone", "pushed", "pushed, lowest F", "stuck", "stuck, left out", "hurried")
ASKED = (WAYS[0], WAYS[1], WAYS[3])
"""In which of them F is asked for, in the rows about the event."""


@dataclass
class Course:
    """What happened in a run in closed loop, of B letters side by side."""

    path: Floats  # (T, B, 2) where the hand was [cm]
    surprise: Floats  # (T, B)
    energy: Floats  # (T, B) F; not a number where it was not asked for
    alarm: NDArray[np.intp]  # (B,) the first row in alarm from the event on; T where none
    blamed: list[str]  # the sense that was most surprising in that row
    rows: Floats  # (T, B, 6) what was read; what was left out is not a number
    threshold: float  # of surprise
    named: list[str] = field(default_factory=list)  # (T,) which letter the first of them seems to be


class Drives(Protocol):
    """Whatever commands the arm, row after row."""

    def command(self) -> Floats:
        """(B, 2) the next joint velocities [rad/s]."""

    def read(self, rows: Floats) -> Floats:
        """(B,) how surprising rows (B, 6) were."""


class Memorised:
    """A memory in closed loop."""

    def __init__(self, asm: NeuralASM, batch: int) -> None:
        self.asm, self.state = asm, asm.initial_state(batch)
        self.attribution = np.zeros((batch, SPEC.size))

    def command(self) -> Floats:
        return self.asm.expected_action(self.state).astype(np.float64)

    def read(self, rows: Floats) -> Floats:
        self.state, surprise = self.asm.observe(self.state, rows)
        self.attribution = surprise.attribution
        return surprise.value


class Recurring:
    """A GRU in closed loop, which is never surprised."""

    def __init__(self, gru: Backpropagated, batch: int) -> None:
        self.gru, self.h = gru, torch.zeros(1, batch, gru.network.cell.hidden_size)
        self.rows: list[Floats] = []

    def command(self) -> Floats:
        reader, motor = self.gru.reader, SPEC.motor
        told = self.gru.network.act(self.h[0]).numpy().astype(np.float64)
        return np.asarray(reader.mean[motor] + reader.spread[motor] * told)

    def read(self, rows: Floats) -> Floats:
        self.rows = [*self.rows[-2:], rows]
        before = self.rows[max(0, len(self.rows) - 2)]
        seen = self.gru.reader.read(rows, before, self.rows[0])
        now = torch.from_numpy(np.hstack([seen.senses, seen.commands[:, :-1]]))[None]
        _, self.h = self.gru.network.cell(now, self.h)
        return np.zeros(len(rows))


def written(
    drives: Drives, cues: Floats, way: str, seed: int, energy: FreeEnergy | None = None, threshold: float = np.inf
) -> Course:
    """Letters after cues (T, B, 6), in one of ``WAYS``; all draw the same noise.

    Args:
        energy: F of the memory that drives, where it is asked for.
        threshold: of its surprise.
    """
    rng, (T, B, _) = np.random.default_rng(seed), cues.shape
    pushes = PUSH * rng.choice([-1.0, 1.0], (B, 2))
    unknown = np.full((T, B), np.nan)
    found = Course(np.zeros((T, B, 2)), np.zeros((T, B)), unknown, np.full(B, T), [""] * B, cues.copy(), threshold)
    q, stuck = np.zeros((B, 2)), np.zeros(B)
    for t in range(T):
        if t < CUE:
            rows = cues[t].copy()
            q = rows[:, ENCODERS].copy()
        else:
            u = drives.command()
            if way == "pushed, lowest F":
                for n in np.flatnonzero(found.alarm < t):
                    assert isinstance(drives, Memorised)
                    assert energy is not None
                    u[n] = energy.reaction(moment(drives.state, n))
            q = q + DT * u + pushes / 2 * (way.startswith("pushed") and EVENT <= t < EVENT + 2)
            rows = felt(q, u, rng)
        if way.startswith("stuck") and t >= EVENT:
            rows[:, 0] = stuck
        else:
            stuck = rows[:, 0].copy()
        if way == "stuck, left out":
            for n in np.flatnonzero(found.alarm < t):
                rows[n, SPEC.slices[found.blamed[n]]] = np.nan
        if energy is not None and isinstance(drives, Memorised) and way in ASKED and EVENT - 5 <= t < EVENT + WINDOW:
            for n in range(B):
                before = moment(drives.state, n)
                found.energy[t, n] = energy.terms(before, rows[n], energy.inferred(before, rows[n])).total
        found.path[t], found.rows[t], found.surprise[t] = hand(q), rows, drives.read(rows)
        for n in np.flatnonzero((found.surprise[t] > threshold) & (found.alarm == T)) if t >= EVENT else ():
            found.alarm[n], found.blamed[n] = t, blamed(drives.attribution[n])  # type: ignore[attr-defined]
    return found


def blamed(attribution: Floats) -> str:
    """The channel of senses that has the largest share."""
    senses = {c.name: SPEC.slices[c.name] for c in SPEC.channels if SPEC.slices[c.name] != COMMAND}
    return max(senses, key=lambda name: float(np.nan_to_num(attribution[senses[name]]).sum()))


def moment(state: MonitorState, n: int) -> Before:
    """What was there before the next row of stream ``n``."""
    at, memory = slice(n, n + 1), state.model
    return Before(memory.traces[at], memory.before[at, 0], memory.earlier[at, 0], memory.before[at, 0])
