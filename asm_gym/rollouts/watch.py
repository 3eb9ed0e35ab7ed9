"""Runs an episode under the safety wrapper, and keeps what the memory and the response made of it."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from asm_gym.evaluation.scored_episode import POLICY_ALONE, InterventionOutcome, ScoredEpisode, TraceDetail
from asm_gym.monitors import Monitor, NeuralASM
from asm_gym.rollouts.staging import play, staged
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.wrappers import NeuralASMSafety


@lru_cache(maxsize=1)
def _memory(path: Path, written_ns: int) -> NeuralASM:
    """Loaded once a process, and again when the file has been written anew."""
    return NeuralASM.load(path)


def guarded(env: gym.Env[Any, Any], monitor: Monitor, trial: Trial) -> gym.Env[Any, Any]:
    """``env`` under the safety wrapper, which acts as the trial says."""
    return NeuralASMSafety(env, monitor, on_alarm=trial.on_alarm, on_overrun="ignore")


def watch(trial: Trial, config: RolloutConfig, memory: Path) -> ScoredEpisode:
    """The trace of one trial, in this process's environment.

    Args:
        memory: where the calibrated memory was saved; ``config.stream_freq`` is the rate that it watches at.
    """
    monitor = _memory(memory, memory.stat().st_mtime_ns)
    infos: list[dict[str, Any]] = []
    with staged(trial, config) as env:
        success = play(trial, config, guarded(env, monitor, trial), infos.append)
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
    """The traces of one trial with the policy alone, and as it says."""
    return [watch(replace(trial, acting=acting), config, memory) for acting in (POLICY_ALONE, trial.acting)]
