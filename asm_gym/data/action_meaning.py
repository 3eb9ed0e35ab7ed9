"""What an action means: a change of the state that it moves, the target of that state, its velocity, or a torque.

For each number u of the action, and each sense x with its change d_t = x_t - x_{t-1} in a row,

    d_t = a d_{t-1} + b u_{t-k} + c x_{t-1} + e         by least squares; k = 0 … LATEST

    target    c < 0, and x follows u: the state moves towards the action, and stays at u = -(c x + e)/b
    delta     c ~ 0: it moves by the action, and stays at 0; a velocity likewise
    torque    c ~ 0 of a sense that is a rate of another, or a ~ 1: it moves on where nothing is commanded
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
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
ENOUGH, FEWEST = 20_000, 50  # rows that are looked at; that can tell
CERTAIN = 5.0  # standard errors that a coefficient must differ from 0 by
TELLS = 0.05  # share of what else is not known of a change that the action must explain
# share -c sd(x)/(b sd(u)) from which the state moves towards an action, and below which by it
TOWARDS, BY = (
    0.3,
    0.1,
)
FOLLOWS = 0.8  # correlation of a state with its target
COASTS = 0.95  # a, from which a state moves on by itself
ALIKE = 0.9  # senses that an action explains nearly as well as the best; of these its own is taken
RATE = 0.9  # correlation of a sense with the change of another whose rate it is
# slopes of targets in the unit of the sense, in radians, and in degrees
OWN = (
    1.0,
    np.pi / 180,
    180 / np.pi,
)
NEAR = 0.05  # a slope or an offset this close to its own, by share, is that

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ActionMeaning:
    """What the A numbers of an action mean, and for which a robot stays: slope x[sense] + offset."""

    means: tuple[str, ...]  # each of ``MEANINGS``, or ``KEPT``, or ``UNKNOWN``
    # the column of the stream that a target is told by; -1 where none is known
    senses: tuple[int, ...]
    slopes: tuple[float, ...]
    offsets: tuple[float, ...]

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, saved: Any) -> Self:
        return cls(**{name: tuple(values) for name, values in saved.items()})

    @classmethod
    def told(
        cls,
        means: ActionMeans,
        size: int,
        recorded: ActionMeaning | None = None,
    ) -> ActionMeaning:
        """Return the meaning that a user or an environment declares.

        Args:
            means: one name for all numbers of an action, or one for each.
            size: A, how many numbers an action has.
            recorded: what recorded episodes show, which tells the senses of targets.

        Raises:
            ValueError: an unknown meaning, or another number of them.
        """
        if isinstance(means, str):
            means = (means,) * size
        if len(means) != size:
            raise ValueError(
                f"action_means must be one name, or {size} of them, got {short_repr(means)}"
            )
        for name in means:
            check_choice("action_means", name, MEANINGS)
        known = recorded or cls.unknown((size,))
        return replace(known, means=tuple(means))

    @classmethod
    def unknown(cls, shape: tuple[int, ...]) -> Self:
        """Return that nothing is known of actions of this shape."""
        size = int(np.prod(shape))
        return cls((UNKNOWN,) * size, (-1,) * size, (0.0,) * size, (0.0,) * size)

    def check_stays(self, robot: object, names: Sequence[str] = ()) -> None:
        """Raise ValueError for numbers of the action, perhaps with ``names``, that nothing is known to make stay."""
        wrong = [k for k, means in enumerate(self.means) if means in (UNKNOWN, TORQUE)]
        if wrong:
            which = ", ".join(names[k] if names else f"number {k}" for k in wrong)
            raise ValueError(
                f"no hold is known for actions of {robot}: {which} are torques, or their meaning is unknown. Set "
                f"action_means to {', '.join(MEANINGS[:3])} for all or for each; or use Hold(env, "
                'safe_action=...), another policy, on_alarm="terminate" or "monitor"'
            )

    def staying(
        self,
        row: NDArray[np.floating[Any]],
        before: NDArray[np.floating[Any]],
        executed: NDArray[np.floating[Any]],
    ) -> NDArray[np.float32]:
        """Return the action for which a robot stays where it is sensed to be.

        An arm that pursues the ``executed`` action is between that and where it was a row before.
        A sense that says otherwise has failed, and counts up to there. A target whose sense is
        unknown or not finite stays at the executed action, as does what is kept. All else stays
        at 0.

        Args:
            row: (D,) the newest of the stream.
            before: (D,) the row before it.
            executed: (A,) the last action before the robot is to stay.

        Returns:
            (A,) the action.
        """
        target = self._sensed_target(row)
        previous = self._sensed_target(before)
        low = np.minimum(previous, executed)
        high = np.maximum(previous, executed)
        between = np.clip(target, low, high)

        target = np.where(np.isfinite(between), between, target)
        target = np.where(np.isfinite(target), target, executed)
        stays = np.isin(self.means, (TARGET, KEPT))
        return np.where(stays, target, 0.0).astype(np.float32)

    def _sensed_target(self, row: NDArray[np.floating[Any]]) -> Floats:
        """Return the targets (A,) that are reached at a row (D,); NaN where no sense is known."""
        senses = np.array(self.senses, np.intp)
        target = np.array(self.offsets) + np.array(self.slopes) * row[senses]
        return np.where(senses >= 0, target, np.nan)


def found_meaning(episodes: Sequence[Episode]) -> ActionMeaning:
    """Return what recorded episodes tell of the numbers of their actions."""
    spec, windows = episodes[0].spec, _windows(episodes)
    rates = _rates(spec, windows)
    each = [_meaning(spec, windows, rates, column) for column in spec.motor]
    return ActionMeaning(*(tuple(zip(*each, strict=True)) or ((),) * 4))


def _windows(episodes: Sequence[Episode]) -> Floats:
    """Return (N, D, LATEST + 1) rows that follow one another and are finite, the newest last."""
    found, count = [np.zeros((0, episodes[0].spec.size, LATEST + 1))], 0
    for episode in episodes:
        if count < ENOUGH and len(episode.stream) > LATEST:
            windows = sliding_window_view(
                np.asarray(episode.stream, np.float64), LATEST + 1, axis=0
            )
            found.append(windows[np.isfinite(windows).all(axis=(1, 2))])
            count += len(windows)
    return np.concatenate(found)


def _rates(spec: StreamSpec, windows: Floats) -> set[int]:
    """Return which senses are rates: their units or names say so, or another sense changes by them."""
    named = {
        i
        for i in spec.sensory
        if spec.units[i] in ("rad/s", "m/s", "deg/s") or "vel" in spec.labels[i].lower()
    }
    now = windows[:, spec.sensory, -1]
    both = np.hstack([now - windows[:, spec.sensory, -2], now])
    both = both - both.mean(axis=0) if len(both) else both
    with np.errstate(invalid="ignore", divide="ignore"):
        alike = np.abs(both.T @ both) / np.sqrt(np.outer(*[(both**2).sum(axis=0)] * 2))
    # (S, S) of the change of each, and of each
    alike = np.nan_to_num(alike[: now.shape[1], now.shape[1] :])
    np.fill_diagonal(alike, 0.0)
    return named | set(spec.sensory[alike.max(axis=0, initial=0.0) > RATE])


class _Fit(NamedTuple):
    """How one sense moves with one number of the action."""

    sense: int
    tells: float  # share of what else is not known of its change that the action explains
    share: float  # -c sd(x)/(b sd(u))
    follows: float  # correlation of the sense with the action
    coasts: float  # a
    slope: float  # of the target where it stays
    offset: float


def _meaning(
    spec: StreamSpec, windows: Floats, rates: set[int], column: int
) -> tuple[str, int, float, float]:
    """Return what a number of the action means, its sense, and slope and offset of where it stays."""
    if len(windows) < FEWEST:
        return UNKNOWN, -1, 0.0, 0.0
    if np.ptp(windows[:, column]) == 0:
        return KEPT, -1, 0.0, 0.0
    asked = [
        (windows[:, sense], windows[:, column, -1 - lag], sense)
        for sense in spec.sensory
        for lag in range(LATEST + 1)
    ]
    fits = [fit for x, u, sense in asked if (fit := _fit(x, u, int(sense)))]
    place = _likeliest(spec, column, [fit for fit in fits if fit.sense not in rates])
    rate = _likeliest(spec, column, [fit for fit in fits if fit.sense in rates])
    if place is not None and place.share >= TOWARDS and place.follows >= FOLLOWS:
        return TARGET, place.sense, place.slope, place.offset
    if (rate is not None and rate.share < TOWARDS) or (place is not None and place.coasts > COASTS):
        return TORQUE, -1, 0.0, 0.0
    if place is not None and abs(place.share) <= BY:
        return DELTA, -1, 0.0, 0.0
    return VELOCITY if rate is not None and rate.follows >= FOLLOWS else UNKNOWN, -1, 0.0, 0.0


def _likeliest(spec: StreamSpec, column: int, fits: Sequence[_Fit]) -> _Fit | None:
    """Return the fit of the sense that a number of the action moves; None where it moves none."""
    best, name = (
        max((fit.tells for fit in fits), default=0.0),
        spec.labels[column].partition("[")[2],
    )
    alike = [fit for fit in fits if fit.tells >= ALIKE * best]
    own = [fit for fit in alike if name and spec.labels[fit.sense].endswith(f"[{name}")]
    return max(
        own or alike,
        key=lambda fit: (fit.slope in OWN and fit.offset == 0.0, fit.tells),
        default=None,
    )


def _fit(x: Floats, u: Floats, sense: int) -> _Fit | None:
    """Return how a sense (N, LATEST + 1) moves with an action (N,); None where nothing tells."""
    inputs, change = np.stack([x[:, -2] - x[:, -3], u, x[:, -2]], axis=1), x[:, -1] - x[:, -2]
    spread, means = inputs.std(axis=0), inputs.mean(axis=0)
    if not (spread > 0).all() or not change.std() > 0:
        return None
    z, y = (inputs - means) / spread, change - change.mean()
    gram = z.T @ z / len(z)
    if np.linalg.cond(gram) > 1e10:
        return None
    inverse = np.linalg.inv(gram)
    weights = inverse @ (z.T @ y) / len(z)
    left = max(float(np.mean((y - z @ weights) ** 2)), 1e-12 * float(np.mean(y**2)))
    errors = CERTAIN * np.sqrt(left * np.diag(inverse) / max(1, len(z) - 4))
    added = weights[1] ** 2 / inverse[1, 1]  # what the action explains beside the others
    tells = float(added / (added + left))
    _, moves, returns = np.abs(weights)
    if moves < errors[1] or tells < TELLS or (returns < errors[2] and errors[2] > BY * moves):
        return None
    a, b, c = weights / spread
    slope = next((own for own in OWN if abs(-c / b / own - 1) < NEAR), float(-c / b))
    offset = float(means[1] - slope * means[2])
    offset = 0.0 if abs(offset) < NEAR * (spread[1] + abs(means[1])) else offset
    share = -float(weights[2] / weights[1]) if returns >= errors[2] else 0.0
    return _Fit(sense, tells, share, float(np.corrcoef(x[:, -1], u)[0, 1]), float(a), slope, offset)
