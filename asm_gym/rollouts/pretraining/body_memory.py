"""A memory of a body, learned from the healthy parts of babbling."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from asm_gym.data.crashes import CRASH, peak_force, peak_torques
from asm_gym.data.episode import Episode
from asm_gym.detection.conformal import HOUR
from asm_gym.detection.contact_limits import healthy_forces
from asm_gym.detection.hand_speed_map import HandSpeedMap
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.calibration import AlarmRate
from asm_gym.monitors.monitor_protocol import Progress
from asm_gym.readings import spans
from asm_gym.spec import StreamSpec

MOTION_KEY = "lesson"  # under which a recording's ``info`` has its training motion
HELD_OUT = 3  # one in so many motions of a task sets the threshold, and is not learned from
LEARNED_UP_TO = CRASH
"""Learned: up to so many times what an undisturbed expert usually feels at most."""
DISTURBED_UP_TO = 1.0
"""The same in a disturbed motion, where contact is an accident: a memory that knows it detects no push."""
AROUND_S = 0.2  # left out before and after a hit [s]
SHORTEST = 20  # least steps of a stretch that is learned from
PASSES = 4  # of the temporal network over the motions
HIDDEN = 32  # its units: few, as its context would mislead under an unknown policy


class Gentle(NamedTuple):
    """Limits of harmless contact."""

    force: float  # external, on an arm as a whole [N]
    # External, on a joint [N m]; shows what cancels in the force, such as an arm that hits itself.
    torque: float

    def times(self, factor: float) -> Gentle:
        """Return limits so many times as high."""
        return Gentle(force=factor * self.force, torque=factor * self.torque)


# learned in any case: an arm whose experts touch little meets contact all the same
KNOWN = Gentle(force=30.0, torque=15.0)


def held_out(number: int) -> bool:
    """Return whether the motion of this number is for the threshold."""
    return number % HELD_OUT == HELD_OUT - 1


class HealthyMotions(NamedTuple):
    """Healthy recordings of training motions."""

    fit: list[Episode]  # to learn from
    # held-out motions in which the expert alone solved its task, without crashes
    calibration: list[Episode]
    whole: list[Episode]  # the same with crashes


def healthy(recordings: Sequence[Episode]) -> HealthyMotions:
    """Select the parts of recordings that press no harder than is usual, measured by the undisturbed expert.

    Raises:
        ValueError: a task has no undisturbed solved motion to measure by, or too little is left.
    """
    usual = usual_contact(recordings)
    motions = HealthyMotions(fit=[], calibration=[], whole=[])
    for episode in recordings:
        motion = episode.info[MOTION_KEY]
        contact = usual[episode.labelled.task]
        if not held_out(motion["number"]):
            limit = contact.times(LEARNED_UP_TO)
            if motion["noise"]:
                limit = contact.times(DISTURBED_UP_TO)
            limit = Gentle(max(limit.force, KNOWN.force), max(limit.torque, KNOWN.torque))
            motions.fit.extend(gentle_pieces(episode, limit))
        elif _undisturbed(episode):
            motions.whole.append(episode)
            motions.calibration.extend(gentle_pieces(episode, contact.times(LEARNED_UP_TO)))
    if not all(motions):
        raise ValueError(
            f"{len(recordings)} training motions leave too little that is healthy: record more"
        )
    return motions


def usual_contact(recordings: Sequence[Episode]) -> dict[str, Gentle]:
    """Return the median of the strongest contacts of the undisturbed expert, by task."""
    peaks: defaultdict[str, list[Gentle]] = defaultdict(list)
    for episode in filter(_undisturbed, recordings):
        peak = Gentle(peak_force(episode), float(peak_torques(episode).max()))
        peaks[episode.labelled.task].append(peak)
    missing = {episode.labelled.task for episode in recordings} - set(peaks)
    if missing:
        raise ValueError(
            f"no undisturbed motion of {', '.join(sorted(missing))} was solved by the expert, "
            "to say what is usual"
        )
    usual = {}
    for task, own in peaks.items():
        force, torque = np.median(own, axis=0).tolist()
        usual[task] = Gentle(force, torque)
    return usual


def _undisturbed(episode: Episode) -> bool:
    return bool(episode.success and episode.info[MOTION_KEY]["noise"] == 0.0)


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
    forces = [float(np.nanmax(e.contact_force)) for e in episodes if len(e.contact_force)]
    force = np.inf
    if forces:
        force = float(np.median(forces))
    limit = Gentle(force, torque).times(LEARNED_UP_TO)
    return [piece for episode in episodes for piece in gentle_pieces(episode, limit)]


def gentle_pieces(episode: Episode, limit: Gentle) -> list[Episode]:
    """Return the stretches of an episode in which nothing presses harder and no number is missing.

    Those of at least ``SHORTEST`` steps.
    """
    forces = episode.contact_force
    if not len(forces):
        forces = np.zeros(len(episode), np.float32)
    rows = len(episode) // len(forces)  # of the stream, in a step
    torques = peak_torques(episode).reshape(-1, rows).max(axis=1)
    whole = np.isfinite(episode.stream).all(axis=1).reshape(-1, rows).all(axis=1)
    hit = ~((forces <= limit.force) & (torques <= limit.torque) & whole)
    around = round(AROUND_S / (rows * episode.spec.dt))
    near = np.convolve(hit, np.ones(2 * around + 1), "same") > 0.5
    pieces = []
    for start, stop in spans(~near):
        if stop - start < SHORTEST:
            continue
        piece = Episode(
            stream=episode.stream[rows * start : rows * stop],
            spec=episode.spec,
            success=episode.success,
            seed=episode.seed,
            contact_force=forces[start:stop],
            label=episode.label,
            info=episode.info,
        )
        pieces.append(piece)
    return pieces


def learn_body(
    motions: HealthyMotions, spec: StreamSpec, seed: int, progress: Progress
) -> NeuralASM:
    """Return a memory fitted on healthy motions, without a threshold."""
    memory = NeuralASM(
        spec, hidden_size=HIDDEN, epochs=PASSES, habituates=False, excuses=True, seed=seed
    )
    return memory.fit(motions.fit, progress).rounded()


def calibrate_body(
    memory: NeuralASM, motions: HealthyMotions, hours: Sequence[Episode], per_hour: float
) -> NeuralASM:
    """Set ceilings and threshold for so many false alarms per hour of healthy episodes, crashes included.

    By the hours of each task, where all have the hours that it takes. The forces of healthy motion are those without
    crashes, and its pace is that of the hours, as experts in training motions go faster than usual.
    """
    whole = [*motions.whole, *hours]
    promise = AlarmRate(per_hour, HOUR)
    by_task: defaultdict[str, list[Episode]] = defaultdict(list)
    for episode in whole:
        by_task[episode.labelled.task].append(episode)
    tasks = []
    if all(map(promise.possible, by_task.values())):
        tasks = [episode.labelled.task for episode in whole]
    memory.calibrate(whole, false_alarms_per_hour=per_hour, each=tasks)
    streams = [episode.stream for episode in motions.calibration]
    memory.healthy_ = healthy_forces(streams, memory.spec)
    memory.pace_ = HandSpeedMap.by_task(hours or motions.calibration, memory.spec)
    return memory
