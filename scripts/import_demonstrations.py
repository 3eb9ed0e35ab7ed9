"""Reads robosuite's or robomimic's HDF5 demonstrations into a Minari dataset, their states replayed in the simulator.

The stream has the groups ``joint``, ``hand`` and ``action``: what motors and contacts did within a step is in no such
file. A memory of it watches ``gym.make(..., stream=("joint", "hand", "action"))``.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from asm_gym.data.datasets import write_dataset
from asm_gym.envs.demonstrations import recorded_in, replay
from asm_gym.episode import Episode
from asm_gym.rollouts.parallel import Progress
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import versions
from asm_gym.scripts.command import run
from asm_gym.scripts.options import check_options, fixed, option


@dataclass(frozen=True)
class Args:
    """Demonstrations as a Minari dataset."""

    file: Path = option(positional=True, metavar="FILE.hdf5")
    """What robosuite's collect_human_demonstrations or robomimic wrote."""
    seed: int = option(0, least=0)
    """Seed of the sensors' noise."""
    out: Path = option(Path("runs/import"), metavar="FOLDER")
    """Folder of the dataset."""
    sensor_noise: float = fixed(1.0, least=0)
    """Scales the noise of the sensors; 0 for exact readings."""

    def __post_init__(self) -> None:
        check_options(self)


def convert(args: Args, progress: Progress) -> tuple[Path, list[Episode]]:
    """The dataset, and what is in it."""
    recorded = recorded_in(args.file)
    env = recorded.make(args.sensor_noise)
    try:
        episodes = []
        for episode in replay(args.file, recorded, env, args.seed):
            episodes.append(episode)
            progress(len(episodes), len(recorded.demos))
        details = {"algorithm_name": "demonstrations", "versions": versions(), "file": args.file.name}
        name = f"asm_gym/{recorded.task.lower()}-demonstrations-v0"
        return write_dataset(args.out, name, episodes, env, details), episodes
    finally:
        env.close()


def convert_and_report(args: Args, console: Console) -> None:
    """Converts, and says what came of it."""
    with stage("replaying", console, {}) as progress:
        folder, episodes = convert(args, progress)
    console.print(f"{len(episodes)} episodes, {sum(e.success for e in episodes)} successful: {folder}")


def main(argv: list[str] | None = None) -> int:
    """Reads demonstrations, and returns the exit code."""
    return run("import", Args, convert_and_report, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
