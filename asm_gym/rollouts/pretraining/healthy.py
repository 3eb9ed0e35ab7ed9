"""A memory of a body, learned from what is healthy of babbling."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from asm_gym.contact_limits import healthy_forces
from asm_gym.crashes import CRASH, peak_torques
from asm_gym.detection.tails import FEWEST_EPISODES
from asm_gym.episode import Episode
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.base import Progress
from asm_gym.rollouts.training.exploration import SHORTEST, Gentle
from asm_gym.spec import StreamSpec

EXPERT = "scripted"
"""The guide that says what is usual."""
HELD_OUT = 3
"""One in so many lessons of a task is not learned from: the threshold is set on those."""
LEARNED_UP_TO, DISTURBED_UP_TO = CRASH, 1.0
"""How many times what an undisturbed expert usually feels at most may be felt in what is learned from, of a guide's own
course and of a disturbed one. In the latter contact is an accident: a memory that knows it feels no push."""
KNOWN = Gentle(30.0, 15.0)
"""[N], [N m] What is learned whatever is usual: an arm whose experts touch little meets contact all the same."""
FOR_CEILINGS = 10
"""One in so many healthy episodes of a task tells how far each sense goes at its worst, where that makes enough."""
AROUND_S = 0.2
"""What is left out before and after a hit [s]."""
PASSES, HIDDEN = 4, 32
"""Of the temporal network over the lessons, and its units: no surprise comes from it."""


def held_out(number: int) -> bool:
    """Whether the lesson of this number is for the threshold."""
    return number % HELD_OUT == HELD_OUT - 1


class Lessons(NamedTuple):
    """Recordings of babbling, as far as they are healthy.

    Attributes:
        fit: to learn from.
        calibration: of lessons that are not learned from, those that are as healthy as a policy that does its task: the
            guide's own course, and solved.
        whole: the same, with what presses harder than is usual.
    """

    fit: list[Episode]
    calibration: list[Episode]
    whole: list[Episode]


def healthy(recordings: Sequence[Episode]) -> Lessons:
    """What of each recording presses no harder than is usual, as told by the expert where nothing disturbs it.

    Noise drives arms into tables and joints into their stops, and so do agents that are half trained. That is no fault
    of the body, but a memory that takes it for usual would be blind to every collision. So learning goes up to twice
    what the expert usually feels at most in that task, and up to once that where a guide was disturbed; but to
    ``KNOWN`` in any case. The threshold is set on what stays below twice that: beyond is a crash.

    Raises:
        ValueError: a task has no undisturbed lesson that was solved, to measure by, or too little is left.
    """
    felt: defaultdict[str, list[tuple[float, float]]] = defaultdict(list)
    for episode in recordings:
        if _undisturbed(episode) and _lesson(episode)["guide"] == EXPERT:
            most = float(np.nanmax(episode.contact_force)), float(peak_torques(episode).max())
            felt[episode.labelled.task].append(most)
    missing = {e.labelled.task for e in recordings} - set(felt)
    if missing:
        raise ValueError(
            f"no undisturbed lesson of {', '.join(sorted(missing))} was solved by the expert, to say what is usual"
        )
    found = Lessons([], [], [])
    for episode in recordings:
        usual = np.median(felt[episode.labelled.task], axis=0)
        if not held_out(_lesson(episode)["number"]):
            share = DISTURBED_UP_TO if _lesson(episode)["noise"] else LEARNED_UP_TO
            found.fit.extend(gentle_pieces(episode, Gentle(*np.maximum(share * usual, KNOWN))))
        elif _undisturbed(episode):
            found.whole.append(episode)
            found.calibration.extend(gentle_pieces(episode, Gentle(*(LEARNED_UP_TO * usual))))
    if not all(found):
        raise ValueError(f"{len(recordings)} lessons leave too little that is healthy: record more")
    return found


def harmless(episodes: Sequence[Episode]) -> list[Episode]:
    """The stretches of a policy's own episodes in which nothing presses twice as hard as it usually does at most.

    Agents crash now and then in episodes that they solve. A memory that is specialised on those would take a crash for
    usual, and a threshold that is set on them would be a crash's. What it promises then holds for harmless episodes.

    Args:
        episodes: of one task, at least half of them harmless; where no contact force is known, joints alone tell.

    Example:
        >>> import numpy as np
        >>> from asm_gym import Channel, Episode, StreamSpec, harmless
        >>> spec = StreamSpec((Channel("external_torque_peak", 1, "N m"),), dt=0.05)
        >>> calm, crash = np.ones((100, 1)), np.ones((100, 1))
        >>> crash[50:] = 30.0
        >>> [len(e) for e in harmless([Episode.from_stream(x, spec) for x in (calm, calm, crash)])]
        [100, 100, 46]
    """
    torque = float(np.median([peak_torques(episode).max() for episode in episodes]))
    known = [float(np.nanmax(e.contact_force)) for e in episodes if len(e.contact_force)]
    force = float(np.median(known)) if known else np.inf
    limit = Gentle(LEARNED_UP_TO * force, LEARNED_UP_TO * torque)
    return [piece for episode in episodes for piece in gentle_pieces(episode, limit)]


def gentle_pieces(episode: Episode, limit: Gentle) -> list[Episode]:
    """The stretches of a stream in which nothing presses harder, those that are long enough to learn from."""
    forces = episode.contact_force if len(episode.contact_force) else np.zeros(len(episode), np.float32)
    rows = len(episode) // len(forces)  # of the stream, in a step
    torques = peak_torques(episode).reshape(-1, rows).max(axis=1)
    hit = ~((forces <= limit.force) & (torques <= limit.torque))
    around = round(AROUND_S / (rows * episode.spec.dt))
    near = np.convolve(hit, np.ones(2 * around + 1), "same") > 0.5
    edges = np.flatnonzero(np.diff(np.concatenate([[True], near, [True]]).astype(int)))
    about = {name: getattr(episode, name) for name in ("spec", "success", "seed", "label", "info")}
    return [
        Episode(episode.stream[rows * a : rows * b], contact_force=forces[a:b], **about)
        for a, b in zip(edges[::2], edges[1::2], strict=True)
        if b - a >= SHORTEST
    ]


def _undisturbed(episode: Episode) -> bool:
    """Whether a guide did its task in its own way."""
    return episode.success and _lesson(episode)["noise"] == 0.0


def _lesson(episode: Episode) -> dict[str, Any]:
    lesson: dict[str, Any] = episode.info["lesson"]
    return lesson


def learn_body(lessons: Lessons, spec: StreamSpec, seed: int, progress: Progress) -> NeuralASM:
    """The memory, without a threshold.

    Nothing is measured against a context, which a policy that was never met would lead astray; so the temporal network,
    which makes it, is small and learned for a few passes alone.

    Args:
        spec: of the stream, as the body has it today.
    """
    memory = NeuralASM(spec, hidden_size=HIDDEN, epochs=PASSES, habituates=False, excuses=True, seed=seed)
    return memory.fit(lessons.fit, progress).rounded()


def calibrate_body(memory: NeuralASM, lessons: Lessons, hours: Sequence[Episode], per_hour: float) -> NeuralASM:
    """Calibrated so that so many faults are said in an hour of healthy episodes, hits and all.

    In an hour of each task, where all have so many hours that it can be promised. Where there are episodes enough, one
    in ``FOR_CEILINGS`` of each task tells before how far each sense goes, and the threshold is set on the others.

    How hard healthy motion presses is told by what presses no harder than is usual: a limit that a hit has raised would
    be none.

    Args:
        hours: of healthy episodes beside the lessons that are left out.
    """
    whole, told = for_threshold([*lessons.whole, *hours])
    if told:
        memory.learn_ceilings(told)
    memory.calibrate(whole, false_alarms_per_hour=per_hour, each=apart(whole, per_hour))
    memory.healthy_ = healthy_forces([episode.stream for episode in lessons.calibration], memory.spec)
    return memory


def for_threshold(whole: Sequence[Episode]) -> tuple[list[Episode], list[Episode]]:
    """Those that set the threshold, and those that tell ceilings, none where these were too few."""
    number: defaultdict[str, int] = defaultdict(int)
    parts: tuple[list[Episode], list[Episode]] = [], []
    for episode in whole:
        number[episode.labelled.task] += 1
        parts[number[episode.labelled.task] % FOR_CEILINGS == 0].append(episode)
    return parts if len(parts[1]) >= FEWEST_EPISODES else (list(whole), [])


def apart(episodes: Sequence[Episode], per_hour: float) -> list[str]:
    """The task of each, where every one has the hours that this rate takes; none where one has not."""
    tasks = [episode.labelled.task for episode in episodes]
    hours: defaultdict[str, float] = defaultdict(float)
    for episode, task in zip(episodes, tasks, strict=True):
        hours[task] += len(episode) * episode.spec.dt / 3600
    return tasks if min(hours.values()) * per_hour >= 1.0 else []
