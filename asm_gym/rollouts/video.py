"""A video of trials with the surprise under the picture."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from asm_gym.evaluation.film import write_video
from asm_gym.graphics import GET_ENCODER, GET_RENDERING, encoder_problem, rendering_backend, rendering_problem
from asm_gym.monitors import Monitor
from asm_gym.rollouts.parallel import Progress
from asm_gym.rollouts.staging import play, staged
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.rollouts.watch import guarded
from asm_gym.wrappers import SurpriseOverlay

PICTURE: dict[str, Any] = {"render_mode": "rgb_array", "camera": "frontview", "render_size": (512, 640)}


@dataclass(frozen=True)
class Clip:
    """One episode to show.

    Args:
        trial: what is run.
        caption: what to write over it.
    """

    trial: Trial
    caption: str


def can_record_video(console: Console) -> bool:
    """Whether this machine can render and encode; says what it lacks, and the command that installs it."""
    missing = {p: remedy for p, remedy in ((rendering_problem(), GET_RENDERING), (encoder_problem(), GET_ENCODER)) if p}
    for problem, remedy in missing.items():
        console.print(f"[yellow]{problem}. To have one: {remedy}[/yellow]")
    if rendering_backend() == "osmesa":
        os.environ["MUJOCO_GL"] = "osmesa"  # before this process loads robosuite, which would choose EGL
    return not missing


def record_video(
    clips: Sequence[Clip], config: RolloutConfig, monitor: Monitor, path: Path, progress: Progress
) -> Path:
    """A video of the clips, one after the other, as a calibrated monitor saw them."""

    def frames() -> Iterator[NDArray[np.uint8]]:
        for k, clip in enumerate(clips):
            yield from _frames(clip, config, monitor)
            progress(k + 1, len(clips))

    return write_video(path, frames(), fps=1.0 / monitor.spec.dt)


def _frames(clip: Clip, config: RolloutConfig, monitor: Monitor) -> list[NDArray[np.uint8]]:
    env = gym.make(clip.trial.env_id, **dict(config.settings), **PICTURE)
    frames: list[NDArray[np.uint8]] = []
    try:
        with staged(clip.trial, config, env) as faulty:
            watched = SurpriseOverlay(
                guarded(faulty, monitor, clip.trial), caption=clip.caption, camera=PICTURE["camera"]
            )
            play(clip.trial, config, watched, lambda _: frames.append(watched.render()))
    finally:
        env.close()
    return frames
