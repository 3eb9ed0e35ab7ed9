"""The Neural ASM as a policy: it commands what its memory expects to be commanded next.

row → memory: expect, infer → motor prediction â → action, grippers by evidence → env → row

A gripper changes its command once there is enough evidence for the other one,

    E_t = exp(-Δt/τ) E_{t-1} + Δt p_t,    E_t > θ:  the other command is given, and E = 0,

where p_t is the share of the way to the other command that is expected, from 0 to 1. The prediction is a mean over what
was shown in similar situations: by its sign alone a gripper would hold on for ever where one demonstration in five lets
go.

Source: Usher and McClelland 2001 (Psychological Review 108(3)), without their mutual inhibition.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.control_period import control_period
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.monitor_protocol import State
from asm_gym.policies.policy import StatefulPolicy
from asm_gym.spec import StreamSpec
from asm_gym.validation import typed

FORGETTING_TIME = 1.6  # τ [s]
CHANGE_AFTER = 0.15  # θ: time for which a command that is certain must be expected [s]


class GripperState(NamedTuple):
    """State of G grippers; a value."""

    is_high: NDArray[
        np.bool_
    ]  # (G,) the upper end of the action's range is commanded, else the lower
    evidence: NDArray[np.float64]  # (G,) E for the other end [s]


class PolicyState(NamedTuple):
    """State of a policy between two steps; a value."""

    memory: State
    action: NDArray[np.float32]  # (A,) the last one
    grippers: GripperState | None  # None before the first step


class CommandReadout:
    """Makes actions of expected commands: kept in the space of ``env``, and each gripper at one end of its range."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        space: Any = env.action_space
        self._low = space.low
        self._high = space.high
        self._grippers = np.asarray(getattr(env.unwrapped, "gripper_actions", ()), dtype=int)
        self._dt = control_period(env)
        # However long a step lasts, one must not be enough for what is less likely than not.
        self._change_after = max(CHANGE_AFTER, 0.5 * self._dt)

    def __call__(
        self, expected: NDArray[np.float32], before: GripperState | None
    ) -> tuple[NDArray[np.float32], GripperState]:
        """Return the action (A,) for expected commands (A,), and the grippers' state; ``before`` is None at first."""
        clipped = np.clip(np.nan_to_num(expected), self._low, self._high)
        action: NDArray[np.float32] = clipped.astype(np.float32)
        low = self._low[self._grippers]
        high = self._high[self._grippers]
        height = (action[self._grippers] - low) / (high - low)  # (G,) 1 at the upper end
        after = self._gripper_state(height.astype(np.float64), before)
        action[self._grippers] = np.where(after.is_high, high, low)
        return action, after

    def _gripper_state(
        self, height: NDArray[np.float64], before: GripperState | None
    ) -> GripperState:
        """Return the state after expected commands (G,) from 0, the lower end, to 1, the upper."""
        if before is None:
            before = GripperState(is_high=height > 0.5, evidence=np.zeros(len(height)))
        for_other = np.where(before.is_high, 1.0 - height, height)
        decay = np.exp(-self._dt / FORGETTING_TIME)
        evidence = decay * before.evidence + self._dt * for_other
        changes = evidence > self._change_after
        return GripperState(
            is_high=before.is_high ^ changes, evidence=np.where(changes, 0.0, evidence)
        )


