"""Carries the payload from bin to bin with two arms: one lifts the lid off and hands the hammer under it to the other.

Meanwhile the other has taken the trash out of the target bin.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.policies.scripted.base import ObservationReader, State, Style
from asm_gym.policies.scripted.carry import CARRY, RAISE, RETREAT, CarryExpert, CarryScene, CarryTask
from asm_gym.policies.scripted.geometry import Pose, Vector, flattest_side, gripping, move
from asm_gym.policies.scripted.handover import PART, HandoverExpert

_DEEP = 0.22  # how far above a bin's floor to come from: its walls are 15 cm high [m]
_WITHDRAWN = 15  # after how many steps the first hand is out of the second's way
_OFF_MIDDLE = 0.025  # how far the hammer's middle is from that of its handle, for its head [m]
_PACE = 0.7  # it is a long way [action units]
_ASIDE = np.array([-0.35, 0.0, -0.05])  # from the start bin's middle to the lid's handle on the table beside it [m]


class Carrier(CarryExpert):
    """One of two arms, which carries one thing.

    Args:
        env, seed, style: as for ``Expert``.
        arm: 0 or 1.
    """

    pace = _PACE

    def __init__(self, env: gym.Env[Any, Any], seed: int, style: Style, arm: int) -> None:
        super().__init__(env, seed, style)
        self._careful, self._gain = True, 3.0  # near its own base, an arm drifts towards it
        self._arm, self.moves = arm, np.arange(6)
        self.read = ObservationReader(env, f"robot{arm}")

    @property
    def base(self) -> Vector:
        """(3, 3) orientation of the arm's base, in whose frame its controller takes commands."""
        return np.array(self.robosuite.robots[self._arm].base_ori, np.float64)

    def command(self, state: State, scene: CarryScene) -> Vector:
        command, base, hand = super().command(state, scene), self.base, scene.hand
        if state.phase == RAISE:  # straight up, little by little: the walls of a bin are near
            up = np.array([*state.anchor[:2], hand.at[2] + 0.03])
            command[:6] = move(hand, up, gripping(hand.turned, None), state.speed, self._gain)
        return np.concatenate([base.T @ command[:3], base.T @ command[3:6], command[6:]])

    def _held(self, task: CarryTask, hand: Vector, turned: Vector) -> Vector:
        # With the wrist in the middle, where it turns both ways.
        return gripping(hand, -self.base[:, 1], 2 * np.pi)

    @staticmethod
    def is_done(state: State) -> bool:
        """Whether everything is where it belongs, and the hand has left it."""
        return state.plan is None or (state.phase == RETREAT and state.since > 14)


class LidCarrier(Carrier):
    """Puts the lid of the start bin on the table."""

    def next_task(self, observation: Any) -> CarryTask | None:
        """Return the lid, until it is off."""
        env = self.robosuite
        start = env.sim.data.body_xpos[env.sim.model.body_name2id(env.transport.start_bin.root_body)]
        if np.linalg.norm((self.pose(observation, "lid_handle").at - start)[:2]) > 0.25:
            return None
        return CarryTask(
            name="lid_handle",
            grip=np.zeros(3),
            closing=np.array([1.0, 0.0, 0.0]),
            turns=np.pi,
            clearance=0.1,
            place=start + _ASIDE,
            over=0.22,
        )


class TrashCarrier(Carrier):
    """Throws the trash into its bin."""

    def next_task(self, observation: Any) -> CarryTask | None:
        """Return the trash, until it is in its bin."""
        at, turned = self.pose(observation, "trash")
        trash_bin = self.read(observation, "trash_bin_pos")
        if np.linalg.norm((at - trash_bin)[:2]) < 0.14:
            return None
        return CarryTask(
            name="trash",
            grip=np.zeros(3),
            closing=turned.T @ flattest_side(turned),
            turns=np.pi / 2,
            clearance=_DEEP,
            place=trash_bin + np.array([0.0, 0.0, 0.17]),
            over=0.08,
            fit=0.04,
        )


class PayloadCarrier(Carrier):
    """Lets the hammer down into the target bin.

    Args:
        env, seed, style, arm: as for ``Carrier``.
        handover: knows where the hand holds it.
    """

    pace = 0.55

    def __init__(self, env: gym.Env[Any, Any], seed: int, style: Style, arm: int, handover: HandoverExpert) -> None:
        super().__init__(env, seed, style, arm)
        self._handover = handover

    def pose(self, observation: Any, name: str) -> Pose:
        """Return the pose of the whole hammer, which has to fit between the walls."""
        at, turned = super().pose(observation, name)
        return Pose(at + _OFF_MIDDLE * turned[:, 2], turned)

    def next_task(self, observation: Any) -> CarryTask | None:
        """Return the hammer, until it is in the bin."""
        at, _ = self.pose(observation, "payload")
        target = self.read(observation, "target_bin_pos")
        if np.linalg.norm((at - target)[:2]) < 0.14 and at[2] < target[2] + 0.05:
            return None
        return CarryTask(
            name="payload",
            grip=np.array([0.0, 0.0, self._handover.hammer(observation).taking - _OFF_MIDDLE]),
            closing=np.array([1.0, 0.0, 0.0]),
            turns=np.pi,
            clearance=_DEEP,
            place=target + np.array([0.0, 0.0, 0.13]),
            over=0.2,
            fit=0.04,
        )

    def take_over(self, observation: Any) -> State:
        """Return a first state in which the hand already has the hammer."""
        return self.begin(observation)._replace(phase=CARRY)


class TransportState(NamedTuple):
    """The states of an episode's four parts; None before a part begins."""

    lid: State | None = None
    trash: State | None = None
    handover: State | None = None
    payload: State | None = None


class TransportExpert:
    """A scripted expert for TwoArmTransport.

    Args:
        env, seed, style: as for ``Expert``.
    """

    def __init__(self, env: gym.Env[Any, Any], seed: int | None = None, style: Style | None = None) -> None:
        style = style or Style()
        seeds = [int(s) for s in np.random.default_rng(seed).integers(2**31, size=4)]
        self._lid = LidCarrier(env, seeds[0], style, arm=0)
        self._trash = TrashCarrier(env, seeds[1], style, arm=1)
        self._handover = HandoverExpert(env, seeds[2], style, name="payload", over=_DEEP, pace=_PACE)
        self._payload = PayloadCarrier(env, seeds[3], style, arm=1, handover=self._handover)

    def predict(
        self,
        observation: Any,
        state: TransportState | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], TransportState]:
        """Return the action (14,) and the next state."""
        if state is None or (episode_start is not None and np.any(episode_start)):
            state = TransportState()
        first, lid = self._lid.predict(observation, state.lid, deterministic=deterministic)
        second, trash = self._trash.predict(observation, state.trash, deterministic=deterministic)
        state = state._replace(lid=lid, trash=trash)
        if not Carrier.is_done(lid):
            return np.concatenate([first, second]), state
        both, shared = self._handover.predict(observation, state.handover, deterministic=deterministic)
        state = state._replace(handover=shared)
        if not Carrier.is_done(trash):
            return np.concatenate([both[:7], second]), state
        if shared.phase == PART and shared.since > _WITHDRAWN:
            started = state.payload or self._payload.take_over(observation)
            second, payload = self._payload.predict(observation, started, deterministic=deterministic)
            return np.concatenate([both[:7], second]), state._replace(payload=payload)
        return both, state
