"""Run trials under the safety wrapper, and score them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from asm_gym.evaluation.scored_episode import POLICY_ALONE, InterventionOutcome, ScoredEpisode, TraceDetail
from asm_gym.monitors import NeuralASM
from asm_gym.rollouts.collect import play, staged
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.wrappers import NeuralASMSafety


@lru_cache(maxsize=1)
def _memory(path: Path, written_ns: int) -> NeuralASM:
    """Load once a process, and again when the file has changed."""
    return NeuralASM.load(path)


def watch(trial: Trial, config: RolloutConfig, memory: Path) -> ScoredEpisode:
    """Run one trial under the guard in this process's environment, and return its scores."""
    monitor = _memory(memory, memory.stat().st_mtime_ns)
    infos: list[dict[str, Any]] = []
    with staged(trial, config) as env:
        guarded = NeuralASMSafety(env, monitor, on_alarm=trial.on_alarm)
        success = play(trial, config, guarded, infos.append)
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