class NeuralASMPolicy(StatefulPolicy):
    """Drives an environment by a memory's motor prediction.

    The memory reads every row that the environment measures, its own command among it. Fit it on streams that hold the
    objects (``gym.make(..., stream=("hand", "gripper", "object", "action"))``), and call ``learn_to_act``: without, it
    goes on along what its state expects, which is no way to reach a goal.

    Args:
        memory: fitted.
        env: with a Box action space; of the robot and the rate of the memory. What the memory knows of objects that are
            not in this task reads 0.

    Raises:
        ValueError: the memory predicts no command, or does not fit the environment; the message says what differs.
        RuntimeError: the memory has learned nothing yet.
    """

    @typed
    def __init__(self, memory: NeuralASM, env: gym.Env[Any, Any]) -> None:
        spec = memory.spec
        _check_actions(spec, env.action_space)
        dt = control_period(env)
        robot: Any = env.unwrapped
        self._measuring_env: Any = None  # None where the row is the observation and the last action
        if hasattr(robot, "measured_spec"):
            self._measuring_env = robot
            measured = robot.measured_spec
            if spec.dt != dt:
                raise ValueError(
                    f"the memory reads a row every {spec.dt} s, and is asked to act every {dt} s"
                )
        else:
            measured = StreamSpec.from_spaces(env.observation_space, env.action_space, dt)
        _check_fit(spec, measured)

        shared = [name for name in spec.slices if name in measured.slices]
        self._measured_columns = _columns_of(shared, measured)
        self._memory_columns = _columns_of(shared, spec)
        self.memory = memory
        self._readout = CommandReadout(env)
        memory.initial_state()  # refuses a memory that has learned nothing

    def begin(self, observation: Any) -> PolicyState:
        """Return the state before the first step."""
        action = np.zeros(len(self.memory.spec.motor), np.float32)
        return PolicyState(self.memory.initial_state(), action, grippers=None)

    def act(
        self, observation: Any, state: PolicyState, deterministic: bool
    ) -> tuple[NDArray[np.float32], PolicyState]:
        """Return the action (A,) that the memory expects, and the next state; nothing is drawn at random."""
        if self._measuring_env is None:
            measured = np.concatenate([np.ravel(observation), state.action])
        else:
            measured = self._measuring_env.measured
        row = np.zeros((1, self.memory.spec.size), np.float32)
        row[0, self._memory_columns] = measured[self._measured_columns]
        memory, _ = self.memory.observe(state.memory, row)
        expected = self.memory.expected_action(memory)[0]
        action, grippers = self._readout(expected, state.grippers)
        return action, PolicyState(memory, action, grippers)


def _columns_of(channels: Sequence[str], spec: StreamSpec) -> NDArray[np.intp]:
    """Return the columns of channels in a stream, in their order."""
    columns: list[int] = []
    for name in channels:
        columns += range(spec.size)[spec.slices[name]]
    return np.array(columns, np.intp)


def _check_actions(spec: StreamSpec, space: spaces.Space[Any]) -> None:
    """Raise ValueError unless a memory of ``spec`` predicts the commands of an action space."""
    if not isinstance(space, spaces.Box):
        raise ValueError(f"a memory drives a Box action space, got {space}")
    if not len(spec.motor):
        raise ValueError(
            f"this memory predicts no command: its stream has no action, only {list(spec.slices)}"
        )
    if len(spec.motor) != int(np.prod(space.shape)):
        raise ValueError(
            f"this memory predicts {len(spec.motor)} commands, the environment takes {space.shape}"
        )


def _check_fit(spec: StreamSpec, measured: StreamSpec) -> None:
    """Raise ValueError unless an environment measures what a memory of ``spec`` reads.

    Further channels, another order, and objects of other tasks do not matter.
    """
    objects = [channel.name for channel in spec.channels if channel.group == "object"]
    harmless = ("order: ", "dt: ", *(f"{name}: missing" for name in objects))
    differences = [line for line in spec.difference(measured) if not line.startswith(harmless)]
    misfits = [line for line in differences if not line.endswith(": new")]
    if spec.source and measured.source and spec.source != measured.source:
        misfits.append(f"robot: {spec.source} against {measured.source}")
    if objects and measured.slices.keys().isdisjoint(objects):
        misfits.append(f"objects: {', '.join(objects)} are known, none of which is here")
    if misfits:
        raise ValueError("the memory does not fit this environment:\n  " + "\n  ".join(misfits))
