"""Motor babbling: a curriculum that teaches what a body does, not how one policy does a task.

    a_t = clip(e_t + s x_t),   x_t = ρ x_{t-1} + √(1 - ρ²) ξ_t      e the guide's action, 0 without one; ξ white

Each lesson is one episode. One in three is the expert's own, and sets the threshold. The others are led by the expert
at many speeds, by the expert under noise, or by noise alone (or a hand that reaches for one place after another); under
noise the arm also drifts now and then, as agents do once they have done their task. Some lessons more limit the speed
of the hand as a guard does, for a slowed arm feels otherwise; with reaching, some have the expert press what it holds.
The noise is weak enough that most of a lesson is free of impacts: those would teach the memory to expect them.

Sources: Laskey et al. 2017 (CoRL, DART) for noise on an expert's commands; Saegusa et al. 2009 (ROBIO) for babbling;
Rolf et al. 2010 (IEEE TAMD 2(3)) for goals in place of random commands.
"""

from __future__ import annotations

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
from asm_gym.policies.base import StatefulPolicy
from asm_gym.policies.scripted.base import CLOSE, OPEN, ObservationReader, Style
from asm_gym.policies.scripted.geometry import Vector, move
from asm_gym.rollouts.collect import environment, record_stream
from asm_gym.rollouts.pretraining.healthy import HELD_OUT, held_out
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_number

ALONE, LED, DRIVEN, REACHING = "noise", "expert", "disturbed", "reaching"
LEADING = (LED, DRIVEN, ALONE, LED, DRIVEN)  # what leads, lesson by lesson of a task
SMOOTHNESS = (0.0, 0.5, 0.9, 0.97)
"""ρ: from the noise by which agents explore to pushing on in one direction, as half-trained ones do."""
NOISE = 0.02, 0.2  # range of s, up to about the exploration of a half-trained agent [action units]
# speed of the expert, relative to its usual one; factor of an object's mass
SPEED, WEIGHT = (
    (0.5, 1.5),
    (0.7, 1.4),
)
PAUSE, PAUSED = 0.01, (5, 60)  # probability per step that the arm stops, and for how many steps
DRIFT, DRIFTED, DRIFTING = 0.015, (5, 60), (0.05, 1.0)
"""Probability per step of a disturbed lesson that the arm drifts, steps, and command [action units]."""
PRESS, PRESSED, PRESSING, HELD = 0.04, (8, 40), (0.1, 0.6), 10
"""Probability per step that an object gripped for ``HELD`` steps is pressed, steps, and command [action units]."""
CHANGED, LIMITS = 0.05, (0.05, 1.0)
"""Probability per step that the limit of a hand's speed changes, in a lesson that has one, and limits [m/s]."""
LOOSENED, LOOSE = 0.05, 0.05
"""Probability per step of a disturbed lesson that the grip's command changes, and its least share of the guide's."""

# range of places, relative to where the hand begins [m]
AROUND = (
    (-0.25, -0.4, -0.12),
    (0.25, 0.4, 0.25),
)
TURNED = 0.2, 0.2, 0.8  # greatest turn of the hand about the axes of the world [rad]
PACE = 0.45  # speed of the hand [action units]
# the hand goes on to the next place this near to one [m], or after so many steps
ARRIVED, GIVEN_UP = (
    0.02,
    60,
)


