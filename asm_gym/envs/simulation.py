"""One loaded model: its physics, its controllers, and its sensors in every substep."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import must_compile
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.envs import compiled_substeps as kernels
from asm_gym.envs.arms import bodies, controller_of, describe, describe_inputs, is_compilable
from asm_gym.envs.commands import move_gripper, scaling_of
from asm_gym.envs.control import HELD
from asm_gym.envs.mujoco_views import (
    ACTS,
    ARMED,
    BRAKED,
    FELT,
    JOINTS,
    PASSED_IN,
    Bound,
    Floats,
    Goals,
    NominalViews,
    SubstepLimits,
    Views,
    Work,
)
from asm_gym.envs.nominal_dynamics import NominalDynamics
from asm_gym.envs.sensors import Proprioception
from asm_gym.spec import Channel


class Simulation:
    """Runs control steps of one loaded model.

    robosuite's OSC_POSE and JOINT_POSITION controllers on one-armed robots run compiled; every other controller is
    robosuite's own code, between the same physics substeps. ``env`` is robosuite's, just reset.
    """

    def __init__(self, env: Any, substeps: int) -> None:
        self.env = env
        self.substeps = substeps
        self.model: mujoco.MjModel = env.sim.model._model
        self.data: mujoco.MjData = env.sim.data._data
        self.warnings: Any = self.data.warning.number  # a view
        self.parts = [(robot, arm) for robot in env.robots for arm in robot.arms]
        self.views = Views.of(self.model, self.data)
        robots = np.unique(np.concatenate([bodies(self.model, robot) for robot, _ in self.parts]))
        # the robots' own model of their dynamics
        self.nominal = NominalDynamics(self.model, self.views, robots)
        n = len(self.parts)
        self._samples = np.zeros((n, substeps, kernels.SAMPLE))
        self.speed_limits = np.full(n, np.inf)
        """(A,) speed of the fastest point of an arm, from which on it is slowed down [m/s]."""
        self._limits = SubstepLimits(
            np.full((n, FELT), np.inf), np.zeros(1), np.zeros(6, np.int64), self.speed_limits
        )
        self.proprioception = Proprioception(self.parts, self.views, self.data)
        self.contact_force = 0.0
        """The largest net contact force on an arm within the control step [N]. In the sum over its bodies a grasp's own
        squeeze cancels; loads that a fault applies are left out."""
        self.keeps_history = False
        """Whether robosuite's buffers of recent forces and velocities are kept up, which cost more than a substep."""
        self.begin_episode()

    def begin_episode(self) -> None:
        """Take up the controllers, which robosuite makes anew in every reset."""
        self._done = 0
        self._row_began = 0
        self._force_before = 0.0
        self._pressed = False
        self._fresh = False
        self._samples[:] = 0.0
        self.dofs = np.concatenate([robot._ref_joint_vel_indexes for robot, _ in self.parts])
        """Places of the arms' joints among the velocities."""
        self._work = Work.empty()
        self._bound: tuple[NominalViews, Bound] | None = None
        self._take_up_controllers()
        self._forget_limits()

        if must_compile(kernels.run):
            print(
                "asm-gym: compiling the simulation loop, once on this machine (about 10 s)",
                file=sys.stderr,
            )
            self._run(0)
        kernels.sample(self.views, self.nominal.now(), self.arms, 0, self._samples)
        self._add_up(1)

    def _take_up_controllers(self) -> None:
        # whether control runs compiled
        self.compiled = all(is_compilable(part) for part in self.parts)
        self.arms = describe(self.parts, self.model)
        self.controllers = [controller_of(part) for part in self.parts]
        """Robosuite's, of each arm."""
        self.moves: list[slice] = []
        """Each arm's part of the action, asked for once an episode: robosuite makes it anew at every look."""
        self._grips: list[Callable[[Floats], None]] = []
        start = 0
        for a, (robot, arm) in enumerate(self.parts):
            low, high = robot._action_split_indexes[arm]
            move = slice(start + low, start + high)
            self.moves.append(move)
            describe_inputs(self.arms, a, self.model, self.controllers[a], move)
            grip = self._gripper(start, robot, arm)
            if grip is not None:
                self._grips.append(grip)
            start += robot.action_dim
        self._goals = Goals.of(len(self.parts), start)

    def _forget_limits(self) -> None:
        self.speed_limits[:] = np.inf
        self._limits.state[:] = 0, 0, 0, -1, 0, 0
        self._limits_set: ContactLimits | None = None
        # Arm and index in the limits of each number that limits apply to, and its column in a sample.
        used = np.ones((len(self.parts), FELT), bool)
        for a, joints in enumerate(self.arms.joints):
            used[a, joints:JOINTS] = False
        self._limited = np.nonzero(used)
        number = self._limited[1]
        self._columns = np.where(number < JOINTS, number, number - JOINTS + kernels.WRENCH.start)

    def begin(self, limits: ContactLimits | None = None, limited: Sequence[Channel] = ()) -> None:
        """Begin a control step under ``limits`` of the ``limited`` channels."""
        self._done = self._row_began = 0
        self._limits.state[:] = 0, 0, 0, -1, 0, 0
        self._pressed, self._limits.load[0] = self.load > 1.0, 0.0
        if limits is not None:
            if limits is not self._limits_set:
                self._limits.most[self._limited], self._limits_set = limits.most(limited), limits
            self._limits.state[ARMED], self._limits.state[ACTS] = 1, limits.stays
        self._force_before = 0.0

    def command(self, action: NDArray[np.float64], hold: bool = False) -> None:
        """Give the controllers a new set-point, which they take up in the next substep.

        Args:
            hold: the arms are to stay, which no action says: one of no change follows a push, a torque of zero brakes
                nothing. So they are braked beneath their controllers (``control.brake``).
        """
        if hold:
            self._goals.held[self._goals.held == 0] = HELD
        else:
            self._goals.held[:] = 0
        self._goals.action[:] = action
        self._fresh = True
        if self.compiled and not (
            hold and self._pressed
        ):  # fingers that close on a table would lift the hand
            for grip in self._grips:
                grip(action)

    def advance(self, count: int) -> None:
        """Run ``count`` substeps of the control step that was begun."""
        if not self.compiled:
            self._run_robosuites(count)
        elif self.keeps_history and self._done == 0:
            wrenches = [self.data.sensordata[at : at + 6].copy() for at in self.arms.wrench]
            self._run(count)
            self._remember(wrenches)
        else:
            self._run(count)
        self._fresh = False
        self._done += count

    def _run_robosuites(self, count: int) -> None:
        """Run substeps under robosuite's own controllers."""
        first = self._done - self._row_began
        for k in range(first, first + count):
            nominal = self.nominal.now()
            self.env.sim.step1()
            self.env._pre_action(self._goals.action.copy(), self._fresh)
            if self._goals.held.any() or self.speed_limits.min() < np.inf:
                kernels.brake_beneath(
                    self.views, nominal, self.arms, self._goals, self._work, self._limits
                )
            self.env.sim.step2()
            kernels.sample(self.views, nominal, self.arms, k, self._samples)
            kernels.feel(self.arms.joints, self._limits, self._goals.held, k, self._samples)
            self._fresh = False

    def _run(self, count: int) -> None:
        nominal = self.nominal.now()
        if self._bound is None or self._bound[0] is not nominal:
            state = (
                self.views,
                nominal,
                self.arms,
                self._goals,
                self._work,
                self._limits,
                self._samples,
            )
            self._bound = nominal, kernels.bind(*state)
        kernels.run(self._bound[1], self._fresh, self._done - self._row_began, count)

    def begin_row(self) -> None:
        """Begin another row of the stream; the contact force goes on to be that of the whole control step."""
        self._force_before = self.contact_force
        self._row_began = self._done

    @property
    def passed_limit(self) -> int | None:
        """The first substep of the control step in which a limit was passed; None for none."""
        first = int(self._limits.state[PASSED_IN])
        return None if first < 0 else first

    @property
    def load(self) -> float:
        """The largest share of a contact limit that was reached in the control step; infinite for NaN."""
        return float(self._limits.load[0])

    @property
    def braked(self) -> float:
        """The share of the control step's substeps in which an arm was slowed down beneath its controller."""
        return float(self._limits.state[BRAKED]) / max(1, self._done * len(self.parts))

    @property
    def felt(self) -> NDArray[np.float64]:
        """(K, N) noiseless loads in each substep since the row began: of each arm the external torque of its joints
        [N m], then the force at its wrist [N]."""
        return self._samples[self._limited[0], : self._done - self._row_began, self._columns].T

    @property
    def felt_mean(self) -> Floats:
        """(N,) their means over the substeps that ``sense`` has summarised last."""
        return self.proprioception.mean[self._limited[0], self._columns]

    @property
    def contact_forces(self) -> NDArray[np.float64]:
        """(K,) the largest net contact force on an arm in each substep since the row began [N]; no sensor tells it."""
        forces = self._samples[:, : self._done - self._row_began, kernels.CONTACT]
        return np.linalg.norm(forces, axis=2).max(axis=0)

    def sense(self, beside: Floats, noise: Floats, rng: np.random.Generator) -> Floats:
        """Return noisy readings (M,) of all sensors, summarised over the substeps since the row began; see
        ``compiled_substeps.sense``."""
        if self._done > self._row_began:
            self._add_up(self._done - self._row_began)
        row = rng.standard_normal(len(noise))
        kernels.sense(self.proprioception.sources, self.proprioception.where, beside, noise, row)
        return row

    def _add_up(self, count: int) -> None:
        """Summarise ``count`` substeps, and take the force of the row into that of the control step; NaN stays."""
        p, before = self.proprioception, self._force_before
        force = kernels.summarise(self._samples, count, p.mean, p.peak, p.last)
        self.contact_force = force if force != force or force > before else before

    def _remember(self, wrenches: list[NDArray[np.float64]]) -> None:
        """Fill the buffers that robosuite fills in the first substep; the acceleration is its running estimate."""
        for (robot, arm), wrench, sample in zip(
            self.parts, wrenches, self._samples[:, 0], strict=True
        ):
            velocities = robot.recent_ee_vel_buffer[arm]
            robot.recent_ee_forcetorques[arm].push(wrench)
            velocities.push(sample[kernels.VELOCITY])
            changes = robot.control_freq * np.diff(velocities.buf, axis=0)
            recent = np.vstack([robot.recent_ee_acc[arm].current, changes])
            robot.recent_ee_acc[arm].push(recent.mean(axis=0))

    def _gripper(
        self, start: int, robot: Any, arm: str
    ) -> Callable[[NDArray[np.float64]], None] | None:
        """Return a function that moves the gripper of an arm by an action whose part of this robot is at ``start``."""
        name = robot.get_gripper_name(arm)
        low, high = robot._action_split_indexes.get(name, (0, 0))
        if low == high:
            return None
        controller, motors = (
            robot.composite_controller.part_controllers[name],
            robot._ref_actuators_indexes_dict[name],
        )
        c, gripper, ctrl, motors = (
            controller,
            robot.gripper[arm],
            self.views.ctrl,
            np.asarray(motors, np.int64),
        )
        scaling = scaling_of(c, c.control_dim)[None]
        middle, half = (
            0.5 * (c.actuator_max + c.actuator_min),
            0.5 * (c.actuator_max - c.actuator_min),
        )
        ranges = np.array([middle, half, *self.views.actuator_ctrlrange[motors].T])

        def move(action: NDArray[np.float64]) -> None:
            # As robosuite's controller does it, less its reading of the joints, which nothing here uses.
            asked = np.asarray(
                gripper.format_action(action[start + low : start + high]), np.float64
            )
            move_gripper(asked, scaling, ranges, motors, ctrl)

        return move

    def hand_change(self, a: int, turns: Floats) -> Floats:
        """Return the change (6,) of the pose of arm ``a``'s hand, in the frame of actions, by turns (n,) of joints."""
        jacobian = np.zeros((6, self.model.nv))
        mujoco.mj_jacSite(self.model, self.data, jacobian[:3], jacobian[3:], int(self.arms.site[a]))
        change = jacobian[:, self.arms.dofs[a, : len(turns)]] @ turns
        base = int(self.arms.base[a])
        if base < 0:
            return change
        frame = self.data.site_xmat[base].reshape(3, 3)
        return np.concatenate([frame.T @ change[:3], frame.T @ change[3:]])

    @property
    def motors(self) -> NDArray[np.intp]:
        """The actuators of the arms' joints, from the base on."""
        return np.concatenate([robot._ref_actuators_indexes_dict[arm] for robot, arm in self.parts])
