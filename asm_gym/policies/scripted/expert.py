"""What scripted experts share: reading an observation by name, phases of a plan, and varying as people do."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.policies.policy import StatefulPolicy
from asm_gym.policies.scripted.geometry import (
    UP,
    Pose,
    Vector,
    command_towards,
    length,
    rotation_from_columns,
    rotation_from_quaternion,
)
from asm_gym.validation import check_number

# Commands of a gripper.
OPEN = -1.0
CLOSE = 1.0

FORGETTING = 0.78  # correlation of the action noise from step to step
SLIDING_JOINTS = 2  # of a gripper whose fingers slide; linkages have more
STILL = 0.1  # below this a gripper's joints have come to rest [rad/s]

STRAIGHT_DOWN = 0.006  # from so little aside of its target a careful hand goes straight down [m]
HIGHEST_DETOUR = 0.06  # above its target, of a careful hand that is aside [m]


@dataclass(frozen=True)
class Style:
    """How an expert varies; each is drawn anew for every episode."""

    # standard deviation of the action noise [action units], correlated over about 0.2 s
    noise: float = 0.05
    speed: float = 1.0  # hand speed relative to the expert's usual one
    speed_spread: float = 0.08  # standard deviation of the speed between episodes
    spread: float = 0.01  # standard deviation of way-points between episodes [m]

    def __post_init__(self) -> None:
        for name in ("noise", "speed_spread", "spread"):
            check_number(name, getattr(self, name), low=0)
        check_number("speed", self.speed, above=0)

    def draw_speed(self, usual: float, rng: np.random.Generator) -> float:
        """Return the speed of one episode, where ``usual`` is the expert's own."""
        drawn = 1 + self.speed_spread * rng.standard_normal()
        return usual * self.speed * float(np.clip(drawn, 0.5, 1.5))

    def draw_noise(self, last: Vector, size: int, rng: np.random.Generator) -> Vector:
        """Return the action noise (size,) after the ``last`` one: an AR(1) process that forgets in about 4 steps."""
        std = self.noise * np.sqrt(1 - FORGETTING**2)
        return FORGETTING * last + std * rng.standard_normal(size)


class ObservationReader:
    """Reads named parts of an environment's flat or dict observation: ``read(observation, "hand_position")``."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._is_flat = isinstance(env.observation_space, spaces.Box)
        self._columns: dict[str, slice] = {}
        start = 0
        for name, size in env.unwrapped.observation_layout.items():  # type: ignore[attr-defined]
            self._columns[name] = slice(start, start + size)
            start += size

    def __call__(self, observation: Any, name: str) -> Vector:
        """Return the numbers of a channel."""
        if self._is_flat:
            return np.asarray(observation[self._columns[name]], np.float64)
        return np.asarray(observation[name], np.float64)

    def hand(self, observation: Any, prefix: str = "") -> Pose:
        """Return the pose of a hand."""
        return Pose(
            position=self(observation, f"{prefix}hand_position"),
            orientation=rotation_from_columns(self(observation, f"{prefix}hand_orientation")),
        )

    def pose(self, observation: Any, name: str) -> Pose:
        """Return the pose of an object."""
        return Pose(
            position=self(observation, f"{name}_pos"),
            orientation=rotation_from_quaternion(self(observation, f"{name}_quat")),
        )


class State(NamedTuple):
    """Where an expert stands in one episode."""

    speed: float  # of the hand in this episode [action units]
    plan: Any  # what else was decided at the beginning
    waypoint_offset: Any = 0.0  # (3,) how this episode's way-points differ from the plan [m]
    noise: Any = 0.0  # (A,) of the last action
    anchor: Any = None  # (3,) where the hand was when the phase began [m]
    phase: int = 0  # of the plan
    steps_in_phase: int = 0


class Phase(NamedTuple):
    """One phase of a plan; its functions are called with the scene."""

    command: Callable[[Any], Vector]  # (6,) of the hand [action units]
    gripper: float | None  # ``OPEN`` or ``CLOSE``; None where the hand is a tool
    # the phases that may follow, each with its condition; the first that holds counts
    next_phases: Mapping[int, Callable[[Any], bool]] = MappingProxyType({})


@dataclass(frozen=True)
class Scene:
    """What an expert observes in one step, and the table of its phases."""

    phases: ClassVar[Mapping[int, Phase]]
    state: State
    hand: Pose

    @property
    def plan(self) -> Any:
        """What was decided at the beginning of the episode."""
        return self.state.plan

    def move(self, position: Vector, orientation: Vector, gain: float = 1.0) -> Vector:
        """Return the hand's command (6,) towards a position (3,) and an orientation (3, 3)."""
        return command_towards(self.hand, position, orientation, self.state.speed, gain)


