"""Run trials under the safety wrapper: score them, or film them with the surprise under the picture."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
from rich.console import Console

from asm_gym.evaluation.scored_episode import POLICY_ALONE, InterventionOutcome, ScoredEpisode, TraceDetail
from asm_gym.graphics import GET_ENCODER, GET_RENDERING, encoder_problem, rendering_backend, rendering_problem
from asm_gym.monitors import Monitor, NeuralASM
from asm_gym.rollouts.parallel import Progress
from asm_gym.rollouts.staging import play, staged
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.wrappers import NeuralASMSafety, SurpriseOverlay

PICTURE: dict[str, Any] = {"render_mode": "rgb_array", "camera": "frontview", "render_size": (512, 640)}


@lru_cache(maxsize=1)
def _memory(path: Path, written_ns: int) -> NeuralASM:
    """Load once a process, and again when the file has changed."""
    return NeuralASM.load(path)


def _guarded(env: gym.Env[Any, Any], monitor: Monitor, trial: Trial) -> gym.Env[Any, Any]:
    return NeuralASMSafety(env, monitor, on_alarm=trial.on_alarm, on_overrun="ignore")


def watch(trial: Trial, config: RolloutConfig, memory: Path) -> ScoredEpisode:
    """Run one trial under the guard in this process's environment, and return its scores."""
    monitor = _memory(memory, memory.stat().st_mtime_ns)
    infos: list[dict[str, Any]] = []
    with staged(trial, config) as env:
        success = play(trial, config, _guarded(env, monitor, trial), infos.append)
    asm = [info["asm"] for info in infos]
    rows = len(asm[0]["surprises"])  # of each control step
    fault = np.repeat([bool(info.get("fault")) for info in infos], rows)
    attribution = np.repeat([list(a["attribution"].values()) for a in asm], rows, axis=0)  # the step's greatest
    trace = ScoredEpisode(
        kind=trial.kind,
        severity=trial.severity,
        task=trial.task,
        acting=trial.acting,
        seed=trial.seed,
        dt=monitor.spec.dt,
        threshold=monitor.threshold,
        surprise=np.concatenate([a["surprises"] for a in asm]),
        onset=int(np.argmax(fault)) if fault.any() else None,
        outcome=InterventionOutcome(
            success,
            ended_by_alarm=bool(asm[-1]["gave_up"] or (trial.acting == "terminate" and asm[-1]["alarm"])),
            contact_force=float(np.max([info.get("contact_force", np.nan) for info in infos])),
        ),
        detail=TraceDetail(attribution, monitor.spec.labels, fault),
    )
    return trace.attributed(attribution, monitor.spec.labels)


def watch_pair(trial: Trial, config: RolloutConfig, memory: Path) -> list[ScoredEpisode]:
    """Run one trial with the policy alone, and with its response."""
    return [watch(replace(trial, acting=acting), config, memory) for acting in (POLICY_ALONE, trial.acting)]


def can_record_video(console: Console) -> bool:
    """Return whether this machine can render and encode; print what it lacks, and how to install it."""
    missing = {p: remedy for p, remedy in ((rendering_problem(), GET_RENDERING), (encoder_problem(), GET_ENCODER)) if p}
    for problem, remedy in missing.items():
        console.print(f"[yellow]{problem}. To have one: {remedy}[/yellow]")
    if rendering_backend() == "osmesa":
        os.environ["MUJOCO_GL"] = "osmesa"  # before this process loads robosuite, which would choose EGL
    return not missing


def record_video(
    trials: Sequence[Trial], config: RolloutConfig, monitor: Monitor, path: Path, progress: Progress
) -> Path:
    """Film the trials, one after the other, with the surprise of a calibrated monitor, as H.264 in an MP4."""
    writer: Any = imageio.get_writer(path, fps=1.0 / monitor.spec.dt, macro_block_size=2)
    with closing(writer):
        for k, trial in enumerate(trials):
            _film(trial, config, monitor, writer)
            progress(k + 1, len(trials))
    return path


def _film(trial: Trial, config: RolloutConfig, monitor: Monitor, writer: Any) -> None:
    made = gym.make(trial.env_id, **dict(config.settings), **PICTURE)
    with closing(made), staged(trial, config, made) as faulty:
        guarded = _guarded(faulty, monitor, trial)
        watched = SurpriseOverlay(guarded, caption=trial.kind)
        play(trial, config, watched, lambda _: writer.append_data(watched.render()))
