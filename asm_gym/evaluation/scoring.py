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
from numpy.typing import NDArray

from asm_gym.data.crashes import crashes
from asm_gym.data.episode import Episode, load_episode
from asm_gym.detection.alarm_rule import rows_over
from asm_gym.detection.conformal import EPISODE, HOUR, conformal_episodes
from asm_gym.detection.incidents import power_of
from asm_gym.evaluation.comparison import BenchmarkResult, LeftOut, detectability_of
from asm_gym.evaluation.defaults import PER_HOUR, RATES
from asm_gym.evaluation.metrics import DetectionMetrics
from asm_gym.evaluation.resampling import Calibration
from asm_gym.evaluation.scored_episode import NOMINAL, InterventionOutcome, ScoredEpisode, onset_row
from asm_gym.monitors import CalibratedMonitor, load_monitor, make_monitor
from asm_gym.monitors.calibration import AlarmRate
from asm_gym.monitors.monitor_protocol import Surprise
from asm_gym.version import __version__

HEALTHY_ROLES = ("fit", "calibration", "nominal")  # roles of episodes without a fault

CODE = ("memory", "detection", "monitors", "scaling.py", "spec.py")
"""Rooms and files of the package whose code decides what a monitor learns."""

STRONG = 0.25  # share of the threshold from which on the shares of a row are kept
AT_ONCE = 256  # episodes scored together: the attribution of more would fill the memory

Map = Callable[[Callable[[Any], Any], Sequence[Any]], list[Any]]
"""``map_items(task, items)`` returns ``[task(item) for item in items]``, perhaps by several processes."""


class Recordings(NamedTuple):
    """The recordings of a run."""

    # by role, without failed healthy episodes, and without scenes in which the robot crashes
    roles: dict[str, list[Episode]]
    left_out: LeftOut
    # all of the role nominal, failed ones too: a faulty episode equals its twin until the onset
    twins: list[Episode]

    @classmethod
    def of(cls, recordings: Sequence[Episode]) -> Recordings:
        """Sort by role. Raises ValueError where there is nothing normal to learn from or to test on."""
        crashed = scenes_with_crash(recordings)
        roles: dict[str, list[Episode]] = {}
        failed = 0
        for recording in recordings:
            label = recording.labelled
            # An alarm in a failed episode would be no false one.
            if label.role in HEALTHY_ROLES and not recording.success:
                failed += 1
            elif (label.task, label.seed) not in crashed:
                roles.setdefault(label.role, []).append(recording)
        for role in HEALTHY_ROLES:
            if role not in roles:
                raise ValueError(
                    f"none of the {role} episodes succeeded without a crash: "
                    "there is nothing normal to learn or to test on"
                )
        twins = [r for r in recordings if r.labelled.role == "nominal"]
        return cls(
            roles=roles,
            left_out=LeftOut(failed_episodes=failed, crashed_scenes=len(crashed)),
            twins=twins,
        )


def scenes_with_crash(recordings: Sequence[Episode]) -> set[tuple[str, int]]:
    """Return task and seed of the solved healthy episodes in which the robot crashes."""
    solved = [r for r in recordings if r.labelled.role in HEALTHY_ROLES and r.success]
    labels = [r.labelled for r in solved]
    # Episodes that are judged do not say what is usual.
    is_reference = [label.role != "nominal" for label in labels]
    crashed = crashes(solved, [label.task for label in labels], is_reference)
    return {(labels[n].task, labels[n].seed) for n in crashed}


@lru_cache(maxsize=1)
def read_recordings(paths: tuple[Path, ...]) -> Recordings:
    """Load these files by role; the last ones are cached for the next monitor."""
    return Recordings.of([load_episode(path) for path in paths])


