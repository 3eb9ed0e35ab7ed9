"""What pushes, pulls, holds or burdens the robot's body."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults.base import (
    Apply,
    Fault,
    Vector3,
    along,
    body_id,
    data_of,
    group_labels,
    listed,
    model_of,
    within,
)

Force = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""(3,) force on a body [N] from its position [m] and velocity [m/s]."""


@dataclass(frozen=True, kw_only=True)
class _OnBody(Fault):
    """Acts on one body.

    Args:
        body: a body of the model, such as ``robot0_link5``.
    """

    body: str = "robot0_link5"

    def check(self, env: RobosuiteEnv) -> None:
        body_id(env, self.body)

    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        return group_labels(env, "torque", "wrench")


@contextmanager
def _force_field(env: RobosuiteEnv, body: int, force: Force) -> Iterator[None]:
    """A force that follows the body's position and velocity, brought up to date in every physics substep."""
    model, data = model_of(env), data_of(env)
    velocity = np.zeros(6)
    with env.edits.edit(data.xfrc_applied, (body, slice(0, 3))) as change:

        def update(_: int = 0) -> None:
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
            now = force(data.xipos[body], velocity[3:])
            change(lambda others: others + now)

        update()
        with listed(env.substep_hooks, update):
            yield


@dataclass(frozen=True, kw_only=True)
class Push(_OnBody):
    """A steady force on a body of the robot, or of anything else.

    Args:
        body: a body of the model, such as ``robot0_link5``.
        newtons: how hard [N].
        direction: in the world's axes; its length does not matter.
    """

    newtons: float = within(20.0, low=-1e4, high=1e4)
    direction: Vector3 = (0.0, 1.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        along("direction", self.direction)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        force = self.newtons * along("direction", self.direction)
        with env.edits.edit(data_of(env).xfrc_applied, (body_id(env, self.body), slice(0, 3))) as change:
            yield lambda i: change(lambda others: others + i * force)


@dataclass(frozen=True, kw_only=True)
class Payload(_OnBody):
    """A mass that nobody told the controller about.

    Args:
        body: where it hangs.
        kilograms: how much [kg].
    """

    body: str = "robot0_right_hand"
    kilograms: float = within(1.0, above=0, high=1e3)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        with env.edits.edit(model_of(env).body_mass, body_id(env, self.body)) as change:
            yield lambda i: change(lambda mass: mass + i * self.kilograms)


@dataclass(frozen=True, kw_only=True)
class Collision(_OnBody):
    """An obstacle that appears in the way: a stiff wall, across the direction in which the body moves at the onset.

    A penalty contact on the body itself, F = k·depth - d·v while the body is inside: what a collision does to the arm,
    without a shape that would have to be compiled into the model.

    Args:
        body: what runs into it.
        gap: from the body to the wall at the onset [m].
        stiffness: k [N/m].
        damping: d, on the way in [N s/m].
        newtons: the most it pushes back with [N].
    """

    graded = False

    body: str = "robot0_right_hand"
    gap: float = within(0.005, low=0, high=10)
    stiffness: float = within(3000.0, low=0, high=1e5)
    damping: float = within(50.0, low=0, high=1e4)
    newtons: float = within(150.0, low=0, high=1e4)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        model, data, body = model_of(env), data_of(env), body_id(env, self.body)
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
        speed = float(np.linalg.norm(velocity[3:]))
        into = velocity[3:] / speed if speed > 1e-3 else np.array([0.0, 0.0, -1.0])
        wall = float(data.xipos[body] @ into) + self.gap

        def force(position: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
            depth = float(position @ into) - wall
            size = self.stiffness * depth + self.damping * max(0.0, float(v @ into)) if depth > 0 else 0.0
            return -min(size, self.newtons) * into

        with _force_field(env, body, force):
            yield lambda _: None


@dataclass(frozen=True, kw_only=True)
class CablePull(_OnBody):
    """A cable that has caught: elastic, and taut from the onset on.

    Args:
        body: what it is tied to.
        stiffness: [N/m].
        slack: how far the body may go before the cable is taut [m].
        newtons: the most it pulls with [N].
    """

    body: str = "robot0_right_hand"
    stiffness: float = within(300.0, low=0, high=1e5)
    slack: float = within(0.01, low=0, high=10)
    newtons: float = within(60.0, low=0, high=1e4)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        body = body_id(env, self.body)
        anchor = data_of(env).xipos[body].copy()
        share = 0.0

        def force(position: NDArray[np.float64], _: NDArray[np.float64]) -> NDArray[np.float64]:
            away = position - anchor
            length = float(np.linalg.norm(away))
            pull = min(self.stiffness * max(0.0, length - self.slack), self.newtons)
            back: NDArray[np.float64] = -share * pull * away / max(length, 1e-9)
            return back

        def apply(intensity: float) -> None:
            nonlocal share
            share = intensity

        with _force_field(env, body, force):
            yield apply


@dataclass(frozen=True, kw_only=True)
class HeldByPerson(_OnBody):
    """A person holds the arm: a spring and damper to a hand that sways.

    Args:
        body: where it is held.
        stiffness, damping: of the grip [N/m, N s/m].
        newtons: the most a person holds with [N].
        sway: how far the person's hand moves [m], at about half a hertz.
    """

    stiffness: float = within(500.0, low=0, high=1e5)
    damping: float = within(20.0, low=0, high=1e4)
    newtons: float = within(60.0, low=0, high=1e4)
    sway: float = within(0.02, low=0, high=10)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        body, data = body_id(env, self.body), data_of(env)
        hold, start = data.xipos[body].copy(), float(data.time)
        direction = self.rng().standard_normal(3)
        direction /= np.linalg.norm(direction)
        share = 0.0

        def force(position: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
            hand = hold + self.sway * np.sin(np.pi * (data.time - start)) * direction
            pull: NDArray[np.float64] = self.stiffness * (hand - position) - self.damping * v
            size = max(float(np.linalg.norm(pull)), 1e-9)
            held_by: NDArray[np.float64] = share * min(1.0, self.newtons / size) * pull
            return held_by

        def apply(intensity: float) -> None:
            nonlocal share
            share = intensity

        with _force_field(env, body, force):
            yield apply


def touches_body(fault: Fault) -> bool:
    """Whether it acts on the robot's body from outside."""
    return isinstance(fault, _OnBody)
