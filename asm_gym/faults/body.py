"""Faults that push, pull, hold or burden the robot's body."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
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
    body_id,
    steady_force,
    within,
)

HAND = "robot0_right_hand"


class BodyFault(Fault):
    """One that acts on a ``body`` of the model, such as ``robot0_link5``."""

    groups = ("torque", "wrench")

    body: str = "robot0_link5"

    def check(self, env: RobosuiteEnv) -> None:
        body_id(env, self.body)


class Push(BodyFault, EditingFault):
    """Push a ``body`` with a steady force of ``newtons`` along a ``direction`` in the world's axes."""

    newtons: float = within(20.0, low=-1e4, high=1e4)
    direction: Vector3 = (0.0, 1.0, 0.0)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        return [steady_force(env, body_id(env, self.body), self.newtons, self.direction)]


class Payload(BodyFault, EditingFault):
    """Attach a mass of ``kilograms`` to a ``body``, unknown to the controller."""

    body: str = HAND
    kilograms: float = within(1.0, above=0, high=1e3)

    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        masses = env.simulation.model.body_mass
        return [(masses, [body_id(env, self.body)], lambda mass: mass + self.kilograms)]


Force = Callable[[Floats, Floats], Floats]
"""(3,) force on a body [N] from its position (3,) [m] and velocity (3,) [m/s]."""


class ForceField(BodyFault):
    """A force that follows the body's position and velocity, brought up to date in every physics substep."""

    @abstractmethod
    def force(self, env: RobosuiteEnv, position: Floats, velocity: Floats) -> Force:
        """Return the force, from where the body is at the onset."""

    @contextmanager
    def applied(self, env: RobosuiteEnv, clock: Clock) -> Iterator[None]:
        data = env.simulation.data
        body = body_id(env, self.body)
        force = self.force(env, data.xipos[body].copy(), _velocity(env, body))
        with env.edits.edit(data.xfrc_applied, (body, slice(0, 3))) as change:

            def update(substep: int) -> None:
                now = force(data.xipos[body], _velocity(env, body))
                change(lambda others: others + now)

            env.substep_hooks.append(update)
            try:
                yield
            finally:
                env.substep_hooks.remove(update)


def _velocity(env: RobosuiteEnv, body: int) -> Floats:
    """Return the velocity (3,) of a body [m/s]."""
    twist = np.zeros(6)
    kind = mujoco.mjtObj.mjOBJ_BODY
    simulation = env.simulation
    mujoco.mj_objectVelocity(simulation.model, simulation.data, kind, body, twist, 0)
    return twist[3:]


class Collision(ForceField):
    """Put a stiff wall in the way of a ``body``, ``gap`` [m] ahead of it: F = k·depth - d·v while inside.

    With ``stiffness`` k [N/m] and ``damping`` d [N s/m] on the way in, it pushes back with ``newtons`` at most.
    """

    body: str = HAND
    gap: float = within(0.005, low=0, high=10)
    stiffness: float = within(3000.0, low=0, high=1e5)
    damping: float = within(50.0, low=0, high=1e4)
    newtons: float = within(150.0, low=0, high=1e4)

    def force(self, env: RobosuiteEnv, position: Floats, velocity: Floats) -> Force:
        speed = float(np.linalg.norm(velocity))
        into = np.array([0.0, 0.0, -1.0])
        if speed > 1e-3:
            into = velocity / speed
        wall = float(position @ into) + self.gap

        def push(at: Floats, v: Floats) -> Floats:
            depth = float(at @ into) - wall
            size = 0.0
            if depth > 0:
                speed_inwards = max(0.0, float(v @ into))
                size = self.stiffness * depth + self.damping * speed_inwards
            return -min(size, self.newtons) * into

        return push


class CablePull(ForceField):
    """Pull by an elastic cable that has caught: ``stiffness`` [N/m] beyond ``slack`` [m], at most ``newtons``."""

    body: str = HAND
    stiffness: float = within(300.0, low=0, high=1e5)
    slack: float = within(0.01, low=0, high=10)
    newtons: float = within(60.0, low=0, high=1e4)

    def force(self, env: RobosuiteEnv, position: Floats, velocity: Floats) -> Force:
        def pull(at: Floats, _: Floats) -> Floats:
            away = at - position
            length = float(np.linalg.norm(away))
            stretch = max(0.0, length - self.slack)
            size = min(self.stiffness * stretch, self.newtons)
            return -size * away / max(length, 1e-9)

        return pull


class HeldByPerson(ForceField):
    """Hold the arm as a person does, with at most ``newtons``: spring [N/m] and damper [N s/m] to a hand that sways.

    The hand moves by ``sway`` [m], at about half a hertz.
    """

    stiffness: float = within(500.0, low=0, high=1e5)
    damping: float = within(20.0, low=0, high=1e4)
    newtons: float = within(60.0, low=0, high=1e4)
    sway: float = within(0.02, low=0, high=10)

    def force(self, env: RobosuiteEnv, position: Floats, velocity: Floats) -> Force:
        data = env.simulation.data
        start = float(data.time)
        direction = self.rng().standard_normal(3)
        direction /= np.linalg.norm(direction)

        def hold(at: Floats, v: Floats) -> Floats:
            angle = np.pi * (data.time - start)
            hand = position + self.sway * np.sin(angle) * direction
            pull: Floats = self.stiffness * (hand - at) - self.damping * v
            size = max(float(np.linalg.norm(pull)), 1e-9)
            return min(1.0, self.newtons / size) * pull

        return hold
