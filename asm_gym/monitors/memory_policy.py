"""The Neural ASM as a policy: what the memory expects to be commanded next is what is commanded.

row → memory: expect, infer → motor prediction â → action, grippers by evidence → env → row

A gripper changes its command once there is enough evidence for the other one,

    E_t = exp(-Δt/τ) E_{t-1} + Δt p_t,    E_t > θ:  the other command is given, and E = 0,

where p_t is how surely the other command is expected, from 0 to 1. The prediction is a mean over what was shown in
similar situations: by its sign alone a gripper would hold on for ever where one demonstration in five lets go.

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
from asm_gym.monitors.surprise import State
from asm_gym.policies.policy import StatefulPolicy
from asm_gym.spec import StreamSpec
from asm_gym.validation import typed

FORGETTING_TIME = 1.6  # τ [s]
CHANGE_AFTER = 0.15  # θ: time for which a command that is certain must be expected [s]


class Grip(NamedTuple):
    """Commands of G grippers; a value."""

    high: NDArray[np.bool_]  # (G,) the upper end of the action's range is commanded, else the lower
    evidence: NDArray[np.float64]  # (G,) E [s]


class PolicyState(NamedTuple):
    """State of a policy between two steps; a value."""

    memory: State
    action: NDArray[np.float32]  # (A,) the last one
    grip: Grip | None  # None before the first step


class CommandReadout:
    """Makes actions of expected commands: kept in the space of ``env``, and each gripper at one end of its range."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        space: Any = env.action_space
        self._low = space.low
        self._high = space.high
        self._grip = np.asarray(getattr(env.unwrapped, "gripper_actions", ()), dtype=int)
        self._dt = control_period(env)
        # However long a step lasts, one must not be enough for what is less likely than not.
        self._change_after = max(CHANGE_AFTER, 0.5 * self._dt)

    def __call__(
        self, expected: NDArray[np.float32], before: Grip | None
    ) -> tuple[NDArray[np.float32], Grip]:
        """Return the action (A,) for expected commands (A,), and the grip to pass in next time; None at first."""
        clipped = np.clip(np.nan_to_num(expected), self._low, self._high)
        action: NDArray[np.float32] = clipped.astype(np.float32)
        low = self._low[self._grip]
        high = self._high[self._grip]

        # (G,) 1 where the upper end is certain
        share = ((action[self._grip] - low) / (high - low)).astype(np.float64)
        if before is None:
            before = Grip(share > 0.5, np.zeros(len(share)))
        other = np.where(before.high, 1.0 - share, share)
        decay = np.exp(-self._dt / FORGETTING_TIME)
        evidence = decay * before.evidence + self._dt * other
        changes = evidence > self._change_after
        grip = Grip(before.high ^ changes, np.where(changes, 0.0, evidence))
        action[self._grip] = np.where(grip.high, high, low)
        return action, grip


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
        _check_actions(memory.spec, env.action_space)
        dt = control_period(env)
        inner: Any = env.unwrapped
        self._measuring_env: Any = None  # that measures a row by itself
        if hasattr(inner, "measured_spec"):
            self._measuring_env = inner
            theirs = inner.measured_spec
            if memory.spec.dt != dt:
                raise ValueError(
                    f"the memory reads a row every {memory.spec.dt} s, "
                    f"and is asked to act every {dt} s"
                )
        else:
            theirs = StreamSpec.from_spaces(env.observation_space, env.action_space, dt)
        _check_fit(memory.spec, theirs)

        shared = [name for name in memory.spec.slices if name in theirs.slices]
        self._measured_columns = _columns_of(shared, theirs)
        self._memory_columns = _columns_of(shared, memory.spec)
        self.memory = memory
        self._readout = CommandReadout(env)
        memory.initial_state()

    def begin(self, observation: Any) -> PolicyState:
        """Return the state before the first step."""
        action = np.zeros(len(self.memory.spec.motor), np.float32)
        return PolicyState(self.memory.initial_state(), action, grip=None)

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
        action, grip = self._readout(self.memory.expected_action(memory)[0], state.grip)
        return action, PolicyState(memory, action, grip)


def _columns_of(channels: Sequence[str], spec: StreamSpec) -> NDArray[np.intp]:
    """Return the columns of channels in a stream, in their order."""
    every = np.arange(spec.size)
    return np.concatenate([every[:0], *(every[spec.slices[name]] for name in channels)])


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


def _check_fit(spec: StreamSpec, theirs: StreamSpec) -> None:
    """Raise ValueError unless an environment that measures ``theirs`` has what a memory of ``spec`` reads.

    Further channels, another order, and objects of other tasks do not matter.
    """
    objects = [channel.name for channel in spec.channels if channel.group == "object"]
    harmless = ("order: ", "dt: ", *(f"{name}: missing" for name in objects))
    misfits = [line for line in spec.difference(theirs) if not line.startswith(harmless)]
    lines = [line for line in misfits if not line.endswith(": new")]
    if spec.source and theirs.source and spec.source != theirs.source:
        lines.append(f"robot: {spec.source} against {theirs.source}")
    if objects and not any(name in theirs.slices for name in objects):
        lines.append(f"objects: {', '.join(objects)} are known, none of which is here")
    if lines:
        raise ValueError("the memory does not fit this environment:\n  " + "\n  ".join(lines))
