"""One control step: its commands, the rows of its stream, and what faults and guards may change within it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from mujoco import mjtWarning
from numpy.typing import NDArray

from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.envs.actions import Actions
from asm_gym.envs.arms import PHYSICS_FREQ
from asm_gym.envs.robosuite_backend import ObjectSensors
from asm_gym.envs.sensors import Corruption, Reading, Senses
from asm_gym.envs.simulated_tracker import HandledObjects
from asm_gym.envs.simulation import Simulation
from asm_gym.envs.undoable_edits import SimulatorEdits
from asm_gym.spec import Channel

_UNSTABLE = (mjtWarning.mjWARN_BADQPOS, mjtWarning.mjWARN_BADQVEL, mjtWarning.mjWARN_BADQACC)


class SteppedEnv(gym.Env[Any, NDArray[np.float32]]):
    """An environment whose control steps can be watched and changed from within."""

    simulation: Simulation  # physics, controllers and sensors of the loaded model
    # channels that contact limits apply to, of one arm after another
    felt_channels: tuple[Channel, ...]
    _action: NDArray[np.float32]
    _actions: Actions  # the action space, and how actions reach the controllers
    _objects: ObjectSensors
    _senses: Senses
    _tracker: HandledObjects | None  # of handled objects, where the stream has such channels
    _row_substeps: int

    def __init__(self, substeps: int) -> None:
        self.substeps = substeps  # physics substeps of a control step
        # sensor faults: each edits the measured row in place, after the noise
        self.corruptions: list[Corruption] = []
        self.deliveries: list[Callable[[NDArray[np.float32]], NDArray[np.float32]]] = []
        """Action faults: each replaces the commanded action."""
        self.edits = SimulatorEdits()  # changes of the simulator's numbers that will be undone
        self.substep_hooks: list[Callable[[int], None]] = []
        """Called after every physics substep with its number in the control step; a hook may call ``measure()`` and
        ``command()``."""
        self.row_hooks: list[Callable[[NDArray[np.float32]], None]] = []
        """Called with every row of the stream within a control step but the last; a hook may call ``command()``."""
        self.holding = False
        """Set, the arms stay in the next control step, and the grippers keep their command, or their target where a
        limit was passed, whatever action arrives; from within a hook, in the rest of the step. The step unsets it."""
        self.keeps_holding = False
        """Set, ``holding`` lasts until both are unset, however many steps a wrapper in between makes of one."""
        self.contact_limits: ContactLimits | None = None
        """Limits of load and hand speed in this episode; ``reset`` removes them. ``info`` then has ``contact_load``,
        the largest share of a limit that was reached within the step, ``contact_left_s``, when in it a limit was passed
        [s], infinite where none was, ``contact_felt``, the step's mean load, and ``braked``, the share of its substeps
        in which an arm was slowed down beneath its controller, 0 without limits."""
        self._limits_of_guards: dict[str, ContactLimits | None] = {}

    @property
    def limits_of_guard(self) -> Any:
        """The contact limits of each guard around this environment, by its name; the strictest count.

        Set to a pair, a guard's name and its limits, or None for no limits of its own.
        """
        return self._limits_of_guards

    @limits_of_guard.setter
    def limits_of_guard(self, named_limits: tuple[str, ContactLimits | None]) -> None:
        guard, limits = named_limits
        self._limits_of_guards[guard] = limits
        self.contact_limits = None
        for own in self._limits_of_guards.values():
            if self.contact_limits is None:
                self.contact_limits = own
            elif own is not None:
                self.contact_limits = self.contact_limits.strictest_with(own, self.felt_channels)

    def _run(self, action: NDArray[np.float32]) -> None:
        """Run the substeps of a control step, and read the rows of the stream before its end."""
        limits = self.contact_limits
        self._rows: list[NDArray[np.float32]] = []
        self._finite = True
        self.simulation.begin(limits, self.felt_channels)
        self._command(action)

        stride = self._row_substeps
        if self.substep_hooks:
            stride = 1
        for substeps_done in range(stride, self.substeps + 1, stride):
            self.simulation.advance(stride)
            for hook in self.substep_hooks:
                hook(substeps_done - 1)
            ends_row = substeps_done % self._row_substeps == 0
            if ends_row and substeps_done < self.substeps:
                self._end_row()

        if limits is not None and limits.stays and self.simulation.passed_limit is not None:
            # The stream says that the last action of the step was commanded.
            self._action = self._actions.resting(self._action)

    def _end_row(self) -> None:
        """Read a row of the stream within the control step."""
        reading = self._read(within_step=True)
        self._finite &= reading.stream_finite
        self.simulation.begin_row()
        self._rows.append(reading.stream)
        for hook in self.row_hooks:
            hook(reading.stream)

    def command(self, action: NDArray[np.float32]) -> None:
        """From within a hook: command another action (A,) for the rest of the control step, efference copy included."""
        self._command(self._actions.checked(action))

    def _command(self, action: NDArray[np.float32]) -> None:
        """Give the controllers an action (A,), slowed down, or that of staying where the arms are held."""
        is_held = self.holding
        if not self.keeps_holding:
            self.holding = False  # it lasts for one command
        if is_held:
            self._action = self._actions.resting(self._action)
        else:
            self._action = self._slowed(action)
        self.simulation.command(self._delivered(self._action), is_held)

    def _slowed(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the action (A,) at the hand speed that the contact limits allow."""
        limits = self.contact_limits
        if limits is None or not math.isfinite(limits.hand_speed):
            self.simulation.speed_limits[:] = np.inf
            return action
        return self._actions.slowed(action, limits)

    def _delivered(self, action: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the action that arrives, in robosuite's units."""
        for deliver in self.deliveries:
            action = np.clip(deliver(action), -1.0, 1.0)
        return self._actions.scaled(action)

    def action_for(self, turns: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """Return the action (A,) that turns joints by ``turns`` (J,) [rad]; raise ValueError where none is a change."""
        return self._actions.turning(np.asarray(turns, np.float64))

    def measure(self) -> NDArray[np.float64]:
        """Return the readings (M,) of ``measured_spec`` over the time since the last row, with noise and faults."""
        return self._read().row

    def _read(self, within_step: bool = False) -> Reading:
        """Read all sensors; ``within_step`` for a row before the last of a control step."""
        return self._senses.read(
            self.simulation.sense,
            self._objects,
            self._action,
            self.corruptions,
            self.np_random,
            within_step=within_step,
            tracker=self._tracker,
        )

    def _forces(self, unstable: bool) -> dict[str, Any]:
        """Return what ``info`` says of contact and strain; NaN or infinite where the simulation diverged."""
        simulation = self.simulation
        strain = simulation.strain.read()
        forces: dict[str, Any] = {
            "contact_force": simulation.contact_force,
            "contact_impulse": simulation.contact_impulse,
            "joint_stops": strain.joint_stops,
            "self_contacts": strain.self_contacts,
            "braked": 0.0,
        }
        if self.contact_limits is not None:
            forces["braked"] = simulation.braked
            forces["contact_load"] = simulation.load
            forces["contact_left_s"] = np.inf
            if simulation.passed_limit is not None:
                forces["contact_left_s"] = (simulation.passed_limit + 1) / PHYSICS_FREQ
            forces["contact_felt"] = simulation.felt_mean
        if unstable:
            forces["contact_force"] = np.nan
            forces["contact_impulse"] = np.nan
            if self.contact_limits is not None:
                forces["contact_load"] = np.inf
        return forces

    def _divergences(self) -> int:
        """Return how often MuJoCo found the simulation unstable; it resets itself then, and says so nowhere else."""
        counts = self.simulation.warnings
        return sum(int(counts[int(warning)]) for warning in _UNSTABLE)
