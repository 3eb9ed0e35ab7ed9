"""One loaded model: its physics, its controllers, and what the sensors see in every substep."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.addresses import table
from asm_gym.compilation import must_compile
from asm_gym.contact_limits import ContactLimits
from asm_gym.envs import compiled_substeps as kernels
from asm_gym.envs.arms import bodies, compilable, describe
from asm_gym.envs.control import hold_at
from asm_gym.envs.mujoco_views import (
    ACTS,
    ARMED,
    FELT,
    JOINTS,
    LEFT,
    Floats,
    Goals,
    Ints,
    NominalViews,
    SubstepLimits,
    Views,
)
from asm_gym.envs.nominal_robot import NominalDynamics
from asm_gym.envs.sensors import Proprioception, SensorErrors
from asm_gym.envs.speeds import HandSpeeds
from asm_gym.spec import Channel


class Reading(NamedTuple):
    """What sensors read.

    Attributes:
        row: (M,) as ``RobosuiteEnv.measured_spec`` names it.
        stream: (D,) what of it the stream carries.
        whole, through: whether they are finite in single precision.
    """

    row: Floats
    stream: NDArray[np.float32]
    whole: bool
    through: bool


class Simulation:
    """Runs control steps of one loaded model.

    robosuite's OSC_POSE and JOINT_POSITION controllers on one-armed robots run compiled; every other controller is
    robosuite's own code, between the same physics substeps.

    Args:
        env: robosuite's environment, its episode just reset.
        substeps: physics substeps of a control step.
    """

    def __init__(self, env: Any, substeps: int) -> None:
        self.env = env
        self.substeps = substeps
        self.model: mujoco.MjModel = env.sim.model._model
        self.data: mujoco.MjData = env.sim.data._data
        self._rotations = importlib.import_module("robosuite.utils.transform_utils")
        self.parts = [(robot, arm) for robot in env.robots for arm in robot.arms]
        self._views = Views.of(self.model, self.data)
        robots = np.unique(np.concatenate([bodies(self.model, robot) for robot, _ in self.parts]))
        self.nominal = NominalDynamics(self.model, self._views, robots)
        """What the robot believes of itself."""
        self._samples = np.zeros((len(self.parts), substeps, kernels.SAMPLE))
        n = len(self.parts)
        self._limits = SubstepLimits(np.full((n, FELT), np.inf), np.zeros(1), np.zeros(5, np.int64))
        self.proprioception = Proprioception(self.parts, self._views, self.data)
        self.contact_force = self.external_force = self.mean_external_force = 0.0
        """The largest net contact force on an arm within the control step [N]: the norm of the summed contact forces on
        its bodies. A grasp's own squeeze cancels in the sum, and loads that a fault applies are left out."""
        self.keeps_history = False
        """Whether robosuite's buffers of recent forces and velocities are kept up, which cost more than a substep."""
        self.begin_episode()

    def begin_episode(self) -> None:
        """Takes up the controllers, which robosuite makes anew in every reset."""
        robots = self.env.robots
        self._done = self._row_began = 0
        self._felt = (0.0, 0.0, 0.0)
        self._fresh = False
        self._action = np.zeros(sum(robot.action_dim for robot in robots))
        self._controllers = [robot.composite_controller.part_controllers[arm] for robot, arm in self.parts]
        # Asked once an episode: robosuite puts these together anew at every look.
        starts = np.cumsum([0, *(robot.action_dim for robot, _ in self.parts)]).tolist()
        splits = [robot._action_split_indexes[arm] for robot, arm in self.parts]
        self._moves = [slice(start + low, start + high) for start, (low, high) in zip(starts, splits, strict=False)]
        self._grips = [self._gripper(start, *part) for start, part in zip(starts, self.parts, strict=False)]
        self.compiled = all(compilable(robot, arm) for robot, arm in self.parts)
        """Whether control runs compiled."""
        self._arms = describe(self.parts, self.model)
        self.speeds = HandSpeeds(self.model, self.data, self._controllers, self._moves, self._arms)
        self._joints, self._dofs = (
            np.concatenate([getattr(robot, name) for robot, _ in self.parts])
            for name in ("_ref_joint_pos_indexes", "_ref_joint_vel_indexes")
        )
        n = len(self.parts)
        self._limits.state[:] = 0, 0, 0, -1, 0
        self._known: ContactLimits | None = None
        # Where the numbers of ``felt`` stand in limits: arm, and place.
        self._felt_places = np.nonzero([[i >= JOINTS or i < n for i in range(FELT)] for n in self._arms.joints])
        self._felt_columns = np.where(
            self._felt_places[1] < JOINTS, self._felt_places[1], self._felt_places[1] - JOINTS + kernels.WRENCH.start
        )
        joints = np.zeros((n, JOINTS))
        self._goals = Goals(np.zeros((n, 3)), np.zeros((n, 3, 3)), joints, joints.copy(), np.zeros(n, np.int64))
        self._deltas = np.zeros((n, JOINTS))
        self._turns = np.tile(np.eye(3), (n, 1, 1))
        action = self._deltas, self._turns, self._samples
        self._table = table((*self._views, *self._arms, *self._goals, *self._limits, *action))
        self._nominal: NominalViews | None = None
        self._reads_by: SensorErrors | None = None
        self._samples[:] = 0.0
        if must_compile(kernels.run):
            print("asm-gym: compiling the simulation loop, once on this machine (about 20 s)", file=sys.stderr)
            self._run(0)
        kernels.sample(self._views, self.nominal.now(), self._arms, 0, self._samples)
        self._summarise(1)

    # ------------------------------------------------------------------ control steps

    def begin(self, limits: ContactLimits | None = None, felt: Sequence[Channel] = ()) -> None:
        """Begins a control step, in which the arms may feel no more than ``limits`` have of what is ``felt``."""
        self._done = self._row_began = 0
        self._limits.state[:] = 0, 0, 0, -1, 0
        self._limits.load[0] = 0.0
        if limits is not None:
            if limits is not self._known:
                self._limits.most[self._felt_places], self._known = limits.most(felt), limits
            self._limits.state[ARMED], self._limits.state[ACTS] = 1, limits.stays
        self._felt = (0.0, 0.0, 0.0)

    def command(self, action: NDArray[np.float64], hold: bool = False) -> None:
        """Gives the controllers a new set-point, which they take up in the next substep.

        Args:
            hold: the arms are to stay. No action says that: one of no change follows where the arm drifts or is pushed
                to, a pose is kept by turning joints, a torque of zero brakes nothing. So the arms are braked beneath
                their controllers, and held where they were when they were first told to (``control.brake``).
        """
        for a in range(len(self.parts)):
            if hold:
                hold_at(self._views, self._arms, self._goals, a)
            else:
                self._goals.held[a] = 0
        self._action = action
        self._fresh = True
        if self.compiled:
            for a, (controller, moves, grip) in enumerate(
                zip(self._controllers, self._moves, self._grips, strict=True)
            ):
                self._deltas[a, : moves.stop - moves.start] = controller.scale_action(action[moves])
                # robosuite rounds this rotation to single precision, which shows after a while.
                self._turns[a] = self._rotations.quat2mat(self._rotations.axisangle2quat(self._deltas[a, 3:6]))
                if grip is not None:
                    grip(action)

    def advance(self, count: int) -> None:
        """Runs ``count`` substeps of the control step that was begun."""
        if self.compiled:
            if self.keeps_history and self._done == 0:
                wrenches = [self.data.sensordata[at : at + 6].copy() for at in self._arms.wrench]
                self._run(count)
                self._remember(wrenches)
            else:
                self._run(count)
        else:
            for k in range(self._done, self._done + count):
                self.env.sim.step1()
                self.env._pre_action(self._action, self._fresh)
                kernels.brake_held(self._views, self.nominal.now(), self._arms, self._goals)
                self.env.sim.step2()
                kernels.sample(self._views, self.nominal.now(), self._arms, k - self._row_began, self._samples)
                kernels.feel(self._arms, self._limits, k - self._row_began, self._samples)
                if kernels.must_stay(self._limits):
                    for a in range(len(self.parts)):
                        hold_at(self._views, self._arms, self._goals, a)
                self._fresh = False
        self._fresh = False
        self._done += count

    def begin_row(self) -> None:
        """What comes now is summarised by itself; the forces go on to be those of the whole control step."""
        self._felt = (self.contact_force, self.external_force, self._done * self.mean_external_force)
        self._row_began = self._done

    def _run(self, count: int) -> None:
        nominal = self.nominal.now()
        if nominal is not self._nominal:
            self._nominal, self._nominal_table = nominal, table(nominal)
        kernels.run(self._table, self._nominal_table, self._fresh, self._done - self._row_began, count)

    @property
    def passed_limit(self) -> int | None:
        """The first substep of the control step in which the arms felt more than a limit; None for none."""
        left = int(self._limits.state[LEFT])
        return None if left < 0 else left

    @property
    def load(self) -> float:
        """The largest share of a contact limit that was felt in the control step; infinite for what is no number."""
        return float(self._limits.load[0])

    @property
    def felt(self) -> NDArray[np.float64]:
        """(K, N) what the arms felt in each substep since the row began, noiseless: of each arm the external torque of
        its joints [N m], then the force at its wrist [N]."""
        return self._samples[self._felt_places[0], : self._done - self._row_began, self._felt_columns].T

    @property
    def mean_felt(self) -> NDArray[np.float64]:
        """(N,) the mean of ``felt``."""
        found = np.empty(len(self._felt_columns))
        kernels.mean_felt(self._samples, self._done - self._row_began, self._felt_places[0], self._felt_columns, found)
        return found

    @property
    def contact_forces(self) -> NDArray[np.float64]:
        """(K,) the largest net contact force on an arm in each substep since the row began [N]; no sensor tells it."""
        forces = self._samples[:, : self._done - self._row_began, kernels.CONTACT]
        found: NDArray[np.float64] = np.linalg.norm(forces, axis=2).max(axis=0)
        return found

    def read(self, beside: Floats, errors: SensorErrors, drawn: Floats, carried: Ints) -> Reading:
        """What the sensors read now, summarised over the substeps since the row began.

        Args:
            beside: what comes after what the arms sense.
            errors: of sensors; no fault among them.
            drawn: (M,) of how many standard deviations each reading is off; taken for the row.
            carried: (D,) which numbers the stream carries.
        """
        count, stream = self._done - self._row_began, np.empty(len(carried), np.float32)
        if self._reads_by is not errors:
            p = self.proprioception
            self._reads_by, self._kept = (
                errors,
                (self._samples, *p.sources, p.where, errors.noise, errors.steps, carried),
            )
            self._senses = table(self._kept)
        *felt, whole, through = kernels.read(self._senses, count, beside, drawn, stream)
        if count:
            self._add_up(count, *felt)
        return Reading(drawn, stream, whole, through)

    def sense(self) -> NDArray[np.float64]:
        """What the arms' sensors read now, summarised over the substeps since the row began; noiseless."""
        if self._done > self._row_began:
            self._summarise(self._done - self._row_began)
        return self.proprioception.read()

    def _remember(self, wrenches: list[NDArray[np.float64]]) -> None:
        """Fills the buffers that robosuite fills in the first substep; the acceleration is its running estimate."""
        for (robot, arm), wrench, sample in zip(self.parts, wrenches, self._samples[:, 0], strict=True):
            velocities = robot.recent_ee_vel_buffer[arm]
            robot.recent_ee_forcetorques[arm].push(wrench)
            velocities.push(sample[kernels.VELOCITY])
            changes = robot.control_freq * np.diff(velocities.buf, axis=0)
            recent = np.vstack([robot.recent_ee_acc[arm].current, changes])
            robot.recent_ee_acc[arm].push(recent.mean(axis=0))

    def _summarise(self, count: int) -> None:
        p = self.proprioception
        self._add_up(count, *kernels.summarise(self._samples, count, p.mean, p.peak, p.last))

    def _add_up(self, count: int, contact: float, external: float, mean: float) -> None:
        """Takes the forces of a row into those of the control step."""
        contact_before, external_before, sum_before = self._felt
        self.contact_force = _larger(contact, contact_before)
        self.external_force = _larger(external, external_before)
        self.mean_external_force = (sum_before + count * mean) / (self._row_began + count)

    def _gripper(self, start: int, robot: Any, arm: str) -> Callable[[NDArray[np.float64]], None] | None:
        """What moves the gripper of an arm by an action whose part for this robot begins at ``start``."""
        name = robot.get_gripper_name(arm)
        low, high = robot._action_split_indexes.get(name, (0, 0))
        if low == high:
            return None
        controller, motors = robot.composite_controller.part_controllers[name], robot._ref_actuators_indexes_dict[name]
        gripper, limits, ctrl = robot.gripper[arm], self._views.ctrlrange, self._views.ctrl

        def move(action: NDArray[np.float64]) -> None:
            controller.set_goal(gripper.format_action(action[start + low : start + high]))
            bounds = limits[motors]
            ctrl[motors] = np.clip(controller.run_controller(), bounds[:, 0], bounds[:, 1])

        return move

    # ------------------------------------------------------------------ knowledge of the robot

    def motions(self, turns: NDArray[np.float64]) -> list[tuple[slice, NDArray[np.float64]]]:
        """For each arm, its part of the action, and that part's values for a change of its joints [rad]."""
        found, joint = [], 0
        for a, part in enumerate(self._moves):
            n, controller = int(self._arms.joints[a]), self._controllers[a]
            move = turns[joint : joint + n]
            if controller.name != "JOINT_POSITION":
                jacobian = np.zeros((6, self.model.nv))
                mujoco.mj_jacSite(self.model, self.data, jacobian[:3], jacobian[3:], int(self._arms.site[a]))
                hand = jacobian[:, self._arms.dofs[a, :n]] @ move
                base = int(self._arms.base[a])
                frame = np.eye(3) if base < 0 else self.data.site_xmat[base].reshape(3, 3)
                move = np.concatenate([frame.T @ hand[:3], frame.T @ hand[3:]])
            middle, half = (f(controller.output_max, controller.output_min) / 2 for f in (np.add, np.subtract))
            found.append((part, (move - middle) / half))
            joint += n
        return found

    def force_behind(self, torques: NDArray[np.float64]) -> tuple[str, NDArray[np.float64]]:
        """The link on which a force would explain external torques (J,) [N m] best, and that force (3,) [N].

        For a force F on link k, τ = J_kᵀ F, and no joint beyond k feels it: of all links the one that leaves the least.
        """
        best: tuple[float, str, NDArray[np.float64]] = (np.inf, "", np.zeros(3))
        jacobian = np.zeros((3, self.model.nv))
        joints = self.model.actuator_trnid[self.motors, 0]
        for joint in joints:
            link = int(self.model.jnt_bodyid[joint])
            mujoco.mj_jacBodyCom(self.model, self.data, jacobian, None, link)
            J = jacobian[:, self._dofs]
            force = np.linalg.lstsq(J.T, torques, rcond=1e-2)[0]
            left = float(np.sum((torques - J.T @ force) ** 2))
            if left < best[0]:
                best = left, self.model.body(link).name, force
        return best[1], best[2]

    @property
    def motors(self) -> NDArray[np.intp]:
        """The actuators of the arms' joints, from the base on."""
        return np.concatenate([robot._ref_actuators_indexes_dict[arm] for robot, arm in self.parts])


def _larger(now: float, before: float) -> float:
    """Of two forces; what is not finite stays so."""
    return now if now != now or now > before else before