class Lesson(NamedTuple):
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
    limit: float = (
        0.0  # probability per step that the limit of the hand's speed changes; 0 for no limit
    )

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
) -> list[Lesson]:
    """Return ``episodes`` of each task; all follow from ``seed``, and fewer are the first of more.

    One lesson more for each three is at a limited speed. ``reaching``: the hand reaches for places where noise alone
    would lead, and one lesson more for each three presses.
    """
    check_number("episodes", episodes, low=1, whole=True)
    lessons, beside = [], range(0, episodes, HELD_OUT)
    leading = [REACHING if reaching and lead == ALONE else lead for lead in LEADING]
    for task in tasks:
        for number, drawn in enumerate(role_seeds(seed, task, "babble", episodes)):
            lessons.append(
                _lesson(
                    task, number, drawn, LED if held_out(number) else leading[number % len(leading)]
                )
            )
        for number, drawn in zip(beside, role_seeds(seed, task, "limit", len(beside)), strict=True):
            lessons.append(
                _lesson(task, number, drawn, leading[number % len(leading)])._replace(limit=CHANGED)
            )
    for task in tasks if reaching else ():
        for number, drawn in zip(beside, role_seeds(seed, task, "press", len(beside)), strict=True):
            driven = _lesson(task, number, drawn, DRIVEN)
            lessons.append(driven._replace(noise=NOISE[0], pause=0.0, drift=0.0, press=PRESS))
    return lessons


def _lesson(task: str, number: int, seed: int, lead: str) -> Lesson:
    rng = np.random.default_rng([seed, 3])
    return Lesson(
        task,
        number,
        seed,
        guide={ALONE: "", REACHING: REACHING}.get(lead, "scripted"),
        noise=0.0 if lead == LED else float(np.exp(rng.uniform(*np.log(NOISE)))),
        smoothness=float(rng.choice(SMOOTHNESS)),
        speed=float(rng.uniform(*SPEED)),
        pause=PAUSE * float(rng.random() < 0.5),
        weight=float(np.exp(rng.uniform(*np.log(WEIGHT)))) if rng.random() < 0.5 else 1.0,
        drift=DRIFT * (lead != LED),
    )


class Babbler(StatefulPolicy):
    """The policy of a lesson."""

    def __init__(self, env: gym.Env[Any, Any], lesson: Lesson) -> None:
        self._guide: Policy | None = None
        if lesson.guide == REACHING:
            self._guide = Reaching(env, lesson.seed, lesson.speed)
        elif lesson.guide:
            self._guide = make_policy(
                lesson.guide, env, seed=lesson.seed, style=Style(speed=lesson.speed)
            )
        self._arm: Any = env.unwrapped
        self._lesson, self._rng = lesson, np.random.default_rng([lesson.seed, 1])
        self._limits = np.random.default_rng([lesson.seed, 4])
        self._noise = self._rng.standard_normal(env.action_space.shape or ())
        self._grip = np.isin(
            np.arange(len(self._noise)), list(getattr(env.unwrapped, "gripper_actions", ()))
        )
        self._noisy_grip = bool(self._rng.random() < 0.5)
        self._left, self._course, self._grasp, self._held = 0, np.zeros_like(self._noise), 1.0, 0

    def begin(self, observation: Any) -> Any:
        if self._lesson.limit:
            self._limit_speed()
        return None

    def _limit_speed(self) -> None:
        speed = float(np.exp(self._limits.uniform(*np.log(LIMITS))))
        self._arm.contact_limits = ContactLimits(hand_speed=speed, stays=False)

    def act(
        self, observation: Any, state: Any, deterministic: bool
    ) -> tuple[NDArray[np.float32], Any]:
        """Return the next action (A,)."""
        lesson, rng = self._lesson, self._rng
        if self._limits.random() < lesson.limit:
            self._limit_speed()
        fresh = rng.standard_normal(self._noise.shape)
        self._noise = lesson.smoothness * self._noise + np.sqrt(1.0 - lesson.smoothness**2) * fresh
        action = lesson.noise * self._noise  # (A,)
        if self._guide is not None:
            guided, state = self._guide.predict(observation, state)
            # Without a guide's grip, however loose, the memory would never learn what holding feels like.
            if lesson.noise and rng.random() < LOOSENED:
                self._grasp = rng.uniform(LOOSE, 1.0)
            self._held = self._held + 1 if (guided[self._grip] > 0.0).any() else 0
            guided = np.where(self._grip, self._grasp, 1.0) * guided
            action = np.where(self._grip & (not self._noisy_grip), 0.0, action) + guided
        self._left = self._left - 1 if self._left else self._steps_astray()
        if self._left:  # it keeps its grip
            action = np.where(self._grip, action, self._course)
        return np.clip(action, -1.0, 1.0).astype(np.float32), state

    def _steps_astray(self) -> int:
        """Return for how many steps the arm stops, drifts or presses from now on; 0 where the guide leads on."""
        rng, lesson = self._rng, self._lesson
        if rng.random() < lesson.pause:
            self._course = np.zeros_like(self._noise)
            return int(rng.integers(*PAUSED))
        if rng.random() < lesson.drift:
            strength = np.exp(rng.uniform(*np.log(DRIFTING)))
            self._course = strength * rng.standard_normal(self._noise.shape)
            return int(rng.integers(*DRIFTED))
        if lesson.press and self._held > HELD and rng.random() < lesson.press:
            strength = np.exp(rng.uniform(*np.log(PRESSING)))
            self._course = strength * self._press_direction()
            return int(rng.integers(*PRESSED))
        return 0

    def _press_direction(self) -> NDArray[np.float64]:
        """Return (A,) a direction: down half of the time, else aside or anywhere; its largest entry is 1."""
        to, kind = np.zeros_like(self._noise), int(self._rng.integers(4))
        if kind < 2:
            to[2] = -1.0
        else:  # 2 aside, 3 anywhere
            to[:kind] = self._rng.standard_normal(kind)
            to /= np.abs(to).max()
        return to


