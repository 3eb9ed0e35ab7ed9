"""The fault suite: every kind at three severities, but ``missing_object``, which has one.

The joint, axis and direction that a fault acts on are drawn from the episode's seed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from gymnasium.spaces import flatdim

from asm_gym.envs.arms import prefix_of
from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults import action, actuator, body, object, sensor
from asm_gym.faults.fault import Fault, Vector3, graded
from asm_gym.registries import Registry, target
from asm_gym.validation import check_choice

SEVERITIES = ("mild", "medium", "strong")
DEVELOPMENT = "development"
TEST = "test"

GROUPS: dict[str, tuple[str, ...]] = {
    DEVELOPMENT: (
        "push",
        "payload",
        "weak_joint",
        "backlash",
        "weak_gripper",
        "encoder_drift",
        "encoder_spikes",
        "encoder_delay",
        "torque_scale",
        "wrist_bias",
        "action_drop",
        "action_repeat",
        "action_noise",
        "slip",
        "snatch",
    ),
    TEST: (
        "collision",
        "cable_pull",
        "held_by_person",
        "stuck_joint",
        "joint_friction",
        "gripper_opens",
        "encoder_bias",
        "frozen_encoder",
        "encoder_noise",
        "encoder_dropout",
        "frozen_wrist",
        "action_delay",
        "action_bias",
        "sign_flip",
        "adversary",
        "teleport",
        "heavy_object",
        "missing_object",
    ),
}
"""Kinds by which settings are chosen, and kinds that are reported: half of each family, drawn once.

