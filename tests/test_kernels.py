"""The compiled mathematics against MuJoCo's, numpy's and robosuite's own."""

import mujoco
import numpy as np
import pytest

from asm_gym.envs import compiled_substeps as kernels
from asm_gym.envs import controllers
from asm_gym.envs.mujoco_views import Work
from asm_gym.envs.robosuite_backend import import_robosuite
from tests.problems import called


@pytest.fixture
def somewhere(lift):
    """The Lift environment in the middle of a movement."""
    env = lift.unwrapped
    env.reset(seed=1)
    for _ in range(5):
        env.step(np.array([0.5, 0.3, -0.4, 0.2, 0.1, 0.3, 1.0], np.float32))
    return env.simulation


def test_a_solution_solves_and_where_a_matrix_is_singular_numbers_that_depend_on_others_are_0():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((6, 8))
    M, L = A @ A.T, np.empty((6, 6))
    b = rng.standard_normal((2, 6))
    x = b.copy()
    called(controllers.solve)(M, 6, L, x[1])
    np.testing.assert_allclose(M @ x[1], b[1], atol=1e-10)
    np.testing.assert_array_equal(x[0], b[0])
    x = np.array([[4.0, 3.0, 2.0]])
    called(controllers.solve)(np.diag([2.0, 0.0, 1.0]), 3, L, x[0])
    np.testing.assert_allclose(x, [[2.0, 0.0, 2.0]], atol=1e-12)
    x = np.array([[2.0, 2.0, 5.0]])
    called(controllers.solve)(
        np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), 3, L, x[0]
    )
    np.testing.assert_allclose(x, [[2.0, 0.0, 5.0]], atol=1e-12)
    x = np.ones((1, 3))
    called(controllers.solve)(np.full((3, 3), np.nan), 3, L, x[0])
    np.testing.assert_array_equal(x, 0.0)


def test_an_arms_mass_matrix_and_jacobian_and_its_hands_velocity_are_mujocos(somewhere):
    model, data, arms, work = somewhere.model, somewhere.data, somewhere.arms, Work.empty()
    mujoco.mj_forward(model, data)
    whole, dofs = np.zeros((model.nv, model.nv)), arms.dofs[0]
    for row, unit in zip(whole, np.eye(model.nv), strict=True):  # M is symmetric
        mujoco.mj_mulM(model, data, row, unit)
    linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, linear, angular, arms.site[0])
    nominal, samples = somewhere.nominal.unedited, np.zeros((1, 1, kernels.SAMPLE))
    called(controllers.read_arm)(somewhere.views, nominal, arms[0], work)
    kernels.sample(somewhere.views, nominal, arms, 0, samples)
    np.testing.assert_array_equal(work.mass, whole[np.ix_(dofs, dofs)])
    np.testing.assert_array_equal(
        [work.bias, work.velocities], [data.qfrc_bias[dofs], data.qvel[dofs]]
    )
    np.testing.assert_allclose(work.jacobian, np.vstack([linear, angular])[:, dofs], atol=1e-12)
    velocity = np.concatenate([linear @ data.qvel, angular @ data.qvel])
    np.testing.assert_allclose(samples[0, 0, kernels.VELOCITY], velocity, atol=1e-12)


@pytest.mark.parametrize("n", [6, 7])
def test_operational_space_torques_are_robosuites(n):
    import_robosuite()
    from robosuite.utils.control_utils import nullspace_torques, opspace_matrices

    rng, work = np.random.default_rng(n), Work.empty()
    A = rng.standard_normal((n, n))
    M, J = A @ A.T + n * np.eye(n), rng.standard_normal((6, n))
    wrench, bias, q, rest, v = rng.standard_normal(6), *rng.standard_normal((4, n))
    _, position, turning, nullspace = opspace_matrices(M, J, J[:3].copy(), J[3:].copy())
    decoupled = np.concatenate([position @ wrench[:3], turning @ wrench[3:]])
    expected = J.T @ decoupled + bias + nullspace_torques(M, nullspace, rest, q, v)
    work.mass[:n, :n], work.jacobian[:, :n], work.bias[:n], work.force[:] = M, J, bias, wrench
    work.torques[:n] = M @ (10 * (rest - q) - 2 * np.sqrt(10) * v)
    called(controllers.osc_torques)(work, n)
    np.testing.assert_allclose(work.torques[:n], expected, atol=1e-9)


def test_a_summary_is_the_mean_the_signed_peak_and_the_last():
    samples = np.zeros((1, 4, kernels.SAMPLE))
    samples[0, :, 0] = [1.0, -5.0, 3.0, 99.0]
    samples[0, 1, kernels.CONTACT] = [3.0, 0.0, 4.0]
    mean, peak, last = (np.zeros((1, kernels.SAMPLE)) for _ in range(3))
    assert kernels.summarise(samples, 3, mean, peak, last) == pytest.approx(5.0)
    assert (mean[0, 0], peak[0, 0], last[0, 0]) == (pytest.approx(-1 / 3), -5.0, 3.0)
