"""The Neural ASM as a policy: what the memory expects to be commanded next is what is commanded.

row → memory: expect, infer → motor prediction â → action, grippers by ``grip`` → env → row

Nothing selects a skill: the row says what lies about, and the memory's state what is being done with it.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Self

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.monitors import NeuralASM
from asm_gym.monitors.base import State
from asm_gym.policies.grip import CommandReadout, Grip
from asm_gym.spec import StreamSpec, control_period
from asm_gym.validation import typed

OBJECT = "object"
"""The group of what lies about; the objects of other tasks are out of play, and read 0."""


class StreamReader:
    """Rows of one spec, made of what an environment measures.

    Args:
        spec: of the rows.
        env: one of this package's, or any whose observation and action are Boxes.

    Raises:
        ValueError: the environment does not measure what the spec names, or is of another robot or rate.
    """

    def __init__(self, spec: StreamSpec, env: gym.Env[Any, Any]) -> None:
        inner: Any = env.unwrapped
        self._inner, self._measures = inner, hasattr(inner, "measured_spec")
        theirs = inner.measured_spec if self._measures else _of_spaces(env)
        if self._measures and spec.dt != control_period(env):
            raise ValueError(
                f"the memory reads a row every {spec.dt} s, and is asked to act every {control_period(env)} s"
            )
        self.spec = spec
        self._from, self._to = self.between(spec, theirs)

    @staticmethod
    def between(spec: StreamSpec, theirs: StreamSpec) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Which columns of ``theirs`` there are in ``spec``, and where.

        Raises:
            ValueError: ``theirs`` lacks channels, or has other ones by the same name.
        """
        lines = [line for line in spec.difference(theirs) if not _harmless(line, spec, theirs)]
        if spec.source and theirs.source and spec.source != theirs.source:
            lines.append(f"robot: {spec.source} against {theirs.source}")
        objects = [c.name for c in spec.channels if c.group == OBJECT]
        if objects and not any(name in theirs.slices for name in objects):
            lines.append(f"objects: {', '.join(objects)} are known, none of which is here")
        if lines:
            raise ValueError("the memory does not fit this environment:\n  " + "\n  ".join(lines))
        shared = [name for name in spec.slices if name in theirs.slices]
        source, target = ([i for n in shared for i in range(s.size)[s.slices[n]]] for s in (theirs, spec))
        return np.array(source, np.intp), np.array(target, np.intp)

    def __call__(self, observation: Any, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """(D,) what is sensed now, after ``action`` (A,)."""
        measured = self._inner.measured if self._measures else np.concatenate([np.ravel(observation), np.ravel(action)])
        row = np.zeros(self.spec.size, np.float32)
        row[self._to] = measured[self._from]
        return row


class ActingState(NamedTuple):
    """Where the policy is: a value."""

    memory: State
    action: NDArray[np.float32]  # (A,) commanded last
    grip: Grip | None = None  # what grippers are told; None before the first step


class NeuralASMPolicy:
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
        self.memory = memory
        self._size = require_motor(memory.spec, env)
        self._read = StreamReader(memory.spec, env)
        self._readout = CommandReadout(env)
        memory.initial_state()

    @classmethod
    def load(cls, path: str, env: gym.Env[Any, Any]) -> Self:
        """With the memory in a file; raises as ``NeuralASM.load`` does too."""
        return cls(NeuralASM.load(path), env)

    def predict(
        self,
        observation: Any,
        state: ActingState | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], ActingState]:
        """The action (A,) that the memory expects, and the state to pass in next time; nothing is drawn at random."""
        if state is None or (episode_start is not None and np.any(episode_start)):
            state = ActingState(self.memory.initial_state(), np.zeros(self._size, np.float32))
        row = self._read(observation, state.action)
        memory, _ = self.memory.observe(state.memory, row[None])
        action, grip = self._readout(self.memory.expected_action(memory)[0], state.grip)
        return action, ActingState(memory, action, grip)


def require_motor(spec: StreamSpec, env: gym.Env[Any, Any]) -> int:
    """How many numbers are commanded; raises ValueError unless the spec holds the environment's actions."""
    space = env.action_space
    if not isinstance(space, spaces.Box):
        raise ValueError(f"a memory drives a Box action space, got {space}")
    if not len(spec.motor):
        raise ValueError(f"this memory predicts no command: its stream has no action, only {', '.join(spec.slices)}")
    if len(spec.motor) != int(np.prod(space.shape)):
        raise ValueError(f"this memory predicts {len(spec.motor)} commands, the environment takes {space.shape}")
    return len(spec.motor)


def _of_spaces(env: gym.Env[Any, Any]) -> StreamSpec:
    return StreamSpec.from_spaces(env.observation_space, env.action_space, control_period(env))


def _harmless(line: str, spec: StreamSpec, theirs: StreamSpec) -> bool:
    """Whether a difference keeps nobody from reading: what is not asked for, where it stands, objects out of play."""
    name, what = line.split(": ", 1)
    absent = what == "missing" and any(c.name == name and c.group == OBJECT for c in spec.channels)
    return absent or what == "new" or name == "order" or name == "dt"
