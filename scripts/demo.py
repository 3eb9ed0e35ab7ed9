"""A robot that notices when something is wrong: the whole safety loop on one robosuite task.

Shows first what the shipped memory of the body notices, with nothing fitted. Then collects nominal episodes, fits and
calibrates a Neural ASM, and runs nominal and faulty episodes with the policy alone and under the safety wrapper, paired
by seed. Prints one table and writes a report, its plots, a video, the fitted memory and every figure as JSON.
"""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from asm_gym.detection import conformal_episodes
from asm_gym.evaluation import figures
from asm_gym.evaluation.defaults import FALSE_ALARM_RATE, WINDOW_S
from asm_gym.evaluation.detection_tables import CONDITION_COLUMNS, headline
from asm_gym.evaluation.metrics import DetectionMetrics, by_condition, false_alarms, hourly_alarms, typical
from asm_gym.evaluation.report import write_json, write_report
from asm_gym.evaluation.scored_episode import NOMINAL
from asm_gym.evaluation.statistics import Share, binomial_interval
from asm_gym.evaluation.tables import ConsoleTable, tabulate
from asm_gym.faults import Collision, Fault, FrozenEncoder, Push, WeakJoint
from asm_gym.monitors import NeuralASM
from asm_gym.rollouts.collect import collect
from asm_gym.rollouts.film import can_record_video, record_video, watch_pair
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import versions
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.staging import play, staged
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.scripts.command import run
from asm_gym.scripts.options import check_options, fixed, option
from asm_gym.tasks import TASKS, env_id
from asm_gym.validation import check_choice
from asm_gym.wrappers import NeuralASMSafety


@dataclass(frozen=True)
class Args:
    """Collect, fit, calibrate, break things, and see who notices."""

    task: str = option("Lift", positional=True, check=env_id, listed=TASKS, metavar="TASK")
    """Name of a task."""
    on_alarm: Literal["graded", "hold", "terminate"] = option("graded")
    """What the wrapper does on an alarm: graded does what the cause asks for."""
    false_alarm_rate: float = fixed(FALSE_ALARM_RATE, check=conformal_episodes)
    """Share of nominal episodes that may raise an alarm; a smaller one takes more episodes to set its threshold."""
    video: bool = True
    """Make no video; there is none where this machine cannot render."""
    workers: int = option(os.cpu_count() or 1, least=1)
    """Processes."""
    seed: int = option(0, least=0)
    """Seed of all that is drawn: the same seed gives the same table."""
    out: Path = option(Path("runs/demo"), metavar="FOLDER")
    """Folder to write to."""
    quick: bool = False
    """A third of the episodes: to see that everything runs, not to judge the figures."""
    fit_episodes: int = fixed(60, quick=20, least=1)
    """Nominal episodes to learn from."""
    calibration_episodes: int = fixed(60, quick=20, least=1)
    """Other nominal episodes that set the threshold, where the rate needs no more."""
    nominal_episodes: int = fixed(40, quick=13, least=1)
    """Nominal episodes to test on."""
    faulty_episodes: int = fixed(20, quick=6, least=1)
    """Episodes to test on for each fault."""
    epochs: int = fixed(40, quick=13, least=1)
    """Passes over the episodes in learning."""

    def __post_init__(self) -> None:
        check_options(self)
        check_choice("response", self.on_alarm, ("graded", "hold", "terminate"))

    @property
    def env_id(self) -> str:
        return env_id(self.task)

    @property
    def calibrating(self) -> int:
        """Episodes that set the threshold: as many as the rate needs."""
        return max(self.calibration_episodes, conformal_episodes(self.false_alarm_rate))


def faults(seed: int, episodes: int) -> list[tuple[str, Fault]]:
    """Each kind of fault ``episodes`` times, at onsets, joints and directions that vary.

    Onsets fall between 0.5 s and 2.3 s, when the arm is on its way.
    """
    rng = np.random.default_rng([seed, 7])
    made: dict[str, list[Fault]] = {"frozen encoder": [], "push": [], "weak joint": [], "collision": []}
    for _ in range(episodes):
        onset = int(rng.integers(10, 46))
        direction = rng.standard_normal(3)
        x, y, z = (float(v) for v in direction / np.linalg.norm(direction))
        push = Push(body="robot0_link5", newtons=20.0, direction=(x, y, z), onset=onset, duration=10)
        made["push"].append(push)
        made["weak joint"].append(WeakJoint(joint=int(rng.integers(7)), strength=0.5, onset=onset))
        made["frozen encoder"].append(FrozenEncoder(joint=int(rng.integers(7)), onset=onset))
        made["collision"].append(Collision(onset=onset, duration=20))
    return [(name, fault) for name, kind in made.items() for fault in kind]


