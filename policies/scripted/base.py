"""What scripted experts share: reading an observation by name, phases of a plan, and varying as people do."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.policies.base import StatefulPolicy
from asm_gym.policies.scripted.geometry import Pose, Vector, matrix, rotation
from asm_gym.validation import check_number

OPEN, CLOSE = -1.0, 1.0
_OVER = 0.006  # how far aside of its target a careful hand goes straight down [m]
_STILL = 0.1  # below this a gripper's joints have come to rest [rad/s]


@dataclass(frozen=True)
class Style:
    """How an expert varies; each is drawn anew for every episode."""

    noise: float = (
        0.05  # standard deviation of the action noise [action units], correlated over about 0.2 s
    )
    speed: float = 1.0  # hand speed relative to the expert's usual one
    speed_spread: float = 0.08  # standard deviation of the speed between episodes
    spread: float = 0.01  # standard deviation of way-points between episodes [m]

    def __post_init__(self) -> None:
        for name in ("noise", "speed_spread", "spread"):
            check_number(name, getattr(self, name), low=0)
        check_number("speed", self.speed, above=0)

    def pace(self, usual: float, rng: np.random.Generator) -> float:
        """Return the speed of one episode, where ``usual`` is the expert's own."""
        return (
            usual
            * self.speed
            * float(np.clip(1 + self.speed_spread * rng.standard_normal(), 0.5, 1.5))
        )

    def drifted(self, drift: Vector, rng: np.random.Generator) -> Vector:
        """Return the next action noise after ``drift``: an AR(1) process that forgets in about 4 steps."""
        rho = 0.78
        return rho * drift + self.noise * np.sqrt(1 - rho**2) * rng.standard_normal(len(drift))


class ObservationReader:
    """Named parts of an environment's flat or dict observation."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._flat = isinstance(env.observation_space, spaces.Box)
        sizes = env.unwrapped.observation_layout  # type: ignore[attr-defined]
        ends = np.cumsum([*sizes.values()]).tolist()
        self._slices = {
            name: slice(end - sizes[name], end) for name, end in zip(sizes, ends, strict=True)
        }

    def __call__(self, observation: Any, name: str) -> Vector:
        """Return the numbers of a channel."""
        part = observation[self._slices[name]] if self._flat else observation[name]
        return np.asarray(part, dtype=np.float64)

    def hand(self, observation: Any, prefix: str = "") -> Pose:
        """Return the pose of a hand."""
        turned = rotation(self(observation, f"{prefix}hand_orientation"))
        return Pose(self(observation, f"{prefix}hand_position"), turned)

    def pose(self, observation: Any, name: str) -> Pose:
        """Return the pose of an object."""
        return Pose(self(observation, f"{name}_pos"), matrix(self(observation, f"{name}_quat")))


class State(NamedTuple):
    """Where an expert stands in one episode."""

    phase: int  # of its plan
    since: int  # steps spent in the phase
    speed: float  # action units
    spread: Vector  # how this episode's way-points differ from the plan [m]
    plan: Any  # what else was decided at the beginning
    anchor: Any  # the hand, or hands, when the phase began
    drift: Vector  # correlated action noise


class Expert(StatefulPolicy):
    """A scripted expert: phases of a plan, each with the command it gives and the condition that ends it."""

    pace: ClassVar[float]  # usual hand speed [action units]

    def __init__(
        self, env: gym.Env[Any, Any], seed: int | None = None, style: Style | None = None
    ) -> None:
        inner: Any = env.unwrapped
        self.inner, self.robosuite = inner, inner.robosuite_env
        self.style = style or Style()
        self.np_random = np.random.default_rng(seed)
        self.read = ObservationReader(env)
        size = int(np.prod(env.action_space.shape or ()))
        # indices of the action that move arms
        self.moves = np.setdiff1d(np.arange(size), inner.gripper_actions)
        self._careful = set(inner.robots) != {"Panda"}
        """Plans have the Panda's pace; other arms drift further from their course."""
        self._gain = 3.0 if self._careful else 2.0

    @abstractmethod
    def begin(self, observation: Any) -> State:
        """Draw the style of an episode, and return its first state."""

    def start(
        self, speed: float, spread: Any = 0.0, plan: Any = None, noises: int = 7, anchor: Any = None
    ) -> State:
        """Return a first state; ``noises`` is how many numbers of the action are noisy."""
        return State(
            0, 0, speed, spread, plan, np.zeros(3) if anchor is None else anchor, np.zeros(noises)
        )

    def act(
        self, observation: Any, state: State, deterministic: bool
    ) -> tuple[NDArray[np.float32], State]:
        """Return the action (A,) and the next state; ``deterministic`` leaves the action noise out, not the style."""
        state = state._replace(
            since=state.since + 1, drift=self.style.drifted(state.drift, self.np_random)
        )
        scene = self.look(observation)
        state = self.advance(state, scene)
        command = self.command(state, scene)
        command[self.moves] += 0.0 if deterministic else state.drift[self.moves]
        return np.clip(command, -1.0, 1.0).astype(np.float32), state

    @abstractmethod
    def look(self, observation: Any) -> Any:
        """Return the scene; it has the ``hand``, or the ``hands``."""

    @abstractmethod
    def next_phase(self, state: State, scene: Any) -> int:
        """Return the phase that follows; the present one while its work is not done."""

    @abstractmethod
    def command(self, state: State, scene: Any) -> Vector:
        """Return the action (A,) that the phase asks for, without noise."""

    def advance(self, state: State, scene: Any) -> State:
        """Return the state in the next phase."""
        phase = self.next_phase(state, scene)
        return state if phase == state.phase else self.entered(state, scene, phase)

    def entered(self, state: State, scene: Any, phase: int) -> State:
        """Return the state at the beginning of a phase."""
        return state._replace(phase=phase, since=0, anchor=scene.hand.at)


def has_settled(velocity: Vector, since: int, usual: int) -> bool:
    """Whether fingers that were told to close or open ``since`` steps ago have done so.

    Those that slide take the ``usual`` steps. Those that turn, in linkages, take several times as long, and are waited
    for until they stand still.
    """
    if velocity.size <= 2:
        return since >= usual
    return (since >= 2 * usual and float(np.abs(velocity).max()) < _STILL) or since >= 5 * usual


def over_first(position: Vector, target: Vector) -> Vector:
    """Return how much higher (3,) than its target [m] a careful hand goes beside it, lest a finger comes down on it."""
    astray = float(np.linalg.norm((position - target)[:2]))
    return np.array([0.0, 0.0, np.clip(4 * (astray - _OVER), 0.0, 0.06)])
