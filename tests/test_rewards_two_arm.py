"""The rewards of the tasks for a pair of arms against robosuite's own, where every stage is reached."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from tests.scenes import UP, Scene, of


def pads(env: Any, k: int) -> list[str]:
    """One geom of each pad of a robot's hand."""
    geoms = env.robots[k].gripper["right"].important_geoms
    return [geoms["left_fingerpad"][0], geoms["right_fingerpad"][0]]


@of("TwoArmLift")
@pytest.mark.parametrize("holding", [(), (0,), (1,), (0, 1)])
def test_two_arm_lift(scene: Scene, holding: tuple[int, ...]) -> None:
    env = scene.env
    handles = env.pot.handle0_geoms, env.pot.handle1_geoms
    scene.touch(*((pad, handles[k][-1]) for k in holding for pad in pads(env, k)))
    terms = scene.both().terms
    assert [terms["grasp_0"], terms["grasp_1"]] == [(k in holding) / 12 for k in (0, 1)]
    pot = scene.data.xpos[env.pot_body_id].copy()
    height = pot[2] + env.sim.data.site_xpos[env.table_top_id][2] - _bottom(scene)
    for quat, upright in (((1, 0, 0, 0), True), ((0.97, 0.26, 0, 0), False), ((0.5, 0.5, 0.5, 0.5), False)):
        scene.place(env.pot, [*pot[:2], height + 0.09], np.array(quat) / np.linalg.norm(quat))
        if quat[0] > 0.6:
            assert (scene.both().terms["lift"] > 0) == upright
        scene.place(env.pot, [*pot[:2], height + 0.3])
        terms, success = scene.both()
        assert success
        assert sum(terms.values()) == terms["lift"] == upright


def _bottom(scene: Scene) -> float:
    return float(scene.data.site_xpos[scene.env.pot_center_id, 2] - scene.env.pot.top_offset[2])


@of("TwoArmPegInHole")
def test_two_arm_peg_in_hole(scene: Scene) -> None:
    env, data, rng = scene.env, scene.data, np.random.default_rng(0)
    peg, hole = env.peg_body_id, env.hole_body_id
    successes = 0
    for _ in range(100):
        data.xmat[hole] = np.linalg.qr(rng.normal(size=(3, 3)))[0].ravel()
        data.xmat[peg] = data.xmat[hole] + rng.normal(0, 0.1, 9)
        data.xpos[peg] = data.xpos[hole] + 0.1 * data.xmat[hole, ::3] + rng.normal(0, 0.05, 3)
        terms, success = scene.both()
        assert (terms["place"] == 0.2) == success
        assert min(terms[name] for name in ("reach", "perpendicular", "parallel", "align")) > 0
        successes += success
    assert 10 < successes < 90


@of("TwoArmHandover")
@pytest.mark.parametrize("first", ["", "handle", "head"])
@pytest.mark.parametrize("second", ["", "handle", "head"])
def test_two_arm_handover(scene: Scene, first: str, second: str) -> None:
    env = scene.env
    parts = {"handle": env.hammer.handle_geoms[0], "head": env.hammer.head_geoms[0]}
    held = [(pad, parts[part]) for k, part in enumerate((first, second)) if part for pad in pads(env, k)]
    hammer = scene.data.xpos[env.hammer_body_id].copy()
    scene.touch(*held)
    won = {name for name, value in scene.both().terms.items() if value}
    assert won == {"grasp" if first else "reach"}
    scene.touch()
    for quat in ((1, 0, 0, 0), (0.7, 0.7, 0, 0), (0.7, 0, 0.7, 0), (0, 1, 0, 0)):
        for height in (0.1, 0.2, 0.3, 0.4):
            scene.place(env.hammer, hammer + height * UP, quat)
            scene.both()
    while scene.data.ncon < len(held):
        scene.place(env.hammer, hammer)
        mujoco.mj_step(scene.model, scene.data)
    scene.touch(*held)
    scene.data.geom_xpos[env.hammer_handle_geom_id, 2] += 0.5
    terms, success = scene.both()
    won = {name for name, value in terms.items() if value}
    if second != "handle":
        assert won == {"lift", "hover"}
    else:
        assert won == {"mutual_grasp" if first else "handover"}
    assert success is (second == "handle" and not first)


@of("TwoArmTransport")
def test_two_arm_transport(scene: Scene) -> None:
    parts = scene.env.transport
    assert not scene.both().success
    scene.place(parts.payload, parts.target_bin_pos + 0.02 * UP)
    assert not scene.both().success
    scene.place(parts.trash, parts.trash_bin_pos + 0.02 * UP)
    assert scene.both() == ({"success": 1.0}, True)