def trials(args: Args) -> list[Trial]:
    """Every episode to test on."""
    broken = faults(args.seed, args.faulty_episodes)
    seeds = episode_seeds(args.seed, args.nominal_episodes + len(broken), stage=2)
    cases = [(NOMINAL, ())] * args.nominal_episodes + [(name, (fault,)) for name, fault in broken]
    return [
        Trial(args.env_id, seed, name, faults=faulty, acting=args.on_alarm)
        for (name, faulty), seed in zip(cases, seeds, strict=True)
    ]


def without_fitting(args: Args) -> str:
    """What the shipped memory of the body makes of a healthy episode and of a push, before anything is learned.

    Nothing where no shipped memory fits.
    """
    seed = episode_seeds(args.seed, 1, stage=3)[0]
    push = Push(body="robot0_link5", newtons=20.0, direction=(0.0, 1.0, 0.0), onset=PUSHED_AT, duration=10)
    surprises = []
    for faults in ((), (push,)):
        infos: list[dict[str, Any]] = []
        with staged(Trial(args.env_id, seed, faults=faults), RolloutConfig()) as env:
            try:
                watched = NeuralASMSafety(env, on_alarm="monitor", on_overrun="ignore")
            except ValueError:
                return ""
            play(Trial(args.env_id, seed), RolloutConfig(), watched, infos.append)
            surprises.append(np.array([info["asm"]["surprise"] for info in infos]) / watched.threshold)
    healthy, pushed = surprises
    noticed = np.flatnonzero(pushed[PUSHED_AT:] > 1.0)
    when = f"noticed after {1e3 * (noticed[0] + 1) * watched.monitor.spec.dt:.0f} ms" if len(noticed) else "not noticed"
    return (
        f"{watched.monitor!r} came with the package. In a healthy episode surprise reaches {healthy.max():.0%} of its "
        f"threshold; a push of 20 N is {when}."
    )


PUSHED_AT = 40
"""Step in which the arm is pushed before anything is learned."""


def fit(args: Args, folder: Path, timed: Callable[[str], Any]) -> tuple[NeuralASM, Share]:
    """A memory of the task as the expert does it, calibrated and saved; and how often the expert succeeded."""
    with timed("collecting nominal episodes") as progress:
        count = args.fit_episodes + args.calibrating
        episodes = collect(args.env_id, "scripted", count, args.seed, args.workers, progress=progress)
    memory = NeuralASM(episodes[0].spec, epochs=args.epochs, seed=args.seed)
    with timed("learning") as progress:
        memory.fit(episodes[: args.fit_episodes], progress=progress)
    memory.calibrate(episodes[args.fit_episodes :], false_alarm_rate=args.false_alarm_rate)
    memory.save(folder / "lift.asm")
    return memory, Share.of([e.success for e in episodes])


def observe_latency_us(memory: NeuralASM, calls: int = 2000) -> dict[str, float]:
    """What one ``observe`` of one environment takes [µs]."""
    state = memory.initial_state(batch=1)
    rows = np.random.default_rng(0).standard_normal((calls, 1, memory.spec.size)).astype(np.float32)
    times = np.empty(calls)
    for k, row in enumerate(rows):
        start = time.perf_counter()
        state, _ = memory.observe(state, row)
        times[k] = time.perf_counter() - start
    median, p95 = np.percentile(1e6 * times, [50, 95])
    return {"median": round(float(median), 1), "p95": round(float(p95), 1)}


