"""Runs one watched episode, faulty or not, with or without an override, and keeps its trace."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from asm_gym.evaluation.trace import POLICY_ALONE, InterventionOutcome, Trace, TraceDetail
from asm_gym.faults import Fault
from asm_gym.monitors import NeuralASM
from asm_gym.policies import make_policy, rollout
from asm_gym.rollouts.parallel import environment
from asm_gym.wrappers import FaultInjection, NeuralASMSafety


@dataclass(frozen=True)
class Trial:
    """One episode to run.

    Args:
        condition: ``"nominal"``, or what to call the fault.
        faults: what goes wrong.
        acting: ``"policy alone"``, or what ``on_alarm`` takes.
        seed: of the environment and of the policy: two trials that differ only in ``acting`` are paired by it.
    """

    condition: str
    faults: tuple[Fault, ...]
    acting: str
    seed: int


@lru_cache(maxsize=1)
def _memory(path: Path, written_ns: int) -> NeuralASM:
    """Loaded once a process, and again when the file has been written anew."""
    return NeuralASM.load(path)


def guarded(env: gym.Env[Any, Any], monitor: NeuralASM, trial: Trial) -> gym.Env[Any, Any]:
    """``env`` with the trial's faults, under the safety wrapper."""
    on_alarm = "monitor" if trial.acting == POLICY_ALONE else trial.acting
    return NeuralASMSafety(FaultInjection(env, trial.faults), monitor, on_alarm=on_alarm, on_overrun="ignore")


def watch_pair(trial: Trial, env_id: str, policy: str, memory: Path) -> list[Trace]:
    """The traces of one trial with the policy alone, and as it says.

    The wrapper acts only after an alarm, so without one both are the same episode, and it runs once.
    """
    alone = watch(replace(trial, acting=POLICY_ALONE), env_id, policy, memory)
    if alone.alarm.any():
        return [alone, watch(trial, env_id, policy, memory)]
    return [alone, replace(alone, acting=trial.acting)]


def watch(trial: Trial, env_id: str, policy: str, memory: Path) -> Trace:
    """The trace of one trial, in this process's environment.

    Args:
        memory: where the calibrated memory was saved.
    """
    monitor = _memory(memory, memory.stat().st_mtime_ns)
    env = guarded(environment(env_id), monitor, trial)
    infos: list[dict[str, Any]] = []
    try:
        success = rollout(env, make_policy(policy, env, seed=trial.seed), trial.seed, infos.append)
    finally:
        env.get_wrapper_attr("undo_faults")()  # the next trial has wrappers of its own around the same environment
    asm = [info["asm"] for info in infos]
    fault = np.array([bool(info["fault"]) for info in infos])
    attribution = np.array([list(a["attribution"].values()) for a in asm])
    trace = Trace(
        kind=trial.condition,
        acting=trial.acting,
        seed=trial.seed,
        dt=monitor.spec.dt,
        threshold=monitor.threshold,
        surprise=np.array([a["surprise"] for a in asm]),
        onset=int(np.argmax(fault)) if fault.any() else None,
        outcome=InterventionOutcome(
            success,
            ended_by_alarm=trial.acting == "terminate" and bool(asm[-1]["alarm"]),
            contact_force=float(np.max([info["contact_force"] for info in infos])),
        ),
        detail=TraceDetail(attribution, monitor.spec.labels, fault),
    )
    return trace.attributed(attribution, monitor.spec.labels)
