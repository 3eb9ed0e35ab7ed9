"""What is near an arm: where, and that only motion towards it is slowed down."""

import mujoco
import numpy as np
import pytest

from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.envs.arm_brake import SURE_GAP
from asm_gym.envs.mujoco_views import ARM, records
from asm_gym.envs.obstacles import NEAR, Obstacles

LOW = (-0.8, -0.8, -0.2)
HIGH = (0.8, 0.8, 1.4)

WORLD = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body name="wall" pos=".5 0 .5" euler="0 20 30"><geom type="box" size=".05 .2 .3"/></body>
    <body name="ball" pos="0 .5 .5"><freejoint/><geom type="sphere" size=".1"/></body>
    <body name="door" pos="0 -.5 .5"><joint type="hinge"/><geom type="box" size=".1 .02 .2"/></body>
    <body name="arm" mocap="true"><geom name="hand" type="sphere" size=".04"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def world():
    """A ball-shaped hand that can be put anywhere, among things that give way and others."""
    model = mujoco.MjModel.from_xml_string(WORLD)
    data = mujoco.MjData(model)
    arms = records(1, ARM)
    arms[0].links[:] = -1
    arms[0].links[0] = model.body("arm").id
    return model, data, Obstacles(model, data, arms)


def points_at(world, place):
    """Return what is near a hand at a place, by way."""
    model, data, obstacles = world
    data.mocap_pos[0] = place
    data.ncon = 0
    mujoco.mj_kinematics(model, data)
    obstacles.look()
    return noted(obstacles)


def noted(obstacles):
    """Return (N,) what was near the hand when obstacles looked last."""
    return obstacles.ahead.points[0, 0, : obstacles.ahead.counts[0, 0]]


def test_points_are_the_nearest_of_all_that_is_near(world):
    model, data, _ = world
    rng = np.random.default_rng(0)
    hand = model.geom("hand").id
    others = [geom for geom in range(model.ngeom) if geom != hand]
    seen = 0
    for _ in range(2000):
        found = points_at(world, rng.uniform(LOW, HIGH))
        expected = []
        for geom in others:
            ends = np.zeros(6)
            gap = mujoco.mj_geomDistance(model, data, hand, geom, NEAR, ends)
            if gap < NEAR:
                way = (ends[3:] - ends[:3]) * np.sign(gap)
                expected.append([gap, *ends[:3], *way / np.linalg.norm(way)])
        assert len(found) == len(expected)
        for point, (gap, *rest) in zip(found, expected, strict=True):
            assert point.gap == pytest.approx(gap)
            np.testing.assert_allclose([*point.place, *point.way], rest, atol=1e-9)
        seen += len(found)
    assert seen > 100


def test_a_point_moves_with_its_link_and_tells_the_gap_within_a_control_step(world):
    model, data, _ = world
    rng = np.random.default_rng(1)
    geoms = [geom for geom in range(model.ngeom) if geom != model.geom("hand").id]
    seen = 0
    for _ in range(2000):
        place = rng.uniform(LOW, HIGH)
        points = points_at(world, place).copy()
        moved = rng.uniform(-0.006, 0.006, 3)  # as far as 1 cm
        data.mocap_pos[0] = place + moved
        mujoco.mj_kinematics(model, data)
        ends = np.zeros(6)
        gaps = [
            mujoco.mj_geomDistance(model, data, model.geom("hand").id, geom, 0.1, ends)
            for geom in geoms
        ]
        for point in points:
            np.testing.assert_allclose(data.xpos[-1] + point.in_link, point.place + moved)
            told = point.gap - point.way @ moved
            if told < 0.0:
                continue
            assert np.abs(told - gaps).min() < SURE_GAP
            seen += 1
    assert seen > 100


def test_what_the_hand_touches_is_no_obstacle_and_belongs_to_the_hand(world):
    model, data, obstacles = world
    assert len(points_at(world, [0.0, 0.35, 0.5])) == 1  # 1 cm from the ball
    data.mocap_pos[0] = [0.0, 0.37, 0.5]
    mujoco.mj_forward(model, data)
    assert data.ncon == 1
    obstacles.look()
    assert len(noted(obstacles)) == 0

    data.qpos[2] = 0.12  # the ball is 2 cm above the floor, and the hand touches it from above
    data.mocap_pos[0] = [0.0, 0.5, 0.25]
    mujoco.mj_forward(model, data)
    obstacles.look()
    (point,) = noted(obstacles)
    np.testing.assert_allclose(point.way, [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(point.place, [0, 0.5, 0.02], atol=1e-6)
    assert point.gap == pytest.approx(0.02)


def test_a_hand_within_an_obstacle_moves_towards_it_as_it_goes_deeper(world):
    (point,) = points_at(world, [0.0, -0.54, 0.5])
    assert point.gap < 0.0
    np.testing.assert_allclose(point.way, [0, 1, 0], atol=1e-6)


def test_an_arm_is_slowed_down_on_its_way_to_the_table_and_not_away_from_it(lift):
    limits = ContactLimits(1e6, 1e6, hand_speed=0.5, momentum=0.5)
    lift.reset(seed=0)
    arm = lift.unwrapped
    arm.contact_limits = limits
    aside = np.float32([0, 1, 0, 0, 0, 0, 0])  # from above the cube
    for _ in range(15):
        lift.step(aside)
    down = np.float32([0, 0, -1, 0, 0, 0, 0])
    braked = []
    for _ in range(60):
        *_, info = lift.step(down)
        braked.append(info["braked"])
    height = arm.simulation.data.site_xpos[arm.simulation.arms.site[0]][2]
    away = []
    for _ in range(20):
        *_, info = lift.step(-down)
        away.append(info["braked"])
    risen = arm.simulation.data.site_xpos[arm.simulation.arms.site[0]][2] - height
    assert braked[0] == 0.0
    assert max(braked) > 0.5
    assert risen > 0.1
    assert max(away[10:]) == 0.0