class Expert(StatefulPolicy):
    """A scripted expert: phases of a plan, each with a command and the condition that ends it.

    Args:
        env: an environment of this package.
        seed: of the style of each episode and of the action noise.
        style: how episodes vary.
    """

    pace: ClassVar[float]  # usual hand speed [action units]

    def __init__(
        self, env: gym.Env[Any, Any], seed: int | None = None, style: Style | None = None
    ) -> None:
        inner: Any = env.unwrapped
        self.inner = inner
        self.robosuite = inner.robosuite_env
        self.style = style or Style()
        self.np_random = np.random.default_rng(seed)
        self.read = ObservationReader(env)
        self.size = int(np.prod(env.action_space.shape or ()))
        # indices of the action that move arms
        self.arm_columns = np.setdiff1d(np.arange(self.size), inner.gripper_actions)
        # Plans are made for the pace and reach of a Panda; other arms drift further.
        self.is_careful = set(inner.robots) != {"Panda"}
        self.gain = 3.0 if self.is_careful else 2.0

    def draw_speed(self) -> float:
        """Return the speed of the hand in one episode [action units]."""
        return self.style.draw_speed(self.pace, self.np_random)

    def draw_offset(self) -> Vector:
        """Return how far (3,) a way-point of one episode is from the plan's [m]."""
        return self.style.spread * self.np_random.standard_normal(3)

    @abstractmethod
    def begin(self, observation: Any) -> State:
        """Draw the style of an episode, and return its first state."""

    @abstractmethod
    def observe(self, observation: Any, state: State) -> Any:
        """Return the ``Scene``."""

    def act(
        self, observation: Any, state: State, deterministic: bool
    ) -> tuple[NDArray[np.float32], State]:
        """Return the action (A,) and the next state; ``deterministic`` leaves the action noise out, not the style."""
        noise = self.style.draw_noise(state.noise, self.size, self.np_random)
        steps = state.steps_in_phase + 1
        scene = self.observe(observation, state._replace(steps_in_phase=steps, noise=noise))
        state = self.advance(scene, observation)
        if state is not scene.state:  # another phase has begun
            scene = self.observe(observation, state)

        phase = scene.phases[state.phase]
        command = phase.command(scene)
        if phase.gripper is not None:
            command = np.append(command, phase.gripper)
        if not deterministic:
            command[self.arm_columns] += noise[self.arm_columns]
        return np.clip(command, -1.0, 1.0).astype(np.float32), state

    def advance(self, scene: Any, observation: Any) -> State:
        """Return the state in the phase that follows, or as it is while the phase's work is not done."""
        for phase, is_due in scene.phases[scene.state.phase].next_phases.items():
            if is_due(scene):
                return self.entered(scene, phase)
        return scene.state

    def entered(self, scene: Any, phase: int) -> State:
        """Return the state at the beginning of a phase."""
        return scene.state._replace(phase=phase, steps_in_phase=0, anchor=scene.hand.position)


def has_settled(velocity: Vector, steps: int, usual: int) -> bool:
    """Return whether fingers have closed or opened.

    Those that slide take the usual number of steps. Those that turn, in linkages, take several
    times as long, and are waited for until they stand still.

    Args:
        velocity: (J,) of the gripper's joints.
        steps: since the gripper was commanded.
        usual: steps that sliding fingers take.
    """
    if velocity.size <= SLIDING_JOINTS:
        return steps >= usual
    is_still = np.abs(velocity).max() < STILL
    return (steps >= 2 * usual and is_still) or steps >= 5 * usual


def height_while_aside(position: Vector, target: Vector) -> Vector:
    """Return how much higher (3,) than its target a careful hand goes while it is aside of it [m].

    A finger would come down on the object otherwise.
    """
    aside = length((position - target)[:2])
    higher = np.clip(4 * (aside - STRAIGHT_DOWN), 0.0, HIGHEST_DETOUR)
    return higher * UP
