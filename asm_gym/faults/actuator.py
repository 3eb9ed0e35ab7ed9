"""Motors, joints and grippers that do not do what they are told."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults.fault import (
    Clock,
    Edit,
    EditingFault,
    Fault,
    Floats,
    HookedFault,
    JointFault,
    within,
)


class MotorFault(JointFault, EditingFault):
    """One that edits a joint or its motor."""

    channels = (
        "measured_torque",
        "commanded_torque",
        "external_torque",
        "external_torque_peak",
        "joint_velocity",
        "joint_position",
    )


class WeakJoint(MotorFault):
    """Reduce the torque of a ``joint``'s motor to a share ``strength``; 0 is a dead motor."""

    strength: float = within(0.5, low=0, high=1)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        gears = env.simulation.model.actuator_gear
        motor = (int(env.simulation.motors[self.joint]), 0)
        loss = 1.0 - self.strength
        return [(gears, [motor], lambda gear: gear * (1.0 - loss))]


class JointFriction(MotorFault):
    """Stiffen a ``joint`` by dry friction of ``newton_metres`` and ``viscous`` friction [N m s/rad].

    A thousand newton metres are beyond every motor: the joint is blocked.
    """

    newton_metres: float = within(4.0, low=0, high=1e4)
    viscous: float = within(2.0, low=0, high=1e4)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        model = env.simulation.model
        dof = int(env.simulation.dofs[self.joint])
        return [
            (model.dof_frictionloss, [dof], lambda friction: friction + self.newton_metres),
            (model.dof_damping, [dof], lambda damping: damping + self.viscous),
        ]


class Backlash(JointFault, HookedFault):
    """Add play of ±``gap`` [rad] to a joint's gear: its encoder follows only after the joint has crossed it."""

    hooks = "corruptions"

    gap: float = within(0.02, low=0, high=3.2)

    def hook(self, env: RobosuiteEnv, clock: Clock) -> Callable[[Floats], None]:
        position = self.element(env, "joint_position")
        reading = float(env.measured[position])

        def play(row: Floats) -> None:
            nonlocal reading
            least = row[position] - self.gap
            most = row[position] + self.gap
            reading = float(np.clip(reading, least, most))
            row[position] = reading

        return play


class GripperFault(Fault):
    """One that acts on the grippers."""

    groups = ("gripper", "wrench")

    def check(self, env: RobosuiteEnv) -> None:
        if not env.gripper_actions:
            raise ValueError(f"{env.task.name} has no gripper that {self.name} could act on")


class GripperOpens(GripperFault, HookedFault):
    """Open the grippers, and keep them open whatever their command."""

    hooks = "deliveries"

    def hook(
        self, env: RobosuiteEnv, clock: Clock
    ) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
        def deliver(action: NDArray[np.float32]) -> NDArray[np.float32]:
            opened = action.copy()
            opened[list(env.gripper_actions)] = -1.0
            return opened

        return deliver


class WeakGripper(GripperFault, EditingFault):
    """Reduce the force of the grippers to a share ``strength``."""

    strength: float = within(0.2, low=0, high=1)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        model = env.simulation.model
        loss = 1.0 - self.strength
        motors: list[int] = []
        for robot, arm in env.simulation.parts:
            motors += map(int, robot._ref_joint_gripper_actuator_indexes[arm] or ())

        def weaken(nominal: Floats) -> Floats:
            return nominal * (1.0 - loss)

        return [(model.actuator_gainprm, motors, weaken), (model.actuator_biasprm, motors, weaken)]
