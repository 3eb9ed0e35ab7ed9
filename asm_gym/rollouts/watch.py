"""Runs an episode under the safety wrapper, and keeps what the memory and the response made of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from asm_gym.evaluation.contact import contact_force
from asm_gym.evaluation.scored import IDEAL, NOMINAL, POLICY_ALONE, InterventionOutcome, ScoredEpisode, TraceDetail
from asm_gym.faults.body import touches_body
from asm_gym.faults.sensor import corrupts_senses
from asm_gym.monitors import Monitor, NeuralASM
from asm_gym.monitors.contact_band import ContactBand
from asm_gym.rollouts.staging import environment, faults_in, play, staged
from asm_gym.rollouts.trial import SPINAL, RolloutConfig, Trial
from asm_gym.spec import control_period
from asm_gym.wrappers import NeuralASMSafety


@lru_cache(maxsize=1)
def _memory(path: Path, written_ns: int) -> NeuralASM:
    """Loaded once a process, and again when the file has been written anew."""
    return NeuralASM.load(path)


def guarded(
    env: gym.Env[Any, Any],
    monitor: Monitor,
    trial: Trial,
    max_override_s: float | None = None,
    band: ContactBand | None = None,
) -> gym.Env[Any, Any]:
    """``env`` under the safety wrapper, which acts as the trial says."""
    limited = max_override_s is not None and trial.acting not in (POLICY_ALONE, IDEAL)
    steps = max(1, round((max_override_s or 0.0) / control_period(env))) if limited else None
    return NeuralASMSafety(env, monitor, on_alarm=trial.on_alarm, max_override=steps, on_overrun="ignore", band=band)


def watch(trial: Trial, config: RolloutConfig, memory: Path) -> ScoredEpisode:
    """The trace of one trial, in this process's environment.

    Args:
        memory: where the calibrated memory was saved; ``config.stream_freq`` is the rate that it watches at.
    """
    monitor = _memory(memory, memory.stat().st_mtime_ns)
    infos: list[dict[str, Any]] = []
    band = band_of(config, monitor) if trial.acting.endswith(SPINAL) else None
    with staged(trial, config) as env:
        success = play(trial, config, guarded(env, monitor, trial, config.max_override_s, band), infos.append)
        began, dt = trial.begins(env), control_period(env)
    asm = [info["asm"] for info in infos]
    rows = len(asm[0]["surprises"])  # of each control step
    fault = np.repeat([bool(info.get("fault")) for info in infos], rows)
    attribution = np.repeat([list(a["attribution"].values()) for a in asm], rows, axis=0)  # the step's greatest

    def felt(name: str, since: int, until: int | None = None) -> list[float]:
        return [info.get(name, math.nan) for info in infos[since:until]]

    lasted = max((t + 1 for t, info in enumerate(infos) if info.get("fault")), default=None)

    named = next((a["cause"] for a in asm[began:] if a["cause"]["family"]), asm[0]["cause"])
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
            contact_force=float(np.max(felt("contact_force", 0))),
            external_force=float(np.nanmax(felt("external_force", began, lasted), initial=0.0)),
            impulse=float(np.nansum(felt("external_impulse", began, lasted))),
            acted_s=sum(a["intervened"] for a in asm) * dt,
            contact=contact_force(np.array(felt("external_force", began)), dt),
            cause=named["family"],
            part=named["part"],
        ),
        detail=TraceDetail(attribution, monitor.spec.labels, fault),
    )
    return trace.attributed(attribution, monitor.spec.labels)


def watch_pair(trial: Trial, config: RolloutConfig, memory: Path) -> list[ScoredEpisode]:
    """The traces of one trial with the policy alone, and as it says."""
    return watch_each(replace(trial, acting=POLICY_ALONE), (POLICY_ALONE, trial.acting), config, memory)


def band_of(config: RolloutConfig, monitor: NeuralASM) -> ContactBand:
    """The band beneath a reflex. Raises ValueError where none was named."""
    if config.band is None:
        raise ValueError(f"a reflex that ends in {SPINAL} needs the file of a band: RolloutConfig(band=...)")
    return ContactBand.load(config.band, monitor)


def watch_each(
    trial: Trial,
    actings: Sequence[str],
    config: RolloutConfig,
    memory: Path,
    undisturbed: Callable[[], ScoredEpisode] | None = None,
) -> list[ScoredEpisode]:
    """The traces of one trial with each of ``actings``, of which those that must be the same run once.

    The ideal reflex's is that of the policy alone, where nothing touches the body and no sense is at fault. Where
    nothing but senses is at fault, it is the one in which nothing goes wrong.

    Args:
        undisturbed: makes the trace of the policy alone in this trial when nothing goes wrong, where that is known.
    """
    if undisturbed is not None and trial.kind == NOMINAL:
        alone = undisturbed()
    else:
        alone = watch(replace(trial, acting=POLICY_ALONE), config, memory)
    of_senses = undisturbed is not None and concerns_senses_alone(trial, config)

    def found(acting: str) -> ScoredEpisode:
        if acting == IDEAL and of_senses and undisturbed is not None:
            return replace(undisturbed(), kind=trial.kind, severity=trial.severity, acting=IDEAL)
        told = acting == IDEAL and concerns_ideal(trial, config)
        if acting == POLICY_ALONE or (acting == IDEAL and not told):
            return replace(alone, acting=acting)
        return watch(replace(trial, acting=acting), config, memory)

    return [found(acting) for acting in actings]


def concerns_ideal(trial: Trial, config: RolloutConfig) -> bool:
    """Whether an ideal reflex has anything to do about what goes wrong."""
    faults = faults_in(trial, environment(trial.env_id, config.settings), config)
    return any(touches_body(fault) or corrupts_senses(fault) for fault in faults)


def concerns_senses_alone(trial: Trial, config: RolloutConfig) -> bool:
    """Whether something goes wrong, and none of it but with the senses."""
    faults = faults_in(trial, environment(trial.env_id, config.settings), config)
    return bool(faults) and all(corrupts_senses(fault) for fault in faults)
