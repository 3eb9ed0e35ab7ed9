"""Features of an arm for a linear model of its torques: friction by speed, and weight by the sines of angles.

    tanh(v/w s)       w ∈ {0.01, 0.1, 1}, of each speed v of spread s
    sin, cos          of angles q, of q_2 + q_3, …, and products of two of them
    g, M q̈ + c        what the links weigh on each joint, by a body model (``body_model``)

Motor current is torque plus what the sign of the speed says, and weight is a sum of products of sines of angles along
the chain: a linear model can say neither without. Source: Stribeck friction smoothed by tanh: Makkar et al. 2005.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.column_names import POSITION_NAME, SPEED_NAME, ratio
from asm_gym.detection.channel_columns import columns_where
from asm_gym.monitors.torque.body_model import BodyModel, JointMotion
from asm_gym.spec import LOG, StreamSpec

Floats = NDArray[np.float64]

TORQUE_NAME = re.compile(r"(.*[^a-z])?(efforts?|torques?|currents?|curr|tau|iq)([^a-z].*)?")
COMMANDED_NAME = re.compile(r"(.*[^a-z])?(target|desired|computed)([^a-z].*)?")

WIDTHS = (0.01, 0.1, 1.0)  # w, shares of a speed's spread
MOST_ANGLES = 12  # of more angles no sines are taken: their products would be too many
# Angles from the second on that are summed: shoulder, elbow and wrist often have parallel axes.
LONGEST_SUM = 3


class PhysicalRows(NamedTuple):
    """N rows of the X senses, in their own units."""

    values: Floats  # (N, X)
    changes: Floats  # (N, X) standardised
    spread: Floats  # (X,) of the values
    rate: Floats  # (X,) rate of a change of 1 [1/s]


@dataclass(frozen=True, eq=False)
class ArmFeatures:
    """Features that are derived from the speeds and angles among X senses.

    Attributes:
        senses: X.
        speeds: (S,) senses that are speeds, or positions, whose changes are.
        angles: (J,) senses that are angles, along the chain.
        from_changes: speeds are changes of positions.
        radians: (J,) each angle's unit [rad].
        body: stands beside the sines; None without a body model.
    """

    senses: int
    speeds: NDArray[np.intp]
    angles: NDArray[np.intp]
    from_changes: bool
    radians: Floats
    body: BodyModel | None = None

    @classmethod
    def of(cls, spec: StreamSpec, urdf: str = "") -> Self:
        """Return the features of a stream, by the names of its channels.

        Raises:
            ValueError: the text ``urdf`` is no body model of the joints that are sensed.
        """
        positions = named_columns(spec, POSITION_NAME)
        speeds = named_columns(spec, SPEED_NAME)
        from_changes = not len(speeds)
        if from_changes:
            speeds = positions
        angles = positions
        if len(positions) > MOST_ANGLES:
            angles = positions[:0]
        radians = [ratio(spec.units[i], "rad") or 1.0 for i in angles]
        body = None
        if urdf:
            _check_joints(len(angles), len(speeds))
            body = BodyModel.of(urdf, [spec.labels[i] for i in angles])
        return cls(
            senses=len(spec.sensory),
            speeds=np.searchsorted(spec.sensory, speeds),
            angles=np.searchsorted(spec.sensory, angles),
            from_changes=from_changes,
            radians=np.array(radians),
            body=body,
        )

    @cached_property
    def sources(self) -> NDArray[np.bool_]:
        """(M, X) which senses each feature is made of."""
        every_sense = np.arange(self.senses)
        of_speed = self.speeds[:, None] == every_sense  # (S, X)
        of_angle = self.angles[:, None] == every_sense  # (J, X)
        parts = [of_speed] * len(WIDTHS)
        joints = len(self.angles)
        if self.body is not None:
            of_weight = of_angle.any(axis=0)
            of_motion = of_weight | of_speed.any(axis=0)
            parts += [of_weight] * joints + [of_motion] * joints

        of_single = np.vstack([of_angle, of_angle])
        last = min(joints, LONGEST_SUM + 1)
        of_sums = [of_angle[1:end].any(axis=0) for end in range(3, last + 1)]
        first, second = self._pairs
        of_products = of_single[first] | of_single[second]
        return np.vstack([*parts, of_single, *of_sums, *of_sums, of_products])

    @cached_property
    def _pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """The sines and cosines of single angles that are multiplied (P,), (P,)."""
        return np.triu_indices(2 * len(self.angles))

    def friction(self, rows: PhysicalRows) -> list[Floats]:
        """Return smooth signs (N, S) of the speeds in rows, for each of ``WIDTHS``."""
        if self.from_changes:
            speed = rows.changes[:, self.speeds]
        else:
            speed = rows.values[:, self.speeds] / rows.spread[self.speeds]
        return [np.tanh(speed / width) for width in WIDTHS]

    def __call__(self, rows: PhysicalRows) -> Floats:
        """Return the features (N, M) of rows."""
        parts = self.friction(rows)
        if self.body is not None:
            parts += self.body.torques(self.motion(rows))
        if len(self.angles):
            parts += self._weight(rows.values[:, self.angles] * self.radians)
        return np.hstack(parts)

    def _weight(self, angle: Floats) -> list[Floats]:
        """Return sines and cosines of angles (N, J) [rad], of their sums, and products of the former."""
        single = np.hstack([np.sin(angle), np.cos(angle)])
        summed = angle[:, 1 : LONGEST_SUM + 1]
        sums = np.cumsum(summed, axis=1)[:, 1:]
        first, second = self._pairs
        products = single[:, first] * single[:, second]
        return [single, np.sin(sums), np.cos(sums), products]

    def motion(self, rows: PhysicalRows) -> JointMotion:
        """Return the motion of the joints in rows."""
        angle = rows.values[:, self.angles] * self.radians
        rates = rows.changes * rows.rate
        rate = rates[:, self.speeds] * self.radians
        if self.from_changes:
            return JointMotion(angle, speed=rate, acceleration=np.zeros_like(angle))
        speed = rows.values[:, self.speeds] * self.radians
        return JointMotion(angle, speed=speed, acceleration=rate)


def _check_joints(angles: int, speeds: int) -> None:
    """Raise ValueError unless each joint has an angle and a speed."""
    if not speeds == angles > 0:
        raise ValueError(
            f"a body model needs an angle and a speed of each joint, among {MOST_ANGLES} at most; "
            f"by their names {angles} numbers are angles and {speeds} are speeds; leave out "
            "others, as --ignore '*finger*' does"
        )


def named_columns(spec: StreamSpec, pattern: re.Pattern[str]) -> NDArray[np.intp]:
    """Return the columns of senses whose channel's name matches."""
    columns = columns_where(spec, lambda channel: bool(pattern.fullmatch(channel.name.lower())))
    return np.intersect1d(columns, spec.sensory)


