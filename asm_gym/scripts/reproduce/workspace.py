"""Six tasks of the Panda seen by the same senses, and experts recorded in them.

A row holds the body, where the thing is from the hand, its goal from the thing, and what was commanded; nothing in it
names the task. Distances have a second sense that resolves millimetres and saturates beyond centimetres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode, save_episode
from asm_gym.faults.suite import possible, suite_fault
from asm_gym.policies import make_policy
from asm_gym.policies.scripted.expert import Style
from asm_gym.policies.scripted.geometry import (
    Pose,
    rotation_about_vertical,
    rotation_from_quaternion,
    yaw,
)
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.wrappers.faults import FaultInjection

Floats = NDArray[np.float64]

SKILLS = ("Lift", "Stack", "PickPlaceCan", "PickPlaceMilk", "Door", "NutAssemblySquare")
SWAY = "sway"
# another thing to carry; and motion of no skill, in the scene of Lift
UNKNOWN = ("PickPlaceCereal", SWAY)
FAULTS = ("push", "held_by_person", "weak_joint", "frozen_encoder", "encoder_bias", "gripper_opens")
SPEC = StreamSpec(
    (
        Channel("joint_position", 7, "rad", 2e-4, "joint"),
        Channel("hand_position", 3, "m", 3e-4, "hand"),
        Channel("hand_orientation", 6, "1", 5e-4, "hand"),
        Channel("gripper_opening", 2, "m", 2e-4, "gripper"),
        Channel("hand_to_thing", 3, "m", group="object"),
        Channel("hand_to_thing_near", 3, group="object"),
        Channel("thing_to_goal", 3, "m", group="object"),
        Channel("thing_to_goal_near", 3, group="object"),
        Channel("turn", 2, "rad", group="object"),
        Channel("external_torque", 7, "N m", 0.15, "torque"),
        Channel("wrist_force", 3, "N", 0.2, "wrench"),
        Channel("wrist_torque", 3, "N m", 0.01, "wrench"),
        Channel("action", 7, group=MOTOR),
    ),
    0.05,
    "Panda",
)
JOINTS = SPEC.slices["joint_position"]
HAND = SPEC.slices["hand_position"]
GROUP_OF = np.repeat([c.group for c in SPEC.channels], [c.size for c in SPEC.channels])
"""(D,) the group of each number in a row."""
GROUPS = tuple(dict.fromkeys(GROUP_OF.tolist()))
"""Groups of senses, and at last the action."""
NEAR = 0.02  # the second sense of a distance resolves less than this [m]
QUARTER = np.pi / 2  # turn after which a square looks the same [rad]
SHAKE = 0.25  # most noise on the commands of experts
EVENT = 30  # row of a fault
SECOND = 20  # rows of a second
REST = 12  # rows recorded after success


# ------------------------------------------------------------------ what differs between the tasks


def object_pose(work: Workspace, name: str) -> Pose:
    """Return the pose of an object by the name of its channels."""
    return Pose(work.read(f"{name}_pos"), rotation_from_quaternion(work.read(f"{name}_quat")))


def handle_pose(work: Workspace, name: str) -> Pose:
    """Return the position of the door's handle."""
    return Pose(work.read(f"{name}_pos"), np.eye(3))


def above_start(work: Workspace, thing: Floats) -> Floats:
    """Return the position above that at which the thing began."""
    return work.start + np.array([0.0, 0.0, 0.1])


def on_second_cube(work: Workspace, thing: Floats) -> Floats:
    """Return the position of a cube that lies on the second one."""
    return work.read("cubeB_pos") + np.array([0.0, 0.0, 0.045])


def in_bin(work: Workspace, thing: Floats) -> Floats:
    """Return the position of the thing's place in the bins."""
    env = work.inner.robosuite_env
    return np.array(env.target_bin_placements[env.object_id])


def on_peg(work: Workspace, thing: Floats) -> Floats:
    """Return the position of the square peg."""
    env = work.inner.robosuite_env
    return np.array(env.sim.data.body_xpos[env.peg1_body_id])


def opened(work: Workspace, thing: Floats) -> Floats:
    """Return the position of the handle when the door is open."""
    simulation = work.inner.simulation
    hinge = simulation.data.xanchor[simulation.model.joint("Door_hinge").id]
    left_to_turn = rotation_about_vertical(0.36 - float(work.read("hinge_qpos")[0]))
    return np.asarray(hinge + left_to_turn @ (thing - hinge))


def no_turn(work: Workspace, pose: Pose) -> Floats:
    """Return the turn of a round thing (2,): none."""
    return np.zeros(2)


def handle_turn(work: Workspace, pose: Pose) -> Floats:
    """Return how far the handle is pressed (2,) [rad]."""
    return np.array([work.read("handle_qpos")[0], 0.0])


def square_turn(work: Workspace, pose: Pose) -> Floats:
    """Return the turn of a square thing from the hand (2,) [rad], up to its symmetry."""
    return np.array([up_to_symmetry(turn_from_hand(work, pose), QUARTER), 0.0])


def nut_turn(work: Workspace, pose: Pose) -> Floats:
    """Return the turn of the nut from the hand and from its peg (2,) [rad], up to its symmetry."""
    from_hand = up_to_symmetry(turn_from_hand(work, pose), np.pi)
    return np.array([from_hand, up_to_symmetry(yaw(pose.orientation[:, 0]), QUARTER)])


def turn_from_hand(work: Workspace, pose: Pose) -> float:
    """Return the turn of a thing about the vertical, from the fingers' line [rad]."""
    return yaw(pose.orientation[:, 0]) + np.pi / 2 - yaw(work.read("hand_orientation")[3:])


