"""``asm-gym benchmark watch``: whether ``asm-gym watch`` keeps up with a robot, and whether it grows."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console
from rich.progress import track

from asm_gym.episode import Episode
from asm_gym.monitors import NeuralASM
from asm_gym.rollouts.collect import collect
from asm_gym.scripts.benchmark.memory import synthetic
from asm_gym.scripts.benchmark.turns import GROWTH, resident
from asm_gym.scripts.command import BAD_NEWS, DONE
from asm_gym.validation import check_number

TENTHS = 10
SAMPLES = 10
"""Times that memory is looked at within a tenth of the rows; the largest counts."""


@dataclass
class Watch:
    """Rows come through a pipe as fast as they are taken: what one costs, and whether the process grows."""

    rows: int = 100_000
    """How many; in the first tenth the command starts, which does not count."""
    channels: int | None = None
    """Sensory channels of synthetic rows and a small memory; by default rows of a Panda and its shipped memory."""
    rate: float = 1000.0
    """Rows a second to keep up with, on one core [Hz]."""

    def __post_init__(self) -> None:
        check_number("rows", self.rows, low=10 * TENTHS * SAMPLES, whole=True)

    def run(self, console: Console) -> int:
        """Prints what a row costs, and memory by tenths of the rows; 1 where it does not keep up, or grows."""
        asm, episodes = self._memory()
        lines = [f"{json.dumps(row.tolist())}\n".encode() for episode in episodes for row in episode.stream]
        every = self.rows // (TENTHS * SAMPLES)
        sizes, seconds = [], []
        with TemporaryDirectory() as folder:
            memory = f"{folder}/x.asm"
            asm.with_threshold(0.99 * asm.detection.reach).save(memory)  # that nothing is printed but the end
            command = [sys.executable, "-m", "asm_gym.scripts.watch", "-", "--monitor", memory, "--silence", "1e6"]
            with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as watching:
                assert watching.stdin is not None
                assert watching.stdout is not None
                for number in track(range(1, self.rows + 1), "watching", console=console, transient=True):
                    watching.stdin.write(lines[number % len(lines)])
                    if number % every == 0:
                        sizes.append(resident(watching.pid))
                        seconds.append(processor_time(watching.pid))
                watching.stdin.close()
                console.print(watching.stdout.read().decode().strip())
        peaks = [float(part.max()) for part in np.array_split(sizes, TENTHS)]
        growth = peaks[-1] / peaks[1] - 1
        cost = (seconds[-1] - seconds[SAMPLES - 1]) / (self.rows - SAMPLES * every)  # [s] of a core, for a row
        size = asm.spec.size
        console.print(f"{size} numbers: {1e3 * cost:.3f} ms of a core a row, so {1 / cost:.0f} rows a second")
        console.print("resident memory [MB] by tenths: " + " ".join(f"{peak:.1f}" for peak in peaks))
        console.print(f"growth since the second: {100 * growth:+.1f} %")
        return DONE if 1 / cost > self.rate and growth < GROWTH else BAD_NEWS

    def _memory(self) -> tuple[NeuralASM, list[Episode]]:
        """A memory, and nominal episodes for it."""
        if self.channels is None:
            return NeuralASM.pretrained("panda"), collect("asm_gym/Lift-v0", episodes=10, workers=1)
        episodes = synthetic(self.channels, 14)
        small = NeuralASM(episodes[0].spec, hidden_size=16, association_size=16, epochs=1)
        return small.fit(episodes[:7]).calibrate(episodes[7:], 0.5), episodes


def processor_time(process: int) -> float:
    """What it has used of all cores since its start [s]."""
    after_name = Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(after_name[11]) + int(after_name[12])) / os.sysconf("SC_CLK_TCK")
