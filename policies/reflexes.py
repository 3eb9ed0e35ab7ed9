"""What to do on an alarm. A reflex is an ordinary policy, which the safety wrapper lets feel every row."""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.stream import StreamSpec, control_period

USUAL_GAIN = 0.1
"""Weight of the newest step in the external torque that is taken to be usual."""

DELTAS = ("OSC_POSE", "JOINT_POSITION")
"""Controllers whose actions are changes, of pose or of joint angles."""


class Begun(NamedTuple):
    """Where a reflex is."""

    executed: NDArray[np.float32]  # (A,) the action executed last before it began; its grip is kept
    steps: int  # that it has acted


class Hold:
    """Stay, and keep the grip.

    Under robosuite's delta controllers a zero command keeps the arm where it is; the gripper's command is repeated as
    it was last given, so that nothing is dropped.

    Args:
        env: one with a Box action space.
        safe_action: what to do instead, where a zero action does not mean "stay".

    Raises:
        ValueError: ``safe_action`` does not fit the action space.
    """

    def __init__(self, env: gym.Env[Any, Any], safe_action: NDArray[np.float32] | None = None) -> None:
        space = env.action_space
        if not isinstance(space, spaces.Box):
            raise TypeError(f"a reflex needs a Box action space, got {space}")
        rest = np.zeros(space.shape, np.float32) if safe_action is None else np.asarray(safe_action, np.float32)
        if not space.contains(rest):
            raise ValueError(f"safe_action {rest} is not in {space}")
        self._rest = rest
        self._grip = np.asarray(getattr(env.unwrapped, "gripper_actions", ()), dtype=int)
        self._explicit = safe_action is not None

    def reset(self) -> None:
        """A new episode begins."""

    def feel(self, row: NDArray[np.floating[Any]], executed: NDArray[np.float32], acting: bool) -> None:
        """What was sensed in a step, and what was done.

        Args:
            row: (D,) of the stream.
            executed: (A,).
            acting: whether this reflex did it.
        """

    def begin(self, executed: NDArray[np.float32]) -> Begun:
        """The state to start from, after ``executed`` (A,)."""
        return Begun(np.asarray(executed, np.float32), 0)

    def predict(
        self,
        observation: Any,
        state: Begun | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], Begun | None]:
        """The next action (A,)."""
        action = self._rest.copy() if self._explicit else self.move()
        if state is None:
            return action, None
        if not self._explicit:
            action[self._grip] = state.executed[self._grip]
        return action, Begun(state.executed, state.steps + 1)

    def move(self) -> NDArray[np.float32]:
        """The next action (A,); the gripper's part of it does not count."""
        return self._rest.copy()


class Recall(Hold):
    """Goes on along what the memory expects to be commanded: the skill's own continuation.

    The wrapper says what that is after every step, by the monitor's ``expected_action``.
    """

    def reset(self) -> None:
        self.expects(self._rest)

    def expects(self, action: NDArray[np.float32]) -> None:
        """What the memory expects to be commanded next (A,)."""
        self._expected = np.nan_to_num(np.asarray(action, np.float32))

    def predict(
        self,
        observation: Any,
        state: Begun | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], Begun | None]:
        """The next action (A,), the gripper's part of it included."""
        return self._expected.copy(), None if state is None else Begun(state.executed, state.steps + 1)


class Retract(Hold):
    """Back along the path just travelled, then stay.

    Under a delta controller the negative of an action undoes it, so the last ones are undone, the newest first.

    Args:
        env: one whose controller takes changes of pose or of joint angles.
        steps: how many actions to undo.

    Raises:
        ValueError: the environment's actions are no changes, or it does not say.
    """

    def __init__(self, env: gym.Env[Any, Any], steps: int = 10) -> None:
        super().__init__(env)
        _require_deltas(env, "retract")
        self._path: deque[NDArray[np.float32]] = deque(maxlen=steps)

    def reset(self) -> None:
        self._path.clear()

    def feel(self, row: NDArray[np.floating[Any]], executed: NDArray[np.float32], acting: bool) -> None:
        if not acting:
            self._path.append(np.asarray(executed, np.float32))

    def move(self) -> NDArray[np.float32]:
        if not self._path:
            return self._rest.copy()
        undone: NDArray[np.float32] = -self._path.pop()
        return undone


class Comply(Hold):
    """Yields along the external torque that the joints measure, as a damper would.

    Args:
        env: one of this package's, with the channel ``external_torque``.
        compliance: how far a joint gives way in a second [rad / (N m s)].
        tolerated: external torque that no joint gives way to [N m].

    Raises:
        ValueError: the environment measures no external torque, or its controller cannot be told to move so.
    """

    def __init__(self, env: gym.Env[Any, Any], compliance: float = 0.05, tolerated: float = 2.0) -> None:
        super().__init__(env)
        _require_deltas(env, "comply")
        spec: StreamSpec = env.get_wrapper_attr("stream_spec")
        self._columns = [
            i for n, s in spec.slices.items() if n.endswith("external_torque") for i in range(spec.size)[s]
        ]
        if not self._columns:
            raise ValueError("comply needs the channel external_torque: make the environment with stream group torque")
        self._env: Any = env.unwrapped
        self.tolerated = tolerated
        self._each_step = compliance * control_period(env)
        self.reset()

    def reset(self) -> None:
        self._usual = np.zeros(len(self._columns))
        self._torque = np.zeros(len(self._columns))

    def feel(self, row: NDArray[np.floating[Any]], executed: NDArray[np.float32], acting: bool) -> None:
        if not acting:
            # What is carried weighs on the joints as well; only what has come since is yielded to.
            self._usual += USUAL_GAIN * (self._torque - self._usual)
        self._torque = np.nan_to_num(np.asarray(row, np.float64)[self._columns])

    @property
    def load(self) -> NDArray[np.float64]:
        """(J,) external torque beyond the usual and the tolerated [N m]."""
        more = self._torque - self._usual
        beyond: NDArray[np.float64] = np.sign(more) * np.maximum(np.abs(more) - self.tolerated, 0.0)
        return beyond

    def move(self) -> NDArray[np.float32]:
        action: NDArray[np.float32] = self._env.action_for(self._each_step * self.load)
        return action


class Graded(Comply):
    """Stays; yields while something keeps pressing.

    The wrapper hands back when surprise is quiet, and on trial after ``TRY_AFTER_S`` where it is not, for a robot that
    holds still where it never did may surprise itself; after ``GIVE_UP_AFTER_S`` in all it ends the episode.

    The arguments are those of ``Comply``, with more torque tolerated.
    """

    TRY_AFTER_S, GIVE_UP_AFTER_S = 0.5, 3.0

    def __init__(self, env: gym.Env[Any, Any], compliance: float = 0.05, tolerated: float = 4.0) -> None:
        super().__init__(env, compliance, tolerated)


def _require_deltas(env: gym.Env[Any, Any], name: str) -> None:
    controller = getattr(env.unwrapped, "controller", None)
    if controller not in DELTAS:
        raise ValueError(
            f"{name} needs an environment whose controller is {' or '.join(DELTAS)}, got {controller}: "
            "use hold with a safe_action of your own, or name any policy"
        )