def benchmark(
    folder: Path,
    files: Sequence[Path],
    monitors: Sequence[str],
    rate: float,
    window_s: float,
    seed: int,
    map_items: Map,
) -> BenchmarkResult:
    """Learn from the episodes for fit and calibration, and score all others with every monitor.

    ``folder`` keeps the fitted monitors; ``map_items`` is such as ``parallel_map``.
    """
    paths = tuple(file.resolve() for file in files)
    folder = folder.resolve()

    def score_monitor(name: str) -> DetectionMetrics:
        roles = read_recordings(paths).roles
        monitor = fitted(folder, name, roles["fit"], seed)
        return calibrated_metrics(name, monitor, roles, rate, window_s)

    results = map_items(score_monitor, list(dict.fromkeys(monitors)))
    recordings = read_recordings(paths)
    return BenchmarkResult(
        monitors={result.name: result for result in results},
        detectability=detectability_of(
            recordings.twins, recordings.roles.get("faulty", []), window_s
        ),
        rate=rate,
        window_s=window_s,
        left_out=recordings.left_out,
    )


def calibrated_metrics(
    name: str,
    monitor: CalibratedMonitor,
    by_role: Mapping[str, Sequence[Episode]],
    rate: float,
    window_s: float,
) -> DetectionMetrics:
    """Calibrate a fitted monitor, and score the nominal and the faulty episodes."""
    monitor.calibrate(by_role["calibration"], rate)
    maxima = monitor.maxima_
    blocks = monitor.blocks_
    assert maxima is not None
    assert blocks is not None

    # Further rates that so many episodes and hours can promise.
    rates = [r for r in RATES if len(maxima) >= conformal_episodes(r)]
    hourly_rates = [r for r in PER_HOUR if r * blocks.total >= 1.0]
    promises = [AlarmRate(r, EPISODE) for r in sorted({rate, *rates})]
    promises += [AlarmRate(r, HOUR) for r in hourly_rates]
    thresholds = {promise: monitor.threshold_at(**promise.named) for promise in promises}
    threshold = thresholds[AlarmRate(rate, EPISODE)]
    return DetectionMetrics(
        name=name,
        traces=traces_of(name, monitor, by_role.get("faulty", []), threshold),
        nominal=traces_of(name, monitor, by_role["nominal"], threshold),
        window_s=window_s,
        calibration=Calibration(thresholds, maxima, blocks),
    )


@cache
def code_digest() -> str:
    """Return a digest of the code that decides what a monitor learns."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for name in CODE:
        path = package / name
        for file in sorted(path.rglob("*.py")) or [path]:
            digest.update(file.relative_to(package).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()[:8]


def fitted(folder: Path, name: str, recordings: Sequence[Episode], seed: int) -> CalibratedMonitor:
    """Return the monitor fitted on these episodes, from ``folder`` if it was fitted before.

    A file is named for the monitor, and digests of its settings, its episodes and our code.
    """
    monitor = make_monitor(name, recordings[0].spec, seed=seed)
    settings = json.dumps((name, __version__, monitor.get_params()), default=str)
    digest = hashlib.sha256(settings.encode())
    for recording in recordings:
        digest.update(str(recording.stream.shape).encode())
        digest.update(recording.stream.tobytes())
    path = folder / "monitors" / f"{name}-{digest.hexdigest()[:12]}-{code_digest()}.asm"
    with suppress(FileNotFoundError, ValueError):  # fitted anew if missing or damaged
        return load_monitor(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    monitor.fit(recordings).save(path)
    return monitor


def traces_of(
    name: str, monitor: CalibratedMonitor, episodes: Sequence[Episode], threshold: float
) -> list[ScoredEpisode]:
    """Score recordings, judged at this threshold."""
    traces = []
    for first in range(0, len(episodes), AT_ONCE):
        group = episodes[first : first + AT_ONCE]
        for episode, surprise in zip(group, monitor.score_episodes(group), strict=True):
            label = episode.labelled
            force = float(np.max(episode.contact_force, initial=0.0))
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
                outcome=InterventionOutcome(episode.success, contact_force=force),
                excused=surprise.excused_by_event,
                power=power_of(monitor),
                strong_shares=strong_shares(surprise, threshold),
            )
            traces.append(trace.attributed(surprise.attribution, episode.spec.labels))
    return traces


def strong_shares(surprise: Surprise, threshold: float) -> dict[int, NDArray[np.float32]]:
    """Return the shares (D,) of the rows near a threshold or above, by row."""
    rows = np.flatnonzero(rows_over(surprise.value, STRONG * threshold))
    return {int(row): surprise.attribution[row].astype(np.float32) for row in rows}
