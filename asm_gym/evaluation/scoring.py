"""Fit monitors on nominal recordings, and score all other recordings."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
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
from asm_gym.evaluation.recordings import read
from asm_gym.evaluation.resampling import Calibration
from asm_gym.evaluation.scored_episode import NOMINAL, InterventionOutcome, ScoredEpisode, TraceDetail, window_steps
from asm_gym.monitors import EVIDENCE, CalibratedMonitor, make_monitor, monitor_class

EXAMPLES = ("push", "collision", "weak_joint", "frozen_encoder", "snatch")
"""Kinds of which the report shows an episode."""

CODE = ("memory", "detection", "monitors", "scaling.py", "spec.py")
"""Rooms and files of the package whose code decides what a monitor learns."""

AT_ONCE = 256
"""Episodes scored together: the attribution of more would fill the memory."""

Map = Callable[[Callable[[Any], Any], Sequence[Any]], list[Any]]
"""``[task(item) for item in items]``, by whichever workers."""


def benchmark(
    folder: Path,
    labels: Sequence[EpisodeLabel],
    monitors: Sequence[str],
    rate: float,
    window_s: float,
    seed: int,
    each: Map,
    recorded: Path | None = None,
) -> BenchmarkResult:
    """Read the recordings, and score them with every monitor.

    Args:
        folder: of the run.
        labels: its episodes; fit and calibration episodes are learned from, all others scored.
        monitors: names.
        rate: share of nominal episodes that may raise an alarm.
        window_s: an alarm within this time of the onset is a detection [s].
        seed: of the monitors.
        each: maps a function over items, as ``parallel_map`` does.
        recorded: where the recordings are; in the folder of the run by default.
    """
    recorded, wanted = (recorded or folder).resolve(), tuple(labels)
    models: dict[str, list[str]] = {}  # one that is judged in two ways is fitted once
    for name in monitors:
        models.setdefault(name.removesuffix(EVIDENCE), []).append(name)
    score = partial(_results, folder=folder.resolve(), recorded=recorded, labels=wanted, rate=rate, seed=seed)
    found = {name: result for results in each(score, list(models.values())) for name, result in results.items()}
    by_role, left_out, twins = read(recorded, wanted)
    seen = detectability_of(twins, by_role.get("faulty", []), window_s)
    return BenchmarkResult({name: found[name] for name in monitors}, seen, rate, window_s, left_out)


def _results(
    names: Sequence[str],
    folder: Path,
    recorded: Path,
    labels: tuple[EpisodeLabel, ...],
    rate: float,
    seed: int,
) -> dict[str, MonitorResult]:
    roles = read(recorded, labels).roles
    return {name: judged(name, fitted(folder, name, roles["fit"], seed), roles, rate) for name in names}


def judged(
    name: str, monitor: CalibratedMonitor, by_role: Mapping[str, Sequence[Episode]], rate: float
) -> MonitorResult:
    """Calibrate a fitted monitor, and score the nominal, faulty and harmless episodes."""
    monitor.calibrate(by_role["calibration"], rate)
    rates = sorted({rate, *(r for r in RATES if len(by_role["calibration"]) >= conformal_episodes(r))})
    hours = 0.0 if monitor.blocks_ is None else monitor.blocks_.total
    calibration = Calibration(
        {r: monitor.threshold_at(r) for r in rates},
        {r: monitor.threshold_at(false_alarms_per_hour=r) for r in PER_HOUR if r * hours >= 1.0},
        np.zeros(0) if monitor.maxima_ is None else monitor.maxima_,
        monitor.blocks_,
    )
    tested = [*by_role["nominal"], *by_role.get("faulty", [])]
    traces = traces_of(name, monitor, tested, calibration.thresholds[rate])
    harmless = traces_of(name, monitor, by_role.get("harmless", []), calibration.thresholds[rate])
    return MonitorResult(traces, harmless, calibration, _examples(monitor, traces, tested))


@cache
def code_digest(package: Path = Path(asm_gym.__file__).parent, names: Sequence[str] = CODE) -> str:
    """Return a digest of the code in these rooms and files of the package."""
    made = hashlib.sha256()
    for place in (package / name for name in names):
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            made.update(path.relative_to(package).as_posix().encode() + path.read_bytes())
    return made.hexdigest()[:8]


def fitted(
    folder: Path, name: str, recordings: Sequence[Episode], seed: int, settings: Mapping[str, Any] | None = None
) -> CalibratedMonitor:
    """Return the monitor fitted on these episodes; kept in the folder by episodes, settings and code.

    Warns, and fits anew, where the folder has one that other code has fitted.
    """
    spec = recordings[0].spec
    model = name.removesuffix(EVIDENCE)
    made = make_monitor(name, spec, seed=seed, **(settings or {}))
    learned = model, asm_gym.__version__, made.get_params(), sorted(str(r.labelled.path) for r in recordings)
    digest = hashlib.sha256(json.dumps(learned, default=str).encode()).hexdigest()[:12]
    path = folder / "monitors" / f"{model}-{digest}-{code_digest()}.asm"
    with suppress(FileNotFoundError, ValueError):  # a damaged one is fitted anew
        return monitor_class(name).load(path)
    if any(other != path for other in path.parent.glob(f"{model}-{digest}*.asm")):
        warnings.warn(f"{model} was fitted by other code than today's: it is fitted anew", stacklevel=2)
    monitor = made.fit(recordings)
    path.parent.mkdir(parents=True, exist_ok=True)
    monitor.save(path)
    return monitor


def onset_row(episode: Episode) -> int | None:
    """Return the row at which the fault begins; the label counts control steps, of several rows each."""
    label = episode.labelled
    rows = len(episode) // (len(episode.contact_force) or len(episode))
    return label.onset * rows if label.role == "faulty" and label.onset is not None else None


def traces_of(
    name: str, monitor: CalibratedMonitor, episodes: Sequence[Episode], threshold: float
) -> list[ScoredEpisode]:
    """Score recordings, judged at this threshold."""
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


def _scores(monitor: CalibratedMonitor, recordings: Sequence[Episode]) -> Iterator[Any]:
    for first in range(0, len(recordings), AT_ONCE):
        yield from monitor.score_episodes(recordings[first : first + AT_ONCE])


def _examples(
    monitor: CalibratedMonitor, traces: Sequence[ScoredEpisode], episodes: Sequence[Episode]
) -> list[ScoredEpisode]:
    """Return the typical episode of each of ``EXAMPLES`` at its strongest, with the detail that figures need."""
    twins = {(e.labelled.task, e.labelled.seed): e.stream for e in episodes if e.labelled.role == "nominal"}
    examples = []
    for kind in EXAMPLES:
        own = {t: e for t, e in zip(traces, episodes, strict=True) if t.kind == kind}
        if own:
            strongest = list(own)[-1].severity
            chosen = typical([t for t in own if t.severity == strongest])
            episode, twin = own[chosen], twins.get((chosen.task, chosen.seed))
            attribution = monitor.score(episode).attribution
            detail = TraceDetail(attribution, episode.spec.labels, episode.faults, episode.stream, twin)
            examples.append(replace(chosen, detail=detail))
    return examples


def detectability_of(nominal: Sequence[Episode], faulty: Sequence[Episode], window_s: float) -> list[Detectability]:
    """Return what an ideal observer could detect of the faulty episodes, whose nominal twins it knows."""
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
