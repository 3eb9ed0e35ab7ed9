"""The scripted expert for ToolHang knows the shapes of what it holds, and how one goes round the other."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import asm_gym  # noqa: F401
from asm_gym.policies.scripted import hanging, tool_hang
from asm_gym.policies.scripted.geometry import Pose, about, carried
from asm_gym.policies.scripted.hanging import Scene
from asm_gym.policies.scripted.tool_hang import ToolHangExpert


@pytest.fixture(scope="module")
def env() -> Any:
    env = gym.make("asm_gym/ToolHang-v0", sensor_noise=0.0)
    env.reset(seed=0)
    yield env
    env.close()


@pytest.fixture
def scene(env: Any) -> Scene:
    observation, _ = env.reset(seed=0)
    return ToolHangExpert(env, seed=0).look(observation)


def test_it_knows_where_the_model_has_tip_hook_hole_and_ring(env: Any, scene: Scene) -> None:
    underneath = env.unwrapped.robosuite_env
    data, site, geom = underneath.sim.data, underneath.obj_site_id, underneath.obj_geom_id
    np.testing.assert_allclose(scene.frame.point(hanging.TIP), data.site_xpos[site["frame_tip_site"]], atol=1e-4)
    np.testing.assert_allclose(scene.tool.point(hanging.RING), data.site_xpos[site["tool_hole1_center"]], atol=1e-4)
    walls = data.geom_xpos[[geom[f"stand_wall_{i}"] for i in range(4)]].mean(axis=0)
    np.testing.assert_allclose(scene.hole[:2], walls[:2], atol=1e-6)
    top = data.site_xpos[site["stand_mount_site"]][2]
    assert scene.hole[2] + hanging.TUBE == pytest.approx(top, abs=1e-6)
    end = scene.frame.point(np.array([-hanging.HOOK, 0, 0])) - data.site_xpos[site["frame_hang_site"]]
    assert np.linalg.norm(end) == pytest.approx(underneath.frame_args["frame_thickness"] / 2, abs=1e-6)


def rectangle(x: tuple[float, float], z: tuple[float, float]) -> Any:
    """(N, 2) points that fill a rectangle, 0.5 mm apart."""
    return np.stack(np.meshgrid(np.arange(*x, 5e-4), np.arange(*z, 5e-4)), axis=-1).reshape(-1, 2)


def room(middle: Any, steep: float, env: Any) -> float:
    """The least distance [m] between ring and L, in the plane of both; the origin is in the hook, x points outwards."""
    frame, ring = env.unwrapped.robosuite_env.frame_args, env.unwrapped.robosuite_env.tool_args
    half = frame["frame_thickness"] / 2
    bar = rectangle((-frame["frame_length"], half), (-half, half))
    hook = rectangle((-half, half), (half, half + frame["hook_height"]))
    # The ring is an octagon of boxes: its nearest sides are these from its middle.
    inner = ring["inner_radius_1"] * np.cos(np.pi / ring["ngeoms"])
    outer = inner + (ring["outer_radius_1"] - ring["inner_radius_1"]) * np.cos(np.pi / ring["ngeoms"])
    handle, axis = np.array([np.cos(steep), -np.sin(steep)]), np.array([np.sin(steep), np.cos(steep)])
    off = np.concatenate([bar, hook]) - middle
    across, along = np.abs(off @ handle), np.abs(off @ axis) - ring["height_1"]
    beside = np.maximum(inner - across, across - outer)
    outside = np.hypot(np.maximum(beside, 0), np.maximum(along, 0))
    return float(np.where((beside < 0) & (along < 0), np.maximum(beside, along), outside).min())


@pytest.mark.parametrize("degrees", np.linspace(20, 75, 12))
def test_the_ring_passes_round_the_hook_without_touching_it(env: Any, degrees: float) -> None:
    upright = Pose(np.zeros(3), np.eye(3))
    scene = Scene(upright, upright, upright, np.zeros(3))
    x, _, z = hanging.course(scene, np.radians(degrees))
    middle = np.array([-x - hanging.HOOK, z])
    assert room(middle, np.radians(degrees), env) > 0.0015
    assert room(np.array([0.0, -0.008]), np.radians(degrees), env) < 0, "it would not, elsewhere"


def test_what_the_hand_holds_goes_where_it_is_carried() -> None:
    rng = np.random.default_rng(0)

    def pose() -> Pose:
        axis = rng.standard_normal(3)
        return Pose(rng.standard_normal(3), about(axis / np.linalg.norm(axis), rng.uniform(0, 3)))

    hand, thing, goal = pose(), pose(), pose()
    own = rng.standard_normal(3)
    target = carried(hand, thing, own, goal.at, goal.turned)
    # A thing that is held keeps its pose in the hand.
    held = Pose(hand.turned.T @ (thing.at - hand.at), hand.turned.T @ thing.turned)
    moved = Pose(target.point(held.at), target.turned @ held.turned)
    np.testing.assert_allclose(moved.point(own), goal.at, atol=1e-12)
    np.testing.assert_allclose(moved.turned, goal.turned, atol=1e-12)


def test_the_steepness_is_that_of_the_handle_below_the_bar(scene: Scene) -> None:
    frame = Pose(np.zeros(3), hanging.UPRIGHT)
    for steep in (0.0, 0.5, 1.5):
        # The bar points along -y, and so does the handle, before it is turned down about x.
        handle = np.array([0.0, -np.cos(steep), -np.sin(steep)])
        tool = Pose(np.zeros(3), np.stack([handle, [1.0, 0, 0], np.cross(handle, [1.0, 0, 0])], axis=1))
        assert hanging.steepness(scene._replace(frame=frame, tool=tool)) == pytest.approx(steep)


def hung(along: float, below: float, lean: float) -> Scene:
    """The ring is so far from the corner along the bar and below it, its tool points down; the rod leans."""
    tool = np.stack([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], axis=1)
    middle = np.array([-along, 0.0, -below])
    turn = about([0.0, 1.0, 0.0], lean)
    frame = Pose(np.zeros(3), turn)
    return Scene(frame, frame, Pose(turn @ (middle - tool @ hanging.RING), turn @ tool), np.zeros(3))


@pytest.mark.parametrize(
    ("along", "below", "lean", "round_it", "hangs"),
    [
        (0.05, 0.006, 0.0, True, True),
        (0.05, 0.006, 0.2, True, False),
        (0.05, 0.02, 0.0, False, False),  # beneath the bar
        (0.095, 0.006, 0.0, False, False),  # beyond the hook
    ],
)
def test_a_tool_hangs_where_its_ring_is_round_the_bar_and_the_frame_stands(along, below, lean, round_it, hangs) -> None:
    scene = hung(along, below, lean)
    assert hanging.is_round(scene) is round_it
    assert hanging.hangs(scene) is hangs


def test_what_hangs_is_left_alone(env: Any) -> None:
    observation, _ = env.reset(seed=0)
    expert = ToolHangExpert(env, seed=0)
    _, state = expert.predict(observation)
    scene = hung(0.05, 0.006, 0.0)
    for phase in (tool_hang.REACH, tool_hang.DESCEND):
        reaching = state._replace(plan=tool_hang.TOOL, phase=phase)
        assert expert.advance(reaching, scene).phase == tool_hang.RETREAT
        assert expert.advance(reaching._replace(plan=tool_hang.FRAME), scene).phase == phase
    retreating = state._replace(plan=tool_hang.TOOL, phase=tool_hang.RETREAT, since=30)
    assert expert.advance(retreating, scene).phase == tool_hang.RETREAT
    assert expert.advance(retreating, hung(0.095, 0.3, 0.0)).phase == tool_hang.REACH
