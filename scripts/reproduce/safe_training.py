"""Trains the same agent alone and under the safety wrapper: fewer violations on the way, as much success in the end?

An untrained actor learns by SAC with demonstrations in its replay buffer: alone; where an alarm costs reward and ends
the episode; and where the robot holds on an alarm. The memory knows harmless exploration, in which none of the runs
takes part; or it is a shipped memory of the body (``--memory panda``), and nothing is recorded for it. A run can be
killed at any time: what has been recorded, fitted or trained is not made again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from asm_gym.detection import conformal_episodes
from asm_gym.monitors import NeuralASM, load_monitor, pretrained
from asm_gym.monitors.shipped import pretrained_file
from asm_gym.rollouts.collect import collect_to
from asm_gym.rollouts.run_folder import claimed, make_missing
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.training.exploration import Gentle, explore, harmless
from asm_gym.rollouts.training.outcome import COUNTED, TrainingOutcome
from asm_gym.rollouts.training.safe_run import ALONE, CONDITIONS, Setting, outcome_file, read_outcome
from asm_gym.rollouts.training.safe_run import run as train
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.scripts.options import fixed, option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.training_report import counts_table, learning_figure, worth_table
from asm_gym.tasks import task as task_spec

DEMONSTRATIONS, FITTING = 11, 12
"""Stages of the seeds of episodes that are recorded."""
FREE = ("seeds", "conditions", "workers", "out", "quick")
"""What may change while a comparison goes on."""


@dataclass(frozen=True)
class Config(kit.Config):
    """Training alone against training under the wrapper, paired by seed."""

    seeds: int = option(5, quick=2, least=1)
    """Runs of each condition."""
    out: Path = option(Path("runs/train_safely"), metavar="FOLDER")
    """Folder of the comparison."""
    task: str = option("Lift", check=task_spec)
    """Name of a task with a scripted expert, whose contacts are gentle."""
    conditions: tuple[str, ...] = option(tuple(CONDITIONS), known=CONDITIONS, metavar="NAME")
    """What to compare; alone must be among them."""
    memory: str | None = option(None, metavar="MEMORY")
    """What watches: the name of a shipped memory, or the path of one; by default one of exploration is made."""
    steps: int = option(2_500, quick=600, least=1)
    """Control steps of each run."""
    final_episodes: int = option(100, quick=2, least=1)
    """Episodes of the last evaluation."""
    harmless_torque: float = option(10.0)
    """External torque on a joint above which exploration is not harmless [N m]: arms that hit themselves, joints at
    stops."""
    harmless_force: float = fixed(20.0)
    """External force above which it is not [N]."""
    demonstrations: int = fixed(50, quick=9)
    """Episodes of the expert in the replay buffer."""
    fit_episodes: int = fixed(120, quick=10)
    """Episodes of exploration that the memory learns from."""
    calibration_episodes: int = fixed(60, quick=9)
    """Other episodes of exploration that its threshold is set on."""
    false_alarm_rate: float = fixed(0.05, quick=0.2, check=conformal_episodes)
    """Share of harmless episodes of exploration that may raise an alarm."""
    force_limit: float = fixed(40.0)
    """External force above which a contact is a violation [N]."""
    cost: float = fixed(1.0)
    """What an alarm takes off the reward where it ends the episode."""
    evaluate_every: int = fixed(500, quick=300)
    """Control steps between evaluations."""
    evaluation_episodes: int = fixed(10, quick=1)
    """Episodes of each evaluation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if ALONE not in self.conditions:
            raise ValueError(f"conditions must hold {ALONE}, which the others are compared with")
        if not self.harmless_torque > 0:
            raise ValueError(f"harmless_torque must be > 0, got {self.harmless_torque}")
        if self.memory is not None and self.memory not in pretrained():
            load_monitor(self.memory)  # refused before anything runs

    @property
    def setting(self) -> Setting:
        """What all runs share."""
        names = ("steps", "evaluate_every", "evaluation_episodes", "final_episodes", "force_limit", "cost")
        return Setting(task_spec(self.task).id, **{name: getattr(self, name) for name in names})


def demonstrations(config: Config) -> list[Path]:
    """Episodes of the expert, recorded where they are not there yet."""
    folder, seeds = (
        config.out.resolve() / "episodes" / "expert",
        episode_seeds(config.seed, config.demonstrations, DEMONSTRATIONS),
    )
    with kit.stage("recording the expert") as tell:
        return collect_to(folder, config.setting.env_id, RolloutConfig(), seeds, config.workers, tell)


def memory_of(config: Config) -> Path:
    """The memory that watches: one that is there, or one of exploration, made where it is not yet."""
    if config.memory is not None:
        return pretrained_file(config.memory) if config.memory in pretrained() else Path(config.memory)
    path, folder = (config.out.resolve() / name for name in ("exploration.asm", "episodes/exploration"))
    gentle = Gentle(config.harmless_force, config.harmless_torque)
    make = partial(explore, env_id=config.setting.env_id, gentle=gentle, folder=folder)
    seeds = episode_seeds(config.seed, config.fit_episodes + config.calibration_episodes, FITTING)
    with kit.stage("exploring") as tell:
        explored = make_missing(make, seeds, lambda seed: folder / f"{seed}.npz", config.workers, tell)
    if not path.is_file():
        fit, calibration = (
            harmless(part) for part in (explored[: config.fit_episodes], explored[config.fit_episodes :])
        )
        if not fit:
            raise ValueError(f"no episode stays harmless for long enough: is {config.task} done gently?")
        with kit.stage("fitting"):
            memory = NeuralASM(fit[0].spec, seed=config.seed, epochs=5 if config.quick else 40).fit(fit)
            memory.calibrate(calibration, config.false_alarm_rate).save(path)
    return path


def trained(config: Config, memory: Path, expert: Sequence[Path]) -> list[TrainingOutcome]:
    """Every condition at every seed; those that are there already are not run again."""
    jobs, folder = [(c, seed) for seed in config.repetitions for c in config.conditions], config.out.resolve()
    make = partial(train, setting=config.setting, memory=memory, demonstrations=expert, folder=folder / "outcomes")
    with kit.stage("training") as tell:
        made = make_missing(make, jobs, lambda job: outcome_file(folder / "outcomes", job), config.workers, tell)
    return [read_outcome(path) for path in made]


def run(config: Config) -> kit.Findings:
    """Records, fits, trains and compares."""
    with claimed(config.out, "train_safely.json", {k: v for k, v in asdict(config).items() if k not in FREE}):
        every = trained(config, memory_of(config), demonstrations(config))
    outcomes = {c: [o for o in every if o.condition == c] for c in config.conditions}
    records = [
        {"condition": o.condition, "seed": o.seed, "steps": o.steps, "success": o.success}
        | {name: sum(getattr(o, name)) for name in COUNTED}
        for o in every
    ]
    tables = [counts_table(outcomes, config.force_limit), worth_table(outcomes, ALONE, config.force_limit)]
    facts = {"runs": [asdict(o) for o in every]}
    return kit.Findings(records, tables, learning_figure(outcomes, config.force_limit), facts)
