"""The fault suite: every kind at three severities.

The joint, axis, direction or reading that a fault acts on is drawn from the episode's seed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults import action, actuator, body, object, sensor
from asm_gym.faults.base import Fault
from asm_gym.registries import Registry, target
from asm_gym.validation import check_choice

SEVERITIES = ("mild", "medium", "strong")
DEVELOPMENT, TEST = "development", "test"

GROUPS: dict[str, tuple[str, ...]] = {
    DEVELOPMENT: (
        *("push", "payload", "weak_joint", "backlash", "weak_gripper"),
        *("encoder_drift", "encoder_spikes", "encoder_delay", "torque_scale", "wrist_bias"),
        *("action_drop", "action_repeat", "action_noise", "slip", "snatch"),
    ),
    TEST: (
        *(
            "collision",
            "cable_pull",
            "held_by_person",
            "stuck_joint",
            "joint_friction",
            "gripper_opens",
        ),
        *("encoder_bias", "frozen_encoder", "encoder_noise", "encoder_dropout", "frozen_wrist"),
        *(
            "action_delay",
            "action_bias",
            "sign_flip",
            "adversary",
            "teleport",
            "heavy_object",
            "missing_object",
        ),
    ),
}
"""Kinds to choose settings by, and kinds to report: half of each family, drawn once; added kinds are in neither."""


class Drawn(NamedTuple):
    """What is drawn for an episode: the joint, axis, direction and bodies that its faults act on."""

    env: RobosuiteEnv
    prefix: str  # of the first arm's channels
    joint: int  # of the first arm
    axis: int  # of the action
    translation: int  # an axis of the action that moves the hand, not one that turns it
    direction: tuple[float, float, float]
    link: str
    hand: str
    onset: int
    seed: int

    @property
    def encoder(self) -> dict[str, Any]:
        return {"channel": f"{self.prefix}joint_position", "element": self.joint}


Kind = Callable[[Drawn, int], Fault]

KINDS: Registry[Kind] = Registry(
    "kind of fault",
    "asm_gym.faults.suite:KINDS",
    {
        "push": lambda d, s: body.Push(
            body=d.link, newtons=(8.0, 20.0, 40.0)[s], direction=d.direction, duration=10
        ),
        "payload": lambda d, s: body.Payload(body=d.hand, kilograms=(0.25, 0.75, 2.0)[s]),
        "collision": lambda d, s: body.Collision(
            body=d.hand, stiffness=(500, 2000, 8000)[s], duration=20
        ),
        "cable_pull": lambda d, s: body.CablePull(body=d.hand, stiffness=(50, 150, 400)[s]),
        "held_by_person": lambda d, s: body.HeldByPerson(
            body=d.link, stiffness=(100, 300, 800)[s], duration=30
        ),
        "weak_joint": lambda d, s: actuator.WeakJoint(joint=d.joint, strength=(0.9, 0.7, 0.4)[s]),
        "stuck_joint": lambda d, s: actuator.JointFriction(
            joint=d.joint, newton_metres=1000.0, viscous=0.0, duration=(4, 12, None)[s]
        ),
        "joint_friction": lambda d, s: actuator.JointFriction(
            joint=d.joint, newton_metres=(0.5, 2, 6)[s], viscous=(0.5, 2, 6)[s]
        ),
        "backlash": lambda d, s: actuator.Backlash(joint=d.joint, gap=(0.003, 0.01, 0.03)[s]),
        "gripper_opens": lambda d, s: actuator.GripperOpens(duration=(2, 8, None)[s]),
        "weak_gripper": lambda d, s: actuator.WeakGripper(strength=(0.5, 0.2, 0.05)[s]),
        "encoder_bias": lambda d, s: sensor.Bias(**d.encoder, amount=(0.01, 0.03, 0.1)[s]),
        "encoder_drift": lambda d, s: sensor.Drift(**d.encoder, rate=(5e-4, 2e-3, 8e-3)[s]),
        "frozen_encoder": lambda d, s: sensor.FrozenEncoder(
            joint=d.joint, duration=(5, 15, None)[s]
        ),
        "encoder_noise": lambda d, s: sensor.Noise(**d.encoder, std=(2e-3, 1e-2, 5e-2)[s]),
        "encoder_spikes": lambda d, s: sensor.Spikes(**d.encoder, amount=(0.02, 0.1, 0.5)[s]),
        "encoder_delay": lambda d, s: sensor.Delay(**d.encoder, steps=(1, 2, 5)[s]),
        "encoder_dropout": lambda d, s: sensor.Dropout(
            **d.encoder, probability=(0.05, 0.2, 0.5)[s]
        ),
        "torque_scale": lambda d, s: sensor.Scale(
            channel=d.prefix + "measured_torque", element=d.joint, factor=(1.05, 1.15, 1.5)[s]
        ),
        "wrist_bias": lambda d, s: sensor.Bias(
            channel=d.prefix + "wrist_force", element=d.translation, amount=(0.5, 2.0, 8.0)[s]
        ),
        "frozen_wrist": lambda d, s: sensor.Freeze(
            channel="wrist_force", element=None, duration=(5, 15, None)[s]
        ),
        "action_delay": lambda d, s: action.ActionDelay(steps=(1, 3, 6)[s]),
        "action_drop": lambda d, s: action.ActionDrop(probability=(0.1, 0.3, 0.7)[s]),
        "action_bias": lambda d, s: action.ActionBias(axis=d.axis, amount=(0.05, 0.15, 0.4)[s]),
        "action_repeat": lambda d, s: action.ActionRepeat(steps=(2, 4, 8)[s]),
        "sign_flip": lambda d, s: action.SignFlip(axis=d.translation, duration=(3, 10, None)[s]),
        "action_noise": lambda d, s: action.ActionNoise(share=(0.15, 0.4, 1.0)[s]),
        "adversary": lambda d, s: action.Adversary(size=(0.05, 0.15, 0.4)[s]),
        "slip": lambda d, s: object.Slip(friction=(0.4, 0.15, 0.03)[s]),
        "snatch": lambda d, s: object.Snatch(
            newtons=(3, 10, 30)[s], direction=d.direction, duration=10
        ),
        "teleport": lambda d, s: object.Teleport(
            offset=((0.01, 0.03, 0.08)[s], (0.01, 0.03, 0.08)[s], 0.0)
        ),
        "heavy_object": lambda d, s: object.Heavy(kilograms=(0.1, 0.4, 1.5)[s]),
        "missing_object": lambda d, _: object.Missing(),
    },
)
"""The fault of each kind for an episode, at severity 0 to 2; ``suite_fault`` sets when it begins."""


def kinds_of(names: Sequence[str]) -> tuple[str, ...]:
    """Return kinds by name, in order; ``development`` and ``test`` stand for those of the group."""
    for name in names:
        if name not in GROUPS:
            check_choice("kind of fault", name, KINDS)
    return tuple(dict.fromkeys(kind for name in names for kind in GROUPS.get(name, (name,))))


def register_fault(name: str, make: Kind | str) -> None:
    """Register a kind of fault, in this process and its workers; raise ValueError if the name is taken.

    Args:
        name: for ``asm-gym evaluate --faults``.
        make: called with a ``Drawn`` and a severity (0, 1 or 2), returns a fault; or its ``module:name``. The fault
            then gets the onset and the seed of the episode.

    Example:
        >>> from asm_gym import register_fault
        >>> from asm_gym.faults import Push
        >>> register_fault("nudge", lambda drawn, severity: Push(newtons=2.0 + severity))
    """
    KINDS.register(name, target(make))


def draw(env: RobosuiteEnv, onset: int, seed: int) -> Drawn:
    """Draw what the faults of the episode with this seed act on."""
    rng = np.random.default_rng([seed, 2])
    robot, model = env.robosuite_env.robots[0], env.simulation.model
    axes = env.action_space.shape[0] - len(env.gripper_actions)  # type: ignore[index]
    direction = rng.standard_normal(3)
    x, y, z = (float(v) for v in direction / np.linalg.norm(direction))
    elbow = model.jnt_bodyid[model.actuator_trnid[env.simulation.motors[4], 0]]
    joint = int(rng.integers(len(robot._ref_joint_vel_indexes)))
    axis, translation = int(rng.integers(axes)), int(rng.integers(3))
    prefix, hand = "robot0_" if len(env.robots) > 1 else "", robot.robot_model.eef_name["right"]
    return Drawn(
        env, prefix, joint, axis, translation, (x, y, z), model.body(elbow).name, hand, onset, seed
    )


def suite_fault(kind: str, env: RobosuiteEnv, severity: str, onset: int, seed: int) -> Fault:
    """Return the fault of one kind and severity for the episode with this seed."""
    check_choice("severity", severity, SEVERITIES)
    fault = KINDS.find(kind)(draw(env, onset, seed), SEVERITIES.index(severity))
    return replace(fault, onset=onset, seed=seed)


def possible(kind: str, env: RobosuiteEnv) -> bool:
    """Whether the environment has what a kind of fault acts on: a loose object, a gripper."""
    try:
        KINDS[kind](draw(env, 0, 0), 1).check(env)
    except ValueError:
        return False
    return True
