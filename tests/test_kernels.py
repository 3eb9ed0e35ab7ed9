"""The compiled mathematics against MuJoCo's, numpy's and robosuite's own."""

import mujoco
import numpy as np
import pytest

from asm_gym.envs import compiled_substeps as kernels
from asm_gym.envs import control
from asm_gym.envs.backend import import_robosuite


@pytest.fixture
def somewhere(lift):
    """The Lift environment in the middle of a movement."""
    env = lift.unwrapped
    env.reset(seed=1)
    for _ in range(5):
        env.step(np.array([0.5, 0.3, -0.4, 0.2, 0.1, 0.3, 1.0], np.float32))
    return env.simulation


def test_a_solution_solves_and_a_singular_one_is_the_least_norm():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((6, 8))
    M, b = A @ A.T, rng.standard_normal(6)
    x = b.copy()
    control.solve(M, 6, x)
    np.testing.assert_allclose(M @ x, b, atol=1e-10)
    flat = np.diag([2.0, 0.0, 1.0])
    x = np.array([4.0, 3.0, 2.0])
    control.solve(flat, 3, x)
    np.testing.assert_allclose(x, [2.0, 0.0, 2.0], atol=1e-12)
    x = np.ones(3)
    control.solve(np.full((3, 3), np.nan), 3, x)
    np.testing.assert_array_equal(x, 0.0)


def test_the_mass_matrix_is_mujocos(somewhere):
    model, data = somewhere.model, somewhere.data
    whole = np.zeros((model.nv, model.nv))
    for row, unit in zip(whole, np.eye(model.nv), strict=True):  # M is symmetric
        mujoco.mj_mulM(model, data, row, unit)
    dofs = somewhere.arms.dofs[0]
    M = np.zeros((7, 7))
    control.mass_matrix(data.M, somewhere.views, dofs, 7, M)
    np.testing.assert_array_equal(M, whole[np.ix_(dofs, dofs)])


def test_the_jacobian_and_the_hands_velocity_are_mujocos(somewhere):
    model, data, arms = somewhere.model, somewhere.data, somewhere.arms
    mujoco.mj_forward(model, data)
    linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, linear, angular, arms.site[0])
    com, J, v = data.subtree_com[arms.root[0]], np.zeros((6, 7)), np.zeros(6)
    control.jacobian(somewhere.views, arms.dofs[0], 7, data.site_xpos[arms.site[0]], com, J)
    np.testing.assert_allclose(J, np.vstack([linear, angular])[:, arms.dofs[0]], atol=1e-12)
    control.hand_velocity(somewhere.views, arms, 0, com, v)
    np.testing.assert_allclose(v, np.concatenate([linear @ data.qvel, angular @ data.qvel]), atol=1e-12)


@pytest.mark.parametrize("n", [6, 7])
def test_operational_space_torques_are_robosuites(n):
    import_robosuite()
    from robosuite.utils.control_utils import nullspace_torques, opspace_matrices

    rng = np.random.default_rng(n)
    A = rng.standard_normal((n, n))
    M, J = A @ A.T + n * np.eye(n), rng.standard_normal((6, n))
    wrench, bias, q, rest, v = rng.standard_normal(6), *rng.standard_normal((4, n))
    _, position, turning, nullspace = opspace_matrices(M, J, J[:3].copy(), J[3:].copy())
    decoupled = np.concatenate([position @ wrench[:3], turning @ wrench[3:]])
    expected = J.T @ decoupled + bias + nullspace_torques(M, nullspace, rest, q, v)
    posture = M @ (10 * (rest - q) - 2 * np.sqrt(10) * v)
    tau = np.zeros(n)
    control.osc_torques(M, J, n, wrench, posture, bias, tau)
    np.testing.assert_allclose(tau, expected, atol=1e-9)


def test_a_summary_is_the_mean_the_signed_peak_and_the_last():
    samples = np.zeros((1, 4, kernels.SAMPLE))
    samples[0, :, 0] = [1.0, -5.0, 3.0, 99.0]
    samples[0, 1, kernels.CONTACT] = [3.0, 0.0, 4.0]
    mean, peak, last = (np.zeros((1, kernels.SAMPLE)) for _ in range(3))
    assert kernels.summarise(samples, 3, mean, peak, last) == pytest.approx(5.0)
    assert (mean[0, 0], peak[0, 0], last[0, 0]) == (pytest.approx(-1 / 3), -5.0, 3.0)
