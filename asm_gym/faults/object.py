"""Faults of a task's objects: they slip, are snatched, moved, heavier or smoother than usual, or missing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import numpy as np

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults.fault import (
    Clock,
    Edit,
    EditingFault,
    Fault,
    Floats,
    Vector3,
    steady_force,
    within,
)
from asm_gym.spec import HANDLED
from asm_gym.validation import check_choice

_AWAY = np.array([8.0, 8.0, 0.5])  # where a missing object lies [m]


def movable(env: RobosuiteEnv) -> dict[str, int]:
    """Return the joints of the objects that can be moved about, by name: each body with a free joint."""
    model = env.simulation.model
    joints: dict[str, int] = {}
    for joint in range(model.njnt):
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            body = model.body(int(model.jnt_bodyid[joint]))
            joints[body.name.removesuffix("_main")] = joint
    return joints


class ObjectFault(Fault):
    """One that acts on an ``object``, such as ``cube``; on the first of the task where empty."""

    groups = ("gripper", "wrench", "torque", "object", HANDLED)

    object: str = ""

    def check(self, env: RobosuiteEnv) -> None:
        self.joint_of(env)

    def joint_of(self, env: RobosuiteEnv) -> int:
        """Return the object's free joint."""
        joints = movable(env)
        if not joints:
            raise ValueError(f"{env.task.name} has no loose object that {self.name} could act on")
        if self.object:
            check_choice("object", self.object, joints)
            return joints[self.object]
        for joint in joints.values():
            # Those out of play lie metres away.
            if np.abs(_position(env, joint)[:2]).max() < 2.0:
                return joint
        return next(iter(joints.values()))

    def body_of(self, env: RobosuiteEnv) -> int:
        """Return the object's body."""
        return int(env.simulation.model.jnt_bodyid[self.joint_of(env)])

    def move(self, env: RobosuiteEnv, position: Floats) -> None:
        """Put the object elsewhere, at rest."""
        joint = self.joint_of(env)
        _position(env, joint)[:] = position
        start = env.simulation.model.jnt_dofadr[joint]
        env.simulation.data.qvel[start : start + 6] = 0.0
        # Contacts and the solver's first guess belong to the place where it was.
        mujoco.mj_forward(env.simulation.model, env.simulation.data)


def _position(env: RobosuiteEnv, joint: int) -> Floats:
    """Return a view of the position (3,) of a free joint [m]."""
    start = env.simulation.model.jnt_qposadr[joint]
    return env.simulation.data.qpos[start : start + 3]


class Slip(ObjectFault, EditingFault):
    """Make the ``object`` slippery: ``friction`` is the remaining coefficient."""

    friction: float = within(0.05, above=0, high=10)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        model = env.simulation.model
        root = model.body_rootid[self.body_of(env)]
        is_own = model.body_rootid[model.geom_bodyid] == root
        can_touch = (model.geom_contype | model.geom_conaffinity) != 0
        geoms = np.flatnonzero(is_own & can_touch).tolist()
        sliding = [(geom, slice(0, 1)) for geom in geoms]
        return [
            (model.geom_friction, sliding, lambda mu: mu * (self.friction / mu)),
            # Between two surfaces the higher friction counts, unless one has priority.
            (model.geom_priority, geoms, lambda priority: priority + 1),
        ]


class Snatch(ObjectFault, EditingFault):
    """Pull at the ``object`` with ``newtons`` along a ``direction`` in the world's axes."""

    newtons: float = within(15.0, low=-1e4, high=1e4)
    direction: Vector3 = (0.0, 1.0, 0.3)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        return [steady_force(env, self.body_of(env), self.newtons, self.direction)]


class Teleport(ObjectFault):
    """Move the ``object`` by ``offset`` [m], at rest; a reset puts it back."""

    offset: Vector3 = within((0.05, 0.05, 0.0), low=-10, high=10)

    @contextmanager
    def applied(self, env: RobosuiteEnv, clock: Clock) -> Iterator[None]:
        position = _position(env, self.joint_of(env))
        self.move(env, position + np.asarray(self.offset))
        yield


class Missing(ObjectFault):
    """Remove the ``object``; a reset brings it back."""

    @contextmanager
    def applied(self, env: RobosuiteEnv, clock: Clock) -> Iterator[None]:
        self.move(env, _AWAY)
        yield


class Heavy(ObjectFault, EditingFault):
    """Make the ``object`` heavier by ``kilograms``."""

    kilograms: float = within(0.5, above=0, high=1e3)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        masses = env.simulation.model.body_mass
        return [(masses, [self.body_of(env)], lambda mass: mass + self.kilograms)]


class ObjectMass(ObjectFault, EditingFault):
    """Multiply the mass of the ``object`` by ``factor``."""

    factor: float = within(1.1, above=0, high=100)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        masses = env.simulation.model.body_mass
        return [(masses, [self.body_of(env)], lambda mass: mass * self.factor)]