def torque_columns(spec: StreamSpec) -> NDArray[np.intp]:
    """Return the columns of measured torques or currents, by their names."""
    return np.setdiff1d(named_columns(spec, TORQUE_NAME), named_columns(spec, COMMANDED_NAME))


def position_columns(spec: StreamSpec) -> NDArray[np.intp]:
    """Return the columns of measured positions, by their names."""
    return np.setdiff1d(named_columns(spec, POSITION_NAME), named_columns(spec, COMMANDED_NAME))


def torques_with_speeds(spec: StreamSpec) -> NDArray[np.intp]:
    """Return (J, 2) columns of torques and of their joints' speeds, where they belong together one by one."""
    torques = torque_names(spec)
    torques = torques[np.isin(torques, spec.sensory)]
    speeds = named_columns(spec, SPEED_NAME)
    if len(torques) == len(speeds):
        return np.stack([torques, speeds], axis=1)
    pairs: list[tuple[int, int]] = []
    channel_of_speed = None
    for channel in spec.channels:
        columns = np.arange(spec.size)[spec.slices[channel.name]]
        if channel_of_speed is None and np.isin(columns, speeds).all():
            channel_of_speed = columns  # the first: that of the joints
    if channel_of_speed is None:
        return np.zeros((0, 2), np.intp)
    for channel in spec.channels:
        columns = np.arange(spec.size)[spec.slices[channel.name]]
        if len(columns) == len(channel_of_speed) and np.isin(columns, torques).all():
            pairs += zip(columns.tolist(), channel_of_speed.tolist(), strict=True)
    return np.array(pairs, np.intp).reshape(-1, 2)


def torque_names(spec: StreamSpec) -> NDArray[np.intp]:
    """Return the columns of all torques or currents by their names, sensed and commanded."""
    return columns_where(spec, lambda channel: bool(TORQUE_NAME.fullmatch(channel.name.lower())))


def motion_columns(spec: StreamSpec) -> NDArray[np.intp]:
    """Return the columns of positions and speeds, by their names."""
    return np.union1d(named_columns(spec, POSITION_NAME), named_columns(spec, SPEED_NAME))


def judged_by_values(spec: StreamSpec) -> bool:
    """Return whether a memory of this stream judges values by default.

    It does where the stream has torques, currents or efforts, by the names of its channels. A
    simulation that also measures contact itself, by a wrist sensor or as external torque, is left
    to changes: there contact shows a held push. In a log (``spec.source`` of ``"table"``) such
    channels are estimates of the robot's own controller, and values are judged beside them.
    """
    measures_contact = any(
        channel.group == "wrench" or "external" in channel.name for channel in spec.channels
    )
    is_log = spec.source == LOG
    return len(torque_columns(spec)) > 0 and (is_log or not measures_contact)
