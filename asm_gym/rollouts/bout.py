"""Runs one episode in which a reflex acts on the alarms, and keeps its trace."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.evaluation.trace import NOMINAL, POLICY_ALONE, InterventionOutcome, Trace
from asm_gym.faults import Fault, Push
from asm_gym.faults.suite import draw, suite_fault
from asm_gym.monitors import NeuralASM
from asm_gym.policies import make_policy, rollout
from asm_gym.rollouts.parallel import environment
from asm_gym.rollouts.record import Course, draw_onset
from asm_gym.stream import control_period
from asm_gym.wrappers import FaultInjection, NeuralASMSafety

PASSING = "passing_push"
"""A condition beside nominal and the kinds of fault."""


@dataclass(frozen=True)
class Bout:
    """One episode to run."""

    task: str
    fault: str
    acting: str
    seed: int


@lru_cache(maxsize=1)
def _memory(path: Path, written_ns: int) -> NeuralASM:
    """Loaded once a process, and again when the file has been written anew."""
    return NeuralASM.load(path)


def _fault(kind: str, env: RobosuiteEnv, onset: int, seed: int) -> tuple[Fault, ...]:
    if kind == NOMINAL:
        return ()
    if kind == PASSING:
        drawn = draw(env, onset, seed)
        duration = max(1, round(0.3 / control_period(env)))
        return (Push(body=drawn.link, newtons=20.0, direction=drawn.direction, duration=duration, onset=onset),)
    return (suite_fault(kind, env, "strong", onset, seed),)


def run_bout(one: Bout, course: Course, max_override_s: float, memory: Path) -> Trace:
    """Runs one episode in this process's environment.

    Args:
        course: how episodes are made; its ``stream_freq`` is the rate that the memory watches at.
        memory: where the calibrated memory was saved.
    """
    base = environment(f"asm_gym/{one.task}-v0", course.settings())
    inner: Any = base.unwrapped
    monitor = _memory(memory, memory.stat().st_mtime_ns)
    dt = control_period(base)
    onset = draw_onset(one.seed, inner.horizon)
    alone = one.acting == POLICY_ALONE
    env = NeuralASMSafety(
        FaultInjection(base, _fault(one.fault, inner, onset, one.seed)),
        monitor,
        on_alarm="monitor" if alone else one.acting,
        max_override=None if alone else max(1, round(max_override_s / dt)),
        on_overrun="ignore",
    )
    infos: list[dict[str, Any]] = []
    try:
        success = rollout(env, make_policy(course.policy, env, seed=one.seed), one.seed, infos.append)
    finally:
        env.get_wrapper_attr("undo_faults")()
    since = infos[onset:]
    last = infos[-1]["asm"]
    return Trace(
        kind=one.fault,
        seed=one.seed,
        dt=monitor.spec.dt,
        threshold=monitor.threshold,
        surprise=np.concatenate([info["asm"]["surprises"] for info in infos]),
        onset=None if one.fault == NOMINAL else onset * len(infos[0]["asm"]["surprises"]),
        task=one.task,
        acting=one.acting,
        outcome=InterventionOutcome(
            success,
            ended_by_alarm=bool(last["gave_up"] or (one.acting == "terminate" and last["alarm"])),
            external_force=float(np.nanmax([info["external_force"] for info in since], initial=0.0)),
            impulse=float(np.nansum([info["external_impulse"] for info in since])),
            acted_s=sum(info["asm"]["intervened"] for info in infos) * dt,
        ),
    )