class Aim(NamedTuple):
    """Where a hand began, and where it is going."""

    began: Vector  # (3,) [m]
    upright: Vector  # (3, 3) its orientation then
    place: Vector  # (3,) [m]
    turned: Vector  # (3, 3)
    grip: float  # as commanded
    left: int  # steps until it gives up


class Reaching(StatefulPolicy):
    """A policy of one arm under OSC_POSE that reaches for one place after another."""

    def __init__(self, env: gym.Env[Any, Any], seed: int, speed: float = 1.0) -> None:
        self._read, self._rng, self._speed = (
            ObservationReader(env),
            np.random.default_rng([seed, 2]),
            PACE * speed,
        )

    def begin(self, observation: Any) -> Aim:
        hand = self._read.hand(observation)
        return self._next(hand.at, hand.turned)

    def act(
        self, observation: Any, state: Aim, deterministic: bool
    ) -> tuple[NDArray[np.float32], Aim]:
        """Return the next action (7,)."""
        hand = self._read.hand(observation)
        if not state.left or np.linalg.norm(state.place - hand.at) < ARRIVED:
            state = self._next(state.began, state.upright)
        action = move(hand, state.place, state.turned, self._speed)
        return np.append(action, state.grip).astype(np.float32), state._replace(left=state.left - 1)

    def _next(self, began: Vector, upright: Vector) -> Aim:
        place = began + self._rng.uniform(*AROUND)
        turn = Rotation.from_rotvec(self._rng.uniform(-1.0, 1.0, 3) * TURNED).as_matrix()
        return Aim(
            began, upright, place, turn @ upright, float(self._rng.choice([OPEN, CLOSE])), GIVEN_UP
        )


def record_lesson(lesson: Lesson, config: RolloutConfig, folder: Path) -> Path:
    """Record the episode of a lesson in the environment of ``config``, and write it to its place under ``folder``."""
    trial, config = lesson.trial, replace(config, policy=partial(Babbler, lesson=lesson))
    base: Any = environment(trial.env_id, config.settings).unwrapped
    if lesson.weight != 1.0 and movable(base):
        trial = replace(
            trial, faults=(ObjectMass(factor=lesson.weight, onset=0, seed=lesson.seed),)
        )
    about = {"skill": lesson.task, "lesson": lesson._asdict()}
    return save_episode(
        folder / lesson.path,
        replace(record_stream(trial, config), faults=np.zeros(0, np.bool_), info=about),
    )
