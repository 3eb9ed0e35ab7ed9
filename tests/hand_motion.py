"""The motion of an arm's hand, written plainly: the oracle of the compiled speed limit."""

import mujoco
import numpy as np

from asm_gym.envs.controllers import REACHES


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


def hand_momentum(simulation, arm, twist):
    """Return m |v|, by the reflected mass 1/m = nᵀ J M⁻¹ Jᵀ n along n = v/|v| [N s]."""
    jacobian = hand_jacobian(simulation, arm)[:3]
    mass = np.zeros((simulation.model.nv, simulation.model.nv))
    rows = np.repeat(np.arange(simulation.model.nv), simulation.model.M_rownnz)
    columns = simulation.model.M_colind
    mass[rows, columns] = mass[columns, rows] = simulation.data.M
    speed = np.linalg.norm(twist[:3])
    if speed == 0.0:
        return 0.0
    along = twist[:3] / speed
    return speed / (along @ jacobian @ np.linalg.solve(mass, jacobian.T) @ along)
