"""What to do on an alarm, beside staying: go on as expected, go back, give way, or what its cause asks for."""

from __future__ import annotations

from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.policies.holding import Begun, Hold, Reflex, nearest_to_rest, require_unchanged, resting_action
from asm_gym.protocols import TurnsJoints
from asm_gym.spec import StreamSpec, control_period
from asm_gym.validation import check_number

__all__ = [
    "Begun",
    "Comply",
    "Graded",
    "Hold",
    "Recall",
    "Reflex",
    "Retract",
    "nearest_to_rest",
    "resting_action",
]

USUAL_GAIN = 0.1
"""Weight of the newest step in the external torque that is taken to be usual."""

FELT_AT_ONCE = 100
"""Rows that are kept before they are reckoned with."""

DELTAS = ("OSC_POSE", "JOINT_POSITION")
"""Controllers whose actions are changes, of pose or of joint angles."""


class Recall(Hold):
    """Goes on along what the memory expects to be commanded: the skill's own continuation.

    The wrapper says what that is after every step, by the monitor's ``expected_action``.

    Args:
        env: one whose stream carries the actions it is given.

    Raises:
        ValueError: a wrapper inside changes actions, so that those of the stream are others.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        if env.has_wrapper_attr("stream_spec"):
            require_unchanged(env, "recall")

    def reset(self) -> None:
        self.expects(self._rest)

    def expects(self, action: NDArray[np.float32]) -> None:
        """What the memory expects to be commanded next (A,)."""
        self._expected = np.nan_to_num(np.array(action, np.float32))

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
        ValueError: the environment's actions are no changes, a wrapper inside changes them, or it does not say.
    """

    def __init__(self, env: gym.Env[Any, Any], steps: int = 10) -> None:
        super().__init__(env)
        _require_deltas(env, "retract")
        self._path: deque[NDArray[np.float32]] = deque(
            maxlen=check_number("steps", steps, low=1, high=10_000, whole=True)
        )

    def reset(self) -> None:
        self._path.clear()

    def feel(self, row: NDArray[np.floating[Any]], executed: NDArray[np.float32], acting: bool) -> None:
        if not acting:
            self._path.append(np.array(executed, np.float32))

    def move(self) -> NDArray[np.float32]:
        if not self._path:
            return super().move()
        undone: NDArray[np.float32] = -self._path.pop()
        return undone


class Comply(Hold):
    """Yields along the external torque that the joints measure, as a damper would.

    Args:
        env: one of this package's, with the channel ``external_torque``.
        compliance: how far a joint gives way in a second [rad / (N m s)].
        tolerated: external torque that no joint gives way to [N m].

    Raises:
        ValueError: the environment measures no external torque, its controller cannot be told to move so, or a wrapper
            inside changes actions.
    """

    def __init__(self, env: gym.Env[Any, Any], compliance: float = 0.05, tolerated: float = 2.0) -> None:
        super().__init__(env)
        self._joints = _require_deltas(env, "comply")
        spec: StreamSpec = env.get_wrapper_attr("stream_spec")
        self._columns = np.array(
            [i for n, s in spec.slices.items() if n.endswith("external_torque") for i in range(spec.size)[s]], np.intp
        )
        if not self._columns.size:
            raise ValueError("comply needs the channel external_torque: make the environment with stream group torque")
        self.tolerated = check_number("tolerated", tolerated, low=0)
        self._each_step = check_number("compliance", compliance, low=0) * control_period(env)
        self.reset()

    def reset(self) -> None:
        self._usual = np.zeros(len(self._columns))
        self._torque = np.zeros(len(self._columns))
        self._felt: list[tuple[NDArray[np.floating[Any]], bool]] = []  # (J,) each, and whether it acted

    def feel(self, row: NDArray[np.floating[Any]], executed: NDArray[np.float32], acting: bool) -> None:
        self._felt.append((row[self._columns], acting))
        if len(self._felt) > FELT_AT_ONCE:
            self._reckon()

    def _reckon(self) -> None:
        """Makes up for rows that were only kept: nobody asks while the policy acts."""
        for felt, acting in self._felt:
            if not acting:
                # What is carried weighs on the joints as well; only what has come since is yielded to.
                self._usual += USUAL_GAIN * (self._torque - self._usual)
            torque = np.asarray(felt, np.float64)
            self._torque = torque if np.isfinite(torque).all() else np.nan_to_num(torque)
        self._felt.clear()

    @property
    def load(self) -> NDArray[np.float64]:
        """(J,) external torque beyond the usual and the tolerated [N m]."""
        self._reckon()
        more = self._torque - self._usual
        beyond: NDArray[np.float64] = np.sign(more) * np.maximum(np.abs(more) - self.tolerated, 0.0)
        return beyond

    def move(self) -> NDArray[np.float32]:
        return self._joints.action_for(self._each_step * self.load)


class Graded(Hold):
    """Does what is asked for: stays, gives way, or goes back.

    The wrapper says which, by severity and cause of the alarm. What the environment does not allow is replaced by
    staying. The wrapper hands back when surprise is quiet, and on trial after ``TRY_AFTER_S`` where it
    is not, for a robot that holds still where it never did may surprise itself; after ``GIVE_UP_AFTER_S`` in all it
    ends the episode. The policy may go on in alarm for ``GO_ON_S`` in an episode. It ends where the policy passes a
    contact limit for the time ``STRIKES``, or presses with more than ``IMPULSE`` [N s] beyond healthy motion.

    Args:
        env: one with a Box action space.
        compliance, tolerated: of ``Comply``.
    """

    TRY_AFTER_S, GIVE_UP_AFTER_S, GO_ON_S = 0.5, 3.0, 5.0
    STRIKES, IMPULSE = 3, 20.0

    def __init__(self, env: gym.Env[Any, Any], compliance: float = 0.05, tolerated: float = 4.0) -> None:
        super().__init__(env)
        self._reflexes: dict[str, Hold] = {"hold": Hold(env)}
        for name, make in (("yield", lambda: Comply(env, compliance, tolerated)), ("retract", lambda: Retract(env))):
            try:
                self._reflexes[name] = make()
            except ValueError:  # the environment does not allow it
                self._reflexes[name] = self._reflexes["hold"]
        self.choose("hold")

    def choose(self, name: str) -> None:
        """What to do from now on: ``"hold"``, ``"yield"`` or ``"retract"``; anything else is staying."""
        self._chosen = self._reflexes.get(name, self._reflexes["hold"])

    def reset(self) -> None:
        for reflex in self._reflexes.values():
            reflex.reset()
        self.choose("hold")

    def feel(self, row: NDArray[np.floating[Any]], executed: NDArray[np.float32], acting: bool) -> None:
        for reflex in self._reflexes.values():
            reflex.feel(row, executed, acting)

    def move(self) -> NDArray[np.float32]:
        return self._chosen.move()


def _require_deltas(env: gym.Env[Any, Any], name: str) -> TurnsJoints:
    inner = env.unwrapped
    controller = inner.controller if isinstance(inner, TurnsJoints) else None
    if not isinstance(inner, TurnsJoints) or controller not in DELTAS:
        raise ValueError(
            f"{name} needs an environment whose controller is {' or '.join(DELTAS)}, got {controller}: "
            "use hold with a safe_action of your own, or name any policy"
        )
    require_unchanged(env, name)
    return inner
