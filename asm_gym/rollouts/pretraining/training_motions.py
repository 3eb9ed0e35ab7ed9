"""Motor babbling: a curriculum that teaches what a body does, not how one policy does a task.

    a_t = clip(e_t + s x_t),   x_t = ρ x_{t-1} + √(1 - ρ²) ξ_t      e the guide's action, 0 without one; ξ white

Each training motion is one episode. One in three is the expert's own, and sets the threshold. The others are led by the
expert at many speeds, by the expert under noise, or by noise alone (or a hand that reaches for one place after
another); under noise the arm also drifts now and then, as agents do once they have done their task. Some more limit the
speed of the hand as a guard does, for a slowed arm feels otherwise; with reaching, some have the expert press what it
holds. The noise is weak enough that most of a motion is free of impacts: those would teach the memory to expect them.

Sources: Laskey et al. 2017 (CoRL, DART) for noise on an expert's commands; Saegusa et al. 2009 (ROBIO) for babbling;
Rolf et al. 2010 (IEEE TAMD 2(3)) for goals in place of random commands.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from asm_gym.data.episode import save_episode
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.faults.object import ObjectMass, movable
from asm_gym.policies import Policy, make_policy
from asm_gym.policies.policy import StatefulPolicy
from asm_gym.policies.scripted.expert import CLOSE, OPEN, ObservationReader, Style
from asm_gym.policies.scripted.geometry import Vector, command_towards
from asm_gym.rollouts.pretraining.body_memory import HELD_OUT, MOTION_KEY, held_out
from asm_gym.rollouts.run_trials import environment, record_stream
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_number

Range = tuple[float, float]


class Interruption(NamedTuple):
    """The arm leaves its course now and then, for a while."""

    probability: float  # per step
    steps: tuple[int, int]  # range of its duration
    strength: Range = (0.0, 0.0)  # range of the command [action units]


# what leads the arm
EXPERT = "expert"
DISTURBED = "disturbed"  # the expert under noise
NOISE_ALONE = "noise"
REACHING = "reaching"
LEADING = (EXPERT, DISTURBED, NOISE_ALONE, EXPERT, DISTURBED)  # motion by motion of a task
GUIDES = {EXPERT: "scripted", DISTURBED: "scripted", NOISE_ALONE: "", REACHING: REACHING}

SMOOTHNESS = (0.0, 0.5, 0.9, 0.97)
"""ρ: from the noise by which agents explore to pushing on in one direction, as half-trained ones do."""
NOISE = (0.02, 0.2)  # of s, up to about the exploration of a half-trained agent [action units]
SPEED = (0.5, 1.5)  # of the expert, relative to its usual one
WEIGHT = (0.7, 1.4)  # factor of an object's mass
PAUSE = Interruption(0.01, (5, 60))
DRIFT = Interruption(0.015, (5, 60), (0.05, 1.0))
PRESS = Interruption(0.04, (8, 40), (0.1, 0.6))
STEPS_TO_GRIP = 10  # with a closed grip, after which an object counts as held
LIMIT_CHANGES = 0.05  # probability per step that the limit of a hand's speed changes
LIMITS = (0.05, 1.0)  # of a hand's speed [m/s]
GRIP_CHANGES = 0.05  # probability per step of a disturbed motion that the grip's command changes
LOOSEST = 0.05  # least share of the guide's command of the grip

# range of places, relative to where the hand begins [m]
AROUND = ((-0.25, -0.4, -0.12), (0.25, 0.4, 0.25))
TURNED = (0.2, 0.2, 0.8)  # greatest turn of the hand about the axes of the world [rad]
PACE = 0.45  # speed of the hand [action units]
ARRIVED = 0.02  # the hand goes on to the next place this near to one [m] ...
GIVEN_UP = 60  # ... or after so many steps


class TrainingMotion(NamedTuple):
    """How the arm moves in one episode: the ``number``-th of its task."""

    task: str
    number: int
    seed: int
    guide: str = "scripted"  # or ``"reaching"``; empty for noise alone
    noise: float = 0.0  # s [action units]
    smoothness: float = 0.0  # ρ of the noise
    speed: float = 1.0  # of the guide, relative to what is usual
    pause: float = 0.0  # probability per step that the arm stops for a while
    weight: float = 1.0  # of the task's object, relative to what is usual
    drift: float = 0.0  # probability per step that the arm drifts for a while
    press: float = 0.0  # probability per step that it presses what it holds for a while
    # probability per step that the limit of the hand's speed changes; 0 for no limit
    limit: float = 0.0

    @property
    def trial(self) -> Trial:
        """The episode to run, without the change of mass."""
        return Trial(task_spec(self.task).id, self.seed, "babble", faults=(), role="babble")

    @property
    def path(self) -> Path:
        """Path of its recording in a run's folder."""
        return self.trial.label.path


