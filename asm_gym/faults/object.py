"""Faults of a task's objects: they slip, are snatched, moved, heavier or smoother than usual, or missing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import numpy as np

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults.base import (
    Apply,
    Edit,
    EditingFault,
    Fault,
    Floats,
    Vector3,
    along,
    data_of,
    group_labels,
    model_of,
    within,
)
from asm_gym.validation import check_numbers

_AWAY = np.array([8.0, 8.0, 0.5])
"""Where a missing object lies [m]."""


def movable(env: RobosuiteEnv) -> dict[str, int]:
    """Return the joints of the objects that can be moved about, by name: each body with a free joint."""
    model = model_of(env)
    free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    return {model.body(int(model.jnt_bodyid[j])).name.removesuffix("_main"): j for j in free}


class ObjectFault(Fault):
    """One that acts on an ``object``, such as ``cube``; on the first of the task where empty."""

    object: str = ""

    def check(self, env: RobosuiteEnv) -> None:
        self.joint_of(env)

    def joint_of(self, env: RobosuiteEnv) -> int:
        """Return the object's free joint."""
        found = movable(env)
        if not found:
            raise ValueError(f"{env.task.name} has no loose object that {self.name} could act on")
        if self.object:
            if self.object not in found:
                raise ValueError(f"unknown object {self.object!r}; known: {', '.join(found)}")
            return found[self.object]
        # Those out of play lie metres away.
        near = [j for j in found.values() if np.abs(_position(env, j)[:2]).max() < 2.0]
        return near[0] if near else next(iter(found.values()))

    def body_of(self, env: RobosuiteEnv) -> int:
        """Return the object's body."""
        return int(model_of(env).jnt_bodyid[self.joint_of(env)])

    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        return group_labels(env, "gripper", "wrench", "torque", "object")

    def friction_of(self, env: RobosuiteEnv) -> list[tuple[int, slice]]:
        """Return the indices in ``geom_friction`` of the shapes that the object touches others with."""
        model = model_of(env)
        own = model.body_rootid[model.geom_bodyid] == model.body_rootid[self.body_of(env)]
        touching = (model.geom_contype | model.geom_conaffinity) != 0
        return [(int(g), slice(0, 1)) for g in np.flatnonzero(own & touching)]

    def move(self, env: RobosuiteEnv, position: Floats) -> None:
        """Put the object elsewhere, at rest."""
        joint = self.joint_of(env)
        _position(env, joint)[:] = position
        start = model_of(env).jnt_dofadr[joint]
        data_of(env).qvel[start : start + 6] = 0.0
        # Contacts and the solver's first guess belong to the place where it was.
        mujoco.mj_forward(model_of(env), data_of(env))


def _position(env: RobosuiteEnv, joint: int) -> Floats:
    """Return a view of the position (3,) of a free joint [m]."""
    start = model_of(env).jnt_qposadr[joint]
    position: Floats = data_of(env).qpos[start : start + 3]
    return position


class Slip(ObjectFault, EditingFault):
    """The ``object`` turns slippery: ``friction`` is the coefficient that is left."""

    friction: float = within(0.05, above=0, high=10)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        model, entries = model_of(env), self.friction_of(env)
        return [
            (model.geom_friction, list(entries), lambda i, mu: mu * (self.friction / mu) ** i),
            # Between two surfaces the higher friction counts, unless one has priority.
            (model.geom_priority, [geom for geom, _ in entries], lambda _, priority: priority + 1),
        ]


class Snatch(ObjectFault, EditingFault):
    """Somebody pulls at the object.

    Args:
        object: its name; the first of the task where empty.
        newtons: how hard [N].
        direction: in the world's axes; its length does not matter.
    """

    newtons: float = within(15.0, low=-1e4, high=1e4)
    direction: Vector3 = (0.0, 1.0, 0.3)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        force = self.newtons * along(self.direction)
        where = (self.body_of(env), slice(0, 3))
        return [(data_of(env).xfrc_applied, [where], lambda i, others: others + i * force)]


class Teleport(ObjectFault):
    """The ``object`` is suddenly elsewhere by ``offset`` [m], at rest; a reset puts it back."""

    graded = False

    offset: Vector3 = (0.05, 0.05, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers("offset", self.offset, 3, low=-10, high=10)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        self.move(env, _position(env, self.joint_of(env)) + np.asarray(self.offset))
        yield lambda _: None


class Missing(ObjectFault):
    """The ``object`` is gone; a reset brings it back."""

    graded = False

    def holds(self, env: RobosuiteEnv) -> frozenset[str]:
        return frozenset({f"object {model_of(env).body(self.body_of(env)).name}"})

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        self.move(env, _AWAY)
        yield lambda _: None


class Heavy(ObjectFault, EditingFault):
    """The ``object`` is heavier than it looks by so many ``kilograms``."""

    kilograms: float = within(0.5, above=0, high=1e3)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        return [(model_of(env).body_mass, [self.body_of(env)], lambda i, mass: mass + i * self.kilograms)]


class ObjectMass(ObjectFault, EditingFault):
    """The mass of the ``object`` is ``factor`` times the usual."""

    harmless = True

    factor: float = within(1.1, above=0, high=100)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        scale = self.factor - 1.0
        return [(model_of(env).body_mass, [self.body_of(env)], lambda i, mass: mass * (1.0 + i * scale))]


class ObjectFriction(ObjectFault, EditingFault):
    """The friction of the ``object`` is ``factor`` times the usual."""

    harmless = True

    factor: float = within(0.9, low=0, high=100)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        scale = self.factor - 1.0
        return [(model_of(env).geom_friction, [*self.friction_of(env)], lambda i, mu: mu * (1.0 + i * scale))]