Kinds that a user registers are in neither group.
"""


class Drawn(NamedTuple):
    """What the faults of an episode act on: a drawn joint, axis and direction, and two bodies."""

    env: RobosuiteEnv
    prefix: str  # of the first arm's channels
    joint: int  # of the first arm
    axis: int  # of the action
    translation: int  # 0 to 2: an axis of translation, of the action and of the wrist force
    direction: Vector3
    link: str  # body that the first arm's fifth joint moves
    hand: str  # body of its hand
    onset: int
    seed: int

    @property
    def encoder(self) -> str:
        return f"{self.prefix}joint_position"

    @property
    def torque_sensor(self) -> str:
        return f"{self.prefix}measured_torque"

    @property
    def wrist_sensor(self) -> str:
        return f"{self.prefix}wrist_force"


Kind = Callable[[Drawn, int], Fault]

# What kinds act on: a parameter of the fault, and the attribute of ``Drawn`` that it is set to.
_ON_LINK = {"body": "link"}
_ON_HAND = {"body": "hand"}
_ON_JOINT = {"joint": "joint"}
_ON_ENCODER = {"channel": "encoder", "element": "joint"}
_ON_TORQUE_SENSOR = {"channel": "torque_sensor", "element": "joint"}
_ON_WRIST_SENSOR = {"channel": "wrist_sensor", "element": "translation"}
_ALONG = {"direction": "direction"}

KINDS: Registry[Kind] = Registry(
    "kind of fault",
    "asm_gym.faults.suite:KINDS",
    {
        "push": graded(body.Push, _ON_LINK | _ALONG, newtons=(8.0, 20.0, 40.0), duration=10),
        "payload": graded(body.Payload, _ON_HAND, kilograms=(0.25, 0.75, 2.0)),
        "collision": graded(body.Collision, _ON_HAND, stiffness=(500, 2000, 8000), duration=20),
        "cable_pull": graded(body.CablePull, _ON_HAND, stiffness=(50, 150, 400)),
        "held_by_person": graded(
            body.HeldByPerson, _ON_LINK, stiffness=(100, 300, 800), duration=30
        ),
        "weak_joint": graded(actuator.WeakJoint, _ON_JOINT, strength=(0.9, 0.7, 0.4)),
        "stuck_joint": graded(
            actuator.JointFriction,
            _ON_JOINT,
            newton_metres=1000.0,
            viscous=0.0,
            duration=(4, 12, None),
        ),
        "joint_friction": graded(
            actuator.JointFriction, _ON_JOINT, newton_metres=(0.5, 2, 6), viscous=(0.5, 2, 6)
        ),
        "backlash": graded(actuator.Backlash, _ON_JOINT, gap=(0.003, 0.01, 0.03)),
        "gripper_opens": graded(actuator.GripperOpens, duration=(2, 8, None)),
        "weak_gripper": graded(actuator.WeakGripper, strength=(0.5, 0.2, 0.05)),
        "encoder_bias": graded(sensor.Bias, _ON_ENCODER, amount=(0.01, 0.03, 0.1)),
        "encoder_drift": graded(sensor.Drift, _ON_ENCODER, rate=(5e-4, 2e-3, 8e-3)),
        "frozen_encoder": graded(sensor.FrozenEncoder, _ON_JOINT, duration=(5, 15, None)),
        "encoder_noise": graded(sensor.Noise, _ON_ENCODER, std=(2e-3, 1e-2, 5e-2)),
        "encoder_spikes": graded(sensor.Spikes, _ON_ENCODER, amount=(0.02, 0.1, 0.5)),
        "encoder_delay": graded(sensor.Delay, _ON_ENCODER, steps=(1, 2, 5)),
        "encoder_dropout": graded(sensor.Dropout, _ON_ENCODER, probability=(0.05, 0.2, 0.5)),
        "torque_scale": graded(sensor.Scale, _ON_TORQUE_SENSOR, factor=(1.05, 1.15, 1.5)),
        "wrist_bias": graded(sensor.Bias, _ON_WRIST_SENSOR, amount=(0.5, 2.0, 8.0)),
        "frozen_wrist": graded(
            sensor.Freeze, {"channel": "wrist_sensor"}, element=None, duration=(5, 15, None)
        ),
        "action_delay": graded(action.ActionDelay, steps=(1, 3, 6)),
        "action_drop": graded(action.ActionDrop, probability=(0.1, 0.3, 0.7)),
        "action_bias": graded(action.ActionBias, {"axis": "axis"}, amount=(0.05, 0.15, 0.4)),
        "action_repeat": graded(action.ActionRepeat, steps=(2, 4, 8)),
        "sign_flip": graded(action.SignFlip, {"axis": "translation"}, duration=(3, 10, None)),
        "action_noise": graded(action.ActionNoise, share=(0.15, 0.4, 1.0)),
        "adversary": graded(action.Adversary, size=(0.05, 0.15, 0.4)),
        "slip": graded(object.Slip, friction=(0.4, 0.15, 0.03)),
        "snatch": graded(object.Snatch, _ALONG, newtons=(3, 10, 30), duration=10),
        "teleport": graded(
            object.Teleport, offset=((0.01, 0.01, 0.0), (0.03, 0.03, 0.0), (0.08, 0.08, 0.0))
        ),
        "heavy_object": graded(object.Heavy, kilograms=(0.1, 0.4, 1.5)),
        "missing_object": graded(object.Missing),
    },
)
"""The fault of each kind for an episode, at severity 0 to 2; ``suite_fault`` sets when it begins."""


def kinds_of(names: Sequence[str]) -> tuple[str, ...]:
    """Return kinds, in order and each once; ``development`` and ``test`` stand for the kinds of a group."""
    for name in names:
        if name not in GROUPS:
            check_choice("kind of fault", name, KINDS)
    kinds: dict[str, None] = {}  # a set that keeps the order
    for name in names:
        kinds |= dict.fromkeys(GROUPS.get(name, (name,)))
    return tuple(kinds)


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
    robot = env.robosuite_env.robots[0]
    model = env.simulation.model
    direction = rng.standard_normal(3)
    x, y, z = (direction / np.linalg.norm(direction)).tolist()
    joint = int(rng.integers(len(robot._ref_joint_vel_indexes)))
    axis = int(rng.integers(flatdim(env.action_space) - len(env.gripper_actions)))
    translation = int(rng.integers(3))
    fifth_joint = model.actuator_trnid[env.simulation.motors[4], 0]
    link = model.jnt_bodyid[fifth_joint]
    return Drawn(
        env=env,
        prefix=prefix_of(0, len(env.robots)),
        joint=joint,
        axis=axis,
        translation=translation,
        direction=(x, y, z),
        link=model.body(link).name,
        hand=robot.robot_model.eef_name["right"],
        onset=onset,
        seed=seed,
    )


def suite_fault(kind: str, env: RobosuiteEnv, severity: str, onset: int, seed: int) -> Fault:
    """Return the fault of one kind and severity for the episode with this seed."""
    check_choice("severity", severity, SEVERITIES)
    make = KINDS.find(kind)
    fault = make(draw(env, onset, seed), SEVERITIES.index(severity))
    return replace(fault, onset=onset, seed=seed)


def possible(kind: str, env: RobosuiteEnv) -> bool:
    """Whether the environment has what a kind of fault acts on: a loose object, a gripper."""
    try:
        # The check comes out the same at any severity, onset and seed.
        fault = KINDS[kind](draw(env, onset=0, seed=0), 1)
        fault.check(env)
    except ValueError:
        return False
    return True
