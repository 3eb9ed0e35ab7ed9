"""The reward's terms against robosuite's own reward: along random actions, and where each stage is reached."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from asm_gym.envs.rewards import Rewards
from asm_gym.tasks import TASKS
from tests.scenes import UP, Scene, of


@of(*TASKS)
def test_terms_add_up_to_robosuites_reward_along_random_actions(
    scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    keys = list(scene.both().terms)
    for _ in range(12):
        scene.step(rng.uniform(-1, 1, scene.env.action_dim))
        assert list(scene.both().terms) == keys
    for scale in (None, 2.5):
        scene.env.reward_scale = scale
        scene.both()
    scene.env.reward_scale = 1.0
    assert capsys.readouterr().out == ""


@of("Lift")
def test_lift(scene: Scene) -> None:
    env = scene.env
    cube = scene.data.xpos[env.cube_body_id].copy()
    scene.place(env.cube, cube, (0, 1, 0, 0))
    scene.reach(cube)
    assert scene.both().terms["reach"] > 0.9 / 2.25
    scene.grasp(env.cube)
    terms = scene.both().terms
    assert terms["grasp"] == 0.25 / 2.25
    scene.place(env.cube, cube + 0.1 * UP)
    assert scene.both() == ({"reach": 0, "grasp": 0, "lift": 1}, True)


@of("Stack")
def test_stack(scene: Scene) -> None:
    env = scene.env
    pads = [env.robots[0].gripper["right"].important_geoms[f"{side}_fingerpad"][0] for side in ("left", "right")]
    a, b = env.cubeA.contact_geoms[0], env.cubeB.contact_geoms[0]
    scene.touch((pads[0], a), (pads[1], b))
    assert scene.both().terms["grasp"] == 0, "one finger each is no grasp"
    scene.touch((pads[0], a), (a, pads[1]))
    terms = scene.both().terms
    assert terms["grasp"] == 0.125
    assert terms["reach"] > 0
    under = scene.data.xpos[env.cubeB_body_id].copy()
    scene.place(env.cubeA, under + 0.2 * UP)
    terms = scene.both().terms
    assert terms == {"reach": 0, "grasp": 0, "lift": 0.5, "align": 0.25, "stack": 0}
    scene.place(env.cubeA, under + (env.cubeA.size[2] + env.cubeB.size[2] - 1e-3) * UP)
    terms, success = scene.both()
    assert terms["stack"] == 1.0
    assert success
    scene.touch((pads[0], a), (a, pads[1]), (a, b))
    assert not scene.both().success, "still held"


@of("Door")
@pytest.mark.parametrize("turn", [-2.5, -0.5, 0.5, 2.5])
def test_door(scene: Scene, turn: float) -> None:
    env = scene.env
    scene.data.qpos[env.handle_qpos_addr] = turn
    scene.forward()
    terms = scene.both().terms
    assert terms["rotate"] == pytest.approx(min(0.25, 0.25 * abs(turn) / (np.pi / 2)))
    assert terms["reach"] > 0
    scene.data.qpos[env.hinge_qpos_addr] = 0.31
    scene.forward()
    assert scene.both() == ({"reach": 0, "rotate": 0, "open": 1}, True)


def turned_to(a: Any, b: Any) -> Any:
    """The quaternion (w, x, y, z) that turns one unit vector to another."""
    quat = np.array([1 + a @ b, *np.cross(a, b)])
    return quat / np.linalg.norm(quat)


@of("ToolHang")
def test_tool_hang(scene: Scene) -> None:
    env, data, rng = scene.env, scene.data, np.random.default_rng(0)
    site = {name: lambda i=i: data.site_xpos[i].copy() for name, i in env.obj_site_id.items()}

    def poses(thing: Any) -> Any:
        return env.sim.data.get_joint_qpos(thing.joints[0]).copy()

    def turn(thing: Any, quat: Any) -> None:
        product = np.zeros(4)
        mujoco.mju_mulQuat(product, quat, poses(thing)[3:])
        scene.place(thing, poses(thing)[:3], product)

    scene.reach(data.site_xpos[scene.hand] + 0.15 * UP)  # out of the way
    rod = site["frame_intersection_site"]() - site["frame_mount_site"]()
    turn(env.frame, turned_to(rod / np.linalg.norm(rod), UP))
    slot = data.geom_xpos[[env.obj_geom_id[f"stand_wall_{i}"] for i in range(4)]].mean(axis=0)
    slot[2] = data.geom_xpos[env.obj_geom_id["stand_base"], 2]
    scene.bring(env.frame, site["frame_tip_site"], slot)
    hook = site["frame_intersection_site"]() - site["frame_hang_site"]()
    hook /= np.linalg.norm(hook)
    rim = data.geom_xpos[[env.obj_geom_id[f"tool_hole1_hc_{i}"] for i in range(8)]]
    normal = np.linalg.svd(rim - rim.mean(axis=0))[2][2]
    turn(env.tool, turned_to(normal, hook))
    middle = (site["frame_intersection_site"]() + site["frame_hang_site"]()) / 2
    for drop in np.linspace(0, 0.01, 41):
        scene.bring(env.tool, site["tool_hole1_center"], middle - drop * UP)
        if env._check_success():
            break
    assert scene.both() == ({"success": 1.0}, True)
    things = env.stand, env.frame, env.tool
    hung = [poses(thing) for thing in things]
    outcomes = set()
    for size in np.repeat([0.002, 0.01, 0.03], 90):
        for thing, pose in zip(things, hung, strict=True):
            scene.place(thing, pose[:3], pose[3:])
        moved, shift = things[rng.integers(3)], rng.normal(0, size, 7)
        scene.place(moved, poses(moved)[:3] + shift[:3], poses(moved)[3:] + 5 * shift[3:])
        reward = Rewards(scene.task, env)._reward
        frame_stands, tool_hangs = bool(env._check_frame_assembled()), bool(env._check_tool_on_frame())
        assert (reward._frame_stands(), reward._tool_hangs()) == (frame_stands, tool_hangs)
        assert scene.both().success is (frame_stands and tool_hangs)
        outcomes.add((frame_stands, tool_hangs))
    assert len(outcomes) == 4
    for thing, pose in zip(things, hung, strict=True):
        scene.place(thing, pose[:3], pose[3:])
    finger = env.robots[0].gripper["right"].important_geoms["left_finger"][0]
    scene.touch((env.tool.contact_geoms[0], finger), ("tool_hole1_hc_0", "frame_horizontal_frame"))
    assert not scene.both().success, "still held"


NUTS = [name for name in TASKS if name.startswith("NutAssembly")]
THINGS = [name for name in TASKS if name.startswith("PickPlace")]


@of(*NUTS)
def test_nuts_on_pegs(scene: Scene) -> None:
    env, data = scene.env, scene.data
    terms = scene.both().terms
    assert sum(value > 0 for value in terms.values()) == 1, "the winning stage alone"
    nut, handle = env.nuts[0], env.object_site_ids[0]
    hand = data.site_xpos[scene.hand].copy()
    scene.bring(nut, lambda: data.site_xpos[handle], hand + 0.03 * UP)
    assert scene.both().terms["reach"] > 0
    # Square nuts differ in where their handle points; one of the two fits between the fingers.
    for quat in ((1, 0, 0, 0), (1, 0, 0, 1)):
        scene.place(nut, hand, np.array(quat) / np.linalg.norm(quat))
        scene.bring(nut, lambda: data.site_xpos[handle], hand)
        try:
            scene.grasp(nut)
            break
        except AssertionError:
            continue
    worth = 0.5 if env.single_object_mode == 0 else 1.0
    assert scene.both().terms["hover"] >= 0.35 * worth, "it is held"
    # The pegs so far away that hovering adds nothing: lifting wins; so much too low: grasping.
    scene.data.xpos[[env.peg1_body_id, env.peg2_body_id], 0] = 9.0
    assert scene.both().terms["lift"] > 0.35 * worth
    scene.data.xpos[env.table_body_id, 2] = 90.0
    assert scene.both().terms["grasp"] == 0.35 * worth
    for i, other in enumerate(env.nuts):
        scene.forward()
        peg = data.xpos[(env.peg1_body_id, env.peg2_body_id)[i]].copy()
        for shift, there in ((0.031, False), (0.0, True)):
            scene.place(other, [peg[0] + shift, peg[1], env.table_offset[2] + 0.02])
            terms, success = scene.both()
            assert terms["place"] == worth * (i + there)
            assert success is (i + there >= (2 if env.single_object_mode == 0 else 1))


@of(*THINGS)
def test_objects_in_bins(scene: Scene) -> None:
    env, data = scene.env, scene.data
    hand = data.site_xpos[scene.hand].copy()
    worth = 0.25 if env.single_object_mode == 0 else 1.0
    thing = env.objects[0]
    body = env.obj_body_id[thing.name]
    scene.bring(thing, lambda: data.xpos[body], hand + 0.1 * UP)
    assert scene.both().terms["reach"] > 0
    scene.bring(thing, lambda: data.xpos[body], hand)
    scene.grasp(thing)
    assert scene.both().terms["hover"] >= 0.35 * worth, "it is held"
    centres = env.target_bin_placements
    for i, thing in enumerate(env.objects):
        scene.place(thing, centres[i] + [0.03, 0, 0.3])
        assert scene.both().terms["hover"] > 0.5 * worth, "it is above its bin"
        scene.place(thing, centres[i] + [0.03, 0, 0.05])
        terms, success = scene.both()
        assert terms["place"] == worth * (i + 1)
        assert success is (i == 3 or env.single_object_mode > 0)
    assert sum(terms.values()) == 4 * worth


@of("Wipe")
def test_wiping_off_all_markers(scene: Scene) -> None:
    env, data = scene.env, scene.data
    robot, markers = env.robots[0], env.model.mujoco_arena.markers
    bodies = [env.sim.model.body_name2id(marker.root_body) for marker in markers]
    unit = env.reward_scale * env.reward_normalization_factor
    scene.reach(data.xpos[bodies].mean(axis=0) + 0.05 * UP)
    assert scene.both().terms["wipe"] == 0
    for height in np.linspace(0.05, -0.01, 31):
        scene.reach(data.xpos[bodies[50]] + height * UP)
        if scene.both().terms["wipe"]:
            break
    assert env.wiped_markers
    assert data.ncon > 1
    terms = scene.both().terms
    assert terms["wipe"] == 0, "a marker is wiped once"
    assert terms["reach"] > 0
    forces = robot.recent_ee_forcetorques["right"]
    for force, term in ((0.4, None), (30.0, "press"), (90.0, "excess_force")):
        forces.push(np.array([0.0, 0.0, force, 0.0, 0.0, 0.0]))
        terms = scene.both().terms
        assert [name for name in ("press", "excess_force") if terms[name]] == [term] * (term is not None)
    assert env.f_excess == 1
    for push, term in ((0.5, 0.0), (5.0, 0.01 * unit)):
        sensor = scene.model.sensor_adr[env.sim.model.sensor_name2id("gripper0_right_force_ee")]
        data.sensordata[sensor : sensor + 3] = env.ee_force_bias["right"] + [0, 0, push]
        assert scene.both().terms["contact"] == pytest.approx(term)
    env.ee_accel_penalty = 0.1
    robot.recent_ee_acc["right"].push(np.full(6, -3.0))
    assert scene.both().terms["acceleration"] == pytest.approx(-0.3 * unit)
    env.ee_accel_penalty = 0
    env.wiped_markers += [marker for marker in markers if marker not in env.wiped_markers]
    terms, success = scene.both()
    assert terms["clean"] == env.task_complete_reward * unit
    assert terms["reach"] == 0
    assert success


@of("Wipe")
def test_wiping_with_the_arm_in_the_way(scene: Scene) -> None:
    env, data = scene.env, scene.data
    penalty = env.arm_limit_collision_penalty * env.reward_normalization_factor
    joints = env.robots[0]._ref_joint_pos_indexes
    data.qpos[joints[3]] = -3.0
    scene.forward()
    assert {k: v for k, v in scene.both().terms.items() if v} == {"joint_limit": penalty}
    data.qpos[joints[1]] = 0.8
    data.qpos[joints[3]] = -2.5
    scene.forward()
    assert {k: v for k, v in scene.both().terms.items() if v} == {"collision": penalty}
    assert env.collisions == 2


@of("Wipe")
def test_an_episode_of_wiping_is_rewarded_as_robosuites_own_steps_are(scene: Scene) -> None:
    env = scene.env
    env.early_terminations = False
    rng = np.random.default_rng(0)
    actions = [np.append(rng.uniform(-0.2, 0.2, 2), [-1, 0, 0, 0]) for _ in range(25)]
    env.reward_shaping = True
    theirs = [env.step(action)[1] for action in actions]
    scene.reset()
    rewards = Rewards(scene.task, env)
    ours = []
    for action in actions:
        scene.step(action)
        ours.append(rewards(action).terms)
    np.testing.assert_allclose([sum(terms.values()) for terms in ours], theirs, rtol=0, atol=1e-9)
    assert any(terms["contact"] for terms in ours)
    assert not all(terms["contact"] for terms in ours), "the wrist's first reading is its zero"


@of("Lift", "Wipe")
def test_rewards_made_anew_follow_a_hard_reset_and_the_old_ones_a_soft_one(scene: Scene) -> None:
    scene.reset(hard=True)
    rewards = Rewards(scene.task, scene.env)
    scene.reset()
    scene.step(np.zeros(scene.env.action_dim))
    scene.env.reward_shaping = True
    assert rewards(None) == scene.both()


def test_an_unknown_task_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown task 'Lifting'"):
        Rewards("Lifting", None)
