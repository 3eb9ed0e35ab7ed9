"""First impacts predicted from chunks of actions, and chunks refused in vain, with places from healthy episodes.

Policies act alone. Every ``EVERY`` steps the next ``CHUNK`` actions are announced, as a policy of chunks would.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd

from asm_gym.detection.commands import learned_motion
from asm_gym.detection.contact_limits import FREE_FORCE
from asm_gym.detection.hand_speed_map import HandSpeedMap
from asm_gym.guard.chunk_preview import preview_chunk
from asm_gym.policies import rollout
from asm_gym.rollouts.run_trials import collect, environment, staged
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import harm, kit
from asm_gym.scripts.reproduce.harm_cases import Case
from asm_gym.tasks import env_id

CHUNK = 16  # actions that are announced
EVERY = 8  # steps from one announcement to the next
AHEAD_S = 0.2  # how long before a blow is early enough [s]


@dataclass(frozen=True)
class Config(harm.Config):
    """Hostile and healthy policies that announce chunks of actions."""

    learned: int = option(40, quick=3, least=1)
    """Healthy episodes of each task's scripted expert, whose places are learned."""
    against: tuple[str, ...] = option(("hostile",), known=("hostile",), metavar="NAME")
    """Which policies; the guards of asm-gym reproduce harm are not used."""


def episode(job: tuple[Case, Any]) -> kit.Record:
    """Run a policy alone; return when it first hits something, and which of its chunks were refused before."""
    case, places = job
    arm: Any = environment(case.trial.env_id, case.config.settings).unwrapped
    rows: list[Any] = []
    is_blow: list[bool] = []

    def keep(info: dict[str, Any]) -> None:
        rows.append(info["stream"])
        is_blow.append(arm.simulation.contact_forces.max() > FREE_FORCE)

    with staged(case.trial, case.config) as env:
        rollout(env, case.make_policy(env), case.trial.seed, keep)
    blow = any(is_blow)
    end = is_blow.index(True) if blow else len(rows) - 1
    commands = np.array(rows)[:, places.spec.motor]
    refused = []
    for t in range(0, end, EVERY):
        chunk = commands[t + 1 : t + 1 + CHUNK]
        if preview_chunk(chunk, rows[t], commands[t], places, arm.dt).at is not None:
            refused.append(t)
    is_early = bool(refused) and (end - refused[0]) * arm.dt >= AHEAD_S
    return {
        **case.key,
        "blow": blow,
        "predicted": blow and is_early,
        "in_vain": sum(not blow or t + CHUNK < end for t in refused),
        "hours": end * arm.dt / 3600,
    }


def learned_places(task: str, config: Config) -> SimpleNamespace:
    """Return what healthy episodes of a task's expert teach, as ``preview_chunk`` reads it."""
    episodes = collect(
        env_id(task),
        policy="scripted",
        episodes=config.learned,
        seed=500,
        workers=config.workers,
    )
    spec = episodes[0].spec
    solved = [episode for episode in episodes if episode.success]
    return SimpleNamespace(
        spec=spec,
        pace_=HandSpeedMap.by_task(solved, spec),
        motion_=learned_motion([episode.stream for episode in solved], spec),
    )


def run(config: Config) -> kit.Findings:
    """Learn the places of each task, and run every policy in it."""
    places = {}
    jobs = []
    for case, count in harm.cases(config):
        task = case.trial.task
        if task not in places:
            places[task] = learned_places(task, config)
        for n in range(count):
            trial = replace(case.trial, seed=1000 + config.seed + n)
            jobs.append((case._replace(trial=trial), places[task]))
    records = kit.each("episodes", episode, jobs, config)

    frame = pd.DataFrame(records)
    rows = []
    for columns in (["kind"], ["task", "policy"]):
        for names, own in frame.groupby(columns, sort=False):
            predicted = f"{own.predicted.sum()} of {own.blow.sum()}"
            rows.append(
                {
                    "": ", ".join(names),
                    "episodes": len(own),
                    f"impacts predicted {AHEAD_S:g} s ahead": predicted,
                    "chunks refused in vain": own.in_vain.sum(),
                    "hours": f"{own.hours.sum():.2f}",
                }
            )
    return kit.Findings(records, [kit.table_of("Chunks of actions", rows)])
