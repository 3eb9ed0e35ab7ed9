"""Glitches: a spike in one group of senses, in one row, is no evidence until a row after it is unusual too.

    n_i       = |e_i| / c_i                       e: whitened errors;  c: below it 90 % of nominal episodes stay
    spike     2 < max n <= 10, no n of another group > 1.3, and no n > 1.3 in the l rows before
    held back e_i → ±c_i in its group;  d_i: the rest
    let go    at the first of the next l rows with an n > 1:  w as if d had never been held back; else d is lost

l is how many rows a change is taken over, 1 at a robot's control rate. A fault that lasts is let go one row later; what
the other groups, or the rows before, feel too is never held back.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import inner
from asm_gym.detection.base import Array, Floats
from asm_gym.scaling import rows_apart
from asm_gym.spec import StreamSpec

SPIKE = 2.0  # n from which on a number may be a spike
LARGEST_SPIKE = 10.0  # n beyond which it is none: no healthy one came to 8, and a sense that jumps so far is a fault
QUIET = 1.3  # n up to which other groups, and the rows before, show no trace of it
TRACE = 1.0  # n of a row after it that says it was none
USUAL_QUANTILE = 0.9  # share of nominal episodes whose maximum of |e| stays below c
LEAST_USUAL = 1e-3  # least c, as a share of the median c


class SpikeRule(NamedTuple):
    """Which of X whitened errors may be spikes."""

    usual: Floats  # (X,) c; infinite where nothing is held back
    groups: NDArray[np.intp]  # (X,)
    rows: int  # l

    @classmethod
    def unused(cls, errors: int) -> Self:
        """Return the rule that holds nothing back."""
        return cls(usual=np.full(errors, np.inf), groups=np.arange(errors), rows=1)

    @classmethod
    def of(cls, usual: Array, spec: StreamSpec) -> Self:
        """Return the rule of errors (X,) of a stream's senses; none is held back where they are another number."""
        names = [channel.group for channel in spec.channels for _ in channel.labels]
        _, groups = np.unique(np.array(names)[spec.sensory], return_inverse=True)
        if len(usual) != len(groups):
            return cls.unused(len(usual))
        if not groups.any():  # one group: every number is its own
            groups = np.arange(len(groups))
        exact = np.array(usual, np.float64)
        return cls(usual=exact, groups=groups.astype(np.intp), rows=rows_apart(spec.dt))


def usual_errors(whitened: Sequence[Array]) -> Floats:
    """Return c (X,) of whitened errors (T, X) of nominal episodes."""
    maxima = np.array([np.abs(episode).max(axis=0) for episode in whitened])
    usual = np.quantile(maxima, USUAL_QUANTILE, axis=0)
    least = LEAST_USUAL * float(np.median(usual))
    return np.maximum(usual, max(least, np.finfo(np.float64).tiny))


class Waiting(NamedTuple):
    """What is held back in B streams; never changed in place."""

    rest: Floats  # (B, X) d
    left: NDArray[np.int64]  # (B,) rows that may still let it go; 0 where nothing waits
    unusual: NDArray[np.int64]  # (B,) rows for which an unusual row before still counts

    @classmethod
    def start(cls, batch: int, errors: int) -> Self:
        """Return the state before the first row."""
        none = np.zeros(batch, np.int64)
        return cls(rest=np.zeros((batch, errors)), left=none, unusual=none.copy())


@inner
def hold_back(
    rule: SpikeRule,
    before: Waiting,
    after: Waiting,
    n: int,
    errors: Any,
) -> tuple[bool, int]:
    """Write what waits after a row of stream n, and take a spike out of its errors.

    Args:
        rule: what a spike is.
        before, after: what waits.
        n: number of the stream.
        errors: (X,) whitened, written to.

    Returns:
        Whether the row has a spike; and how many rows ago what it lets go, ``before.rest``, was held back, 0 for none.
    """
    largest, place = largest_of(rule, errors)
    rest = after.rest[n]
    rest.fill(0.0)
    left = before.left[n]
    age = 0
    if left > 0 and largest > TRACE:
        age = rule.rows - left + 1
        left = 0
    after.left[n] = max(left - 1, 0)
    if after.left[n] > 0:
        for i in range(len(errors)):
            rest[i] = before.rest[n, i]

    is_spike = SPIKE < largest <= LARGEST_SPIKE and before.unusual[n] == 0
    if is_spike:
        is_spike = not elsewhere(rule, errors, rule.groups[place])
    after.unusual[n] = max(before.unusual[n] - 1, 0)
    if largest > QUIET:
        after.unusual[n] = rule.rows
    if is_spike:
        after.left[n] = rule.rows
        take_out(rule, rule.groups[place], errors, rest)
    return is_spike, age


@inner
def largest_of(rule: SpikeRule, errors: Any) -> Any:
    """Return the largest n of errors (X,), and its place."""
    largest = 0.0
    place = 0
    for i in range(len(errors)):
        size = abs(errors[i]) / rule.usual[i]
        if size > largest:
            largest = size
            place = i
    return largest, place


@inner
def elsewhere(rule: SpikeRule, errors: Any, group: int) -> bool:
    """Return whether errors (X,) of another group are unusual."""
    unusual = False
    for i in range(len(errors)):
        of_another = rule.groups[i] != group
        unusual = unusual or (of_another and abs(errors[i]) > QUIET * rule.usual[i])
    return unusual


@inner
def take_out(
    rule: SpikeRule,
    group: int,
    errors: Any,
    rest: Any,
) -> None:
    """Limit errors (X,) of a group to what is usual; write what is left of them."""
    for i in range(len(errors)):
        usual = rule.usual[i]
        if rule.groups[i] == group and abs(errors[i]) > usual:
            limited = np.copysign(usual, errors[i])
            rest[i] = errors[i] - limited
            errors[i] = limited