def draw(rows: Sequence[DetectionMetrics], folder: Path) -> dict[str, Figure]:
    """Draws every plot, and saves it as PNG too: {caption: figure}."""
    examples = [typical(m.watched) for m in rows]
    frozen = next(t for t in examples if t.kind == "frozen encoder")
    drawn = {
        "Surprise over time in a typical episode of each condition": (
            "surprise",
            figures.surprise_figure(examples),
        ),
        "How soon faults were noticed": ("delay", figures.delay_figure(rows)),
        "Faults told from nominal episodes at the same time": ("roc", figures.roc_figure(rows)),
        "Where the surprise came from when an encoder froze": ("attribution", figures.attribution_figure(frozen)),
    }
    for name, figure in drawn.values():
        figures.save(figure, folder / f"{name}.png")
    return {caption: figure for caption, (_, figure) in drawn.items()}


def as_json(m: DetectionMetrics) -> dict[str, Any]:
    """What one condition showed."""
    return {
        "condition": m.name,
        "episodes": len(m.watched),
        "false_alarm_episodes": false_alarms(m.watched),
        "false_alarms_per_hour": hourly_alarms(m.watched).value,
        "detected": m.detected,
        "delays": m.delays,
        "auroc": m.auroc,
        "top_labels": m.top_channels,
        "outcomes": m.outcomes,
    }


def figures_of(
    args: Args, rows: Sequence[DetectionMetrics], expert: Share, latency: dict[str, float], seconds: dict[str, float]
) -> dict[str, Any]:
    """Every figure, with what it takes to make it again."""
    return {
        "arguments": {**asdict(args), "out": str(args.out)},
        "versions": {"python": platform.python_version(), **versions("numba")},
        "window_s": WINDOW_S,
        "results": [as_json(m) for m in rows],
        "expert_success": expert._asdict(),
        "observe_us": latency,
        "seconds": seconds,
    }


def demonstrate(args: Args, console: Console) -> None:
    """The whole demo."""
    folder = args.out
    folder.mkdir(parents=True, exist_ok=True)
    seconds: dict[str, float] = {}
    timed = partial(stage, console=console, seconds=seconds)

    with timed("watching without fitting"):
        said = without_fitting(args)
    console.print(said or f"No shipped memory fits {args.task}.", highlight=False)
    can_show = args.video and can_record_video(console)
    memory, expert = fit(args, folder, timed)
    todo = trials(args)
    with timed("testing, policy alone and wrapped") as progress:
        work = partial(watch_pair, config=RolloutConfig(), memory=folder / "lift.asm")
        traces = [trace for pair in parallel_map(work, todo, args.workers, progress) for trace in pair]
    rows = by_condition(traces, WINDOW_S)
    latency = observe_latency_us(memory)
    title = f"Noticed while the policy acts alone; solved and force: alone → {args.on_alarm}"
    table = tabulate(title, CONDITION_COLUMNS, rows)
    console.print("", ConsoleTable(table, plain=True), "")
    low, high = binomial_interval(args.nominal_episodes, args.false_alarm_rate)
    expected = (
        f"At a false-alarm rate of {args.false_alarm_rate:g}, {low} to {high} of {args.nominal_episodes} nominal "
        f"episodes raise an alarm by chance (95 %)."
    )
    console.print(f"{headline(rows)} {expected}")
    console.print(
        f"The expert succeeded in {expert.k} of {expert.n} episodes; one observe() takes {latency['median']:.0f} µs."
    )

    with timed("drawing"):
        drawn = draw(rows, folder)
    video = None
    if can_show:
        examples = {(t.kind, t.seed) for t in (typical(m.watched) for m in rows)}
        shown = [t for t in todo if (t.kind, t.seed) in examples]
        with timed("recording a video") as progress:
            video = record_video(shown, RolloutConfig(), memory, folder / "demo.mp4", progress)
    write_json(folder / "demo.json", figures_of(args, rows, expert, latency, seconds))
    write_report(
        folder / "report.html",
        f"asm-gym demo: {args.task}",
        f"A Neural Associative Skill Memory learned what {args.fit_episodes} nominal episodes feel like and then "
        f"watched others, some of them faulty. {headline(rows)} {expected}",
        [table],
        drawn,
        video,
        {"command": f"asm-gym demo --seed {args.seed}", **asdict(args), "observe() [µs]": latency},
    )
    console.print(f"Wrote {folder}/report.html" + (f" and {video}" if video else ""))


def main(argv: list[str] | None = None) -> int:
    """Runs the demo, and returns the exit code."""
    return run("demo", Args, demonstrate, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
