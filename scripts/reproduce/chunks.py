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
from asm_gym.detection.hand_speed_map import HandSpeedMap
from asm_gym.evaluation.tables import Table
from asm_gym.guard.preview import preview_chunk
from asm_gym.policies import rollout
from asm_gym.rollouts.run_trials import collect, environment, staged
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import harm, kit
from asm_gym.tasks import env_id

# actions that are announced; how often; how long before a blow is early enough [s]
CHUNK, EVERY, AHEAD_S = (
    16,
    8,
    0.2,
)


@dataclass(frozen=True)
class Config(harm.Config):
    """Hostile and healthy policies that announce chunks of actions."""

    learned: int = option(40, quick=3, least=1)
    """Healthy episodes of each task's scripted expert, whose places are learned."""
    against: tuple[str, ...] = option(("hostile",), known=("hostile",), metavar="NAME")
    """Which policies; the guards of asm-gym reproduce harm are not used."""


def episode(job: tuple[harm.Case, Any]) -> kit.Record:
    """Run a policy alone; return when it first hits something, and which of its chunks were refused before."""
    case, known = job
    arm: Any = environment(case.trial.env_id, case.config.settings).unwrapped
    rows: list[Any] = []
    forces: list[float] = []

    def keep(info: dict[str, Any]) -> None:
        rows.append(info["stream"])
        forces.append(float(arm.simulation.contact_forces.max()))

    with staged(case.trial, case.config) as env:
        rollout(env, case.make_policy(env), case.trial.seed, keep)
    done, hits = np.array(rows)[:, known.spec.motor], np.flatnonzero(np.array(forces) > harm.EXCESS)
    until = int(hits[0]) if hits.size else len(rows) - 1
    chunks = {t: done[t + 1 : t + 1 + CHUNK] for t in range(0, until, EVERY)}
    previews = {
        t: preview_chunk(chunk, rows[t], done[t], known, arm.dt) for t, chunk in chunks.items()
    }
    refused = [t for t, preview in previews.items() if preview.at is not None]
    early = bool(refused) and (until - refused[0]) * arm.dt >= AHEAD_S
    vain = [t for t in refused if not hits.size or t + CHUNK < until]
    found = {"blow": bool(hits.size), "predicted": bool(hits.size) and early, "in_vain": len(vain)}
    return {**case.key, **found, "hours": until * arm.dt / 3600}


def run(config: Config) -> kit.Findings:
    """Learn the places of each task, and run every policy in it."""
    jobs, known = [], {}
    for case, count in harm.cases(config):
        task = case.trial.task
        if task not in known:
            found = collect(
                env_id(task),
                policy="scripted",
                episodes=config.learned,
                seed=500,
                workers=config.workers,
            )
            spec, solved = found[0].spec, [episode for episode in found if episode.success]
            known[task] = SimpleNamespace(
                spec=spec,
                pace_=HandSpeedMap.by_task(solved, spec),
                motion_=learned_motion([episode.stream for episode in solved], spec),
            )
        trials = [replace(case.trial, seed=1000 + config.seed + n) for n in range(count)]
        jobs += [(case._replace(trial=trial), known[task]) for trial in trials]
    records = kit.each("episodes", episode, jobs, config)
    frame = pd.DataFrame(records)
    groups = [*frame.groupby(["kind"], sort=False), *frame.groupby(["task", "policy"], sort=False)]
    rows = []
    for names, own in groups:
        counts = f"{len(own)}", f"{own.predicted.sum()} of {own.blow.sum()}", f"{own.in_vain.sum()}"
        rows.append((", ".join(names), *counts, f"{own.hours.sum():.2f}"))
    headings = (
        "",
        "episodes",
        f"impacts predicted {AHEAD_S:g} s ahead",
        "chunks refused in vain",
        "hours",
    )
    return kit.Findings(records, [Table("Chunks of actions", headings, rows)])
