"""What an action means: a change of the state that it moves, the target of that state, its velocity, or a torque.

For each number u of the action, and each sense x with its change d_t = x_t - x_{t-1} in a row,

    d_t = a d_{t-1} + b u_{t-k} + c x_{t-1} + e         by least squares; k = 0 … LATEST

    target    c < 0, and x follows u: the state moves towards the action; it stays where u = -(c x + e)/b
    delta     c ~ 0: it moves by the action, and stays where u = -e/b; a velocity likewise
    torque    the same of a sense that is a rate of another, or a ~ 1: it moves on where nothing is commanded
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_choice, short_repr

DELTA, TARGET, VELOCITY, TORQUE = "delta", "target", "velocity", "torque"
MEANINGS = DELTA, TARGET, VELOCITY, TORQUE
ActionMeans = str | Sequence[str]  # one of them for all numbers of an action, or one for each
ACTIONS = "actions"  # where a monitor keeps what it has found, in what is saved about it
KEPT, UNKNOWN = "kept", ""  # it never changed: its last value is kept; nothing tells

LATEST = 3  # rows after which a command may be seen to act, at most
ENOUGH = 20_000  # rows that are looked at
FEWEST = 50  # rows that can tell
CERTAIN = 5.0  # standard errors that a coefficient must differ from 0 by
TELLS = 0.05  # share of what else is not known of a change that the action must explain
TOWARDS, BY = 0.3, 0.1  # share -c sd(x)/(b sd(u)) from which the state moves towards an action, and below which by it
FOLLOWS = 0.8  # correlation of a state with its target
COASTS = 0.95  # a, from which a state moves on by itself
ALIKE = 0.9  # senses that an action explains nearly as well as the best; of these its own is taken
RATE = 0.9  # correlation of a sense with the change of another whose rate it is
OWN = (1.0, np.pi / 180, 180 / np.pi)  # slopes of targets in the unit of the sense, in radians, and in degrees
NEAR = 0.05  # a slope or an offset this close to its own, by share, is that

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ActionMeaning:
    """What the A numbers of an action mean, and for which a robot stays: slope x[sense] + offset."""

    means: tuple[str, ...]  # each of ``MEANINGS``, or ``KEPT``, or ``UNKNOWN``
    senses: tuple[int, ...]  # the column of the stream that a target is told by; -1 where none is known
    slopes: tuple[float, ...]
    offsets: tuple[float, ...]

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, saved: Any) -> Self:
        return cls(**{name: tuple(values) for name, values in saved.items()})

    @classmethod
    def told(cls, means: ActionMeans, size: int, found: ActionMeaning | None = None) -> ActionMeaning:
        """Return what a user says, for all numbers or for each, with the senses that were found.

        Raises:
            ValueError: an unknown meaning, or another number of them.
        """
        each = (means,) * size if isinstance(means, str) else tuple(means)
        if len(each) != size:
            raise ValueError(f"action_means must be one name, or {size} of them, got {short_repr(means)}")
        for name in each:
            check_choice("action_means", name, MEANINGS)
        found = found or cls((UNKNOWN,) * size, (-1,) * size, (0.0,) * size, (0.0,) * size)
        same = [told == was or {told, was} == {DELTA, VELOCITY} for told, was in zip(each, found.means, strict=True)]
        parts = zip(same, found.senses, found.slopes, found.offsets, strict=True)
        known = [part if as_found else (-1, 0.0, 0.0) for as_found, *part in parts]
        return cls(each, *(tuple(values) for values in zip(*known, strict=True)))

    def staying(self, row: NDArray[np.floating[Any]], executed: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """Return the action (A,) for which a robot stays where it is sensed to be in ``row`` (D,).

        A target whose sense is not known or not finite stays at what was ``executed`` (A,) last, as does what is kept.
        """
        action = np.array(self.offsets, np.float64)
        for k, (means, sense) in enumerate(zip(self.means, self.senses, strict=True)):
            if means in (TARGET, KEPT):
                sensed = action[k] + self.slopes[k] * row[sense] if sense >= 0 else np.nan
                action[k] = sensed if means == TARGET and np.isfinite(sensed) else executed[k]
        return action.astype(np.float32)


def found_meaning(episodes: Sequence[Episode]) -> ActionMeaning:
    """Return what recorded episodes tell of the numbers of their actions."""
    spec = episodes[0].spec
    rows = _rows_of(episodes)
    found = [_meaning(spec, rows, k) for k in range(len(spec.motor))] if len(rows.change) >= FEWEST else None
    found = found or [(UNKNOWN, -1, 0.0, 0.0)] * len(spec.motor)
    return (
        ActionMeaning(*(tuple(part) for part in zip(*found, strict=True))) if found else ActionMeaning((), (), (), ())
    )


@dataclass(frozen=True)
class _Rows:
    """Rows of recorded episodes, side by side."""

    change: Floats  # (N, S) d_t
    before: Floats  # (N, S) d_{t-1}
    state: Floats  # (N, S) x_{t-1}
    now: Floats  # (N, S) x_t
    actions: Floats  # (N, LATEST + 1, A) u_t, u_{t-1}, …
    rates: NDArray[np.bool_]  # (S,) a sense is the rate of another, or is named as one


def _rows_of(episodes: Sequence[Episode]) -> _Rows:
    spec, parts, count = episodes[0].spec, list[tuple[Floats, ...]](), 0
    for episode in episodes:
        if count >= ENOUGH:
            break
        stream = np.asarray(episode.stream, np.float64)
        x, u = stream[:, spec.sensory], stream[:, spec.motor]
        if (n := len(x) - LATEST) < 2:
            continue
        d = np.diff(x, axis=0)
        lagged = np.stack([u[LATEST - k : LATEST - k + n] for k in range(LATEST + 1)], axis=1)
        part = d[LATEST - 1 :], d[LATEST - 2 : -1], x[LATEST - 1 : -1], x[LATEST:], lagged
        whole = np.isfinite(stream).all(axis=1)
        whole = np.logical_and.reduce([whole[k : k + n] for k in range(LATEST + 1)])
        parts.append(tuple(array[whole] for array in part))
        count += n
    if not parts:
        empty = np.zeros((0, len(spec.sensory)))
        return _Rows(empty, empty, empty, empty, np.zeros((0, LATEST + 1, len(spec.motor))), np.zeros(0, bool))
    change, before, state, now, actions = (np.concatenate(part) for part in zip(*parts, strict=True))
    return _Rows(change, before, state, now, actions, _rates(spec, change, now))


def _rates(spec: StreamSpec, change: Floats, now: Floats) -> NDArray[np.bool_]:
    """Return which senses (S,) are rates: their units or names say so, or another sense changes by them."""
    units, labels = spec.units, spec.labels
    named = [units[i] in ("rad/s", "m/s", "deg/s") or "vel" in labels[i].lower() for i in spec.sensory]
    a, b = (part - part.mean(axis=0) for part in (change, now))
    scale = np.sqrt(np.outer((a**2).sum(axis=0), (b**2).sum(axis=0)))
    with np.errstate(invalid="ignore", divide="ignore"):
        alike = np.abs(a.T @ b) / scale  # (S, S) of the change of each, and of each
    np.fill_diagonal(alike, 0.0)
    found: NDArray[np.bool_] = np.array(named, bool) | (np.nan_to_num(alike).max(axis=0, initial=0.0) > RATE)
    return found


def _meaning(spec: StreamSpec, rows: _Rows, k: int) -> tuple[str, int, float, float]:
    """Return what the k-th number of the action means, its sense, and slope and offset of where it stays."""
    unknown = UNKNOWN, -1, 0.0, 0.0
    if np.ptp(rows.actions[:, :, k]) == 0:
        return KEPT, -1, 0.0, 0.0
    fits = [fit for lag in range(LATEST + 1) for s in range(rows.change.shape[1]) if (fit := _fit(rows, k, s, lag))]
    places, rates = ([fit for fit in fits if rows.rates[fit.sense] == rate] for rate in (False, True))
    place, rate = (_likeliest(spec, k, part) for part in (places, rates))
    if place is not None and place.share >= TOWARDS and place.follows >= FOLLOWS:
        return TARGET, int(spec.sensory[place.sense]), place.slope, place.offset
    pushed = (rate is not None and rate.share < TOWARDS) or (place is not None and place.coasts > COASTS)
    if pushed:
        return TORQUE, -1, 0.0, 0.0
    if place is not None and abs(place.share) <= BY:
        return DELTA, -1, 0.0, place.rest
    return (VELOCITY, -1, 0.0, 0.0) if rate is not None and rate.follows >= FOLLOWS else unknown


def _likeliest(spec: StreamSpec, k: int, fits: Sequence[_Fit]) -> _Fit | None:
    """Return the fit of the sense that the k-th number of the action moves; None where it moves none."""
    best = max((fit.tells for fit in fits), default=0.0)
    own = spec.labels[spec.motor[k]].partition("[")[2]

    def preferred(fit: _Fit) -> tuple[Any, ...]:
        named = bool(own) and spec.labels[spec.sensory[fit.sense]].endswith(f"[{own}")
        return fit.tells >= ALIKE * best, named, fit.slope in OWN and fit.offset == 0.0, fit.tells

    return max(fits, key=preferred, default=None)


@dataclass(frozen=True)
class _Fit:
    """How one sense moves with one number of the action."""

    sense: int
    tells: float  # share of what else is not known of its change that the action explains
    share: float  # -c sd(x)/(b sd(u))
    follows: float  # correlation of the sense with the action
    coasts: float  # a
    slope: float  # of the target where it stays
    offset: float
    rest: float  # the action for which it stays, where it moves by the action


def _fit(rows: _Rows, k: int, s: int, lag: int) -> _Fit | None:
    """Return how sense ``s`` moves with the k-th number of the action ``lag`` rows before; None where nothing tells."""
    d, x, u = rows.change[:, s], rows.state[:, s], rows.actions[:, lag, k]
    inputs = np.stack([rows.before[:, s], u, x], axis=1)  # (N, 3)
    spread = inputs.std(axis=0)
    if not (spread > 0).all() or not d.std() > 0:
        return None
    means, middle = inputs.mean(axis=0), d.mean()
    z, y = (inputs - means) / spread, d - middle
    gram = z.T @ z / len(z)
    if np.linalg.cond(gram) > 1e10:
        return None
    inverse = np.linalg.inv(gram)
    weights = inverse @ (z.T @ y) / len(z)
    left = max(float(np.mean((y - z @ weights) ** 2)), 1e-12 * float(np.mean(y**2)))
    errors = np.sqrt(left * np.diag(inverse) / max(1, len(z) - 4))
    if abs(weights[1]) < CERTAIN * errors[1]:
        return None
    added = weights[1] ** 2 / inverse[1, 1]  # what the action explains beside the others
    if (tells := float(added / (added + left))) < TELLS:
        return None
    a, b, c = weights / spread
    share = -float(weights[2]) / float(weights[1])
    certain = abs(weights[2]) >= CERTAIN * errors[2]
    if not certain and errors[2] * CERTAIN > BY * abs(weights[1]):
        return None  # it may be either
    share = share if certain else 0.0
    slope = float(-c / b)
    slope = next((own for own in OWN if abs(slope / own - 1) < NEAR), slope)
    offset = float(means[1] - slope * means[2])
    offset = 0.0 if abs(offset) < NEAR * (spread[1] + abs(means[1])) else offset
    rest = float(means[1] - middle * (1 - a) / b)
    rest = 0.0 if abs(rest) < 2 * NEAR * spread[1] else rest
    follows = float(np.corrcoef(rows.now[:, s], u)[0, 1])
    return _Fit(s, tells, share, follows, float(a), slope, offset, rest)
