"""Will GR00T fail? Logs of a policy of others, in RoboCasa: what a monitor of success makes of its failures.

ActProbe's authors logged what a policy's action chunks looked like, and where the hand was, in nine simulated kitchen
tasks: 1,801 episodes, of which 209 failed. Nobody tells a monitor here of a failure: it learns from two thirds of the
successes of all tasks, and is asked about the rest and every failure. Failures last to the end and successes do not, so
what an episode's length says is kept out: only the first steps count, of episodes that still run then.

ActProbe itself learns from failures, with labels. Its own figures are of other splits, and stand in its paper.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.episode import Episode
from asm_gym.evaluation.statistics import auroc
from asm_gym.evaluation.tables import Table
from asm_gym.monitors import MONITORS, make_monitor
from asm_gym.scripts.options import fixed, option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record

SOURCE = "air-embodied-brain/actprobe @ d5dfbcc9, benchmarks/groot_robocasa/data/metrics_logs (Apache-2.0)"
FOLDER = "actprobe_groot_robocasa"
SIGNALS = {"magnitude alone": "action_norm", "inconsistency alone": "chunk_mse"}
"""What ActProbe reads, each by itself: its greatest value so far."""

FIRST = 2
"""Steps that are left out: nothing was planned before them that they could be consistent with."""


class Log(NamedTuple):
    """An episode of the policy."""

    task: str
    success: bool
    episode: Episode


@dataclass(frozen=True)
class Config(kit.Config):
    """Failures of a policy of others, told from its successes."""

    folder: Path = option(Path("real_arms"), positional=True, metavar="FOLDER")
    """Where the recordings lie."""
    workers: int = option(1, least=1)
    """Processes."""
    monitors: tuple[str, ...] = option(
        ("memory_skill", "neural_asm", "association_linear+evidence", "window_pca+evidence", *SIGNALS),
        quick=("window_pca+evidence", *SIGNALS),
        least=1,
        known=(*MONITORS, *SIGNALS),
    )
    """Names of monitors, and of single signals; memory_skill is skill surprise."""
    steps: tuple[int, ...] = fixed((10, 20))
    """After how many steps it is asked."""


def run(config: Config) -> Findings:
    """Each monitor on each split."""
    logs = read_logs_of(config.folder)
    jobs = [(name, seed) for name in config.monitors for seed in config.repetitions]
    records = kit.together(kit.each("watching", partial(judged, logs=logs, config=config), jobs, config))
    return Findings(records, [table(records, logs, config)])


def read_logs_of(folder: Path) -> list[Log]:
    """Every episode. Raises FileNotFoundError that says where they are published."""
    files = sorted((folder / FOLDER).glob("*_Env.jsonl"))
    if not files:
        raise FileNotFoundError(f"{folder / FOLDER} holds no *_Env.jsonl: they are {SOURCE}")
    return [found for file in files for line in file.open(encoding="utf-8") if (found := _log(file.name, line))]


def _log(name: str, line: str) -> Log | None:
    """One episode; none where it is over before anything can be said."""
    said = json.loads(line)
    steps = said["steps"][FIRST:]
    if len(steps) < 2:
        return None

    def column(key: str) -> NDArray[np.float64]:
        return np.array([step.get(key, np.nan) for step in steps], np.float64)

    def physical(key: str) -> NDArray[np.float64]:
        return np.array([step["physics_info"][f"state.{key}"] for step in steps], np.float64)

    columns = {key: column(key) for key in ("action_norm", "chunk_mse", "denoising_curvature")}
    hand = physical("end_effector_position_absolute")
    # A kitchen stands elsewhere in each episode: where the hand is counts from where it was.
    columns |= {"hand": hand - hand[0], "gripper": physical("gripper_qpos")}
    task = name.partition("_")[0]
    episode = Episode.from_table(columns, rate=1.0, success=bool(said["success"]), info={"skill": task})
    return Log(task, bool(said["success"]), episode)


def judged(job: tuple[str, int], logs: Sequence[Log], config: Config) -> list[Record]:
    """Of each episode that was not learned from, the greatest surprise after so many steps."""
    name, seed = job
    rng = np.random.default_rng(seed)
    finite = [log for log in logs if np.isfinite(log.episode.stream).all()]
    successes = [n for n, log in enumerate(finite) if log.success]
    learned = set(rng.permutation(successes)[: 2 * len(successes) // 3].tolist())
    asked = [log for n, log in enumerate(finite) if n not in learned]
    values = surprises(name, seed, [finite[n].episode for n in sorted(learned)], [log.episode for log in asked])
    return [
        {"monitor": name, "seed": seed, "task": log.task, "failed": not log.success, "after": steps}
        | {"greatest": float(value[: steps - FIRST].max())}
        for log, value in zip(asked, values, strict=True)
        for steps in config.steps
        if len(value) >= steps - FIRST
    ]


def surprises(name: str, seed: int, learned: list[Episode], asked: list[Episode]) -> list[NDArray[np.float64]]:
    """(T,) of each episode."""
    if name in SIGNALS:
        place = asked[0].spec.slices[SIGNALS[name]].start
        return [episode.stream[:, place].astype(np.float64) for episode in asked]
    monitor: Any = make_monitor(name, asked[0].spec, seed=seed).fit(learned)
    return [score.value for score in monitor.score_episodes(asked)]


def table(records: Sequence[Record], logs: Sequence[Log], config: Config) -> Table:
    """A row a monitor: AUROC within tasks, mean and spread over splits."""
    rows = []
    for name in config.monitors:
        cells = []
        for steps in config.steps:
            areas = [within(records, name, seed, steps) for seed in config.repetitions]
            cells.append(f"{np.mean(areas):.3f} ± {np.std(areas):.3f}")
        rows.append((name, *cells))
    failed = sum(not log.success for log in logs)
    caption = (
        f"Failures of GR00T told from its successes by the greatest surprise so far: AUROC, the mean over "
        f"{len({log.task for log in logs})} tasks, of {len(logs)} episodes of which {failed} failed; mean and spread "
        f"over {config.seeds} splits. Only episodes that still run are asked about."
    )
    return Table(caption, ("Monitor", *(f"after {steps} steps" for steps in config.steps)), rows)


def within(records: Sequence[Record], name: str, seed: int, steps: int) -> float:
    """The mean over tasks, so that no task's difficulty counts."""
    own = [r for r in records if (r["monitor"], r["seed"], r["after"]) == (name, seed, steps)]
    areas = []
    for task in sorted({r["task"] for r in own}):
        failed, others = ([r["greatest"] for r in own if r["task"] == task and r["failed"] is f] for f in (True, False))
        if failed and others:
            areas.append(auroc(failed, others))
    return float(np.mean(areas)) if areas else float("nan")
