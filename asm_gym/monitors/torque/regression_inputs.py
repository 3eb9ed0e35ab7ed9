"""What values are regressed on, and which of it tells each value: not its own past, and of a torque its own arm.

    z_t = [x_t, Δ_t, x_{t-l}, φ_t, u_t, 1]      X values, their changes, values l rows before, M features, A commands

``InputColumns`` says where each part is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.monitors.torque.arm_features import WIDTHS, ArmFeatures

Floats = NDArray[np.float64]
Places = NDArray[np.intp]


class RegressionRows(NamedTuple):
    """N rows as regression reads them, all standardised."""

    values: Floats  # (N, X)
    changes: Floats  # (N, X)
    before: Floats  # (N, X) values l rows before
    commands: Floats  # (N, A + 1) with a 1


def inputs_of(rows: RegressionRows, features: Floats) -> Floats:
    """Return the inputs (N, I) of regression for rows with standardised features (N, M)."""
    return np.hstack([rows.values, rows.changes, rows.before, features, rows.commands])


@dataclass(frozen=True, eq=False)
class InputColumns:
    """Where each part of the inputs is: columns of ``inputs_of``.

    Attributes:
        values: (X,)
        changes: (X,)
        before: (X,) of the values before.
        features: (M,)
        commands: (A + 1,)
    """

    values: Places
    changes: Places
    before: Places
    features: Places
    commands: Places

    @classmethod
    def of(cls, senses: int, features: int, commands: int) -> Self:
        """Return where the parts are of so many senses, features and commands."""
        ends = np.cumsum([senses, senses, senses, features])
        parts = np.split(np.arange(ends[-1] + commands, dtype=np.intp), ends)
        return cls(
            values=parts[0],
            changes=parts[1],
            before=parts[2],
            features=parts[3],
            commands=parts[4],
        )

    def withheld(self, groups: Places, features: ArmFeatures) -> list[Places]:
        """Return the inputs that hold a group's own values, which it is not predicted from.

        Args:
            groups: (X,) the group of each sense.
            features: of the arm.

        Returns:
            columns, for each group. Values before are withheld from all: a value is predicted from this row alone.
        """
        found = []
        for group in range(int(groups.max()) + 1):
            own = groups == group
            own_features = features.sources[:, own].any(axis=1)
            columns = [
                self.values[own],
                self.changes[own],
                self.before,
                self.features[own_features],
            ]
            found.append(np.hstack(columns))
        return found

    def of_joints(self, features: ArmFeatures) -> list[list[Places]]:
        """Return, for each joint, the sets of inputs that model the arm at it.

        All hold the friction of the joint, and commands; besides weight by sines and accelerations, or weight and
        motion by the body and its own acceleration, or all of these.
        """
        joints = len(features.speeds)
        has_body = features.body is not None
        own_parts = len(WIDTHS) + 2 * has_body  # friction, and weight and motion by the body
        # Each of them has a feature of every joint; the sines follow.
        of_joints = self.features[: joints * own_parts].reshape(own_parts, joints)
        sines = self.features[joints * own_parts :]
        accelerations = self.changes[features.speeds]
        speeds = self.values[features.speeds]
        if features.from_changes:
            speeds = accelerations
        found = []
        for joint in range(joints):
            friction = of_joints[: len(WIDTHS), joint]
            body = of_joints[len(WIDTHS) :, joint]
            common = [speeds[[joint]], friction, self.commands]
            by_sines = [sines, accelerations]
            by_body = [body, accelerations[[joint]]]
            candidates = [[*common, *by_sines]]
            if has_body:
                candidates += [[*common, *by_body], [*common, *by_body, *by_sines]]
            found.append([np.unique(np.hstack(one)) for one in candidates])
        return found
