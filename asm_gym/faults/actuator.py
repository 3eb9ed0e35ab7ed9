"""Motors, joints and grippers that do not do what they are told."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults.base import (
    Apply,
    Edit,
    EditingFault,
    Fault,
    Floats,
    check_joint,
    group_labels,
    joint_labels,
    listed,
    model_of,
    within,
)

_TORQUES = ("measured_torque", "commanded_torque", "external_torque", "external_torque_peak")
_MOTION = ("joint_velocity", "joint_position")


class _OnJoint(Fault):
    """Acts on one joint, counted from the base, 0 first; a second arm's go on after the first one's."""

    joint: int = 3

    def check(self, env: RobosuiteEnv) -> None:
        check_joint(env, self.joint)

    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        return joint_labels(env, self.joint, *_TORQUES, *_MOTION)

    def dof(self, env: RobosuiteEnv) -> int:
        """Return the joint's index among the velocities."""
        model = model_of(env)
        return int(model.jnt_dofadr[model.actuator_trnid[env.motors[self.joint], 0]])


class WeakJoint(_OnJoint, EditingFault):
    """A ``joint`` whose motor gives only a share ``strength`` of the commanded torque; 0 is a dead motor."""

    strength: float = within(0.5, low=0, high=1)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        motor = (int(env.motors[self.joint]), 0)
        return [(model_of(env).actuator_gear, [motor], lambda i, gear: gear * (1.0 - i * (1.0 - self.strength)))]


class StuckJoint(_OnJoint, EditingFault):
    """A ``joint`` that is blocked, by friction beyond what its motor can overcome."""

    graded = False

    def holds(self, env: RobosuiteEnv) -> frozenset[str]:
        return frozenset({f"joint {self.joint}"})

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        return [(model_of(env).dof_frictionloss, [self.dof(env)], lambda _, friction: friction + 1000.0)]


class JointFriction(_OnJoint, EditingFault):
    """A ``joint`` that moves stiffly.

    Args:
        joint: counted from the base, 0 first.
        newton_metres: dry friction [N m].
        viscous: friction that grows with speed [N m s/rad].
    """

    newton_metres: float = within(4.0, low=0, high=1e4)
    viscous: float = within(2.0, low=0, high=1e4)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        model, dof = model_of(env), self.dof(env)
        return [
            (model.dof_frictionloss, [dof], lambda i, friction: friction + i * self.newton_metres),
            (model.dof_damping, [dof], lambda i, damping: damping + i * self.viscous),
        ]


class Backlash(_OnJoint):
    """Play in a joint's gear, before its encoder: the reading follows the joint only after it has crossed the gap.

    Args:
        joint: counted from the base, 0 first.
        gap: half the play [rad].
    """

    gap: float = within(0.02, low=0, high=3.2)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        position = env.measured_spec.labels.index(next(iter(joint_labels(env, self.joint, _MOTION[1]))))
        reading, half = float(env.measured[position]), 0.0

        def play(row: Floats) -> None:
            nonlocal reading
            reading = float(np.clip(reading, row[position] - half, row[position] + half))
            row[position] = reading

        def apply(intensity: float) -> None:
            nonlocal half
            half = intensity * self.gap

        with listed(env.corruptions, play):
            yield apply

    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        return joint_labels(env, self.joint, *_MOTION)


class _OnGripper(Fault):
    """Acts on the grippers."""

    def check(self, env: RobosuiteEnv) -> None:
        if not env.gripper_actions:
            raise ValueError(f"{env.task.name} has no gripper that {self.name} could act on")

    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        return group_labels(env, "gripper", "wrench")


class GripperOpens(_OnGripper):
    """The grippers open, and stay open whatever they are told."""

    graded = False

    def holds(self, env: RobosuiteEnv) -> frozenset[str]:
        return frozenset({"the grippers"})

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        where = list(env.gripper_actions)

        def deliver(action: NDArray[np.float32]) -> NDArray[np.float32]:
            opened = action.copy()
            opened[where] = -1.0
            return opened

        with listed(env.deliveries, deliver):
            yield lambda _: None


class WeakGripper(_OnGripper, EditingFault):
    """The grippers close with only a share ``strength`` of their force."""

    strength: float = within(0.2, low=0, high=1)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        model = model_of(env)
        motors = [
            int(m)
            for robot in env.robosuite_env.robots
            for arm in robot.arms
            for m in robot._ref_joint_gripper_actuator_indexes[arm] or ()
        ]

        def weaken(i: float, parameters: Floats) -> Floats:
            return parameters * (1.0 - i * (1.0 - self.strength))

        return [(model.actuator_gainprm, motors, weaken), (model.actuator_biasprm, motors, weaken)]
