"""Lets reflexes act on the alarms of a memory that an evaluation has fitted: what is gained, what it costs.

Every faulty episode is run with the policy alone and with each reflex, paired by seed, on the real simulator. Reads the
folder of ``asm-gym evaluate`` for nominal episodes to learn from and to calibrate on.
"""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import tyro
from rich.console import Console

from asm_gym.choices import check_choice
from asm_gym.episodes import Episode, EpisodeLabel, load_episode
from asm_gym.evaluation.contact import QUASI_STATIC, within_limits
from asm_gym.evaluation.intervention import Comparison, IdealShare, compare, share_of_ideal
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.tables import Table, console_table, markdown
from asm_gym.evaluation.trace import IDEAL, NOMINAL, POLICY_ALONE, Trace
from asm_gym.faults.suite import KINDS
from asm_gym.monitors import NeuralASM, pretrained
from asm_gym.policies.registry import agents
from asm_gym.rollouts.benchmark import fitted
from asm_gym.rollouts.collect import check
from asm_gym.rollouts.folder import claimed, files_in, locked, make_missing
from asm_gym.rollouts.parallel import TWO_PROCESSES, ParallelConfig, Progress, parallel_map
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.trial import PASSING, RolloutConfig, Trial, record, watch_each
from asm_gym.scripts.command import at_least, run
from asm_gym.tasks import task as task_spec
from asm_gym.wrappers.arguments import ON_ALARM

AGENTS = "agents"
"""As a policy: of each task the agent that was trained in it."""

FAULTS = (NOMINAL, PASSING, "collision", "held_by_person", "stuck_joint", "encoder_bias")


