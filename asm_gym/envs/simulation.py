"""One loaded model: its physics, its controllers, and its sensors in every substep."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import Bound, announce, bind
from asm_gym.detection.contact_limits import FREE_FORCE, ContactLimits
from asm_gym.detection.hand_speed import NO_SPEED_LIMIT
from asm_gym.envs import compiled_substeps as kernels
from asm_gym.envs.arms import (
    PHYSICS_FREQ,
    bodies,
    controller_of,
    describe,
    describe_inputs,
    is_compilable,
)
from asm_gym.envs.controller_inputs import Gripper
from asm_gym.envs.controllers import HELD
from asm_gym.envs.mujoco_views import (
    FELT,
    GOAL,
    JOINTS,
    STATUS,
    Ahead,
    Floats,
    MotionLimits,
    NominalViews,
    SubstepLimits,
    Views,
    Work,
    records,
)
from asm_gym.envs.nominal_dynamics import NominalDynamics
from asm_gym.envs.obstacles import Obstacles
from asm_gym.envs.sensors import Proprioception
from asm_gym.envs.strain import StrainSensor
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
        bodies_of_robots = [bodies(self.model, robot) for robot, _ in self.parts]
        own_bodies = np.unique(np.concatenate(bodies_of_robots))
        # the robots' own model of their dynamics
        self.nominal = NominalDynamics(self.model, self.views, own_bodies)
        arm_count = len(self.parts)
        self._samples = np.zeros((arm_count, substeps, kernels.SAMPLE))
        self.speed_limits = np.full(arm_count, np.inf)
        """(A,) speed of the fastest point of an arm, from which on it is slowed down [m/s]."""
        self._limits = SubstepLimits(
            load_limits=np.full((arm_count, FELT), np.inf),
            load_share=np.zeros(1),
            status=records(1, STATUS),
            speed_limits=self.speed_limits,
            motion=(NO_SPEED_LIMIT, NO_SPEED_LIMIT),
            ahead=Ahead.everywhere(arm_count),
        )
        self._motion_limits_set: ContactLimits | None = None
        self.proprioception = Proprioception(self.parts, self.views, self.data)
        self.strain = StrainSensor(self.parts, self.model, self.data)
        self.contact_force = 0.0
        """The largest net contact force on an arm within the control step [N]. In the sum over its bodies a grasp's own
        squeeze cancels; loads that a fault applies are left out."""
        self.keeps_history = False
        """Whether robosuite's buffers of recent forces and velocities are kept up, which cost more than a substep."""
        self.begin_episode()

    def begin_episode(self) -> None:
        """Take up the controllers, which robosuite makes anew in every reset."""
        self._substeps_done = 0  # of the control step
        self._row_start = 0  # substep of the control step at which the row begins
        self._force_of_earlier_rows = 0.0  # the largest in this control step [N]
        self._impulse_of_earlier_rows = 0.0  # in this control step [N s]
        self._pressed = False  # a contact limit was passed in the control step before
        self._has_new_command = False  # that the controllers have not taken up
        self._samples[:] = 0.0
        self.dofs = np.concatenate([robot._ref_joint_vel_indexes for robot, _ in self.parts])
        """Places of the arms' joints among the velocities."""
        self._work = Work.empty()
        self._bound_nominal: NominalViews | None = None  # that ``_bound`` holds
        self._take_up_controllers()
        self._clear_limits()

        if announce(kernels.run, "the simulation loop"):
            self._run(0)
        kernels.sample(self.views, self.nominal.now(), self.arms, 0, self._samples)
        self._summarise(1)

    def _take_up_controllers(self) -> None:
        """Describe the controllers, and each arm's part of the action."""
        # whether control runs compiled
        self.compiled = all(is_compilable(part) for part in self.parts)
        self.arms = describe(self.parts, self.model)
        self._obstacles = Obstacles(self.model, self.data, self.arms)
        self._limits = self._limits._replace(ahead=self._obstacles.ahead)
        self._goals = records(len(self.parts), GOAL)
        self._goals.strengths[:] = 1.0
        self.controllers = [controller_of(part) for part in self.parts]
        """Robosuite's, of each arm."""
        self.moves: list[slice] = []
        """Each arm's part of the action; robosuite computes it anew whenever it is read."""
        self._grippers: list[Gripper] = []
        start = 0
        for a, (robot, arm) in enumerate(self.parts):
            low, high = robot._action_split_indexes[arm]
            move = slice(start + low, start + high)
            self.moves.append(move)
            describe_inputs(self.arms[a], self.model, self.controllers[a], move)

            no_gripper = 0, 0
            gripper_name = robot.get_gripper_name(arm)
            low, high = robot._action_split_indexes.get(gripper_name, no_gripper)
            if low < high:
                grip = slice(start + low, start + high)
                self._grippers.append(Gripper(robot, arm, grip, self.views))
            start += robot.action_dim
        self._action = np.zeros(start)  # in robosuite's units

    def _clear_limits(self) -> None:
        """Remove the limits of contact and speed, and choose the numbers that limits would apply to."""
        self.speed_limits[:] = np.inf
        self._limits.load_share[:] = 0.0
        self._limits.status[:] = 0
        self._limits_set: ContactLimits | None = None
        # Arm, and column of a sample, of each number that limits apply to.
        columns = np.arange(FELT)
        is_wrist = columns >= JOINTS
        is_joint = columns < self.arms.joint_count[:, None]  # (arms, FELT)
        self._limited = np.nonzero(is_wrist | is_joint)

    def begin(self, limits: ContactLimits | None = None, limited: Sequence[Channel] = ()) -> None:
        """Begin a control step under ``limits`` of the ``limited`` channels."""
        self._substeps_done = 0
        self._row_start = 0
        self._force_of_earlier_rows = 0.0
        self._impulse_of_earlier_rows = 0.0
        self._pressed = self.load > 1.0
        self._limits.load_share[0] = 0.0
        self._limits.status[:] = 0
        if limits is None:
            return
        if limits is not self._limits_set:
            self._limits.load_limits[self._limited] = limits.limit_of_each(limited)
            self._limits_set = limits
        self._obstacles.look()
        self._limits.status.armed = True
        self._limits.status.stops = limits.stays

    @property
    def ahead(self) -> Ahead:
        """Where the arms are near obstacles; changed in place."""
        return self._limits.ahead

    @property
    def motion_limits(self) -> MotionLimits:
        """The limits of the motion of hands, and of hands beside their own base."""
        return self._limits.motion

    def limit_motion(self, limits: ContactLimits) -> None:
        """Slow the arms down by the speed and momentum of ``limits`` from now on."""
        if limits is self._motion_limits_set:
            return
        beside_base = limits.reduced(1.0, limits.hand_speed / 2)
        motion = limits.speed_limit(), beside_base.speed_limit()
        self._limits = self._limits._replace(motion=motion)
        self._motion_limits_set = limits
        self._bound_nominal = None  # the compiled substeps have the former limits

    def command(self, action: Floats, hold: bool = False) -> None:
        """Give the controllers a new set-point, which they take up in the next substep.

        Args:
            action: (A,) in robosuite's units.
            hold: the arms are to stay, which no action says: one of no change follows a push, a torque of zero brakes
                nothing. So they are braked beneath their controllers (``controllers.brake``).
        """
        held = self._goals.held
        if hold:
            held[held == 0] = HELD
        else:
            held[:] = 0
        self._action[:] = action
        self._has_new_command = True

        # Fingers that close on a table would lift the hand.
        stays_open = hold and self._pressed
        if self.compiled and not stays_open:
            for gripper in self._grippers:
                gripper.command(action)

    def advance(self, count: int) -> None:
        """Run ``count`` substeps of the control step that was begun."""
        if not self.compiled:
            self._run_robosuites(count)
        elif self.keeps_history and self._substeps_done == 0:
            sensed = self.data.sensordata
            wrenches = [sensed[at : at + 6].copy() for at in self.arms.wrench]
            self._run(count)
            self._remember(wrenches)
        else:
            self._run(count)
        self._has_new_command = False
        self._substeps_done += count

    def _run_robosuites(self, count: int) -> None:
        """Run substeps under robosuite's own controllers."""
        first = self._substeps_done - self._row_start  # since the row began
        for k in range(first, first + count):
            nominal = self.nominal.now()
            self.env.sim.step1()
            self.env._pre_action(self._action.copy(), self._has_new_command)
            kernels.evaluate_nominal(self.views, nominal)
            if self._goals.held.any() or self.speed_limits.min() < np.inf:
                kernels.brake_beneath(
                    self.views, nominal, self.arms, self._goals, self._work, self._limits
                )
            self.env.sim.step2()
            kernels.sample(self.views, nominal, self.arms, k, self._samples)
            kernels.feel(self._goals, self._limits, k, self._samples)
            self._has_new_command = False

    def _run(self, count: int) -> None:
        """Run compiled substeps."""
        nominal = self.nominal.now()
        if nominal is not self._bound_nominal:
            self._bind(nominal)
        kernels.run(
            self._bound, self._has_new_command, self._substeps_done - self._row_start, count
        )

    def _bind(self, nominal: NominalViews) -> None:
        """Prepare the arguments of compiled substeps."""
        parts = (
            self.views,
            nominal,
            self.arms,
            self._goals,
            self._work,
            self._limits,
            self._action,
            self._samples,
        )
        self._bound_nominal = nominal
        self._bound: Bound = bind(*parts)

    def begin_row(self) -> None:
        """Begin another row of the stream; the contact force goes on to be that of the whole control step."""
        self._force_of_earlier_rows = self.contact_force
        self._impulse_of_earlier_rows = self.contact_impulse
        self._row_start = self._substeps_done

    @property
    def passed_limit(self) -> int | None:
        """The first substep of the control step in which a limit was passed; None for none."""
        passed_after = int(self._limits.status[0]["passed_after"])
        if passed_after == 0:
            return None
        return passed_after - 1

    @property
    def load(self) -> float:
        """The largest share of a contact limit that was reached in the control step; infinite for NaN."""
        return float(self._limits.load_share[0])

    @property
    def braked(self) -> float:
        """The share of the control step's substeps in which an arm was slowed down beneath its controller."""
        braked = float(self._limits.status[0]["braked"])
        return braked / max(1, self._substeps_done * len(self.parts))

    @property
    def felt(self) -> Floats:
        """(K, N) noiseless loads in each substep since the row began: of each arm the external torque of its joints
        [N m], then the force at its wrist [N]."""
        arms, columns = self._limited
        return self._samples[arms, : self._substeps_done - self._row_start, columns].T

    @property
    def felt_mean(self) -> Floats:
        """(N,) their means over the substeps that ``sense`` has summarised last."""
        return self.proprioception.mean[self._limited]

    @property
    def contact_forces(self) -> Floats:
        """(K,) the largest net contact force on an arm in each substep since the row began [N]; no sensor tells it."""
        forces = self._samples[:, : self._substeps_done - self._row_start, kernels.CONTACT]
        return np.linalg.norm(forces, axis=2).max(axis=0)

    @property
    def contact_impulse(self) -> float:
        """Contact force beyond ``FREE_FORCE``, summed over the substeps of the control step so far [N s]."""
        count = self._substeps_done - self._row_start
        excess = kernels.summed_excess(self._samples, count, FREE_FORCE)
        return self._impulse_of_earlier_rows + excess / PHYSICS_FREQ

    def sense(self, other_values: Floats, noise: Floats, rng: np.random.Generator) -> Floats:
        """Return noisy readings (M,) of all sensors, summarised over the substeps since the row began.

        The arguments are those of ``compiled_substeps.sense``.
        """
        if self._substeps_done > self._row_start:
            self._summarise(self._substeps_done - self._row_start)
        own = self.proprioception
        row = rng.standard_normal(len(noise))
        kernels.sense(own.sources, own.places, other_values, noise, row)
        return row

    def _summarise(self, count: int) -> None:
        """Summarise ``count`` substeps of a row; the contact force is the largest of the control step so far."""
        own = self.proprioception
        self.contact_force = kernels.summarise(self._samples, count, own.mean, own.peak, own.last)
        if self.contact_force <= self._force_of_earlier_rows:  # NaN is not, and stays
            self.contact_force = self._force_of_earlier_rows

    def _remember(self, wrenches: list[Floats]) -> None:
        """Fill the buffers that robosuite fills in the first substep; the acceleration is its running estimate."""
        for a, (robot, arm) in enumerate(self.parts):
            velocities = robot.recent_ee_vel_buffer[arm]
            robot.recent_ee_forcetorques[arm].push(wrenches[a])
            velocities.push(self._samples[a, 0, kernels.VELOCITY])
            changes = robot.control_freq * np.diff(velocities.buf, axis=0)
            recent = np.vstack([robot.recent_ee_acc[arm].current, changes])
            robot.recent_ee_acc[arm].push(recent.mean(axis=0))

    def hand_change(self, a: int, turns: Floats) -> Floats:
        """Return the change (6,) of the pose of arm ``a``'s hand, in the frame of actions, by turns (n,) of joints."""
        arm = self.arms[a]
        jacobian = np.zeros((6, self.model.nv))
        linear = jacobian[:3]
        angular = jacobian[3:]
        mujoco.mj_jacSite(self.model, self.data, linear, angular, arm.site)
        change = jacobian[:, arm.dofs[: len(turns)]] @ turns
        frame = self.data.site_xmat[arm.frame].reshape(3, 3)
        return np.concatenate([frame.T @ change[:3], frame.T @ change[3:]])

    @property
    def motors(self) -> NDArray[np.intp]:
        """The actuators of the arms' joints, from the base on."""
        return np.concatenate([robot._ref_actuators_indexes_dict[arm] for robot, arm in self.parts])
