"""Films episodes with the surprise under the picture."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from asm_gym.evaluation.video import write_video
from asm_gym.faults import Fault
from asm_gym.monitors import Monitor
from asm_gym.policies import make_policy, rollout
from asm_gym.rollouts.parallel import Progress
from asm_gym.scripts import doctor
from asm_gym.wrappers import FaultInjection, NeuralASMSafety, SurpriseOverlay


@dataclass(frozen=True)
class Scene:
    """One episode to film.

    Args:
        env_id: such as ``asm_gym/Lift-v0``.
        caption: what to write over it.
        seed: of the environment and of the policy.
        faults: what goes wrong in that environment.
        on_alarm: as in ``NeuralASMSafety``.
        steps: where to cut; None for the whole episode.
        policy: what acts.
        robot: the arm.
    """

    env_id: str
    caption: str
    seed: int
    faults: Callable[[Any], Sequence[Fault]]
    on_alarm: str = "monitor"
    steps: int | None = None
    policy: str = "scripted"
    robot: str = "Panda"


def prepare_film(console: Console) -> bool:
    """Whether this machine can render and encode; says what it lacks, and the command that installs it."""
    needed = (doctor.rendering(), doctor.encoder())
    for check in needed:
        if not check.ok:
            console.print(f"[yellow]{check.detail}. To have one: {check.remedy}[/yellow]")
    if doctor.rendering_backend() == "osmesa":
        os.environ["MUJOCO_GL"] = "osmesa"  # before this process loads robosuite, which would choose EGL
    return all(check.ok for check in needed)


def film(scenes: Sequence[Scene], monitor: Monitor, path: Path, progress: Progress) -> Path:
    """A video of the scenes, one after the other, as a calibrated monitor saw them."""

    def frames() -> Iterator[NDArray[np.uint8]]:
        for k, scene in enumerate(scenes):
            yield from _pictures(scene, monitor)
            progress(k + 1, len(scenes))

    return write_video(path, frames(), fps=1.0 / monitor.spec.dt)


def _pictures(scene: Scene, monitor: Monitor) -> list[NDArray[np.uint8]]:
    base = gym.make(
        scene.env_id, robot=scene.robot, render_mode="rgb_array", camera="agentview", render_size=(512, 640)
    )
    faulty = FaultInjection(base, scene.faults(base.unwrapped))
    guarded = NeuralASMSafety(faulty, monitor, on_alarm=scene.on_alarm, on_overrun="ignore")
    watched = SurpriseOverlay(guarded, caption=scene.caption)
    pictures: list[NDArray[np.uint8]] = []

    def take(_: dict[str, Any]) -> None:
        pictures.append(watched.render())

    try:
        policy = make_policy(scene.policy, watched, seed=scene.seed)
        rollout(watched, policy, scene.seed, take, scene.steps)
    finally:
        watched.close()
    return pictures
