"""What arms are made of, as inputs of a linear model: friction by speed, and weight by the sines of angles.

    tanh(v/w s)       w ∈ {0.01, 0.1, 1}, of each speed v of spread s
    sin, cos          of angles q, of q_2 + q_3, …, and products of two of them
    g, M q̈ + c        what the links weigh on each joint, by a body model in place of the sines (``body_model``)

Motor current is torque plus what the sign of the speed says, and weight is a sum of products of sines of angles along
the chain: a linear model can say neither without. Source: Stribeck friction smoothed by tanh: Makkar et al. 2005.
"""

from __future__ import annotations

import re
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.names import POSITION, SPEED, ratio
from asm_gym.monitors.body_model import BodyModel
from asm_gym.spec import StreamSpec

Floats = NDArray[np.float64]

_FORCE = re.compile(r"(.*[^a-z])?(efforts?|torques?|currents?|curr|tau|iq)([^a-z].*)?")
_COMMANDED = re.compile(r"(.*[^a-z])?(target|desired|computed)([^a-z].*)?")

WIDTHS = (0.01, 0.1, 1.0)  # w, shares of a speed's spread
MOST_ANGLES = 12  # of more angles no sines are taken: their products would be too many
CHAIN = 3  # angles from the second on that are summed: shoulder, elbow and wrist often turn about parallel axes


class Derived(NamedTuple):
    """Inputs that are derived from speeds and angles."""

    speeds: NDArray[np.intp]  # (S,) senses that are speeds, or whose changes are
    angles: NDArray[np.intp]  # (J,) senses that are angles, along the chain
    from_steps: bool  # speeds are changes of positions
    radians: Floats  # (J,) in one of their units
    pairs: NDArray[np.intp]  # (2, P) of sines and cosines of single angles, that are multiplied
    sources: NDArray[np.bool_]  # (M, X) which senses each derived input is made of
    links: BodyModel | None = None  # replaces the sines

    @classmethod
    def of(cls, spec: StreamSpec, urdf: str = "") -> Self:
        """Return what a stream has by its channels' names. Raises ValueError where the body model ``urdf`` misfits."""
        (moving, from_steps), angles = speeds(spec), _named(spec, POSITION)
        angles = angles if len(angles) <= MOST_ANGLES else angles[:0]
        units = [c.unit for c in spec.channels for _ in c.labels]
        radians = np.array([ratio(units[i], "rad") or 1.0 for i in angles])
        links, J = None, len(angles)
        if urdf and not len(moving) == J > 0:
            raise ValueError(
                f"a body model needs an angle and a speed of each joint, among {MOST_ANGLES} at most; by their names "
                f"{J} numbers are angles and {len(moving)} are speeds; leave out others, as --ignore '*finger*' does"
            )
        if urdf:
            links = BodyModel.of(urdf, [spec.labels[i] for i in angles])
        # (S, X), (J, X)
        of_speed, of_angle = (
            (spec.sensory == moving[:, None]),
            (spec.sensory == angles[:, None]),
        )
        if links is None:
            pairs = np.array(np.triu_indices(2 * J), np.intp)
            single = np.vstack([of_angle, of_angle])
            sums = [of_angle[1 : n + 1].any(axis=0) for n in range(2, min(J, CHAIN + 1))]
            derived = [single, *sums, *sums, single[pairs[0]] | single[pairs[1]]]
        else:
            pairs, every = np.zeros((2, 0), np.intp), of_angle.any(axis=0)
            derived = [*[every] * J, *[every | of_speed.any(axis=0)] * J]
        sources = np.vstack([of_speed] * len(WIDTHS) + derived)
        speed, angle = (np.searchsorted(spec.sensory, part) for part in (moving, angles))
        return cls(speed, angle, from_steps, radians, pairs, sources, links)

    def __call__(self, values: Floats, steps: Floats, spread: Floats, rate: Floats) -> Floats:
        """Return the derived inputs (N, M) of ``values`` (N, X) with their ``spread`` (X,).

        ``steps`` (N, X) are standardised changes; 1 is ``rate`` (X,) in a second.
        """
        speed = (
            steps[:, self.speeds]
            if self.from_steps
            else values[:, self.speeds] / spread[self.speeds]
        )
        parts = [np.tanh(speed / width) for width in WIDTHS]
        if self.links is not None:
            parts += self.links.torques(*self.motion(values, steps, spread, rate))
        elif len(self.angles):
            q = values[:, self.angles] * self.radians
            single = np.hstack([np.sin(q), np.cos(q)])
            sums = np.cumsum(q[:, 1 : CHAIN + 1], axis=1)[:, 1:]
            products = single[:, self.pairs[0]] * single[:, self.pairs[1]]
            parts += [single, np.sin(sums), np.cos(sums), products]
        return np.hstack(parts)

    def motion(
        self, values: Floats, steps: Floats, spread: Floats, rate: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return angles, speeds and accelerations (N, J) of what ``__call__`` takes."""
        q, pace = (
            values[:, self.angles] * self.radians,
            (steps * rate)[:, self.speeds] * self.radians,
        )
        return (
            (q, pace, np.zeros_like(q))
            if self.from_steps
            else (q, values[:, self.speeds] * self.radians, pace)
        )


def _named(spec: StreamSpec, pattern: re.Pattern[str]) -> NDArray[np.intp]:
    """Return the columns of senses whose channel's name matches."""
    columns = {
        i
        for n, s in spec.slices.items()
        if pattern.fullmatch(n.lower())
        for i in range(s.start, s.stop)
    }
    return np.array([i for i in spec.sensory if int(i) in columns], np.intp)


def speeds(spec: StreamSpec) -> tuple[NDArray[np.intp], bool]:
    """Return the columns that are speeds and False; or those of positions and True."""
    for pattern, from_steps in ((SPEED, False), (POSITION, True)):
        found = _named(spec, pattern)
        if len(found):
            return found, from_steps
    return np.zeros(0, np.intp), False


def forces(spec: StreamSpec) -> NDArray[np.intp]:
    """Return the columns of measured torques or currents, by their names."""
    return np.setdiff1d(_named(spec, _FORCE), _named(spec, _COMMANDED)).astype(np.intp)


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
    is_log = spec.source == "table"
    return len(forces(spec)) > 0 and (is_log or not measures_contact)


def motion(spec: StreamSpec) -> NDArray[np.intp]:
    """Return the columns of positions and speeds, by their names."""
    return np.union1d(_named(spec, POSITION), _named(spec, SPEED)).astype(np.intp)
