"""Find what the numbers of recorded actions mean, by least squares.

For each number u of the action, and each sense x with its change d_t = x_t - x_{t-1} in a row,

    d_t = a d_{t-1} + b u_{t-k} + c x_{t-1} + e         k = 0 … LATEST_LAG

    target    c < 0, and x follows u: the state moves towards the action, and stays at u = -(c x + e)/b
    delta     c ~ 0: it moves by the action, and stays at 0; a velocity likewise
    torque    c ~ 0 of a sense that is a rate of another, or a ~ 1: it moves on where nothing is commanded

All of it follows from the correlations of these variables.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.action_meaning import (
    DELTA,
    KEPT,
    TARGET,
    TORQUE,
    UNKNOWN,
    VELOCITY,
    ActionMeaning,
)
from asm_gym.data.column_names import SPEED_NAME
from asm_gym.data.episode import Episode
from asm_gym.spec import StreamSpec

LATEST_LAG = 3  # most rows after which a command may act
MOST_EXAMINED_ROWS = 20_000  # rows that are examined
FEWEST_ROWS = 50  # with fewer, nothing is known
LEAST_EXPLAINED = 0.05  # share of the otherwise unexplained change that the action must explain
CERTAIN = 5.0  # standard errors by which a weight must differ from 0
# Variance that is added to each standardised variable, so that none is a sum of others.
RIDGE = 1e-12
TARGET_PULL = 0.3  # pull from which on a state moves towards an action
DELTA_PULL = 0.1  # pull up to which it moves by the action
TARGET_CORRELATION = 0.8  # least correlation of a state with its target
COASTING_MOMENTUM = 0.95  # momentum above which a state moves on by itself
# Preference for a sense of the action's own element, such as state[elbow] of action[elbow].
OWN_PREFERENCE = 1.1
RATE_CORRELATION = 0.9  # least correlation of a rate with the change of its sense
USUAL_SLOPES = 1.0, np.pi / 180, 180 / np.pi  # of targets in the unit of the sense, or in degrees
NEAR_USUAL = 0.05  # slopes and offsets within this share of the usual ones are those

# Variables of each column of the stream; the first LATEST_LAG + 1 are its value so many rows ago.
NOW = 0
PREVIOUS = 1
CHANGE = LATEST_LAG + 1  # from the previous row to now
PREVIOUS_CHANGE = LATEST_LAG + 2

Floats = NDArray[np.float64]


class _Statistics(NamedTuple):
    """Statistics of the V variables of D columns in recorded rows."""

    rows: int
    mean: Floats  # (V, D)
    spread: Floats  # (V, D) standard deviations
    correlation: Floats  # (V, D, V, D) 0 with what is constant


class _Response(NamedTuple):
    """How one sense responds to one number of the action; the defaults are of no response."""

    sense: int = -1  # column of the stream
    explained: float = 0.0  # share of the otherwise unexplained change that the action explains
    momentum: float = np.nan  # a
    pull: float = np.nan  # -c sd(x)/(b sd(u))
    follows: float = np.nan  # correlation of the sense with the action


class _Target(NamedTuple):
    """The action for which a state stays; the defaults are of what is no target."""

    sense: int = -1  # column of the stream
    slope: float = 0.0  # -c/b
    offset: float = 0.0  # -e/b


def identify_meaning(episodes: Sequence[Episode]) -> ActionMeaning:
    """Return what recorded episodes show of the numbers of their actions."""
    spec = episodes[0].spec
    variables = _variables(episodes)
    if len(variables) < FEWEST_ROWS:
        return ActionMeaning.unknown(spec.motor.shape)

    statistics = _statistics(variables)
    places, rates = _places_and_rates(spec, statistics)
    means = []
    targets = []
    for column in spec.motor:
        place = _strongest(spec, statistics, column, places)
        rate = _strongest(spec, statistics, column, rates)
        meaning = _meaning(place, rate)
        target = _Target()
        if meaning == TARGET:
            target = _target(statistics, column, place)
        if statistics.spread[NOW, column] == 0:
            meaning = KEPT
        means.append(meaning)
        targets.append(target)
    return ActionMeaning(
        means=tuple(means),
        senses=tuple(target.sense for target in targets),
        slopes=tuple(target.slope for target in targets),
        offsets=tuple(target.offset for target in targets),
    )


def _variables(episodes: Sequence[Episode]) -> Floats:
    """Return the variables (N, V, D) of recorded rows."""
    lags = np.arange(LATEST_LAG + 1)
    parts: list[Floats] = []
    for episode in episodes:
        rows = np.arange(LATEST_LAG, len(episode))
        values = episode.stream.astype(np.float64)[rows[:, None] - lags]
        changes = values[:, :2] - values[:, 1:3]
        parts.append(np.concatenate([values, changes], axis=1))
        if sum(map(len, parts)) >= MOST_EXAMINED_ROWS:
            break
    return np.concatenate(parts)


def _statistics(variables: Floats) -> _Statistics:
    """Return the statistics of variables (N, V, D)."""
    rows, *shape = variables.shape
    mean = variables.mean(axis=0)
    spread = variables.std(axis=0)
    scaled = (variables - mean) / np.where(spread > 0, spread, 1.0)
    flat = scaled.reshape(rows, -1)
    correlation = flat.T @ flat / rows
    np.fill_diagonal(correlation, 1.0 + RIDGE)
    return _Statistics(rows, mean, spread, correlation.reshape(*shape, *shape))


def _places_and_rates(
    spec: StreamSpec, statistics: _Statistics
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the senses that are no rates, and those that are.

    A rate has the name of one, or another sense changes by it.
    """
    senses = spec.sensory
    of_changes = np.abs(statistics.correlation[CHANGE, :, NOW])  # (D, D)
    np.fill_diagonal(of_changes, 0.0)
    is_change = of_changes[senses].max(axis=0) > RATE_CORRELATION
    is_named = [SPEED_NAME.fullmatch(label) is not None for label in spec.labels]
    is_rate = np.logical_or(is_change, is_named)[senses]
    return senses[~is_rate], senses[is_rate]


