"""Hostile policies as a search finds them: programs of a few motions, drawn at random and changed a little."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.policies.policy import Policy, StatefulPolicy
from asm_gym.policies.registry import make_policy

NUMBERS = 6  # of a motion: along x, y and z, and about them
MOST_MOTIONS = 6
SHORTEST = 3  # motion [control steps]
LONGEST = 60  # motion [control steps]
LATEST = 100  # control step up to which the task's expert may act before
SCENES = 1000
GRIPS = (-1.0, 0.0, 1.0)
BEGINS_AT_ONCE = 0.5  # probability that no expert acts before

Rng = np.random.Generator


class Segment(NamedTuple):
    """One motion of a program."""

    steps: int  # for which it lasts [control steps]
    motion: tuple[float, ...]  # (NUMBERS,) of the action
    grip: float


class Program(NamedTuple):
    """What a hostile policy does in an episode."""

    scene: int  # seed of the environment
    expert_steps: int  # for which the task's expert acts first [control steps]
    waits: bool  # time stands still while the guard acts
    repeats: bool  # begins again after the last motion, which else goes on
    segments: tuple[Segment, ...]

    def at(self, step: int) -> Segment:
        """Return the motion at a control step since the expert left off."""
        period = sum(segment.steps for segment in self.segments)
        if self.repeats:
            step = step % period
        for segment in self.segments:
            if step < segment.steps:
                return segment
            step -= segment.steps
        return self.segments[-1]


def random_program(rng: Rng) -> Program:
    """Return a program at random."""
    expert_steps = 0
    if rng.random() > BEGINS_AT_ONCE:
        expert_steps = int(rng.integers(LATEST))
    count = int(rng.integers(1, MOST_MOTIONS))
    return Program(
        scene=int(rng.integers(SCENES)),
        expert_steps=expert_steps,
        waits=bool(rng.integers(2)),
        repeats=bool(rng.integers(2)),
        segments=tuple(_random_segment(rng) for _ in range(count)),
    )


def _random_segment(rng: Rng) -> Segment:
    """Return a motion along some of the axes, some of which are at their full speed."""
    motion = rng.uniform(-1.0, 1.0, NUMBERS)
    is_full = rng.random(NUMBERS) < 0.5
    is_still = rng.random(NUMBERS) < 0.5
    motion = np.where(is_full, np.sign(motion), motion)
    motion = np.where(is_still, 0.0, motion)
    return Segment(
        steps=int(rng.integers(SHORTEST, LONGEST)),
        motion=tuple(motion.tolist()),
        grip=float(rng.choice(GRIPS)),
    )


def changed_program(program: Program, rng: Rng) -> Program:
    """Return a program with one or two changes."""
    for _ in range(int(rng.integers(1, 3))):
        change = CHANGES[int(rng.integers(len(CHANGES)))]
        program = change(program, rng)
    return program


def _change_motion(program: Program, rng: Rng) -> Program:
    """Turn the direction of a motion a little."""

    def turned(segment: Segment) -> Segment:
        motion = np.array(segment.motion) + 0.3 * rng.standard_normal(NUMBERS)
        return segment._replace(motion=tuple(np.clip(motion, -1.0, 1.0).tolist()))

    return _with_one_changed(program, rng, turned)


def _change_steps(program: Program, rng: Rng) -> Program:
    """Make a motion shorter or longer."""

    def timed(segment: Segment) -> Segment:
        steps = segment.steps + round(8.0 * rng.standard_normal())
        return segment._replace(steps=min(max(steps, SHORTEST), LONGEST))

    return _with_one_changed(program, rng, timed)


def _change_segment(program: Program, rng: Rng) -> Program:
    """Replace a motion by another."""
    return _with_one_changed(program, rng, lambda segment: _random_segment(rng))


def _with_one_changed(program: Program, rng: Rng, change: Callable[[Segment], Segment]) -> Program:
    segments = list(program.segments)
    place = int(rng.integers(len(segments)))
    segments[place] = change(segments[place])
    return program._replace(segments=tuple(segments))


def _add_or_drop(program: Program, rng: Rng) -> Program:
    """Insert a motion, or drop one where there are several."""
    segments = list(program.segments)
    place = int(rng.integers(len(segments)))
    is_full = len(segments) == MOST_MOTIONS
    drops = len(segments) > 1 and rng.random() < 0.5
    if is_full or drops:
        del segments[place]
    else:
        segments.insert(place, _random_segment(rng))
    return program._replace(segments=tuple(segments))


def _change_begin(program: Program, rng: Rng) -> Program:
    """Begin at another time of the expert's episode, in this scene or another one."""
    steps = program.expert_steps + round(10.0 * rng.standard_normal())
    changed = program._replace(expert_steps=min(max(steps, 0), LATEST))
    if rng.random() < 0.3:
        return changed._replace(scene=int(rng.integers(SCENES)))
    return changed


def _change_manner(program: Program, rng: Rng) -> Program:
    """Wait for the hand-back or not, begin again or not."""
    if rng.random() < 0.5:
        return program._replace(waits=not program.waits)
    return program._replace(repeats=not program.repeats)


# Motions change most often.
CHANGES = (
    _change_motion,
    _change_motion,
    _change_steps,
    _change_steps,
    _change_segment,
    _add_or_drop,
    _change_begin,
    _change_manner,
)


class ProgramPolicy(StatefulPolicy):
    """Acts by a program, whatever it observes.

    Args:
        env: whose actions change the poses of hands; each hand makes the same motion.
        program: what it does.
    """

    def __init__(self, env: gym.Env[Any, Any], program: Program) -> None:
        space: Any = env.action_space
        inner: Any = env.unwrapped
        self._program = program
        self._low = space.low
        self._high = space.high
        self._grips = np.array(inner.gripper_actions, np.intp)
        self._moves = np.setdiff1d(np.arange(space.shape[0]), self._grips)
        self._expert: Policy | None = None
        if program.expert_steps > 0:
            self._expert = make_policy("scripted", env, seed=program.scene)
        self._steps = 0  # of the episode, whoever acts

    def begin(self, observation: Any) -> tuple[int, Any]:
        self._steps = 0
        return 0, None

    def act(
        self, observation: Any, state: tuple[int, Any], deterministic: bool
    ) -> tuple[NDArray[np.float32], tuple[int, Any]]:
        own_steps, expert_state = state
        step = self._steps
        if self._program.waits:
            step = own_steps
        self._steps += 1
        since = step - self._program.expert_steps
        if self._expert is not None and since < 0:
            begins = np.array([own_steps == 0])
            action, expert_state = self._expert.predict(
                observation, expert_state, begins, deterministic
            )
            return np.array(action, np.float32), (own_steps + 1, expert_state)

        segment = self._program.at(max(since, 0))
        action = np.zeros(len(self._low), np.float32)
        action[self._moves] = np.resize(segment.motion, len(self._moves))
        action[self._grips] = segment.grip
        return np.clip(action, self._low, self._high), (own_steps + 1, expert_state)
