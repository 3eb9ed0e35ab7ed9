"""What happens to the objects of a task: they slip, are snatched, moved, heavier than expected, or missing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults.base import Apply, Fault, Vector3, along, data_of, group_labels, model_of, within
from asm_gym.validation import check_numbers

_AWAY = np.array([8.0, 8.0, 0.5])  # where a missing object lies [m]


def movable(env: RobosuiteEnv) -> dict[str, int]:
    """The objects that can be moved about, by name: each body with a free joint."""
    model = model_of(env)
    free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    return {model.body(int(model.jnt_bodyid[j])).name.removesuffix("_main"): j for j in free}


@dataclass(frozen=True, kw_only=True)
class ObjectFault(Fault):
    """One that acts on an object.

    Args:
        object: its name, such as ``cube``; the first of the task where empty.
    """

    object: str = ""

    def check(self, env: RobosuiteEnv) -> None:
        self.joint_of(env)

    def joint_of(self, env: RobosuiteEnv) -> int:
        """The object's free joint."""
        found = movable(env)
        if not found:
            raise ValueError(f"{env.task.name} has no loose object that {self.name} could act on")
        if self.object:
            if self.object not in found:
                raise ValueError(f"unknown object {self.object!r}; known: {', '.join(found)}")
            return found[self.object]
        # Those out of play lie metres away.
        near = [j for j in found.values() if np.abs(self._place(env, j)[:2]).max() < 2.0]
        return near[0] if near else next(iter(found.values()))

    def body_of(self, env: RobosuiteEnv) -> int:
        return int(model_of(env).jnt_bodyid[self.joint_of(env)])

    def geoms_of(self, env: RobosuiteEnv) -> list[int]:
        """The shapes the object touches others with."""
        model = model_of(env)
        body = self.body_of(env)
        members = [b for b in range(model.nbody) if model.body_rootid[b] == model.body_rootid[body]]
        return [
            g
            for g in range(model.ngeom)
            if model.geom_bodyid[g] in members and (model.geom_contype[g] or model.geom_conaffinity[g])
        ]

    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        return group_labels(env, "gripper", "wrench", "torque", "object")

    @staticmethod
    def _place(env: RobosuiteEnv, joint: int) -> NDArray[np.float64]:
        start = model_of(env).jnt_qposadr[joint]
        place: NDArray[np.float64] = data_of(env).qpos[start : start + 3]
        return place

    def _move(self, env: RobosuiteEnv, position: NDArray[np.float64]) -> None:
        joint = self.joint_of(env)
        self._place(env, joint)[:] = position
        start = model_of(env).jnt_dofadr[joint]
        data_of(env).qvel[start : start + 6] = 0.0
        # Contacts and the solver's first guess belong to the place where it was.
        mujoco.mj_forward(model_of(env), data_of(env))


@dataclass(frozen=True, kw_only=True)
class Slip(ObjectFault):
    """The object turns slippery.

    Args:
        object: its name; the first of the task where empty.
        friction: the coefficient that is left.
    """

    friction: float = within(0.05, above=0, high=10)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        model, geoms = model_of(env), self.geoms_of(env)
        entries = [(g, slice(0, 1)) for g in geoms]
        # Between two surfaces the higher friction counts, unless one has priority.
        with (
            env.edits.edit(model.geom_friction, *entries) as change,
            env.edits.edit(model.geom_priority, *geoms) as first,
        ):
            first(lambda priority: priority + 1)
            yield lambda i: change(lambda mu: mu * (self.friction / mu) ** i)


@dataclass(frozen=True, kw_only=True)
class Snatch(ObjectFault):
    """Somebody pulls at the object.

    Args:
        object: its name; the first of the task where empty.
        newtons: how hard [N].
        direction: in the world's axes; its length does not matter.
    """

    newtons: float = within(15.0, low=-1e4, high=1e4)
    direction: Vector3 = (0.0, 1.0, 0.3)

    def __post_init__(self) -> None:
        super().__post_init__()
        along("direction", self.direction)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        force = self.newtons * along("direction", self.direction)
        with env.edits.edit(data_of(env).xfrc_applied, (self.body_of(env), slice(0, 3))) as change:
            yield lambda i: change(lambda others: others + i * force)


@dataclass(frozen=True, kw_only=True)
class Teleport(ObjectFault):
    """The object is suddenly somewhere else, at rest; a reset puts it back.

    Args:
        object: its name; the first of the task where empty.
        offset: by how much [m].
    """

    graded = False

    offset: Vector3 = (0.05, 0.05, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers("offset", self.offset, 3, low=-10, high=10)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        self._move(env, self._place(env, self.joint_of(env)) + np.asarray(self.offset))
        yield lambda _: None


@dataclass(frozen=True, kw_only=True)
class Missing(ObjectFault):
    """The object is gone; a reset brings it back."""

    graded = False

    def holds(self, env: RobosuiteEnv) -> frozenset[str]:
        return frozenset({f"object {model_of(env).body(self.body_of(env)).name}"})

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        self._move(env, _AWAY)
        yield lambda _: None


@dataclass(frozen=True, kw_only=True)
class Heavy(ObjectFault):
    """The object is heavier than it looks.

    Args:
        object: its name; the first of the task where empty.
        kilograms: by how much [kg].
    """

    kilograms: float = within(0.5, above=0, high=1e3)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        with env.edits.edit(model_of(env).body_mass, self.body_of(env)) as change:
            yield lambda i: change(lambda mass: mass + i * self.kilograms)
