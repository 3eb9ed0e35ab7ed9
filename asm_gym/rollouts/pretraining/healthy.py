"""A memory of a body, learned from the healthy parts of babbling."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from asm_gym.data.crashes import CRASH, peak_force, peak_torques
from asm_gym.data.episode import Episode, spans
from asm_gym.detection.conformal import HOUR
from asm_gym.detection.contact_limits import healthy_forces
from asm_gym.detection.hand_speed_map import HandSpeedMap
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.calibration import AlarmRate
from asm_gym.monitors.surprise import Progress
from asm_gym.spec import StreamSpec

HELD_OUT = 3  # one in so many lessons of a task sets the threshold, and is not learned from
LEARNED_UP_TO, DISTURBED_UP_TO = CRASH, 1.0
"""Learned: up to so many times what an undisturbed expert usually feels at most, in an undisturbed and a disturbed
lesson. In the latter contact is an accident: a memory that knows it detects no push."""
AROUND_S = 0.2  # left out before and after a hit [s]
SHORTEST = 20  # least steps of a stretch that is learned from
PASSES, HIDDEN = 4, 32
"""Passes of the temporal network over the lessons, and its units: few, as its context would mislead under an unknown
policy."""


class Gentle(NamedTuple):
    """Limits of harmless contact."""

    force: float  # external, on an arm as a whole [N]
    torque: float  # external, on a joint [N m]; it shows what cancels in the force, such as an arm that hits itself


# learned in any case: an arm whose experts touch little meets contact all the same
KNOWN = Gentle(30.0, 15.0)


def held_out(number: int) -> bool:
    """Return whether the lesson of this number is for the threshold."""
    return number % HELD_OUT == HELD_OUT - 1


class Lessons(NamedTuple):
    """Healthy recordings of babbling."""

    fit: list[Episode]  # to learn from
    # held-out lessons in which the expert alone solved its task, without crashes
    calibration: list[Episode]
    whole: list[Episode]  # the same with crashes


def healthy(recordings: Sequence[Episode]) -> Lessons:
    """Select the parts of recordings that press no harder than is usual, measured by the undisturbed expert.

    Raises:
        ValueError: a task has no undisturbed solved lesson to measure by, or too little is left.
    """
    peaks: defaultdict[str, list[tuple[float, float]]] = defaultdict(list)
    for episode in recordings:
        if _undisturbed(episode):
            peaks[episode.labelled.task].append(
                (peak_force(episode), float(peak_torques(episode).max()))
            )
    missing = {e.labelled.task for e in recordings} - set(peaks)
    if missing:
        raise ValueError(
            f"no undisturbed lesson of {', '.join(sorted(missing))} was solved by the expert, to say what is usual"
        )
    found = Lessons([], [], [])
    for episode in recordings:
        usual = np.median(peaks[episode.labelled.task], axis=0)
        if not held_out(episode.info["lesson"]["number"]):
            share = DISTURBED_UP_TO if episode.info["lesson"]["noise"] else LEARNED_UP_TO
            found.fit.extend(gentle_pieces(episode, Gentle(*np.maximum(share * usual, KNOWN))))
        elif _undisturbed(episode):
            found.whole.append(episode)
            found.calibration.extend(gentle_pieces(episode, Gentle(*(LEARNED_UP_TO * usual))))
    if not all(found):
        raise ValueError(f"{len(recordings)} lessons leave too little that is healthy: record more")
    return found


def _undisturbed(episode: Episode) -> bool:
    return bool(episode.success and episode.info["lesson"]["noise"] == 0.0)


def harmless(episodes: Sequence[Episode]) -> list[Episode]:
    """Return the parts of episodes in which contact forces stay below twice their usual maximum.

    Agents sometimes collide in episodes that they solve. A memory fitted on those would treat a collision as normal,
    and a threshold set on them would be too high.

    Args:
        episodes: of one task, at least half of them without a collision; joint torques replace missing contact forces.

    Example:
        >>> import numpy as np
        >>> from asm_gym import Channel, Episode, StreamSpec, harmless
        >>> spec = StreamSpec((Channel("external_torque_peak", 1, "N m"),), dt=0.05)
        >>> healthy, crash = np.ones((100, 1)), np.ones((100, 1))
        >>> crash[50:] = 30.0
        >>> [len(e) for e in harmless([Episode.from_stream(x, spec) for x in (healthy, healthy, crash)])]
        [100, 100, 46]
    """
    torque = float(np.median([peak_torques(episode).max() for episode in episodes]))
    known = [float(np.nanmax(e.contact_force)) for e in episodes if len(e.contact_force)]
    force = float(np.median(known)) if known else np.inf
    limit = Gentle(LEARNED_UP_TO * force, LEARNED_UP_TO * torque)
    return [piece for episode in episodes for piece in gentle_pieces(episode, limit)]


def gentle_pieces(episode: Episode, limit: Gentle) -> list[Episode]:
    """Return the stretches of an episode in which nothing presses harder, those of at least ``SHORTEST`` steps."""
    forces = (
        episode.contact_force if len(episode.contact_force) else np.zeros(len(episode), np.float32)
    )
    rows = len(episode) // len(forces)  # of the stream, in a step
    torques = peak_torques(episode).reshape(-1, rows).max(axis=1)
    hit = ~((forces <= limit.force) & (torques <= limit.torque))
    around = round(AROUND_S / (rows * episode.spec.dt))
    near = np.convolve(hit, np.ones(2 * around + 1), "same") > 0.5
    about = {name: getattr(episode, name) for name in ("spec", "success", "seed", "label", "info")}
    return [
        Episode(episode.stream[rows * a : rows * b], contact_force=forces[a:b], **about)
        for a, b in spans(~near)
        if b - a >= SHORTEST
    ]


def learn_body(lessons: Lessons, spec: StreamSpec, seed: int, progress: Progress) -> NeuralASM:
    """Return a memory fitted on healthy lessons, without a threshold."""
    memory = NeuralASM(
        spec, hidden_size=HIDDEN, epochs=PASSES, habituates=False, excuses=True, seed=seed
    )
    return memory.fit(lessons.fit, progress).rounded()


def calibrate_body(
    memory: NeuralASM, lessons: Lessons, hours: Sequence[Episode], per_hour: float
) -> NeuralASM:
    """Set ceilings and threshold for so many false alarms per hour of healthy episodes, crashes included.

    By the hours of each task, where all have the hours that it takes. The forces of healthy motion are those without
    crashes, and its pace is that of the hours, as experts in lessons go faster than usual.
    """
    whole, asked = [*lessons.whole, *hours], AlarmRate(per_hour, HOUR)
    by_task: defaultdict[str, list[Episode]] = defaultdict(list)
    for episode in whole:
        by_task[episode.labelled.task].append(episode)
    tasks = (
        [episode.labelled.task for episode in whole]
        if all(map(asked.possible, by_task.values()))
        else []
    )
    memory.calibrate(whole, false_alarms_per_hour=per_hour, each=tasks)
    memory.healthy_ = healthy_forces(
        [episode.stream for episode in lessons.calibration], memory.spec
    )
    memory.pace_ = HandSpeedMap.by_task(hours or lessons.calibration, memory.spec)
    return memory
