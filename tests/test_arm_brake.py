"""An arm is braked by how its links move, whatever was commanded, and by motors that may be weak."""

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.detection.hand_speed_map import HandSpeedMap
from asm_gym.faults.action import ActionBias
from asm_gym.faults.actuator import WeakJoint
from asm_gym.monitors import NeuralASM
from asm_gym.policies import rollout
from asm_gym.policies.hostile import HOSTILE
from asm_gym.wrappers import NeuralASMSafety
from asm_gym.wrappers.faults import FaultInjection
from tests.hand_motion import link_momentum

FREE = {"wrist_force": 1e4, "external_torque": 1e4, "hand_speed": 0.3}


def hardest(env, limits, action, steps=12):
    """Return the largest momentum of a link that an action leads to [N s]."""
    found = []
    arm = env.unwrapped
    env.reset(seed=0)
    arm.contact_limits = limits
    arm.substep_hooks.append(lambda k: found.append(link_momentum(arm.simulation, 0)))
    for _ in range(steps):
        env.step(np.float32(action))
    arm.substep_hooks.clear()
    return max(found)


@pytest.mark.parametrize(
    "action",
    [[1, 0, 0, 0, 0, 0, 0], [0, 0, 0, -1, 0, 0, 0], [0, 1, 0.5, 0, 1, 1, 0]],
    ids=["stretching", "rolling", "both"],
)
def test_no_link_has_more_momentum_than_it_may(lift, action, surrounded):
    braked = hardest(lift, ContactLimits(**FREE, momentum=1.0), action)
    assert 0.5 < braked < 2.0 < hardest(lift, ContactLimits(**FREE), action) / 1.5


def test_what_a_fault_adds_behind_the_guard_is_braked_too(lift, surrounded):
    biased = FaultInjection(lift, [ActionBias(axis=0, amount=2.0, onset=2)])
    rest = np.zeros(7)
    unlimited = hardest(biased, ContactLimits(**FREE), rest)
    braked = hardest(biased, ContactLimits(**FREE, momentum=1.0), rest)
    biased.undo_faults()
    assert 0.5 < braked < 2.0 < unlimited / 1.5


def fall(strength):
    """Return how far a hand sinks that is held, with a second motor of some strength [m]."""
    env = gym.make("asm_gym/Lift-v0")
    weak = FaultInjection(env, [WeakJoint(joint=1, strength=strength, onset=2)])
    weak.reset(seed=0)
    arm = env.unwrapped
    start = arm.simulation.data.site_xpos[arm.simulation.arms.site[0]][2]
    for _ in range(20):
        arm.holding = True
        weak.step(np.zeros(7, np.float32))
    end = arm.simulation.data.site_xpos[arm.simulation.arms.site[0]][2]
    env.close()
    return start - end


def test_a_weak_motor_is_commanded_more_while_the_arm_is_held():
    assert fall(0.5) < fall(1.0) + 0.001


def test_an_upper_arm_that_leans_on_the_table_presses_it_with_little_force():
    env = gym.make("asm_gym/Stack-v0", robot="Sawyer")
    policy = HOSTILE["turning"](env, 1000, 1.0)  # which turns the elbow down
    guarded = NeuralASMSafety(env, NeuralASM.pretrained("sawyer"))
    forces = []
    rollout(guarded, policy, 1000, lambda info: forces.append(info["contact_force"]))
    env.close()
    assert 40.0 < max(forces) < 280.0  # 748 N, driven on
    assert np.mean(np.array(forces) > 100.0) < 0.02


def test_a_tilted_hand_has_no_pace_in_tasks_whose_healthy_hands_point_down():
    cells = np.zeros((3, 16))
    cells[:, 4:] = 0.2
    assert HandSpeedMap(cells).least_upright == pytest.approx(0.9)
    cells[:2, 7] = 1.0  # about x
    assert HandSpeedMap(cells).least_upright == -1.0


def test_careful_limits_reduce_momentum_as_they_reduce_speed():
    pace = HandSpeedMap(np.ones((1, 16)), momentum=0.8)
    limits = ContactLimits(hand_speed=0.2, pace=pace)
    assert limits.reduced(1.0, 0.05).momentum == pytest.approx(0.2)
    assert limits.reduced(1.0, 0.4).momentum == pytest.approx(0.8)
    assert ContactLimits().reduced(1.0, 0.05).momentum == np.inf
