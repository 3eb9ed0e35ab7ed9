"""Fits every monitor on the nominal recordings, and asks each what it makes of all the others."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

import asm_gym
from asm_gym.detection import conformal_episodes
from asm_gym.episode import Episode, EpisodeLabel
from asm_gym.evaluation.comparison import BenchmarkResult, Detectability, MonitorResult
from asm_gym.evaluation.defaults import PER_HOUR, RATES
from asm_gym.evaluation.ideal import earliest, noise_floor, separation
from asm_gym.evaluation.metrics import typical
from asm_gym.evaluation.scored_episode import NOMINAL, InterventionOutcome, ScoredEpisode, TraceDetail, window_steps
from asm_gym.monitors import EVIDENCE, CalibratedMonitor, make_monitor, monitor_class
from asm_gym.monitors.registry import model_of
from asm_gym.rollouts.parallel import ParallelConfig, Progress, parallel_map
from asm_gym.rollouts.run_folder import NOMINAL_ROLES, Recordings, labelled, unread

EXAMPLES = ("push", "collision", "weak_joint", "frozen_encoder", "snatch")
"""Kinds of which the report shows an episode."""

NO_SETTINGS: Mapping[str, Mapping[str, Any]] = {}
"""Every monitor has its own hyperparameters."""


def benchmark(
    folder: Path,
    labels: Sequence[EpisodeLabel],
    monitors: Sequence[str],
    rate: float,
    window_s: float,
    seed: int,
    parallel: ParallelConfig,
    progress: Progress,
    settings: Mapping[str, Mapping[str, Any]] = NO_SETTINGS,
    recorded: Path | None = None,
) -> BenchmarkResult:
    """Reads the recordings, and lets every monitor judge them.

    Args:
        folder: of the run.
        labels: its episodes; those of roles fit and calibration are learned from, all others judged.
        rate: share of nominal episodes that may raise an alarm.
        window_s: how soon an alarm must come to count as detection [s].
        seed: of the monitors.
        parallel: who judges; each monitor is one task.
        settings: by the names of models, hyperparameters that are not their own.
        recorded: where the recordings are; in the folder of the run by default.
    """
    recorded = (recorded or folder).resolve()
    progress(0, len(monitors))
    # One that is judged in two ways is fitted once.
    models: dict[str, list[str]] = {}
    for name in monitors:
        models.setdefault(name.removesuffix(EVIDENCE), []).append(name)
    of = tuple(labels)
    ask = partial(
        _results, folder=folder.resolve(), recorded=recorded, labels=of, rate=rate, seed=seed, settings=settings
    )
    made = parallel_map(
        ask, list(models.values()), parallel, lambda k, n: progress(k * len(monitors) // n, len(monitors))
    )
    found = {name: result for results in made for name, result in results.items()}
    by_role, left_out, twins = read(recorded, of)
    return BenchmarkResult(
        {name: found[name] for name in monitors},
        detectability_of(twins, by_role.get("faulty", []), window_s),
        rate,
        window_s,
        left_out,
    )


@lru_cache(maxsize=1)
def read(recorded: Path, labels: tuple[EpisodeLabel, ...]) -> Recordings:
    """The recordings of a run; those asked for last are kept, for the next monitor."""
    return Recordings.of(labelled(recorded, labels))


def _results(
    names: Sequence[str],
    folder: Path,
    recorded: Path,
    labels: tuple[EpisodeLabel, ...],
    rate: float,
    seed: int,
    settings: Mapping[str, Mapping[str, Any]],
) -> dict[str, MonitorResult]:
    by_role = read(recorded, labels).roles
    with unread(recorded, "a monitor"):
        return {name: result_of(name, folder, by_role, rate, seed, settings.get(model_of(name))) for name in names}


def result_of(
    name: str,
    folder: Path,
    by_role: Mapping[str, Sequence[Episode]],
    rate: float,
    seed: int,
    settings: Mapping[str, Any] | None = None,
) -> MonitorResult:
    """What one monitor makes of the episodes.

    Args:
        folder: where fitted monitors are kept.
        by_role: fit, calibration and nominal episodes, and perhaps faulty and harmless ones.
        rate: share of nominal episodes that may raise an alarm.
        settings: hyperparameters that are not its own.
    """
    return judged(name, fitted(folder, name, by_role["fit"], seed, settings), by_role, rate)


def judged(
    name: str, monitor: CalibratedMonitor, by_role: Mapping[str, Sequence[Episode]], rate: float
) -> MonitorResult:
    """What a fitted monitor makes of the episodes, once it is calibrated."""
    monitor.calibrate(by_role["calibration"], rate)
    rates = sorted({rate, *(r for r in RATES if len(by_role["calibration"]) >= conformal_episodes(r))})
    thresholds = {r: monitor.threshold_at(r) for r in rates}
    hours = 0.0 if monitor.blocks_ is None else monitor.blocks_.total
    hourly = {r: monitor.threshold_at(false_alarms_per_hour=r) for r in PER_HOUR if r * hours >= 1.0}
    tested = [*by_role["nominal"], *by_role.get("faulty", [])]
    traces = traces_of(name, monitor, tested, thresholds[rate])
    return MonitorResult(
        traces,
        traces_of(name, monitor, by_role.get("harmless", []), thresholds[rate]),
        thresholds,
        _examples(monitor, traces, tested),
        np.zeros(0) if monitor.maxima_ is None else monitor.maxima_,
        hourly,
        monitor.blocks_,
        [episode.labelled.task for episode in by_role["calibration"]],
    )


LEARNING = ("memory", "detection", "monitors", "scaling.py", "spec.py")
"""What decides, in the package, over what a monitor learns."""


@cache
def code_digest(package: Path = Path(asm_gym.__file__).parent, names: Sequence[str] = LEARNING) -> str:
    """Of the code in these rooms and files of the package."""
    made = hashlib.sha256()
    for place in (package / name for name in names):
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            made.update(path.relative_to(package).as_posix().encode() + path.read_bytes())
    return made.hexdigest()[:8]


def fitted(
    folder: Path, name: str, recordings: Sequence[Episode], seed: int, settings: Mapping[str, Any] | None = None
) -> CalibratedMonitor:
    """The monitor fitted on these episodes; kept in the folder for the next time, by what it learned and by which code.

    ``settings`` are hyperparameters, where they are not its own. Warns where one is there that other code has learned,
    and fits anew.
    """
    spec = recordings[0].spec
    model = name.removesuffix(EVIDENCE)
    made = make_monitor(name, spec, seed=seed, **(settings or {}))
    learned = model, asm_gym.__version__, made.get_params(), sorted(str(r.labelled.path) for r in recordings)
    digest = hashlib.sha256(json.dumps(learned, default=str).encode()).hexdigest()[:12]
    path = folder / "monitors" / f"{model}-{digest}-{code_digest()}.asm"
    # One that cannot be read, for it is damaged, is made anew.
    with suppress(FileNotFoundError, ValueError):
        return monitor_class(name).load(path)
    if any(other != path for other in path.parent.glob(f"{model}-{digest}*.asm")):
        warnings.warn(f"{model} was fitted by other code than today's: it is fitted anew", stacklevel=2)
    monitor = made.fit(recordings)
    path.parent.mkdir(parents=True, exist_ok=True)
    monitor.save(path)
    return monitor


def calibrated(
    folder: Path,
    name: str,
    labels: Sequence[EpisodeLabel],
    seed: int,
    threshold: float,
    settings: Mapping[str, Any] | None = None,
) -> CalibratedMonitor:
    """The monitor as it judged the run, with the threshold it judged by."""
    nominal = Recordings.of(labelled(folder, [label for label in labels if label.role in NOMINAL_ROLES]))
    return fitted(folder, name, nominal.roles["fit"], seed, settings).with_threshold(threshold)


AT_ONCE = 256
"""Episodes scored together: what each number of all rows had a share of would fill the memory."""


def _scores(monitor: CalibratedMonitor, recordings: Sequence[Episode]) -> Iterator[Any]:
    for first in range(0, len(recordings), AT_ONCE):
        yield from monitor.score_episodes(recordings[first : first + AT_ONCE])


def onset_row(episode: Episode) -> int | None:
    """The row at which the fault of a faulty episode begins; its label counts control steps, of several rows each."""
    label = episode.labelled
    rows = len(episode) // (len(episode.contact_force) or len(episode))
    return label.onset * rows if label.role == "faulty" and label.onset is not None else None


def traces_of(
    name: str, monitor: CalibratedMonitor, episodes: Sequence[Episode], threshold: float
) -> list[ScoredEpisode]:
    """What a monitor made of recordings, judged at this threshold."""
    made = []
    for episode, surprise in zip(episodes, _scores(monitor, episodes), strict=True):
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
            outcome=InterventionOutcome(episode.success),
            excused=surprise.excused_by_event,
        )
        made.append(trace.attributed(surprise.attribution, episode.spec.labels))
    return made


def _examples(
    monitor: CalibratedMonitor, traces: Sequence[ScoredEpisode], episodes: Sequence[Episode]
) -> list[ScoredEpisode]:
    """Of each of a few kinds, at its strongest, the typical episode, with what is drawn of it."""
    twins = {(e.labelled.task, e.labelled.seed): e.stream for e in episodes if e.labelled.role == "nominal"}
    examples = []
    for kind in EXAMPLES:
        own = {t: e for t, e in zip(traces, episodes, strict=True) if t.kind == kind}
        if not own:
            continue
        strongest = list(own)[-1].severity
        chosen = typical([t for t in own if t.severity == strongest])
        episode = own[chosen]
        attribution = monitor.score(episode).attribution
        twin = twins.get((chosen.task, chosen.seed))
        detail = TraceDetail(attribution, episode.spec.labels, episode.faults, episode.stream, twin)
        examples.append(replace(chosen, detail=detail))
    return examples


def detectability_of(nominal: Sequence[Episode], faulty: Sequence[Episode], window_s: float) -> list[Detectability]:
    """What an ideal observer could see of the faulty episodes, whose nominal twins it knows."""
    twins = {(e.labelled.task, e.labelled.seed): e.stream for e in nominal}
    noises: dict[str, Any] = {}
    found = []
    for episode in faulty:
        label = episode.labelled
        if label.task not in noises:
            own = [e.stream for e in nominal if e.labelled.task == label.task]
            noises[label.task] = noise_floor(episode.spec.noise, own)
        summed = separation(episode.stream, twins[label.task, label.seed], noises[label.task], onset_row(episode) or 0)
        window = summed[: window_steps(window_s, episode.spec.dt)]
        seen = float(window[-1]) if len(window) else 0.0
        which = label.task, label.kind, label.severity, label.seed
        found.append(Detectability(*which, seen, earliest(window), episode.spec.dt))
    return found
