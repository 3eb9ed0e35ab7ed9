"""Conformal calibration: a threshold that healthy operation exceeds no more often than promised.

By the episode
    threshold    the ⌈(n + 1)(1 - rate)⌉-th smallest of the maxima of n nominal episodes; a value above it is an alarm
By the hour
    block        an episode; a longer one is cut into minutes, with a rest; an incident counts once, see ``incidents``
    threshold    the least maximum q of n healthy blocks with   #{i: m_i > q} + 1 <= r (T_1 + … + T_n)

m_i is the largest value in block i, T_i its duration [h], and r the rate [1/h]. The loss of a block,
[m_i > q] - r T_i, falls with q and is at most 1, so conformal risk control bounds the mean loss of the next block by 0.
Rows of a block may depend on each other; blocks must be exchangeable.

From few maxima
    threshold    q = u (k/e)^ξ,   ξ = H (1 + 0.6/√k),   H = mean of ln(m_i/u) over the k maxima above u

e is how many of the n maxima may exceed q: n·rate, or r (T_1 + … + T_n). Where that is less than ``ENOUGH``, one or two
maxima would set q above. Then the k = n/10 largest are taken to have a Pareto tail, and the mean rate is no theorem.

Sources: Vovk et al. 2005 and Angelopoulos and Bates 2023 (split conformal prediction); Angelopoulos et al. 2024 (ICLR,
conformal risk control), Theorem 1; Hill 1975 and Weissman 1978 (the tail; the 0.6 standard errors in ξ are ours).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import numpy as np
from scipy.special import betaincinv

from asm_gym.detection.alarm_rule import rows_of_a_minute, rows_over
from asm_gym.detection.base import Array, Floats
from asm_gym.exceptions import NotEnoughEpisodes
from asm_gym.validation import check_number, short_repr

EPISODE = "episode"  # units of a rate of false alarms
HOUR = "hour"
LEAST_RATE = 1e-15
"""Rates are not taken to be smaller, as the inverse of the smallest floats is infinite."""
CONFIDENCE = 0.95  # share of calibrations in which ``Promise.at_most`` holds
LEAST_PER_HOUR = 1e-6  # limits of a rate
MOST_PER_HOUR = 1e6
ROUNDING = 1e-9
ENOUGH = 5.0  # maxima that may exceed a threshold, from which on they are counted
FEWEST_IN_TAIL = 50  # maxima that a model of their tail takes
MOST_COUNTED = 12  # thresholds at which incidents are counted, of maxima of all ranks
MAXIMA_PER_ONE_IN_TAIL = 10  # one in so many maxima is in the tail
# Added to the exponent of the tail: with these a Pareto law keeps a rate of 1 % from 100 maxima on.
STANDARD_ERRORS = 0.6


def conformal_episodes(rate: float) -> int:
    """Return the least number of nominal episodes that a false-alarm rate needs: ⌈1/rate⌉ - 1."""
    check_number("false_alarm_rate", rate, above=0.0, below=1.0)
    return math.ceil(1.0 / max(rate, LEAST_RATE) - ROUNDING) - 1


def conformal_threshold(maxima: Array, rate: float) -> float:
    """Return the q that the maximum of a fresh nominal episode exceeds with a probability of at most ``rate``.

    The fresh episode and the n calibration episodes, of ``maxima`` (n,), must be exchangeable. Raises ValueError where
    there are too few.
    """
    values = checked_maxima(maxima)
    episodes = len(values)
    needed = conformal_episodes(rate)
    if episodes < needed:
        possible = math.ceil(1e3 / (episodes + 1)) / 1e3
        raise NotEnoughEpisodes(
            f"a false alarm rate of {rate} needs",
            needed=f"{needed} nominal episodes",
            got=f"{episodes}",
            advice=f"these can promise {possible:g} at best",
        )
    # (n + 1)(1 - rate) is often whole, but not in floating point.
    rank = math.ceil((episodes + 1) * (1.0 - rate) - ROUNDING)
    return float(np.sort(values)[rank - 1])


def checked_maxima(maxima: Array) -> Array:
    """Return maxima (n,). Raises ValueError unless they are numbers in this shape."""
    try:
        values = np.asarray(maxima)
    except ValueError:  # rows of several lengths
        values = np.array(None)
    if values.ndim != 1 or values.dtype.kind not in "iuf" or np.isnan(values).any():
        raise ValueError(f"maxima must be numbers in the shape (n,), got {short_repr(maxima)}")
    return values


class Tail(NamedTuple):
    """A Pareto tail of the largest maxima: beyond q > u, ``size (q/u)^(-1/ξ)`` of them are to be expected."""

    size: int  # k
    lowest: float  # u, below the tail
    exponent: float  # ξ

    @classmethod
    def of(
        cls,
        maxima: Array,
        expected: float,
        blocks: int | None = None,
    ) -> Tail | None:
        """Return the tail of maxima (n,), ``expected`` of which may exceed a threshold; None where they are counted.

        With ``blocks``, its size goes by so many; other maxima are of further incidents in them.
        """
        count = blocks or len(maxima)
        if count < FEWEST_IN_TAIL or expected >= ENOUGH:
            return None
        values = np.sort(maxima)
        size = count // MAXIMA_PER_ONE_IN_TAIL
        lowest = float(values[-size - 1])
        if not 0.0 < lowest < values[-1] < np.inf:
            return None
        hill = float(np.log(values[-size:] / lowest).mean())
        margin = 1.0 + STANDARD_ERRORS / math.sqrt(size)
        return cls(size=size, lowest=lowest, exponent=hill * margin)

    def threshold(self, expected: float) -> float:
        """Return what so many are expected to exceed."""
        return self.lowest * (self.size / expected) ** self.exponent

    def expected_above(self, threshold: float) -> float:
        """Return how many are expected to exceed a threshold above u: half of one at least, where the model ends."""
        expected = self.size * (threshold / self.lowest) ** (-1.0 / self.exponent)
        return max(expected, 0.5)


def episode_threshold(maxima: Array, rate: float) -> float:
    """Return ``conformal_threshold``, or what the tail of few maxima (n,) makes of it; raises as that."""
    counted = conformal_threshold(maxima, rate)
    expected = len(maxima) * rate
    tail = Tail.of(maxima, expected)
    if tail is None:
        return counted
    return tail.threshold(expected)


class Promise(NamedTuple):
    """The promise of a threshold set on nominal episodes, or blocks by the hour.

    If k of n maxima exceed it, the share of fresh ones that do is Beta(k + 1, n - k)-distributed
    (Vovk 2012).
    """

    episodes: int  # that it was set on
    # Mean rate of alarms over calibrations: (k + 1)/(n + 1) an episode, or (k + 1)/hours an hour.
    rate: float
    at_most: float  # upper bound of the rate in 95 % of calibrations
    per: str = EPISODE  # or ``HOUR``
    hours: float = 0.0  # of the blocks; 0 by the episode
    # The rate is that of the maxima's ``Tail``, as too few were above the threshold to count.
    modelled: bool = False

    @classmethod
    def of(
        cls,
        maxima: Array,
        threshold: float,
        blocks: int | None = None,
    ) -> Self:
        """Return the promise by the episode, from the maxima (n,) of nominal ones; ``blocks`` as of ``Tail.of``."""
        episodes = len(maxima)
        beyond = int(rows_over(maxima, threshold).sum())
        at_most = 1.0
        if beyond < episodes:
            at_most = float(betaincinv(beyond + 1, episodes - beyond, CONFIDENCE))

        rate = (beyond + 1) / (episodes + 1)
        tail = Tail.of(maxima, expected=0.0, blocks=blocks)  # whatever the rate was
        was_counted = threshold in maxima  # a threshold that is counted is one of the maxima
        modelled = tail is not None and threshold > tail.lowest and not was_counted
        if tail is not None and modelled:
            rate = tail.expected_above(threshold) / episodes
        return cls(
            episodes=episodes,
            rate=rate,
            at_most=max(rate, at_most),
            modelled=modelled,
        )

    def hourly(self, hours: float) -> tuple[float, float]:
        """Return ``rate`` and ``at_most`` as alarms an hour, where the episodes took so many hours."""
        per_hour = 1.0
        if self.per == EPISODE:
            per_hour = self.episodes / hours
        return self.rate * per_hour, self.at_most * per_hour


class Blocks(NamedTuple):
    """Healthy operation in blocks."""

    maxima: Floats  # (n,) the largest value in each
    hours: Floats  # (n,) duration of each; 0 of another incident in a block
    group: Floats = np.zeros(0)  # (n,) number of its task; empty for one group

    @classmethod
    def of(
        cls,
        values: Sequence[Array],
        dt: float,
        each: Sequence[str] = (),
    ) -> Blocks:
        """Cut the values (T,) of whole episodes, a row each ``dt`` [s]; ``each`` names the group of every episode."""
        most = rows_of_a_minute(dt)
        group_of_episodes = each or [""] * len(values)
        groups = list(dict.fromkeys(group_of_episodes))
        blocks = []
        for value, group in zip(values, group_of_episodes, strict=True):
            for first in range(0, len(value), most):
                block = value[first : first + most]
                hours = len(block) * dt / 3600
                blocks.append((block.max(), hours, groups.index(group)))
        columns = np.reshape(np.array(blocks, float), (-1, 3)).T
        if len(groups) < 2:
            columns = columns[:2]  # without the group
        return cls(*columns)

    def with_incidents(self, count: Callable[[float, int], int]) -> Self:
        """Return the blocks with another of no duration for each incident beyond one a block.

        Args:
            count: returns the incidents at a threshold in the episodes of a group, by its number.
        """
        group_of_blocks = self.group
        if not self.group.size:
            group_of_blocks = np.zeros(len(self.maxima))
        extra: list[tuple[float, float]] = []  # threshold, group
        for group in np.unique(group_of_blocks):
            maxima = np.sort(self.maxima[group_of_blocks == group])[::-1]
            ranks = np.unique(np.geomspace(1, len(maxima), MOST_COUNTED).astype(int)) - 1
            level = float(maxima[0])
            added = 0
            for threshold in maxima[ranks]:
                below = float(np.nextafter(threshold, -np.inf))
                missing = count(below, int(group)) - int((maxima > below).sum()) - added
                extra += [(level, float(group))] * missing
                added += max(missing, 0)
                level = float(threshold)
        if not extra:
            return self
        thresholds, groups = np.transpose(extra)
        all_groups = self.group
        if self.group.size:
            all_groups = np.concatenate([self.group, groups])
        return type(self)(
            maxima=np.concatenate([self.maxima, thresholds]),
            hours=np.concatenate([self.hours, np.zeros(len(extra))]),
            group=all_groups,
        )

    @classmethod
    def restored(cls, kept: Floats) -> Blocks:
        """Read an ``array``. Raises ValueError where that is no maxima and hours."""
        fits = kept.ndim == 2 and len(kept) in (2, 3) and kept.size > 0
        if not fits or not (kept[1] >= 0).all() or not kept[1].any():  # hours
            raise ValueError(
                f"blocks should be maxima and hours, (2, n) or (3, n), found {short_repr(kept)}"
            )
        return cls(*kept)

    @property
    def array(self) -> Floats:
        """As a file keeps them: (3, n), or (2, n) for one group."""
        return np.stack([part for part in self if part.size])

    @property
    def groups(self) -> list[Blocks]:
        """The blocks of each group, where they have several."""
        masks = [self.group == group for group in np.unique(self.group)]
        return [Blocks(maxima=self.maxima[mask], hours=self.hours[mask]) for mask in masks]

    @property
    def timed(self) -> int:
        """How many blocks there are, further incidents in them aside."""
        return int((self.hours > 0).sum())

    @property
    def total(self) -> float:
        """Total duration [h]."""
        return float(self.hours.sum())


def check_per_hour(rate: float) -> float:
    """Return a rate [1/h]. Raises ValueError or TypeError unless it can be promised."""
    return check_number("false_alarms_per_hour", rate, low=LEAST_PER_HOUR, high=MOST_PER_HOUR)


def check_hours(rate: float, hours: float) -> None:
    """Raise ValueError, naming the missing hours, where ``hours`` are too few for this rate."""
    if math.floor(rate * hours + ROUNDING) >= 1:
        return
    unit = 10.0 ** (math.floor(math.log10(1.0 / hours)) - 2)
    possible = math.ceil(1.0 / hours / unit) * unit  # rounded up to three digits
    missing = math.ceil(100 * (1.0 / rate - hours)) / 100
    raise NotEnoughEpisodes(
        f"{rate:g} false alarms an hour need",
        needed=f"{1.0 / rate:.4g} hours of nominal episodes",
        got=f"{hours:.3g}",
        advice=f"record {missing:.4g} hours more, or promise {possible:.4g}",
    )


def hourly_threshold(blocks: Blocks, rate: float) -> float:
    """Return the q that healthy operation exceeds in at most ``rate`` blocks an hour, on average over calibrations.

    The rate holds in each group. Raises ValueError where there are too few hours for it.
    """
    check_per_hour(rate)
    if blocks.group.size:
        return max(hourly_threshold(group, rate) for group in blocks.groups)
    check_hours(rate, blocks.total)
    expected = rate * blocks.total
    tail = Tail.of(blocks.maxima, expected, blocks.timed)
    if tail is not None:
        return tail.threshold(expected)
    allowed = math.floor(expected + ROUNDING) - 1  # blocks that may exceed it
    maxima = np.sort(blocks.maxima)
    rank = max(len(maxima) - 1 - allowed, 0)
    return float(maxima[rank])


def hourly_promise(
    blocks: Blocks,
    threshold: float,
    episodes: int,
) -> Promise:
    """Return the promise of a threshold, in the group with most alarms; ``episodes`` were cut into the blocks."""
    if blocks.group.size:
        promises = [hourly_promise(group, threshold, episodes) for group in blocks.groups]
        worst = max(promises, key=lambda promise: promise.rate)
        return worst._replace(hours=blocks.total)

    by_block = Promise.of(blocks.maxima, threshold, blocks.timed)
    count = len(blocks.maxima)
    blocks_judged = count + 1  # with a fresh one
    if by_block.modelled:
        blocks_judged = count
    return Promise(
        episodes=episodes,
        rate=by_block.rate * blocks_judged / blocks.total,
        at_most=by_block.at_most * count / blocks.total,
        per=HOUR,
        hours=blocks.total,
        modelled=by_block.modelled,
    )