def up_to_symmetry(turn: float, period: float) -> float:
    """Return the smallest turn that looks like this one [rad]."""
    return turn - period * np.round(turn / period)


@dataclass(frozen=True)
class TaskRules:
    """What the senses need to know of a task."""

    # name of the channels of the thing to handle
    thing: str
    # returns where (3,) the thing that is at (3,) is to go [m]
    goal: Callable[[Workspace, Floats], Floats]
    # returns the sense ``turn`` (2,)
    turn: Callable[[Workspace, Pose], Floats]
    # returns the pose of the thing
    pose: Callable[[Workspace, str], Pose] = object_pose
    # where to grasp the thing, in its own frame [m]
    grasp: tuple[float, float, float] = (0.0, 0.0, 0.0)


TASKS = {
    "Lift": TaskRules("cube", above_start, square_turn),
    "Stack": TaskRules("cubeA", on_second_cube, square_turn),
    "PickPlaceCan": TaskRules("Can", in_bin, no_turn),
    "PickPlaceMilk": TaskRules("Milk", in_bin, square_turn),
    "PickPlaceCereal": TaskRules("Cereal", in_bin, square_turn),
    "Door": TaskRules("handle", opened, handle_turn, pose=handle_pose),
    "NutAssemblySquare": TaskRules("SquareNut", on_peg, nut_turn, grasp=(0.054, 0.0, 0.0)),
}


# ------------------------------------------------------------------ senses


class Workspace:
    """A task, seen by the senses that all have."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        inner: Any = env.unwrapped
        self.env = env
        self.inner = inner
        self.rules = TASKS[inner.task.name]

    def reset(self, seed: int) -> tuple[Any, Floats]:
        """Return the observation and the first row (D,)."""
        observation, _ = self.env.reset(seed=seed)
        self.start = self.pose().position
        return observation, self.row()

    def step(self, action: Any) -> tuple[Any, Floats, bool]:
        """Return the observation, the row (D,), and whether the task was solved."""
        observation, _, self.terminated, _, info = self.env.step(action)
        return observation, self.row(), bool(info["is_success"])

    def read(self, name: str) -> Floats:
        """Return what was measured last of a channel."""
        return self.inner.measured[self.inner.measured_spec.slices[name]]

    def pose(self) -> Pose:
        """Return the pose of the thing."""
        return self.rules.pose(self, self.rules.thing)

    def row(self) -> Floats:
        """Return what is sensed now, and what was commanded (D,)."""
        pose = self.pose()
        hand = self.read("hand_position")
        reach = pose.point(np.array(self.rules.grasp)) - hand
        way = self.rules.goal(self, pose.position) - pose.position
        values = (
            self.read("joint_position"),
            hand - self.inner.robosuite_env.robots[0].base_pos,
            self.read("hand_orientation"),
            self.read("gripper_opening"),
            reach,
            np.tanh(reach / NEAR),
            way,
            np.tanh(way / NEAR),
            self.rules.turn(self, pose),
            self.read("external_torque"),
            self.read("wrist_force"),
            self.read("wrist_torque"),
            self.read("action"),
        )
        return np.concatenate(values)


@cache
def environment(skill: str) -> gym.Env[Any, Any]:
    """Return this process's environment of a skill."""
    return gym.make(f"asm_gym/{skill}-v0", render_mode="rgb_array", render_size=(200, 200))


# ------------------------------------------------------------------ experts


class Demonstration(NamedTuple):
    """An episode to record: the skill, the seed, and the kind of fault from row ``EVENT`` on."""

    skill: str
    seed: int
    fault: str = ""

    @property
    def name(self) -> str:
        """Name of its file."""
        return "-".join([self.skill, str(self.seed), self.fault]).strip("-") + ".npz"

    @property
    def is_possible(self) -> bool:
        """Whether the scene has what the fault acts on."""
        inner: Any = environment(self.skill).unwrapped
        return possible(self.fault, inner)


def demonstrate(wanted: Demonstration, folder: Path) -> Path:
    """Record an expert whose commands are shaken, so that it shows how to return.

    A fault lasts for two seconds.
    """
    scene = wanted.skill
    policy = partial(make_policy, "scripted", style=Style(noise=0.0))
    if wanted.skill == SWAY:
        scene = "Lift"
        policy = partial(make_policy, SWAY)
    inner: Any = environment(scene).unwrapped
    rows_left = inner.horizon
    faults = []
    if wanted.fault:
        rows_left = EVENT + 2 * SECOND
        faults = [suite_fault(wanted.fault, inner, "medium", EVENT, wanted.seed)]
    env = FaultInjection(environment(scene), faults)
    work = Workspace(env)
    expert = policy(env, seed=wanted.seed)

    rng = np.random.default_rng([wanted.seed, 1])
    shake = rng.uniform(0.0, SHAKE)
    observation, row = work.reset(wanted.seed)
    rows = [row]
    state = None
    rows_solved = 0
    while len(rows) < rows_left and rows_solved <= REST:
        action, state = expert.predict(observation, state, deterministic=True)
        action[:6] = np.clip(action[:6] + shake * rng.standard_normal(6), -1.0, 1.0)
        observation, row, solved = work.step(action)
        rows.append(row)
        rows_solved += solved
    env.undo_faults()
    episode = Episode.from_stream(
        np.array(rows),
        SPEC,
        success=rows_solved > 0,
        seed=wanted.seed,
        info={"skill": wanted.skill},
    )
    return save_episode(folder / wanted.name, episode)