def curriculum(
    tasks: Sequence[str], episodes: int, seed: int, reaching: bool = False
) -> list[TrainingMotion]:
    """Return ``episodes`` of each task; all follow from ``seed``, and fewer are the first of more.

    One motion more for each three is at a limited speed. ``reaching``: the hand reaches for places where noise alone
    would lead, and one motion more for each three presses.
    """
    check_number("episodes", episodes, low=1, whole=True)
    leading = list(LEADING)
    if reaching:
        leading[leading.index(NOISE_ALONE)] = REACHING
    extra = math.ceil(episodes / HELD_OUT)
    motions = []
    for task in tasks:
        for number, own_seed in enumerate(role_seeds(seed, task, "babble", episodes)):
            lead = leading[number % len(leading)]
            if held_out(number):
                lead = EXPERT
            motions.append(_motion(task, number, own_seed, lead))
        for n, own_seed in enumerate(role_seeds(seed, task, "limit", extra)):
            number = n * HELD_OUT
            limited = _motion(task, number, own_seed, leading[number % len(leading)])
            motions.append(limited._replace(limit=LIMIT_CHANGES))
        if not reaching:
            continue
        for n, own_seed in enumerate(role_seeds(seed, task, "press", extra)):
            pressing = _motion(task, n * HELD_OUT, own_seed, DISTURBED)
            motions.append(
                pressing._replace(noise=NOISE[0], pause=0.0, drift=0.0, press=PRESS.probability)
            )
    return motions


def _motion(task: str, number: int, seed: int, lead: str) -> TrainingMotion:
    rng = np.random.default_rng([seed, 3])
    noise = 0.0
    if lead != EXPERT:
        noise = log_uniform(rng, NOISE)
    smoothness = float(rng.choice(SMOOTHNESS))
    speed = float(rng.uniform(*SPEED))
    pause = PAUSE.probability * float(rng.random() < 0.5)
    weight = 1.0
    if rng.random() < 0.5:
        weight = log_uniform(rng, WEIGHT)
    return TrainingMotion(
        task=task,
        number=number,
        seed=seed,
        guide=GUIDES[lead],
        noise=noise,
        smoothness=smoothness,
        speed=speed,
        pause=pause,
        weight=weight,
        drift=DRIFT.probability * (lead != EXPERT),
    )


def log_uniform(rng: np.random.Generator, bounds: Range) -> float:
    """Return a random number whose logarithm is uniform between those of ``bounds``."""
    return float(np.exp(rng.uniform(*np.log(bounds))))


class MotionPolicy(StatefulPolicy):
    """The policy of a training motion."""

    def __init__(self, env: gym.Env[Any, Any], motion: TrainingMotion) -> None:
        self._guide: Policy | None = None
        if motion.guide == REACHING:
            self._guide = ReachingPolicy(env, motion.seed, motion.speed)
        elif motion.guide:
            style = Style(speed=motion.speed)
            self._guide = make_policy(motion.guide, env, seed=motion.seed, style=style)
        self._arm: Any = env.unwrapped
        self._motion = motion
        self._rng = np.random.default_rng([motion.seed, 1])
        self._limits = np.random.default_rng([motion.seed, 4])  # draws the limits of speed
        self._noise = self._rng.standard_normal(env.action_space.shape or ())  # (A,)
        self._is_grip = np.zeros(len(self._noise), np.bool_)  # (A,)
        self._is_grip[list(getattr(self._arm, "gripper_actions", ()))] = True
        self._noisy_grip = bool(self._rng.random() < 0.5)
        self._grip_share = 1.0  # of the guide's command of the grip
        self._steps_gripped = 0  # since the guide closed the grip
        self._interruption = np.zeros_like(self._noise)  # (A,) action
        self._steps_left = 0  # of the interruption

    def begin(self, observation: Any) -> Any:
        if self._motion.limit:
            self._limit_speed()
        return None

    def _limit_speed(self) -> None:
        speed = log_uniform(self._limits, LIMITS)
        self._arm.contact_limits = ContactLimits(hand_speed=speed, stays=False)

    def act(
        self, observation: Any, state: Any, deterministic: bool
    ) -> tuple[NDArray[np.float32], Any]:
        """Return the next action (A,)."""
        motion = self._motion
        if self._limits.random() < motion.limit:
            self._limit_speed()
        rho = motion.smoothness
        white = self._rng.standard_normal(self._noise.shape)
        self._noise = rho * self._noise + np.sqrt(1.0 - rho**2) * white
        action = motion.noise * self._noise  # (A,)
        if self._guide is not None:
            guided, state = self._guide.predict(observation, state)
            if not self._noisy_grip:
                action = np.where(self._is_grip, 0.0, action)
            action = action + self._with_looser_grip(guided)

        if self._steps_left:
            self._steps_left -= 1
        else:
            self._steps_left = self._interrupt()
        if self._steps_left:  # it keeps its grip
            action = np.where(self._is_grip, action, self._interruption)
        return np.clip(action, -1.0, 1.0).astype(np.float32), state

    def _with_looser_grip(self, guided: NDArray[Any]) -> NDArray[Any]:
        """Return the guide's action (A,) with a looser grip.

        Without a guide's grip, however loose, the memory would never learn what holding feels like.
        """
        if self._motion.noise and self._rng.random() < GRIP_CHANGES:
            self._grip_share = self._rng.uniform(LOOSEST, 1.0)
        is_closing = guided[self._is_grip] > 0.0
        self._steps_gripped += 1
        if not is_closing.any():
            self._steps_gripped = 0
        return np.where(self._is_grip, self._grip_share, 1.0) * guided

    def _interrupt(self) -> int:
        """Return for how many steps the arm stops, drifts or presses from now on; 0 where the guide leads on."""
        rng = self._rng
        motion = self._motion
        if rng.random() < motion.pause:
            self._interruption = np.zeros_like(self._noise)
            return int(rng.integers(*PAUSE.steps))
        if rng.random() < motion.drift:
            strength = log_uniform(rng, DRIFT.strength)
            self._interruption = strength * rng.standard_normal(self._noise.shape)
            return int(rng.integers(*DRIFT.steps))
        holds = self._steps_gripped > STEPS_TO_GRIP
        if motion.press and holds and rng.random() < motion.press:
            strength = log_uniform(rng, PRESS.strength)
            self._interruption = strength * self._press_direction()
            return int(rng.integers(*PRESS.steps))
        return 0

    def _press_direction(self) -> NDArray[np.float64]:
        """Return (A,) a direction: down half of the time, else aside or anywhere; its largest entry is 1."""
        direction = np.zeros_like(self._noise)
        axes = int(self._rng.integers(4))
        if axes < 2:
            direction[2] = -1.0
            return direction
        # 2 aside, 3 anywhere
        direction[:axes] = self._rng.standard_normal(axes)
        return direction / np.abs(direction).max()


