"""Demonstrate the safety wrapper on one robosuite task, from recording to a table of detected faults.

The demo collects nominal episodes, fits and calibrates a memory of the task, and runs nominal and faulty episodes with
the policy alone and under the safety wrapper, paired by seed. It prints one table, and writes the memory and a report.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console
from scipy.stats import binom

from asm_gym.detection import conformal_episodes
from asm_gym.evaluation import figures
from asm_gym.evaluation.defaults import FALSE_ALARM_RATE, WINDOW_S
from asm_gym.evaluation.detection_tables import (
    ALL_CONDITION_COLUMNS,
    CONDITION_COLUMNS,
    headline,
)
from asm_gym.evaluation.metrics import by_condition, typical
from asm_gym.evaluation.report_page import write_report
from asm_gym.evaluation.scored_episode import NOMINAL, ScoredEpisode
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.tables import tabulate
from asm_gym.faults import Collision, Fault, FrozenEncoder, Push, WeakJoint
from asm_gym.monitors import NeuralASM
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import versions
from asm_gym.rollouts.run_trials import collect, watch_pair
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.trial import RolloutConfig, Trial, task_in
from asm_gym.scripts.command import Options, option, origin, run
from asm_gym.tasks import TASKS, env_id

PUSHED = "robot0_link5"  # link that is pushed
RESPONSE = "graded"  # of the wrapper to an alarm, by its cause


@dataclass(frozen=True)
class Args(Options):
    """Options of the demonstration."""

    task: str = option("Lift", positional=True, check=env_id, known=TASKS, metavar="TASK")
    """Name of a task."""
    workers: int = option(os.cpu_count() or 1, least=1)
    """Number of processes."""
    out: Path = option(Path("runs/demo"), metavar="FOLDER")
    """Folder to write to."""
    fit_episodes: int = option(60, quick=20, least=1)
    """Nominal episodes to learn from."""
    calibration_episodes: int = option(60, quick=20, least=conformal_episodes(FALSE_ALARM_RATE))
    """Other nominal episodes that set the threshold."""
    nominal_episodes: int = option(40, quick=13, least=1)
    """Nominal episodes to test on."""
    faulty_episodes: int = option(20, quick=6, least=1)
    """Episodes to test on for each fault."""
    epochs: int = option(40, quick=13, least=1)
    """Training passes over the episodes."""


def faults(seed: int, episodes: int) -> dict[str, list[Fault]]:
    """Return ``episodes`` faults of each kind by its name, with random joints and directions.

    Onsets fall between 0.5 s and 2.3 s, while the arm is on its way.
    """
    rng = np.random.default_rng([seed, 7])
    frozen: list[Fault] = []
    pushes: list[Fault] = []
    weak: list[Fault] = []
    collisions: list[Fault] = []
    for _ in range(episodes):
        onset = int(rng.integers(10, 46))
        direction = rng.standard_normal(3)
        x, y, z = (direction / np.linalg.norm(direction)).tolist()
        pushes.append(
            Push(body=PUSHED, newtons=20.0, direction=(x, y, z), onset=onset, duration=10)
        )
        weak.append(WeakJoint(joint=int(rng.integers(7)), strength=0.5, onset=onset))
        frozen.append(FrozenEncoder(joint=int(rng.integers(7)), onset=onset))
        collisions.append(Collision(onset=onset, duration=20))
    return {
        "frozen encoder": frozen,
        "push": pushes,
        "weak joint": weak,
        "collision": collisions,
    }


def trials(args: Args) -> list[Trial]:
    """Return every episode to test on."""
    env = env_id(args.task)
    cases: list[tuple[str, tuple[Fault, ...]]] = [(NOMINAL, ())] * args.nominal_episodes
    for kind, own in faults(args.seed, args.faulty_episodes).items():
        cases += [(kind, (fault,)) for fault in own]
    seeds = episode_seeds(args.seed, len(cases), stage=2)
    return [
        Trial(env, seed, kind, faults=own, acting=RESPONSE)
        for (kind, own), seed in zip(cases, seeds, strict=True)
    ]


def fit(args: Args) -> tuple[Path, Share]:
    """Fit, calibrate and save a memory of the task; return its file and how often the expert succeeded."""
    env = env_id(args.task)
    count = args.fit_episodes + args.calibration_episodes
    with stage("collecting nominal episodes") as progress:
        episodes = collect(env, "scripted", count, args.seed, args.workers, progress=progress)
    memory = NeuralASM(episodes[0].spec, epochs=args.epochs, seed=args.seed)
    with stage("learning") as progress:
        memory.fit(episodes[: args.fit_episodes], progress=progress)
    memory.calibrate(episodes[args.fit_episodes :], false_alarm_rate=FALSE_ALARM_RATE)
    file = args.out / f"{task_in(env).lower()}.asm"
    memory.save(file)
    return file, Share.of([e.success for e in episodes])


def episode_to_show(traces: Sequence[ScoredEpisode]) -> ScoredEpisode:
    """Return the guarded episode with the longest override, of those with a fault that were solved."""
    guarded = [trace for trace in traces if trace.acting == RESPONSE]
    solved = [trace for trace in guarded if trace.outcome.success and trace.onset is not None]
    return max(solved or guarded, key=lambda trace: trace.outcome.overridden_steps)


def demonstrate(args: Args, console: Console) -> None:
    """Run the demo."""
    args.out.mkdir(parents=True, exist_ok=True)
    memory, expert = fit(args)
    work = partial(watch_pair, config=RolloutConfig(), memory=memory)
    with stage("testing, policy alone and wrapped") as progress:
        pairs = parallel_map(work, trials(args), args.workers, progress)
    traces = [trace for pair in pairs for trace in pair]
    rows = by_condition(traces, WINDOW_S)
    title = f"Found while the policy acts alone; solved and harm: alone → {RESPONSE}"
    console.print("", tabulate(title, CONDITION_COLUMNS, rows), "")
    low, high = binom.interval(0.95, args.nominal_episodes, FALSE_ALARM_RATE)
    result = (
        f"{headline(rows)} At a false-alarm rate of {FALSE_ALARM_RATE:g}, {low:g} to {high:g} of "
        f"{args.nominal_episodes} nominal episodes raise an alarm by chance (95 %). The expert "
        f"succeeded in {expert.k} of {expert.n} episodes."
    )
    console.print(result)
    shown = episode_to_show(traces)
    one_episode = {"One episode under the guard": figures.guarded_figure(shown)}
    of_conditions = [typical(condition.watched) for condition in rows]
    surprise = figures.surprise_figure(of_conditions)
    report = args.out / "report.html"
    write_report(
        report,
        title=f"asm-gym demo: {args.task}",
        intro=(
            f"A Neural Associative Skill Memory learned what {args.fit_episodes} nominal episodes "
            f"feel like and then watched others, some of them faulty. {result}"
        ),
        tables=[tabulate(title, ALL_CONDITION_COLUMNS, rows)],
        opening=one_episode,
        drawn={"Surprise over time in a typical episode of each condition": surprise},
        details=origin() | asdict(args) | versions("numba") | {"window_s": WINDOW_S},
    )
    console.print(f"Wrote {report} and {memory}")


main = partial(run, "demo", Args, demonstrate)
