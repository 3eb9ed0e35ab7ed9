"""Records a policy's episodes, in worker processes; as a command, into a Minari dataset.

Every episode is a file of its own as soon as it has ended: a run that is killed loses those that were running, and the
same command goes on with the rest.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
from rich.console import Console

from asm_gym.data.datasets import require_minari, write_dataset
from asm_gym.episode import Episode, load_episode
from asm_gym.rollouts.collect import check, collect_to
from asm_gym.rollouts.parallel import ParallelConfig
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import claimed, versions
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.scripts.command import run
from asm_gym.scripts.options import check_options, option
from asm_gym.tasks import ROBOTS, TASKS, env_id


@dataclass(frozen=True)
class Args:
    """Episodes of a policy, as a Minari dataset."""

    task: str = option("Lift", positional=True, check=env_id, listed=TASKS, metavar="TASK")
    """Name of a task, or any Gymnasium id whose spaces are numbers, such as Pusher-v5."""
    policy: str = "scripted"
    """What acts: scripted, hold, sway, a shipped agent, or the path of one."""
    robot: str | None = option(None, known=ROBOTS)
    """The arm; the task's own by default."""
    episodes: int = option(100, quick=4, least=1)
    """How many; a second call with more of them goes on."""
    only_successful: bool = False
    """Leave episodes that failed out of the dataset."""
    workers: str = option("2", check=ParallelConfig.named, metavar="N")
    """Processes; or a cluster that is running, as dask:tcp://host:8786 or ray:host:6379, which shares the folder."""
    seed: int = option(0, least=0)
    """Seed of all that is drawn: the same seed gives the same episodes."""
    out: Path = option(Path("runs/collect"), metavar="FOLDER")
    """Folder of the episodes and of the dataset."""
    quick: bool = False
    """To see that everything runs."""

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def parallel(self) -> ParallelConfig:
        """Who does the work."""
        return ParallelConfig.named(self.workers)

    @property
    def env_id(self) -> str:
        return env_id(self.task)

    @property
    def dataset_id(self) -> str:
        """Minari's name of the dataset."""
        name = self.env_id.rsplit(":", 1)[-1].rsplit("/", 1)[-1].rsplit("-v", 1)[0].lower()
        return f"asm_gym/{name}-{Path(self.policy).stem}-v0"

    @property
    def config(self) -> RolloutConfig:
        """How the episodes are made."""
        return RolloutConfig(self.policy, self.robot)


def assemble(args: Args, files: list[Path]) -> tuple[Path, list[Episode]]:
    """The dataset of recorded episodes, and what of them went into it."""
    episodes = [load_episode(file) for file in files]
    kept = [e for e in episodes if e.success or not args.only_successful]
    if not kept:
        raise ValueError(f"none of {len(episodes)} episodes succeeded, so none is left for the dataset")
    details = {"algorithm_name": args.policy, "versions": versions(), "settings": dict(args.config.settings)}
    env = gym.make(args.env_id, **dict(args.config.settings))
    try:
        return write_dataset(args.out, args.dataset_id, kept, env, details), kept
    finally:
        env.close()


def record(args: Args, console: Console) -> tuple[Path, list[Episode]]:
    """Records the episodes that are not there yet, and writes the dataset of all."""
    claim = {"env_id": args.env_id, "policy": args.policy, "settings": dict(args.config.settings), "seed": args.seed}
    with claimed(args.out, "collect.json", claim):
        with stage("recording", console, {}) as progress:
            seeds = episode_seeds(args.seed, args.episodes)
            files = collect_to(args.out / "episodes", args.env_id, args.config, seeds, args.parallel, progress)
        return assemble(args, files)


def record_and_report(args: Args, console: Console) -> None:
    """Records, and says where the episodes are."""
    require_minari()
    check(args.env_id, args.config)
    folder, kept = record(args, console)
    steps = sum(map(len, kept))
    console.print(f"{len(kept)} episodes, {steps} steps, {sum(e.success for e in kept)} successful: {folder}")
    console.print(f"MINARI_DATASETS_PATH={args.out} lets minari.load_dataset({args.dataset_id!r}) find it")


def main(argv: list[str] | None = None) -> int:
    """Records, and returns the exit code."""
    return run("collect", Args, record_and_report, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