@dataclass(frozen=True)
class Args:
    """Reflexes x faults: success, force, and time in alarm, against the policy alone."""

    run: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/evaluate")
    """Folder of an evaluation, whose nominal episodes the memory learns from at the control rate."""
    memory: str | None = None
    """A calibrated memory to watch with, in place of one that learns from the evaluation's recordings: the body whose
    memory ships, such as panda, or a path."""
    tasks: tuple[str, ...] = ("Lift", "Stack", "PickPlaceCan", "Door")
    """Names of tasks; at the control rate the evaluation must have recorded them."""
    robot: str = "Panda"
    """The arm."""
    policy: str = "scripted"
    """What acts: scripted, agents for the shipped agent of each task, or the path of an agent."""
    reflexes: tuple[str, ...] = ("hold", "retract", "comply", "recall", "graded", "terminate")
    """Names of reflexes: what the safety wrapper does on an alarm."""
    faults: tuple[str, ...] = FAULTS
    """nominal, passing_push (20 N for 0.3 s), or kinds of the suite, which are strong."""
    episodes: int = 12
    """Episodes of each task, fault and reflex."""
    monitor_freq: int | None = None
    """Rows watched a second [Hz], for reflexes within control steps; nominal episodes are then recorded here."""
    fit_episodes: int = 60
    """Nominal episodes of each task to learn from, with a monitor_freq."""
    calibration_episodes: int = 60
    """Other nominal episodes of each task, to calibrate on."""
    region: str = "hand"
    """Region of a person's body by whose permissible forces contacts are judged."""
    max_override_s: float = 3.0
    """How long a reflex may act at a stretch before the episode is ended [s]."""
    false_alarm_rate: float = 0.01
    """Share of nominal episodes that may raise an alarm."""
    parallel: tyro.conf.OmitArgPrefixes[ParallelConfig] = TWO_PROCESSES
    """Who does the work."""
    seed: int = 0
    """Seed of the evaluation, of the memory and of the episodes."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/react")
    """Folder of the results."""

    def __post_init__(self) -> None:
        for task in self.tasks:
            task_spec(task)
        for name in self.reflexes:
            check_choice("reflex", name, ON_ALARM)
        check_choice("region of the body", self.region, QUASI_STATIC)
        for name in self.faults:
            check_choice("fault", name, (NOMINAL, PASSING, *KINDS))
        at_least(1, self, "episodes", "fit_episodes", "calibration_episodes")
        if self.memory is not None and self.monitor_freq is not None:
            raise ValueError("with a memory of its own no episodes are recorded: leave out monitor_freq")
        if not self.max_override_s > 0:
            raise ValueError(f"max_override_s must be > 0, got {self.max_override_s}")

    def config(self, task: str) -> RolloutConfig:
        """How the episodes of a task are made."""
        policy = self.policy
        if policy == AGENTS:
            policy = next((name for name in agents() if name.startswith(f"{task.lower()}_")), policy)
        return RolloutConfig(policy, self.robot, self.monitor_freq, self.max_override_s)


def learned_from(args: Args) -> NeuralASM:
    """The memory, fitted and calibrated on what the evaluation recorded of these tasks.

    Raises:
        ValueError: it recorded too little.
    """

    folder = args.run if args.monitor_freq is None else args.out

    def role(name: str) -> list[Episode]:
        paths = files_in(folder, args.tasks, name)
        return [e for e in map(load_episode, paths) if e.success]

    fit = role("fit")
    if not fit:
        raise ValueError(f"{args.run} has no recordings of {', '.join(args.tasks)}: run asm-gym evaluate first")
    memory = fitted(args.out, "neural_asm", fit, args.seed)
    assert isinstance(memory, NeuralASM)
    return memory.calibrate(role("calibration"), args.false_alarm_rate)


def record_nominal(args: Args, progress: Progress) -> None:
    """Records nominal episodes at ``monitor_freq``, those that are not there yet."""
    roles = {"fit": args.fit_episodes, "calibration": args.calibration_episodes}
    wanted = [
        EpisodeLabel(task, role, seed=s)
        for task in args.tasks
        for role, n in roles.items()
        for s in role_seeds(args.seed, task, role, n)
    ]
    make = partial(_record, args=args)
    make_missing(make, wanted, lambda label: args.out / label.path, args.parallel, progress)


def _record(label: EpisodeLabel, args: Args) -> Path:
    return record(label, args.config(label.task), args.out.resolve())


def trials(args: Args) -> list[Trial]:
    """Every episode with the policy alone, those that share a task and a fault side by side."""
    return [
        Trial(task_spec(task).id, seed, fault, "" if fault in (NOMINAL, PASSING) else "strong")
        for task in args.tasks
        for fault in args.faults
        for seed in role_seeds(args.seed, task, "react", args.episodes)
    ]


class Measured(NamedTuple):
    """What became of one reflex under one fault, over all tasks."""

    comparison: Comparison
    ideal: IdealShare
    harmless: Share  # contacts within the limits
    settled: Share  # episodes that were solved, or ended by the wrapper
    named: Counter[str]  # families of causes at the first alarm


def comparisons(traces: Sequence[Trace], args: Args) -> list[Measured]:
    """Each reflex under each fault, over all tasks."""

    def of(fault: str, acting: str) -> list[Trace]:
        return [t for t in traces if (t.kind, t.acting) == (fault, acting)]

    def measured(fault: str, reflex: str) -> Measured:
        alone, acted = of(fault, POLICY_ALONE), of(fault, reflex)
        ideal = share_of_ideal(alone, acted, of(fault, IDEAL))
        named = Counter(t.outcome.cause for t in acted if t.outcome.cause)
        contacts = within_limits([t.outcome.contact for t in acted], args.region)
        settled = Share.of([t.outcome.success or t.outcome.ended_by_alarm for t in acted])
        return Measured(compare(alone, acted, args.seed), ideal, contacts, settled, named)

    return [measured(fault, reflex) for fault in args.faults for reflex in (*args.reflexes, IDEAL)]


def table(found: Sequence[Measured], args: Args) -> Table:
    """A row for each fault and reflex."""
    headings = (
        *("Fault", "Reflex", "Success", "alone", "gained", "Peak force less by", "Impulse less by"),
        *("Of the ideal reflex's", "Within limits", "Solved or ended", "Median delay [ms]", "Cause named"),
    )
    rows = [
        (
            c.kind.replace("_", " "),
            c.acting,
            f"{100 * c.success.value:.0f} %",
            f"{100 * c.alone.value:.0f} %",
            c.gained.percent(),
            c.peak.percent() if c.kind != NOMINAL else "",
            c.impulse.percent() if c.kind != NOMINAL else "",
            " / ".join("" if math.isnan(share) else f"{share:.2f}" for share in asdict(m.ideal).values()),
            f"{m.harmless.k} of {m.harmless.n}",
            f"{m.settled.k} of {m.settled.n}",
            "" if c.kind == NOMINAL else f"{c.median_delay_ms:.0f}" if math.isfinite(c.median_delay_ms) else "missed",
            ", ".join(f"{family} {n}" for family, n in m.named.most_common(3)),
        )
        for m in found
        for c in (m.comparison,)
    ]
    return Table(
        f"Reflexes against the policy alone, paired by seed. {args.episodes} episodes of each of "
        f"{', '.join(args.tasks)}, {args.policy}. Force is that on the arm from outside while the fault lasts. "
        "Brackets hold 95 % bootstrap intervals. The ideal reflex is told of the fault. It stays from the first "
        "physics substep of a contact to its end, and its senses are never at fault. Shares of what it gains are of "
        "success / peak / impulse, from the policy alone (0) to it (1). Within limits: contacts under the forces of "
        "ISO/TS 15066 for "
        f"the {args.region}, which is no claim of conformity.",
        headings,
        rows,
    )


def _row(trace: Trace) -> dict[str, Any]:
    """An episode as it is written down."""
    return {
        "task": trace.task,
        "fault": trace.kind,
        "acting": trace.acting,
        "seed": trace.seed,
        "success": trace.outcome.success,
        "peak_force": trace.outcome.external_force,
        "impulse": trace.outcome.impulse,
        "alarm_s": float(trace.alarm.sum() * trace.dt),
        "acted_s": trace.outcome.acted_s,
        "delay_ms": None if trace.delay is None else 1e3 * trace.delay,
        "ended": trace.outcome.ended_by_alarm,
        "contact": list(trace.outcome.contact),
        "cause": trace.outcome.cause,
        "part": trace.outcome.part,
    }


def _watch(trial: Trial, args: Args, memory: Path) -> list[Trace]:
    return watch_each(trial, (POLICY_ALONE, IDEAL, *args.reflexes), args.config(trial.task), memory)


def memory_of(named: str) -> NeuralASM:
    """The memory that ships with a body, or one that was saved."""
    return NeuralASM.pretrained(named) if named in pretrained() else NeuralASM.load(named)


def react(args: Args, console: Console) -> Table:
    """Fits, runs, compares and writes."""
    for task in args.tasks:
        check(task_spec(task).id, args.config(task))  # what does not fit is refused before anything runs
    settings = {"robot": args.robot, "policy": args.policy, "seed": args.seed, "monitor_freq": args.monitor_freq}
    with claimed(args.out, "recordings.json", settings) if args.monitor_freq is not None else locked(args.out):
        return _react(args, console)


def _react(args: Args, console: Console) -> Table:
    seconds: dict[str, float] = {}
    if args.monitor_freq is not None:
        with stage("recording", console, seconds) as progress:
            record_nominal(args, progress)
    memory = args.out / "memory.asm"
    with stage("fitting and calibrating", console, seconds):
        (learned_from(args) if args.memory is None else memory_of(args.memory)).save(memory)
    with stage("acting", console, seconds) as progress:
        run = partial(_watch, args=args, memory=memory.resolve())
        traces = [trace for each in parallel_map(run, trials(args), args.parallel, progress) for trace in each]
    found = comparisons(traces, args)
    made = table(found, args)
    (args.out / "reactions.md").write_text(markdown(made) + "\n", encoding="utf-8")
    content = {
        "settings": json.loads(json.dumps(asdict(args), default=str)),
        "seconds": seconds,
        "episodes": [_row(trace) for trace in traces],
    }
    (args.out / "reactions.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return made


def react_and_report(args: Args, console: Console) -> None:
    """Compares, and prints the table."""
    made = react(args, console)
    console.print(console_table(made, left=2))
    console.print(f"Wrote {args.out / 'reactions.md'} and {args.out / 'reactions.json'}")


def main(argv: list[str] | None = None) -> int:
    """Compares, and returns the exit code."""
    return run("reproduce reflexes", Args, react_and_report, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
