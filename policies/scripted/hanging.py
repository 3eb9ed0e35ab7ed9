"""The shapes of ToolHang's stand, frame and tool, and how the tool's ring goes round the frame's hook."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from asm_gym.policies.scripted.geometry import Pose, Vector

# The frame's own frame: origin in the corner, z along the rod away from the tip, x along the bar away from the hook.
FRAME_GRIP = np.array([0.0, -0.006, -0.048])  # higher, and the palm would stand on the hook [m]
ROD = np.array([0.0, 0.0, -0.048])  # the rod beside the grip
TIP = np.array([0.0, 0.0, -0.2207])
HOOK = 0.0875  # from the corner along the bar to the middle of the hook [m]
HOOK_TOP = 0.016  # from the bar's middle [m]
UPRIGHT = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # with the bar to the robot's right

# The stand, from the middle of its base [m].
HOLE = np.array([0.0, 0.045, 0.0])
TUBE = 0.155  # its upper end
IN = 0.02  # how deep in the tube the tip no longer can miss it
STANDS = 0.012  # the tip's height when the frame stands; the task asks for 0.021

# The tool's own frame: origin in the middle of its handle, x along it, away from the ring, z along the ring's axis.
TOOL_GRIP = np.array([0.0, 0.0, 0.003])
RING = np.array([-0.0935, 0.0, 0.0])
# How the ring passes round the bar's end without touching it: how steeply the tool points down, and where the middle of
# the ring then is from that of the hook, along the bar and up. The room left is 2 mm at the narrowest.
STEEP = np.radians([20.0, 35.0, 45.0, 55.0, 65.0, 75.0])
ALONG = np.array([0.0, 0.0, -0.002, -0.004, -0.007, -0.011])  # [m]
ABOVE = np.array([0.007, 0.004, 0.002, 0.0, 0.0, -0.003])  # [m]
ROOM = 0.009  # from the bar's middle to the ring's, where the bar is in the ring [m]
TILTED = 0.1  # a rod that leans further is being pushed over [rad]


class Scene(NamedTuple):
    """What is observed."""

    hand: Pose
    frame: Pose
    tool: Pose
    hole: Vector  # (3,) under the tube, at the height of the base's middle [m]
    fingers: Vector = np.zeros(2)  # velocities of the gripper's joints


def steepness(scene: Scene) -> float:
    """Return how far down from the bar's direction the tool points [rad]."""
    handle = scene.frame.turned.T @ scene.tool.turned[:, 0]
    return float(np.arctan2(-handle[2], -handle[0]))


def course(scene: Scene, steep: float) -> Vector:
    """Return where (3,) the ring's middle is to be when the tool points ``steep`` [rad] down."""
    along, above = np.interp(steep, STEEP, ALONG), np.interp(steep, STEEP, ABOVE)
    return scene.frame.point(np.array([-HOOK - along, 0.0, above]))


def astray(scene: Scene) -> float:
    """Return how far the ring's middle is from its course round the hook [m]."""
    return float(np.linalg.norm(scene.tool.point(RING) - course(scene, steepness(scene))))


def tilt(scene: Scene) -> float:
    """Return how far the frame's rod is from upright [rad]."""
    return float(np.arccos(np.clip(scene.frame.turned[2, 2], -1.0, 1.0)))


def is_round(scene: Scene) -> bool:
    """Whether the ring is round the bar, between hook and corner, and the tool points down."""
    along, aside, above = scene.frame.turned.T @ (scene.tool.point(RING) - scene.frame.at)
    inside = -HOOK < along < -0.005 and np.hypot(aside, above) < ROOM
    return bool(inside and steepness(scene) > STEEP[2])


def hangs(scene: Scene) -> bool:
    """Whether the ring is round the bar of a frame that stands."""
    return is_round(scene) and tilt(scene) < TILTED