def _strongest(
    spec: StreamSpec, statistics: _Statistics, column: int, senses: NDArray[np.intp]
) -> _Response:
    """Return the response of the one of ``senses`` (S,) that the action in a column moves most."""
    strongest = _Response()
    most = 0.0
    _, bracket, element = spec.labels[column].partition("[")
    for sense in senses.tolist():
        preference = 1.0
        if spec.labels[sense].endswith(bracket + element):
            preference = OWN_PREFERENCE
        for lag in range(LATEST_LAG + 1):
            response = _response(statistics, sense, column, lag)
            strength = response.explained * preference
            if strength > most:
                strongest = response
                most = strength
    return strongest


def _meaning(place: _Response, rate: _Response) -> str:
    """Return the meaning of a number of the action that moves a place, a rate, both, or none."""
    if place.pull >= TARGET_PULL and place.follows >= TARGET_CORRELATION:
        return TARGET
    if rate.pull < TARGET_PULL or place.momentum > COASTING_MOMENTUM:
        return TORQUE
    if abs(place.pull) <= DELTA_PULL:
        return DELTA
    if rate.follows >= TARGET_CORRELATION:
        return VELOCITY
    return UNKNOWN


def _response(statistics: _Statistics, sense: int, column: int, lag: int) -> _Response:
    """Return how a sense responds to an action that is ``lag`` rows old.

    With the precision matrix P of inputs i and change y, the weights are w_i = -P_iy/P_yy, their
    squared partial correlations w_i² P_yy/P_ii, and N squared standard errors P_ii/P_yy - w_i².
    """
    variables = [PREVIOUS_CHANGE, lag, PREVIOUS, CHANGE]
    columns = [sense, column, sense, sense]
    correlation = statistics.correlation[variables, columns][:, variables, columns]  # (4, 4)
    precision = np.linalg.inv(correlation)
    *variance, certainty = np.diag(precision)
    momentum, moves, returns = -precision[:3, 3] / certainty
    explained = moves**2 * certainty / variance[1]
    least_certain = CERTAIN**2 / statistics.rows
    if explained < max(LEAST_EXPLAINED, least_certain):
        return _Response()

    pull = -returns / moves
    return_variance = variance[2] / certainty - returns**2
    pull_variance = return_variance / moves**2 / statistics.rows
    least_pull = max(abs(pull), DELTA_PULL)
    if CERTAIN**2 * pull_variance > least_pull**2:
        return _Response()

    return _Response(
        sense=sense,
        explained=explained,
        momentum=momentum,
        pull=pull,
        follows=statistics.correlation[NOW, sense, lag, column],
    )


def _target(statistics: _Statistics, column: int, place: _Response) -> _Target:
    """Return the action in a column for which a place stays, in a usual unit where one is near."""
    mean = statistics.mean[NOW]
    spread = statistics.spread[NOW]
    slope = place.pull * spread[column] / spread[place.sense]
    for usual in USUAL_SLOPES:
        if abs(slope / usual - 1) < NEAR_USUAL:
            slope = usual
    offset = mean[column] - slope * mean[place.sense]
    usual_size = spread[column] + abs(mean[column])
    if abs(offset) < NEAR_USUAL * usual_size:
        offset = 0.0
    return _Target(place.sense, float(slope), float(offset))
