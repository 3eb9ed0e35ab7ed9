"""What scripted experts share: reading an observation by name, moving the hand, and varying as people do."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.validation import check_number

Vector = NDArray[np.float64]

# What one unit of action moves the hand's set-point by, in robosuite's OSC_POSE: 5 cm, 0.5 rad.
_METRES, _RADIANS = 0.05, 0.5
OPEN, CLOSE = -1.0, 1.0
_OVER = 0.006  # how far aside of its target a careful hand goes straight down [m]
_STILL = 0.1  # below this a gripper's joints have come to rest [rad/s]


@dataclass(frozen=True)
class Style:
    """How an expert varies; each is drawn anew for every episode.

    Args:
        noise: standard deviation of the action noise, in action units; correlated over about 0.2 s, as a hand's is.
        speed: hand speed relative to the expert's usual one.
        speed_spread: standard deviation of the speed between episodes.
        spread: standard deviation of way-points between episodes [m].
    """

    noise: float = 0.05
    speed: float = 1.0
    speed_spread: float = 0.08
    spread: float = 0.01

    def __post_init__(self) -> None:
        for name in ("noise", "speed_spread", "spread"):
            check_number(name, getattr(self, name), low=0)
        check_number("speed", self.speed, above=0)

    def pace(self, usual: float, rng: np.random.Generator) -> float:
        """The speed of one episode, where ``usual`` is the expert's own."""
        return usual * self.speed * float(np.clip(1 + self.speed_spread * rng.standard_normal(), 0.5, 1.5))

    def drifted(self, drift: Vector, rng: np.random.Generator) -> Vector:
        """The next action noise after ``drift``: an AR(1) process that forgets in about 4 steps."""
        rho = 0.78
        step: Vector = rho * drift + self.noise * np.sqrt(1 - rho**2) * rng.standard_normal(len(drift))
        return step


class ObservationReader:
    """Named parts of an environment's flat or dict observation.

    Args:
        env: has the observation's layout.
        robot: whose hand and fingers are meant where a name does not say, such as ``"robot0"``.
    """

    def __init__(self, env: gym.Env[Any, Any], robot: str = "") -> None:
        self._robot = robot
        self._flat = isinstance(env.observation_space, spaces.Box)
        self._slices: dict[str, slice] = {}
        start = 0
        for name, size in env.unwrapped.observation_layout.items():  # type: ignore[attr-defined]
            self._slices[name] = slice(start, start + size)
            start += size

    def __call__(self, observation: Any, name: str) -> Vector:
        own = f"{self._robot}_{name}"
        name = own if own in self._slices else name
        part = observation[self._slices[name]] if self._flat else observation[name]
        return np.asarray(part, dtype=np.float64)


class Expert:
    """What every scripted expert has.

    Args:
        env: tells where things stand in the observation, and in the room where the observation does not say.
        seed: of the noise and of the style drawn for each episode.
        style: how much it varies.
    """

    def __init__(self, env: gym.Env[Any, Any], seed: int | None = None, style: Style | None = None) -> None:
        self.env = env
        self.style = style or Style()
        self.np_random = np.random.default_rng(seed)
        self._read = ObservationReader(env)
        self._careful = set(env.unwrapped.robots) != {"Panda"}  # type: ignore[attr-defined]
        """Plans have the Panda's pace; other arms drift further from their course."""


