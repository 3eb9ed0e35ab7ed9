"""The Neural ASM as a policy: what the memory expects to be commanded next is what is commanded.

row → memory: expect, infer → motor prediction â → action, grippers by evidence → env → row

A gripper changes its command once there is enough evidence for the other one,

    E_t = exp(-Δt/τ) E_{t-1} + Δt p_t,    E_t > θ:  the other command is given, and E = 0,

where p_t is how surely the other command is expected, from 0 to 1. The prediction is a mean over what was shown in
similar situations: by its sign alone a gripper would hold on for ever where one demonstration in five lets go.

Source: Usher and McClelland 2001 (Psychological Review 108(3)), without their mutual inhibition.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.control_period import control_period
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.base import State
from asm_gym.policies.base import StatefulPolicy
from asm_gym.spec import StreamSpec
from asm_gym.validation import typed

FORGETS = 1.6  # τ [s]
ENOUGH = 0.15  # θ: so long a command must be expected without a doubt [s]


class Grip(NamedTuple):
    """What the G grippers are told; a value."""

    high: NDArray[np.bool_]  # (G,) told the upper end of the action's range, else the lower
    evidence: NDArray[np.float64]  # (G,) E [s]


class CommandReadout:
    """Makes actions of expected commands: kept in the space of ``env``, and each gripper at one end of its range."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._space: Any = env.action_space
        self._grip = np.asarray(getattr(env.unwrapped, "gripper_actions", ()), dtype=int)
        self._dt = control_period(env)
        # However long a step lasts, one must not be enough for what is less likely than not.
        self._enough = max(ENOUGH, 0.5 * self._dt)

    def __call__(
        self, expected: NDArray[np.float32], before: Grip | None
    ) -> tuple[NDArray[np.float32], Grip]:
        """Return the action (A,) for expected commands (A,), and the grip to pass in next time; None at first."""
        low, high = self._space.low, self._space.high
        action = np.clip(np.nan_to_num(expected), low, high).astype(np.float32)
        g = self._grip
        # (G,) 1 where the upper end is certain
        share = ((action - low)[g] / (high - low)[g]).astype(np.float64)
        before = before or Grip(share > 0.5, np.zeros(len(share)))
        other = np.where(before.high, 1.0 - share, share)
        evidence = np.exp(-self._dt / FORGETS) * before.evidence + self._dt * other
        changes = evidence > self._enough
        grip = Grip(before.high ^ changes, np.where(changes, 0.0, evidence))
        action[g] = np.where(grip.high, high[g], low[g])
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
        inner: Any = env.unwrapped
        self._measures = inner if hasattr(inner, "measured_spec") else None
        spec, dt, space = memory.spec, control_period(env), env.action_space
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
        if self._measures and spec.dt != dt:
            raise ValueError(
                f"the memory reads a row every {spec.dt} s, and is asked to act every {dt} s"
            )
        theirs = (
            inner.measured_spec
            if self._measures
            else StreamSpec.from_spaces(env.observation_space, space, dt)
        )
        _check_fit(spec, theirs)
        shared = [name for name in spec.slices if name in theirs.slices]
        self._from, self._to = (
            np.array([i for n in shared for i in range(s.size)[s.slices[n]]], np.intp)
            for s in (theirs, spec)
        )
        self.memory = memory
        self._readout = CommandReadout(env)
        memory.initial_state()

    def begin(self, observation: Any) -> tuple[State, NDArray[np.float32], Grip | None]:
        """Return the memory's state, the last command (A,), and what grippers are told."""
        return self.memory.initial_state(), np.zeros(len(self.memory.spec.motor), np.float32), None

    def act(
        self, observation: Any, state: Any, deterministic: bool
    ) -> tuple[NDArray[np.float32], Any]:
        """Return the action (A,) that the memory expects, and the next state; nothing is drawn at random."""
        memory, last, grip = state
        measured = (
            self._measures.measured
            if self._measures
            else np.concatenate([np.ravel(observation), last])
        )
        row = np.zeros((1, self.memory.spec.size), np.float32)
        row[0, self._to] = measured[self._from]
        memory, _ = self.memory.observe(memory, row)
        action, grip = self._readout(self.memory.expected_action(memory)[0], grip)
        return action, (memory, action, grip)


def _check_fit(spec: StreamSpec, theirs: StreamSpec) -> None:
    """Raise ValueError unless an environment that measures ``theirs`` has what a memory of ``spec`` reads.

    Further channels, another order, and objects of other tasks do not matter.
    """
    objects = [c.name for c in spec.channels if c.group == "object"]
    harmless = ("order: ", "dt: ", *(f"{name}: missing" for name in objects))
    lines = [
        line
        for line in spec.difference(theirs)
        if not line.startswith(harmless) and not line.endswith(": new")
    ]
    if spec.source and theirs.source and spec.source != theirs.source:
        lines.append(f"robot: {spec.source} against {theirs.source}")
    if objects and not any(name in theirs.slices for name in objects):
        lines.append(f"objects: {', '.join(objects)} are known, none of which is here")
    if lines:
        raise ValueError("the memory does not fit this environment:\n  " + "\n  ".join(lines))