class Reach(NamedTuple):
    """The place that a hand reaches for, and where it began."""

    first_position: Vector  # (3,) of the hand [m]
    first_orientation: Vector  # (3, 3)
    position: Vector  # (3,) to reach [m]
    orientation: Vector  # (3, 3) to reach
    grip: float  # command of the grip
    steps_left: int  # until it gives up


class ReachingPolicy(StatefulPolicy):
    """A policy of one arm under OSC_POSE that reaches for one place after another."""

    def __init__(self, env: gym.Env[Any, Any], seed: int, speed: float = 1.0) -> None:
        self._read = ObservationReader(env)
        self._rng = np.random.default_rng([seed, 2])
        self._speed = PACE * speed  # [action units]

    def begin(self, observation: Any) -> Reach:
        hand = self._read.hand(observation)
        return self._next_reach(hand.position, hand.orientation)

    def act(
        self, observation: Any, state: Reach, deterministic: bool
    ) -> tuple[NDArray[np.float32], Reach]:
        """Return the next action (7,)."""
        hand = self._read.hand(observation)
        distance = np.linalg.norm(state.position - hand.position)
        if not state.steps_left or distance < ARRIVED:
            state = self._next_reach(state.first_position, state.first_orientation)
        motion = command_towards(hand, state.position, state.orientation, self._speed)
        action = np.append(motion, state.grip)
        return action.astype(np.float32), state._replace(steps_left=state.steps_left - 1)

    def _next_reach(self, first_position: Vector, first_orientation: Vector) -> Reach:
        position = first_position + self._rng.uniform(*AROUND)
        turn = TURNED * self._rng.uniform(-1.0, 1.0, 3)  # rotation vector [rad]
        return Reach(
            first_position=first_position,
            first_orientation=first_orientation,
            position=position,
            orientation=Rotation.from_rotvec(turn).as_matrix() @ first_orientation,
            grip=float(self._rng.choice([OPEN, CLOSE])),
            steps_left=GIVEN_UP,
        )


def record_motion(motion: TrainingMotion, config: RolloutConfig, folder: Path) -> Path:
    """Record a training motion in the environment of ``config``, and write it to its path in ``folder``."""
    config = replace(config, policy=partial(MotionPolicy, motion=motion))
    trial = motion.trial
    arm: Any = environment(trial.env_id, config.settings).unwrapped
    if motion.weight != 1.0 and movable(arm):
        mass = ObjectMass(factor=motion.weight, onset=0, seed=motion.seed)
        trial = replace(trial, faults=(mass,))
    episode = replace(
        record_stream(trial, config),
        faults=np.zeros(0, np.bool_),
        info={"skill": motion.task, MOTION_KEY: motion._asdict()},
    )
    return save_episode(folder / motion.path, episode)