class PhasedExpert(Expert, ABC):
    """An expert whose state says in which phase of its plan it is, since when, and how its noise has drifted."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], Any]:
        """The action (A,); ``deterministic`` leaves the action noise out, not the style."""
        if state is None or (episode_start is not None and np.any(episode_start)):
            state = self._begin(observation)
        state = state._replace(since=state.since + 1, drift=self.style.drifted(state.drift, self.np_random))
        command, state = self._act(observation, state, np.zeros_like(state.drift) if deterministic else state.drift)
        return np.clip(command, -1.0, 1.0).astype(np.float32), state

    @abstractmethod
    def _begin(self, observation: Any) -> Any:
        """Where an episode stands before its first step: a NamedTuple with ``since`` and ``drift``."""

    @abstractmethod
    def _act(self, observation: Any, state: Any, noise: Vector) -> tuple[Vector, Any]:
        """The command (A,) with ``noise`` where it belongs, and where the episode then stands."""


def has_settled(velocity: Vector, since: int, usual: int) -> bool:
    """Whether fingers that were told to close or open ``since`` steps ago have done so.

    Args:
        velocity: of the gripper's joints.
        since: control steps.
        usual: how many steps fingers that slide take. Those that turn, in linkages, take several times as long, more
            where they close on little, and are waited for until they stand still.
    """
    if velocity.size <= 2:
        return since >= usual
    return (since >= 2 * usual and float(np.abs(velocity).max()) < _STILL) or since >= 5 * usual


def rotation(columns: Vector) -> Vector:
    """(3, 3) rotation from its first two columns (6,), made orthonormal again after sensor noise."""
    x = columns[:3] / np.linalg.norm(columns[:3])
    y = columns[3:] - (x @ columns[3:]) * x
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def matrix(quaternion: Vector) -> Vector:
    """(3, 3) rotation from a unit quaternion (x, y, z, w)."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def pointing_down(hand: Vector, object_rotation: Vector | None = None) -> Vector:
    """(3, 3) the rotation nearest ``hand`` (3, 3) whose fingers point down and close along a side of the object."""
    if object_rotation is None:
        return gripping(hand, None)
    # The side that lies flattest gives the object's heading; a cube looks the same every quarter turn.
    side = object_rotation[:, int(np.abs(object_rotation[2]).argmin())]
    return gripping(hand, side, np.pi / 2)


def gripping(hand: Vector, closing: Vector | None, turns: float = np.pi) -> Vector:
    """(3, 3) the rotation nearest ``hand`` (3, 3) whose fingers point down and close along ``closing``.

    Args:
        closing: (3,) in the world; the hand's own direction where None.
        turns: after how much of a turn the direction is as good again [rad].
    """
    own = hand[:2, 1]  # fingers move along the hand's y axis
    yaw = np.arctan2(own[1], own[0])
    if closing is not None:
        heading = np.arctan2(closing[1], closing[0])
        yaw = heading + np.round((yaw - heading) / turns) * turns
    y = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    z = np.array([0.0, 0.0, -1.0])
    return np.stack([np.cross(y, z), y, z], axis=1)


def grasping(hand: Vector, approach: Vector, closing: Vector) -> Vector:
    """(3, 3) the rotation nearest ``hand`` (3, 3) whose fingers point along ``approach`` and close along ``closing``.

    Both are unit vectors (3,) at right angles.
    """
    y = closing * (1.0 if hand[:, 1] @ closing > 0 else -1.0)
    return np.stack([np.cross(y, approach), y, approach], axis=1)


def move(
    position: Vector, target: Vector, hand: Vector, target_rotation: Vector, speed: float, gain: float = 1.0
) -> Vector:
    """(6,) the hand's command: towards a pose, at no more than ``speed`` (in action units).

    The controller covers about a third of what it is asked for in one step, so a ``gain`` of 2 does not overshoot.
    """
    step = gain * (target - position) / _METRES
    norm = np.linalg.norm(step)
    if norm > speed:
        step *= speed / norm
    turn = 0.5 * np.cross(hand, target_rotation, axis=0).sum(axis=1) / _RADIANS
    return np.concatenate([step, np.clip(turn, -0.5, 0.5)])


def over_first(position: Vector, target: Vector) -> Vector:
    """(3,) how much higher than its target a careful hand goes while it is not over it, lest a finger comes down on it.

    Args:
        position, target: (3,) of the hand [m].
    """
    astray = float(np.linalg.norm((position - target)[:2]))
    return np.array([0.0, 0.0, np.clip(4 * (astray - _OVER), 0.0, 0.06)])


def turn_left(hand: Vector, target: Vector) -> float:
    """The angle between two orientations [rad]."""
    return float(np.arccos(np.clip((np.trace(hand.T @ target) - 1) / 2, -1.0, 1.0)))
