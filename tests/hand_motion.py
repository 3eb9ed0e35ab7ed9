"""The motion of an arm's hand, written plainly: the oracle of the compiled speed limit."""

import mujoco
import numpy as np

from asm_gym.envs.arm_brake import REACHES


def hand_jacobian(simulation, arm):
    """Return (6, nv) linear, then angular velocity of the hand for the speed of each joint of the model."""
    jacobian = np.zeros((6, simulation.model.nv))
    site = int(simulation.arms.site[arm])
    mujoco.mj_jacSite(simulation.model, simulation.data, jacobian[:3], jacobian[3:], site)
    return jacobian


def joint_twist(simulation, arm, speeds):
    """Return the twist (6,) of the hand for the speeds of the arm's joints [rad/s]."""
    dofs = simulation.arms.dofs[arm, : len(speeds)]
    return hand_jacobian(simulation, arm)[:, dofs] @ speeds


def present_twist(simulation, arm):
    """Return the twist (6,) that the hand has now [m/s], [rad/s]."""
    joints = int(simulation.arms.joint_count[arm])
    return joint_twist(simulation, arm, simulation.data.qvel[simulation.arms.dofs[arm, :joints]])


def hand_speed(twist):
    """Return how fast the furthest point of a hand can go [m/s]."""
    return np.linalg.norm(twist[:3]) + REACHES * np.linalg.norm(twist[3:])


def stopping_impulse(simulation, body, place, velocity):
    """Return |Λ v| of a place of a body, Λ⁻¹ = J M⁻¹ Jᵀ [N s]."""
    model, data = simulation.model, simulation.data
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, place.copy(), int(body))
    mass = np.zeros((model.nv, model.nv))
    rows = np.repeat(np.arange(model.nv), model.M_rownnz)
    mass[rows, model.M_colind] = mass[model.M_colind, rows] = data.M
    inverse = jacobian @ np.linalg.solve(mass, jacobian.T)
    return np.linalg.norm(np.linalg.solve(inverse + 1e-4 * np.eye(3), velocity))


def hand_momentum(simulation, arm, twist):
    """Return |Λ v| of the hand in a motion, a twist (6,) [N s]."""
    site = simulation.arms.site[arm]
    place = simulation.data.site_xpos[site]
    return stopping_impulse(simulation, simulation.arms.site_body[arm], place, twist[:3])


def link_momentum(simulation, arm):
    """Return the largest |Λ v| of the origins of an arm's links, and of its hand [N s]."""
    model, data = simulation.model, simulation.data
    hardest = hand_momentum(simulation, arm, present_twist(simulation, arm))
    for link in simulation.arms.links[arm, 1:]:
        if link < 0:
            break
        place = data.xpos[link]
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, place.copy(), int(link))
        velocity = jacobian @ data.qvel
        hardest = max(hardest, stopping_impulse(simulation, link, place, velocity))
    return hardest
