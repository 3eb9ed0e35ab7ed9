"""Fits every monitor on the nominal recordings, and asks each what it makes of all the others."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import asm_gym
from asm_gym.detection.detector import conformal_episodes, conformal_threshold
from asm_gym.episodes import Episode, EpisodeLabel
from asm_gym.evaluation import comparison
from asm_gym.evaluation.comparison import IDEAL, RATES, Cell, Score, Sight
from asm_gym.evaluation.ideal import earliest, noise_floor, separation
from asm_gym.evaluation.scoring import Verdict, coverage
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.trace import InterventionOutcome, Trace, TraceDetail, window_steps
from asm_gym.monitors import EVIDENCE, Monitor, make_monitor, monitor_class
from asm_gym.rollouts.folder import NOMINAL_ROLES, Recordings, labelled
from asm_gym.rollouts.parallel import ParallelConfig, Progress, parallel_map

EXAMPLES = ("push", "collision", "weak_joint", "frozen_encoder", "snatch")
"""Kinds of which the report shows an episode."""


@dataclass(frozen=True)
class Judgement:
    """What the monitors said of a run's episodes.

    Args:
        verdicts: of nominal and faulty episodes, by monitor.
        harmless: of harmless variations, by monitor.
        thresholds: by monitor and by the false-alarm rate they were set for.
        sights: what an ideal observer could see.
        rate, window_s: the run's own.
        failed: nominal episodes that did not succeed; they are left out.
        examples: a typical faulty episode of some kinds, as the first monitor saw it.
        shown: which those are.
    """

    verdicts: Mapping[str, Sequence[Verdict]]
    harmless: Mapping[str, Sequence[Verdict]]
    thresholds: Mapping[str, Mapping[float, float]]
    sights: Sequence[Sight]
    rate: float
    window_s: float
    failed: int = 0
    examples: Sequence[Trace] = ()
    shown: Sequence[EpisodeLabel] = ()

    @cached_property
    def visible(self) -> dict[tuple[str, str], bool]:
        return comparison.visible_kinds(self.sights)

    @cached_property
    def cells(self) -> dict[str, dict[tuple[str, str], Cell]]:
        """Each monitor's score on each kind, the ideal observer's first."""
        kinds = self.visible
        ideal = {k: comparison.ideal_cell([s for s in self.sights if (s.kind, s.severity) == k]) for k in kinds}
        return {IDEAL: ideal} | {
            m: comparison.by_kind(v, self.thresholds[m], self.rate, self.window_s) for m, v in self.verdicts.items()
        }

    @cached_property
    def scores(self) -> list[Score]:
        """A row for each monitor."""
        return [
            comparison.score(m, v, self.thresholds[m], self.rate, self.window_s, self.visible)
            for m, v in self.verdicts.items()
        ]

    def ideal(self) -> Cell:
        """The bound, over the kinds that can be seen."""
        return comparison.ideal_cell([s for s in self.sights if self.visible[(s.kind, s.severity)]])

    def cries(self) -> dict[str, dict[str, Share]]:
        """Episodes of each harmless variation with an alarm, by monitor."""
        return {
            m: {k: coverage([x for x in v if x.kind == k], self.thresholds[m][self.rate]) for k in _kinds(v)}
            for m, v in self.harmless.items()
        }


class Opinion(NamedTuple):
    """What one monitor said."""

    verdicts: list[Verdict]
    harmless: list[Verdict]
    thresholds: dict[float, float]
    examples: dict[EpisodeLabel, Trace]


def judge(
    folder: Path,
    labels: Sequence[EpisodeLabel],
    monitors: Sequence[str],
    rate: float,
    window_s: float,
    seed: int,
    crew: ParallelConfig,
    progress: Progress,
) -> Judgement:
    """Reads the recordings, and lets every monitor judge them.

    Args:
        folder: of the run.
        labels: its episodes; those of roles fit and calibration are learned from, all others judged.
        seed: of the monitors.
        crew: who judges; each monitor is one task.
    """
    progress(0, len(monitors))
    # One that is judged in two ways is fitted once.
    models: dict[str, list[str]] = {}
    for name in monitors:
        models.setdefault(name.removesuffix(EVIDENCE), []).append(name)
    opine = partial(_opinions, folder=folder.resolve(), labels=tuple(labels), rate=rate, seed=seed)
    made = parallel_map(
        opine, list(models.values()), crew, lambda k, n: progress(k * len(monitors) // n, len(monitors))
    )
    found = {name: opinion for opinions in made for name, opinion in opinions.items()}
    opinions = {name: found[name] for name in monitors}
    by_role, failed, twins = Recordings.of(labelled(folder, labels))
    return Judgement(
        {n: o.verdicts for n, o in opinions.items()},
        {n: o.harmless for n, o in opinions.items()},
        {n: o.thresholds for n, o in opinions.items()},
        sights_of(twins, by_role.get("faulty", []), window_s),
        rate,
        window_s,
        failed,
        list(opinions[monitors[0]].examples.values()),
        list(opinions[monitors[0]].examples),
    )


def _opinions(
    names: Sequence[str], folder: Path, labels: Sequence[EpisodeLabel], rate: float, seed: int
) -> dict[str, Opinion]:
    by_role = Recordings.of(labelled(folder, labels)).roles
    return {name: opinion_of(name, folder, by_role, rate, seed) for name in names}


def opinion_of(name: str, folder: Path, by_role: Mapping[str, Sequence[Episode]], rate: float, seed: int) -> Opinion:
    monitor = fitted(folder, name, by_role["fit"], seed)
    maxima = np.array([s.value.max() for s in _scores(monitor, by_role["calibration"])])
    rates = sorted({rate, *(r for r in RATES if len(maxima) >= conformal_episodes(r))})
    thresholds = {r: conformal_threshold(maxima, r) for r in rates}
    tested = [*by_role["nominal"], *by_role.get("faulty", [])]
    verdicts = _verdicts(name, monitor, tested, thresholds[rate])
    harmless = _verdicts(name, monitor, by_role.get("harmless", []), thresholds[rate])
    return Opinion(verdicts, harmless, thresholds, _examples(monitor, verdicts, tested, thresholds[rate]))


def fitted(folder: Path, name: str, recordings: Sequence[Episode], seed: int) -> Monitor:
    """The monitor fitted on these episodes; kept in the folder for the next time, under the name of what it learned."""
    spec = recordings[0].spec
    model = name.removesuffix(EVIDENCE)
    made: Any = make_monitor(name, spec, seed=seed)
    learned = model, asm_gym.__version__, made.get_params(), sorted(str(r.labelled.path) for r in recordings)
    digest = hashlib.sha256(json.dumps(learned, default=str).encode())
    path = folder / "monitors" / f"{model}-{digest.hexdigest()[:12]}.asm"
    # One that cannot be read, for it is damaged or of an older asm-gym, is made anew.
    with suppress(FileNotFoundError, ValueError):
        loaded: Monitor = monitor_class(name).load(path)
        return loaded
    monitor: Monitor = made.fit(recordings)
    path.parent.mkdir(parents=True, exist_ok=True)
    monitor.save(path)
    return monitor


def calibrated(folder: Path, name: str, labels: Sequence[EpisodeLabel], seed: int, threshold: float) -> Any:
    """The monitor as it judged the run, with the threshold it judged by."""
    nominal = Recordings.of(labelled(folder, [label for label in labels if label.role in NOMINAL_ROLES]))
    monitor: Any = fitted(folder, name, nominal.roles["fit"], seed)
    monitor.threshold_ = threshold
    return monitor


def _scores(monitor: Any, recordings: Sequence[Episode]) -> list[Any]:
    return list(monitor.score_episodes(recordings)) if recordings else []


def _verdicts(name: str, monitor: Monitor, recordings: Sequence[Episode], threshold: float) -> list[Verdict]:
    made = []
    for episode, surprise in zip(recordings, _scores(monitor, recordings), strict=True):
        label = episode.labelled
        faulty = label.role == "faulty"
        verdict = Verdict(
            task=label.task,
            monitor=name,
            kind=label.kind or "nominal",
            severity=label.severity,
            seed=label.seed,
            dt=episode.spec.dt,
            surprise=surprise.value,
            onset=label.onset if faulty else None,
            guilty=label.affected_channels,
        )
        after = verdict.detected_after(threshold)
        if after is not None and label.onset is not None:
            blamed = int(np.argmax(surprise.attribution[label.onset + after]))
            verdict = Verdict(**{**verdict.__dict__, "blamed": episode.spec.labels[blamed]})
        made.append(verdict)
    return made


def _examples(
    monitor: Any, verdicts: Sequence[Verdict], recordings: Sequence[Episode], threshold: float
) -> dict[EpisodeLabel, Trace]:
    """Of each of a few kinds, at its strongest, the episode with the median delay."""
    chosen = []
    for kind in EXAMPLES:
        own = [i for i, v in enumerate(verdicts) if v.kind == kind]
        own = [i for i in own if verdicts[i].severity == verdicts[own[-1]].severity]
        if own:
            late = sorted((math.inf if (a := verdicts[i].detected_after(threshold)) is None else a, i) for i in own)
            chosen.append(late[(len(late) - 1) // 2][1])
    twins = {(r.labelled.task, r.labelled.seed): r.stream for r in recordings if r.labelled.role == "nominal"}
    traces = {}
    for i in chosen:
        episode, label = recordings[i], recordings[i].labelled
        surprise = monitor.score(episode)
        traces[label] = Trace(
            kind=label.kind,
            severity=label.severity,
            task=label.task,
            seed=label.seed,
            dt=episode.spec.dt,
            threshold=threshold,
            surprise=surprise.value,
            onset=label.onset,
            outcome=InterventionOutcome(episode.success),
            detail=TraceDetail(
                surprise.attribution,
                episode.spec.labels,
                episode.faults,
                episode.stream,
                twins.get((label.task, label.seed)),
            ),
        )
    return traces


def sights_of(nominal: Sequence[Episode], faulty: Sequence[Episode], window_s: float) -> list[Sight]:
    twins = {(r.labelled.task, r.labelled.seed): r.stream for r in nominal}
    noises: dict[str, Any] = {}
    sights = []
    for episode in faulty:
        label = episode.labelled
        if label.task not in noises:
            own = [r.stream for r in nominal if r.labelled.task == label.task]
            noises[label.task] = noise_floor(episode.spec.noise, own)
        summed = separation(episode.stream, twins[label.task, label.seed], noises[label.task], label.onset or 0)
        window = summed[: window_steps(window_s, episode.spec.dt)]
        seen = float(window[-1]) if len(window) else 0.0
        sights.append(
            Sight(label.task, label.kind, label.severity, label.seed, seen, earliest(window), episode.spec.dt)
        )
    return sights


def _kinds(verdicts: Sequence[Verdict]) -> list[str]:
    return list(dict.fromkeys(v.kind for v in verdicts))
