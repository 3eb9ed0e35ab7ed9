"""Lets reflexes act on the alarms of a memory that an evaluation has fitted: what is gained, what it costs.

Every faulty episode is run with the policy alone and with each reflex, paired by seed, on the real simulator. Reads the
folder of ``asm-gym evaluate`` for nominal episodes to learn from and to calibrate on. A command that was stopped
goes on where it was: traces are kept under ``--out``.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from asm_gym.episode import Episode, EpisodeLabel, load_episode
from asm_gym.evaluation.contact import QUASI_STATIC
from asm_gym.evaluation.scored import IDEAL, NOMINAL, POLICY_ALONE, ScoredEpisode
from asm_gym.evaluation.tables import Table, console_table, markdown
from asm_gym.faults.suite import KINDS
from asm_gym.files import written_whole
from asm_gym.monitors import NeuralASM, pretrained
from asm_gym.policies.registry import agents
from asm_gym.rollouts.collect import check
from asm_gym.rollouts.parallel import TWO_PROCESSES, ParallelConfig, Progress
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.record import record
from asm_gym.rollouts.run_folder import claimed, files_in, locked, make_missing, versions
from asm_gym.rollouts.scoring import LEARNING, code_digest, fitted
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.substeps import band_of_task
from asm_gym.rollouts.trial import PASSING, SPINAL, RolloutConfig, Trial
from asm_gym.rollouts.watch import watch, watch_each
from asm_gym.scripts.command import at_least, run
from asm_gym.scripts.reproduce.reflexes_report import comparisons, row, table
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_choice
from asm_gym.wrappers.factory import ON_ALARM

AGENTS = "agents"
"""As a policy: of each task the agent that was trained in it."""

FAULTS = (NOMINAL, PASSING, "collision", "held_by_person", "stuck_joint", "encoder_bias")

DECIDING = (
    *("tasks", "robot", "policy", "reflexes", "monitor_freq", "fit_episodes", "calibration_episodes"),
    *("max_override_s", "false_alarm_rate", "seed"),
)
"""Arguments that decide over an episode."""


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
    """Names of reflexes: what the safety wrapper does on an alarm; with +spinal behind it, such as graded+spinal, above
    a band on what the arm feels, which is learned first from nominal episodes of each task."""
    faults: tuple[str, ...] = FAULTS
    """nominal, passing_push (20 N for 0.3 s), or kinds of the suite, which are strong."""
    episodes: int = 12
    """Episodes of each task, fault and reflex."""
    monitor_freq: int | None = None
    """Rows watched a second [Hz], for reflexes within control steps; nominal episodes are then recorded here."""
    fit_episodes: int = 60
    """Nominal episodes of each task to learn from, with a monitor_freq or for bands."""
    calibration_episodes: int = 60
    """Other nominal episodes of each task, to calibrate on."""
    region: str = "hand"
    """Region of a person's body by whose permissible forces contacts are judged."""
    max_override_s: float = 3.0
    """How long a reflex may act at a stretch before the episode is ended [s]."""
    false_alarm_rate: float = 0.01
    """Share of nominal episodes that may raise an alarm, of a memory that learns here, and of a band."""
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
            check_choice("reflex", name.removesuffix(SPINAL), ON_ALARM)
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
        band = self.folder / f"{task}.band" if self.spinal else None
        return RolloutConfig(policy, self.robot, self.monitor_freq, self.max_override_s, band=band)

    @property
    def spinal(self) -> bool:
        """Whether bands are needed."""
        return any(name.endswith(SPINAL) for name in self.reflexes)

    @property
    def folder(self) -> Path:
        """Where traces and bands of these settings and this code are kept, so that a stopped command goes on."""
        given = self.memory or str(self.run)
        memory = sha256(Path(given).read_bytes()).hexdigest() if Path(given).is_file() else given
        code = code_digest(names=(*LEARNING, "envs", "faults", "policies", "rollouts", "wrappers"))
        settings = memory, code, versions(), [getattr(self, name) for name in DECIDING]
        digest = sha256(json.dumps(settings, default=str).encode()).hexdigest()
        return self.out.resolve() / "traces" / digest[:12]


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


def make_band(task: str, args: Args, memory: Path) -> Path:
    """Learns what the arm feels in a task, and writes it where its reflexes look for it."""
    counts = args.fit_episodes, args.calibration_episodes
    band = band_of_task(NeuralASM.load(memory), task, args.config(task), counts, args.false_alarm_rate, args.seed)
    path = args.folder / f"{task}.band"
    band.save(path)
    return path


def trials(args: Args) -> list[Trial]:
    """Every episode with the policy alone, those that share a task and a seed side by side."""
    return [
        Trial(task_spec(task).id, seed, fault, "" if fault in (NOMINAL, PASSING) else "strong")
        for task in args.tasks
        for seed in role_seeds(args.seed, task, "react", args.episodes)
        for fault in args.faults
    ]


def place(trial: Trial, folder: Path) -> Path:
    """Where the traces of a trial are kept."""
    return folder / f"{trial.task}-{trial.seed}-{trial.kind}.json"


def kept(trial: Trial, folder: Path) -> list[ScoredEpisode]:
    """The traces of a trial that was run."""
    return [ScoredEpisode.from_json(line) for line in place(trial, folder).read_text(encoding="utf-8").splitlines()]


def run_trial(trial: Trial, args: Args, memory: Path) -> Path:
    """Runs a trial with the policy alone and with every reflex, and keeps the traces."""
    config, folder = args.config(trial.task), args.folder
    nominal = replace(trial, kind=NOMINAL, severity="")

    @cache
    def undisturbed() -> ScoredEpisode:
        known = kept(nominal, folder)[:1] if place(nominal, folder).is_file() else []
        return known[0] if known else watch(nominal, config, memory)

    traces = watch_each(trial, (POLICY_ALONE, IDEAL, *args.reflexes), config, memory, undisturbed)
    with written_whole(place(trial, folder)) as file:
        file.write("\n".join(trace.to_json() for trace in traces).encode())
    return place(trial, folder)


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
    if args.spinal:
        with stage("learning what is felt", console, seconds) as progress:
            feel = partial(make_band, args=args, memory=memory.resolve())
            make_missing(feel, args.tasks, lambda task: args.folder / f"{task}.band", args.parallel, progress)
    with stage("acting", console, seconds) as progress:
        make = partial(run_trial, args=args, memory=memory.resolve())
        tried = trials(args)
        make_missing(make, tried, lambda trial: place(trial, args.folder), args.parallel, progress)
    traces = [trace for trial in tried for trace in kept(trial, args.folder)]
    found = comparisons(traces, args)
    made = table(found, args)
    (args.out / "reactions.md").write_text(markdown(made) + "\n", encoding="utf-8")
    content = {
        "settings": json.loads(json.dumps(asdict(args), default=str)),
        "seconds": seconds,
        "episodes": [row(trace) for trace in traces],
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
