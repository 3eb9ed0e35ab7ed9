"""Recordings by role: fit monitors on nominal ones, and score all others."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from asm_gym.data.crashes import crashes
from asm_gym.data.episode import Episode, load_episode
from asm_gym.detection.conformal import EPISODE, HOUR, conformal_episodes
from asm_gym.evaluation.comparison import BenchmarkResult, detectability_of
from asm_gym.evaluation.defaults import PER_HOUR, RATES
from asm_gym.evaluation.metrics import DetectionMetrics
from asm_gym.evaluation.resampling import Calibration
from asm_gym.evaluation.scored_episode import NOMINAL, InterventionOutcome, ScoredEpisode, onset_row
from asm_gym.monitors import EVIDENCE, CalibratedMonitor, make_monitor, monitor_class
from asm_gym.monitors.calibration import AlarmRate
from asm_gym.version import __version__

NOMINAL_ROLES = ("fit", "calibration", "nominal")  # roles of episodes without a fault

CODE = ("memory", "detection", "monitors", "scaling.py", "spec.py")
"""Rooms and files of the package whose code decides what a monitor learns."""

AT_ONCE = 256  # episodes scored together: the attribution of more would fill the memory

Map = Callable[[Callable[[Any], Any], Sequence[Any]], list[Any]]
"""``[task(item) for item in items]``, by whichever workers."""


class Recordings(NamedTuple):
    """The recordings of a run."""

    # without failed nominal episodes, and without scenes in which the robot crashes
    roles: dict[str, list[Episode]]
    left_out: tuple[int, int]  # numbers of nominal episodes that failed, and of scenes with a crash
    # all of the role nominal: a faulty episode equals its twin until the onset
    twins: list[Episode]

    @classmethod
    def of(cls, recordings: Sequence[Episode]) -> Recordings:
        """Sort by role. Raises ValueError where there is nothing normal to learn from or to test on."""
        healthy = [r for r in recordings if r.labelled.role in NOMINAL_ROLES and r.success]
        reference = [r.labelled.role != "nominal" for r in healthy]
        found = crashes(healthy, [r.labelled.task for r in healthy], reference)
        crashed = {(healthy[n].labelled.task, healthy[n].labelled.seed) for n in found}
        roles: dict[str, list[Episode]] = {}
        failed = 0
        for recording in recordings:
            label = recording.labelled
            # An alarm in a failed episode would be no false one.
            if label.role in NOMINAL_ROLES and not recording.success:
                failed += 1
            elif (label.task, label.seed) not in crashed:
                roles.setdefault(label.role, []).append(recording)
        for role in NOMINAL_ROLES:
            if not roles.get(role):
                raise ValueError(
                    f"none of the {role} episodes succeeded without a crash: "
                    "there is nothing normal to learn or to test on"
                )
        return cls(
            roles, (failed, len(crashed)), [r for r in recordings if r.labelled.role == "nominal"]
        )


@lru_cache(maxsize=1)
def read(paths: tuple[Path, ...]) -> Recordings:
    """Load these files by role; the last ones are cached for the next monitor."""
    return Recordings.of([load_episode(path) for path in paths])


def benchmark(
    folder: Path,
    files: Sequence[Path],
    monitors: Sequence[str],
    rate: float,
    window_s: float,
    seed: int,
    each: Map,
) -> BenchmarkResult:
    """Learn from the episodes for fit and calibration, and score all others with every monitor.

    ``folder`` keeps the fitted monitors; ``each`` maps a function over items, as ``parallel_map`` does.
    """
    paths = tuple(file.resolve() for file in files)
    models: dict[str, list[str]] = {}  # one that is judged in two ways is fitted once
    for name in monitors:
        models.setdefault(name.removesuffix(EVIDENCE), []).append(name)
    folder = folder.resolve()

    def score(names: Sequence[str]) -> dict[str, DetectionMetrics]:
        roles = read(paths).roles
        return {
            name: judged(name, fitted(folder, name, roles["fit"], seed), roles, rate, window_s)
            for name in names
        }

    found = {
        name: result
        for results in each(score, list(models.values()))
        for name, result in results.items()
    }
    by_role, left_out, twins = read(paths)
    seen = detectability_of(twins, by_role.get("faulty", []), window_s)
    return BenchmarkResult({name: found[name] for name in monitors}, seen, rate, window_s, left_out)


def judged(
    name: str,
    monitor: CalibratedMonitor,
    by_role: Mapping[str, Sequence[Episode]],
    rate: float,
    window_s: float,
) -> DetectionMetrics:
    """Calibrate a fitted monitor, and score all other episodes."""
    monitor.calibrate(by_role["calibration"], rate)
    fresh = 0 if monitor.maxima_ is None else len(monitor.maxima_)
    rates = sorted({rate, *(r for r in RATES if fresh >= conformal_episodes(r))})
    hours = 0.0 if monitor.blocks_ is None else monitor.blocks_.total
    promises = [AlarmRate(r, EPISODE) for r in rates] + [
        AlarmRate(r, HOUR) for r in PER_HOUR if r * hours >= 1.0
    ]
    calibration = Calibration(
        {promise: monitor.threshold_at(**promise.named) for promise in promises},
        np.zeros(0) if monitor.maxima_ is None else monitor.maxima_,
        monitor.blocks_,
    )
    threshold = calibration.thresholds[AlarmRate(rate, EPISODE)]
    nominal, faulty = (
        traces_of(name, monitor, by_role.get(role, []), threshold) for role in ("nominal", "faulty")
    )
    return DetectionMetrics(name, faulty, nominal, window_s, calibration)


@cache
def code_digest() -> str:
    """Return a digest of the code that decides what a monitor learns."""
    package, made = Path(__file__).parents[1], hashlib.sha256()
    for place in (package / name for name in CODE):
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            made.update(path.relative_to(package).as_posix().encode() + path.read_bytes())
    return made.hexdigest()[:8]


def fitted(folder: Path, name: str, recordings: Sequence[Episode], seed: int) -> CalibratedMonitor:
    """Return the monitor fitted on these episodes; kept in the folder by episodes, settings and code."""
    model = name.removesuffix(EVIDENCE)
    made = make_monitor(name, recordings[0].spec, seed=seed)
    learned = (
        model,
        __version__,
        made.get_params(),
        sorted(str(r.labelled.path) for r in recordings),
    )
    digest = hashlib.sha256(json.dumps(learned, default=str).encode()).hexdigest()[:12]
    path = folder / "monitors" / f"{model}-{digest}-{code_digest()}.asm"
    with suppress(FileNotFoundError, ValueError):  # a damaged one is fitted anew
        return monitor_class(name).load(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    monitor = made.fit(recordings)
    monitor.save(path)
    return monitor


def traces_of(
    name: str, monitor: CalibratedMonitor, episodes: Sequence[Episode], threshold: float
) -> list[ScoredEpisode]:
    """Score recordings, judged at this threshold."""
    made = []
    for first in range(0, len(episodes), AT_ONCE):
        some = episodes[first : first + AT_ONCE]
        for episode, surprise in zip(some, monitor.score_episodes(some), strict=True):
            label = episode.labelled
            trace = ScoredEpisode(
                kind=label.kind or NOMINAL,
                seed=label.seed,
                dt=episode.spec.dt,
                threshold=threshold,
                surprise=surprise.value,
                onset=onset_row(episode),
                severity=label.severity,
                task=label.task,
                monitor=name,
                affected_channels=label.affected_channels,
                outcome=InterventionOutcome(
                    episode.success, contact_force=float(np.max(episode.contact_force, initial=0.0))
                ),
                excused=surprise.excused_by_event,
            )
            made.append(trace.attributed(surprise.attribution, episode.spec.labels))
    return made
