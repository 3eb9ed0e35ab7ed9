"""Wear: what drifts so slowly that no row and no episode shows it, told from block to block of operation.

    r_t    = x_t - x̂_t                             x̂: completed from all other sensors; a torque from no torque
    m_k    = median of r in block k                 an offset, of every sense
             mean of r sign(v), |v| of use          drag, of every torque whose joint's speed v is sensed
    z_k    = (m_k - mean of m_1 … m_{k-1}) / s √(1 + 1/(k - 1)),   at most ±3;  s: no less than their spread
    e_k    = exp(z_k) / E[exp(z)], exp(-z_k) / E[exp(-z)]
    W_k    = max(W_{k-1}, 1) e_k                    for each m and both directions, N in all
    wear   W_k >= N c                               c: blocks between two false ones that are promised
    named  the sense i with the largest (d·a_i)²/a_i·a_i      d: how offsets shift;  a_i: how a bias of i alone would

A block is an episode, a longer one is cut into minutes. s and E are those of healthy blocks that were not learned from.
z compares a block with those before it, so that neither a new task nor a new payload at the beginning is wear, and the
z of healthy blocks do not depend on each other. Then the mean number of blocks until a false one is at least c.

Sources: Hawkins 1987 (The Statistician 36) for the self-starting CUSUM; Shin, Ramdas and Rinaldo 2024 (NEJSDS 2(2),
arXiv 2203.03532) for e-detectors of CUSUM's form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.alarm_rule import rows_of_a_minute
from asm_gym.detection.base import Floats
from asm_gym.memory.completion import Completion
from asm_gym.validation import check_number, short_repr

PER_HOUR = 0.1  # false wear that is promised [1/h]
FARTHEST = 3.0  # limit of z
SHIFT_GAIN = 0.2  # weight of the newest block in the shift by which a sense is named
FIRST_BLOCKS = 5  # that nothing is told of: they are what the others are compared with
FEWEST_BLOCKS = 20  # healthy blocks that s and E need
SHORTEST = 20  # rows of a block
MOST_ROWS = 200  # of a block that are read
MOVING = 0.2  # drag is read where a joint is faster than this share of its usual speed
LEAST_SPREAD = 1e-6  # of m [spread of the sense]
ORDERS = 20  # random orders of the healthy blocks, that E is the mean over


class Wear(NamedTuple):
    """What wears, and for how long."""

    channel: str  # label of the number that drifts
    kind: str  # "offset" or "drag"
    since_s: float  # operation since the drift began [s]

    def __str__(self) -> str:
        """Return it in words."""
        return f"wear: {self.kind} of {self.channel} for {self.since_s:.0f} s"


@dataclass(frozen=True, eq=False)
class DriftSenses:
    """Reads how far senses are from what all other sensors say, in whole blocks.

    Attributes:
        completion: of a memory.
        weights: (S, Y) that complete each sense.
        torques: (J,) places of torques among the senses whose joints' speeds are sensed.
        speeds: (J,) places of these speeds.
    """

    completion: Completion
    weights: Floats
    torques: NDArray[np.intp]
    speeds: NDArray[np.intp]

    @classmethod
    def of(
        cls, completion: Completion, pairs: NDArray[np.intp], withheld: NDArray[np.bool_]
    ) -> Self:
        """Return the reader of a memory's streams.

        Args:
            completion: of the memory.
            pairs: (J, 2) columns of a torque and of its joint's speed.
            withheld: (D,) columns that no torque of ``pairs`` is completed from.
        """
        spec = completion.spec
        weights = completion.each_alone.copy()
        places = np.searchsorted(spec.sensory, pairs)
        if len(pairs):
            filling = completion.filling(withheld)
            is_paired = np.isin(filling.columns, pairs[:, 0])
            paired = np.searchsorted(spec.sensory, filling.columns[is_paired])
            weights[paired] = filling.weights[is_paired]
        return cls(completion, weights, torques=places[:, 0], speeds=places[:, 1])

    @property
    def labels(self) -> list[tuple[str, str]]:
        """Channel and kind of each m."""
        spec = self.completion.spec
        names = np.array(spec.labels)[spec.sensory]
        offsets = [(str(name), "offset") for name in names]
        return offsets + [(str(names[torque]), "drag") for torque in self.torques]

    @cached_property
    def response(self) -> Floats:
        """(S, S) how much each r changes by a bias of each sense, now and in the row before."""
        senses = len(self.weights)
        now = self.weights[:, :senses]
        before = self.weights[:, senses : 2 * senses]
        return np.eye(senses) - now - before

    def _lift(self, block: NDArray[np.floating[Any]]) -> Floats:
        """Return y (N, Y) of rows of a block (T, D), evenly spaced: each knows the row before."""
        count = min(len(block) - 1, MOST_ROWS)
        rows = np.linspace(1, len(block) - 1, count).astype(np.intp)
        with_row_before = np.stack([rows - 1, rows], axis=1).ravel()
        return self.completion.lift(block[with_row_before])[1::2]

    def read(self, block: NDArray[np.floating[Any]]) -> Floats:
        """Return m (M,) of a block (T, D), in spreads of the senses."""
        lifted = self._lift(block)
        centred = lifted - self.completion.centre
        senses = self.weights.shape[0]
        rest = centred[:, :senses] - centred @ self.weights.T  # (T, S) r
        speed = lifted[:, self.speeds]
        direction = np.where(np.abs(speed) > MOVING, np.sign(speed), 0.0)
        moving = np.maximum(np.abs(direction).sum(axis=0), 1.0)
        drag = (rest[:, self.torques] * direction).sum(axis=0) / moving
        return np.concatenate([np.median(rest, axis=0), drag])


def blocks_of(stream: NDArray[np.floating[Any]], dt: float) -> list[NDArray[np.floating[Any]]]:
    """Cut a stream (T, D) with a row each ``dt`` [s] into blocks; too short ones are left out."""
    most = rows_of_a_minute(dt)
    blocks = [stream[first : first + most] for first in range(0, len(stream), most)]
    return [block for block in blocks if len(block) >= SHORTEST]


class WearScale(NamedTuple):
    """What healthy blocks say of M numbers m."""

    spread: Floats  # (M,) s
    rising: Floats  # (M,) E[exp(z)]
    falling: Floats  # (M,) E[exp(-z)]
    block_s: float  # mean duration of a block [s]

    @classmethod
    def of(cls, values: Floats, block_s: float) -> Self | None:
        """Return the scale by m (K, M) of healthy blocks; None where they are too few."""
        if len(values) < FEWEST_BLOCKS:
            return None
        spread = np.maximum(values.std(axis=0, ddof=1), LEAST_SPREAD)
        rng = np.random.default_rng(0)
        orders = [rng.permutation(len(values)) for _ in range(ORDERS)]
        z = np.concatenate([_in_order(values[order], spread) for order in orders])
        return cls(
            spread=spread,
            rising=np.exp(z).mean(axis=0),
            falling=np.exp(-z).mean(axis=0),
            block_s=block_s,
        )

    @classmethod
    def restored(cls, kept: Floats, size: int) -> Self:
        """Read an ``array`` of M = ``size``. Raises ValueError where it is none."""
        if kept.shape != (4, size) or not ((kept > 0.0) & np.isfinite(kept)).all():
            raise ValueError(
                f"wear should be (4, {size}) numbers above 0, found {short_repr(kept)}"
            )
        spread, rising, falling, block_s = kept
        return cls(spread, rising, falling, block_s=float(block_s[0]))

    @property
    def array(self) -> Floats:
        """As a file keeps it (4, M)."""
        return np.vstack([*self[:3], np.full(len(self.spread), self.block_s)])


def _in_order(values: Floats, spread: Floats) -> Floats:
    """Return z (K - 1, M) of blocks m (K, M), each compared with all before it."""
    before = np.arange(1, len(values))[:, None]
    mean = np.cumsum(values, axis=0)[:-1] / before
    z = (values[1:] - mean) / (spread * np.sqrt(1.0 + 1.0 / before))
    return np.clip(z, -FARTHEST, FARTHEST)


class WearCounter:
    """Adds up the drift of one robot, from block to block.

    Args:
        senses: read blocks.
        scale: of healthy blocks.
        per_hour: false wear that is promised [1/h].
    """

    def __init__(self, senses: DriftSenses, scale: WearScale, per_hour: float = PER_HOUR) -> None:
        check_number("per_hour", per_hour, above=0.0)
        self._senses = senses
        self._scale = scale
        streams = 2 * len(scale.spread)  # N
        between = 3600.0 / scale.block_s / per_hour  # c [blocks]
        self._critical = float(np.log(streams * max(between, 1.0)))
        self.acknowledge()

    def acknowledge(self) -> None:
        """Begin anew: what the next blocks say is healthy."""
        size = len(self._scale.spread)
        self._total = np.zeros(size)  # of m
        self._squares = np.zeros(size)  # of m
        self._blocks = 0
        self._evidence = np.zeros((2, size))  # log W, rising and falling
        self._began = np.zeros((2, size))  # operation when W was last 1 [s]
        self._time = 0.0  # of operation [s]
        self._shift = np.zeros(size)  # running mean of how far m is from that of all before
        self.worn: tuple[Wear, ...] = ()

    def follow(self, block: NDArray[np.floating[Any]], dt: float) -> tuple[Wear, ...]:
        """Take up a block (T, D) without an alarm; return what wears, the strongest first."""
        value = self._senses.read(block)
        if self._blocks >= FIRST_BLOCKS:
            self._add(value)
        self._time += len(block) * dt
        self._total += value
        self._squares += value**2
        self._blocks += 1
        self.worn = self._worn()
        return self.worn

    def _add(self, value: Floats) -> None:
        """Add the evidence of m (M,)."""
        scale = self._scale
        count = self._blocks
        mean = self._total / count
        variance = np.maximum(self._squares - count * mean**2, 0.0) / (count - 1)
        spread = np.maximum(scale.spread, np.sqrt(variance))
        self._shift += SHIFT_GAIN * (value - mean - self._shift)
        z = (value - mean) / (spread * np.sqrt(1.0 + 1.0 / count))
        z = np.clip(z, -FARTHEST, FARTHEST)
        step = np.stack([z - np.log(scale.rising), -z - np.log(scale.falling)])
        is_new = self._evidence <= 0.0
        self._began[is_new] = self._time
        self._evidence = np.maximum(self._evidence, 0.0) + step

    def _worn(self) -> tuple[Wear, ...]:
        """Return what wears now: at most one offset and one drag, that of the stronger evidence first."""
        evidence = self._evidence.max(axis=0)
        senses = len(self._senses.response)
        worn: list[Wear] = []
        for m in np.argsort(-evidence):
            if evidence[m] < self._critical:
                break
            channel, kind = self._senses.labels[m]
            if kind in [wear.kind for wear in worn]:
                continue
            if m < senses:
                channel, _ = self._senses.labels[self._biased()]
            since = self._time - self._began[self._evidence[:, m].argmax(), m]
            worn.append(Wear(channel=channel, kind=kind, since_s=float(since)))
        return tuple(worn)

    def _biased(self) -> int:
        """Return the sense whose bias alone would explain most of the shift, in spreads of healthy blocks."""
        response = self._senses.response
        spread = self._scale.spread[: len(response)]
        shift = self._shift[: len(response)] / spread
        alone = response / spread[:, None]
        explained = (shift @ alone) ** 2 / (alone**2).sum(axis=0)
        return int(explained.argmax())


def wear_scale(
    senses: DriftSenses, streams: Sequence[NDArray[np.floating[Any]]], dt: float
) -> WearScale | None:
    """Return the scale of wear by healthy streams (T, D), with a row each ``dt`` [s]; None for too few blocks."""
    blocks = [block for stream in streams for block in blocks_of(stream, dt)]
    if len(blocks) < FEWEST_BLOCKS:
        return None
    values = np.array([senses.read(block) for block in blocks])
    block_s = float(np.mean([len(block) for block in blocks])) * dt
    return WearScale.of(values, block_s)
