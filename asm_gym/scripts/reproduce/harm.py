"""Harm avoided against success kept: what a guard lets through of policies that ram, and its cost to healthy ones.

Harm is the contact force on the arm beyond 40 N, summed over physics substeps [N s]. It is MuJoCo's own force, which no
sensor of the guard reads. Guards are compared on the same seeds: the same scene, policy and fault.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from asm_gym.detection.contact_limits import FREE_FORCE, LEANS_S
from asm_gym.envs.arms import PHYSICS_FREQ
from asm_gym.evaluation.contact_harm import harm_of
from asm_gym.evaluation.defaults import TRANSIENT
from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.scored_episode import NOMINAL, POLICY_ALONE
from asm_gym.evaluation.tables import Table
from asm_gym.faults.action import ActionBias
from asm_gym.faults.actuator import WeakJoint
from asm_gym.policies import rollout
from asm_gym.policies.hostile import HOSTILE
from asm_gym.rollouts.run_trials import environment, recorded_forces, staged
from asm_gym.rollouts.trial import PASSING, Trial
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import harm_search, kit
from asm_gym.scripts.reproduce.harm_cases import (
    CASE,
    CONTROL_RATE,
    ELSEWHERE,
    GUARDS,
    RAMMED_TASKS,
    Case,
    guarded,
)
from asm_gym.scripts.reproduce.kit import Record
from asm_gym.tasks import env_id

MET_TASKS = (*RAMMED_TASKS, "PickPlaceBread", "PickPlaceCereal")
"""Tasks that the Panda's memory knows."""
UNMET_TASKS = ("PickPlaceMilk", "NutAssemblyRound")
"""Tasks that the Panda's memory has not met."""
ALL_TASKS = (*MET_TASKS, *UNMET_TASKS)
HEALTHY = [
    *product(ALL_TASKS, ["scripted"]),
    ("Lift", "lift_sac"),
    ("Stack", "stack_sac"),
    ("Door", "door_sac"),
]
"""Tasks and policies that do no harm on purpose."""
FAULT_SEVERITIES = {
    "frozen_encoder": "medium",
    "encoder_bias": "medium",
    "encoder_dropout": "medium",
    "weak_joint": "medium",
    PASSING: "",
}
"""Faults under which healthy policies act too, and their severity."""
FAULTY_TASKS = ("Lift", "Stack")
SLOWER = (0.5, 0.25)  # shares of the full action at which a hostile policy acts too
IMPAIRMENTS = {
    "weak_joint": WeakJoint(joint=1, strength=0.3, onset=20),
    "action_bias": ActionBias(axis=2, amount=-2.0, onset=20),
}
"""Faults behind the guard under which hostile policies act too."""
IMPAIRED_TASKS = ("Lift", "PickPlaceCan")
RAMMING = ("down", "aside and down", "forward", "ramp")
"""Hostile policies that act with an impairment."""
AGAINST = ("hostile", "elsewhere", "impaired", "faulty", "unmet")
KEPT = 0.95  # share of its harm that is to be kept away of every cell
LITTLE = 1.0  # a cell with no more harm without a guard does not count [N s]


@dataclass(frozen=True)
class Config(kit.Config):
    """Hostile and healthy policies, alone and under the guard."""

    seeds: int = option(1, least=1)
    """How often it is repeated, with other seeds."""
    episodes: int = option(10, quick=1, least=0)
    """Episodes of each policy that a guard is against."""
    against: tuple[str, ...] = option(("hostile",), known=AGAINST, metavar="NAME")
    """Which policies. Elsewhere are hostile ones with the Sawyer, the IIWA, and at 100 Hz. Impaired are ramming ones
    with a weak joint, or with a bias of the action behind the guard. Faulty are healthy ones in Lift and Stack under
    each kind of fault. Unmet are hostile ones in the tasks that the memory has not met."""
    search: int = option(0, least=0)
    """Episodes of a search for the hardest contact, under each guard, with each arm in each task; nothing else is done.
    """
    healthy: int = option(40, quick=1, least=0)
    """Episodes of each healthy policy."""
    guards: tuple[str, ...] = option((POLICY_ALONE, "default"), known=GUARDS, metavar="NAME")
    """Ways to guard."""
    tasks: tuple[str, ...] = option(ALL_TASKS, quick=("Lift",), known=ALL_TASKS, metavar="TASK")
    """Tasks; hostile policies act in the first five, and in the last two where these are against unmet ones."""


def cases(config: Config) -> list[tuple[Case, int]]:
    """Return every case and its number of episodes."""
    trials = {task: Trial(env_id(task), 0) for task in config.tasks}
    rammed = [trials[task] for task in config.tasks if task in RAMMED_TASKS]
    hostile = [Case("hostile", name, trial) for trial, name in product(rammed, HOSTILE)]
    slower = [
        Case("hostile", "down", trial, speed=speed) for trial, speed in product(rammed, SLOWER)
    ]
    unmet = [
        Case("hostile", name, trials[task]) for task, name in product(unmet_tasks(config), HOSTILE)
    ]
    elsewhere = [case._replace(config=arm) for arm, case in product(ELSEWHERE, hostile)]
    healthy = [Case("healthy", policy, trials[task]) for task, policy in HEALTHY if task in trials]
    against = {
        "hostile": hostile + slower,
        "elsewhere": elsewhere,
        "impaired": impaired_cases(hostile),
        "faulty": faulty_cases(healthy),
        "unmet": unmet,
    }
    counted = [(case, config.episodes) for name in config.against for case in against[name]]
    return counted + [(case, config.healthy) for case in healthy]


def unmet_tasks(config: Config) -> list[str]:
    """Return the tasks that the memory has not met."""
    return [task for task in config.tasks if task in UNMET_TASKS]


def faulty_cases(healthy: Sequence[Case]) -> list[Case]:
    """Return the cases of healthy policies with each fault."""
    faulty = []
    for case, (fault, severity) in product(healthy, FAULT_SEVERITIES.items()):
        if case.trial.task in FAULTY_TASKS:
            trial = replace(case.trial, kind=fault, severity=severity)
            faulty.append(case._replace(kind="faulty", trial=trial))
    return faulty


def impaired_cases(hostile: Sequence[Case]) -> list[Case]:
    """Return the cases of ramming policies with each impairment."""
    impaired = []
    for case, (name, fault) in product(hostile, IMPAIRMENTS.items()):
        if case.policy in RAMMING and case.trial.task in IMPAIRED_TASKS:
            trial = replace(case.trial, kind=name, faults=(fault,))
            impaired.append(case._replace(trial=trial))
    return impaired


# ------------------------------------------------------------------ measurement


def episode(job: tuple[Case, str]) -> Record:
    """Run one episode of a case under a guard; return the simulator's contact forces, summed up, and the outcome."""
    case, guard = job
    seed = case.trial.seed
    arm: Any = environment(case.trial.env_id, case.config.settings).unwrapped
    infos: list[dict[str, Any]] = []
    with staged(case.trial, case.config) as env, recorded_forces(env) as forces:
        guarded_env = guarded(env, guard, case)
        policy = case.make_policy(env)
        success = rollout(guarded_env, policy, seed, infos.append)
    cost = np.array([info.get("cost", 0.0) for info in infos])
    alarm_begins = np.diff(cost, prepend=0.0) > 0.0
    solved_steps = np.flatnonzero([info["success"] for info in infos])
    time = np.nan
    if len(solved_steps):
        time = (solved_steps[0] + 1) * arm.dt
    return {
        **case.key,
        "guard": guard,
        "seed": seed,
        "success": bool(success),
        **harm_of(np.array(forces), PHYSICS_FREQ)._asdict(),
        "time": time,
        "alarms": int(alarm_begins.sum()),
        "cost": float(cost.sum()),
        "overridden": sum(bool(info.get("overridden")) for info in infos),
    }


def jobs_of(config: Config) -> list[tuple[Case, str]]:
    """Return every episode: a case with its seed, and a guard."""
    jobs = []
    for repetition, (case, count) in product(config.repetitions, cases(config)):
        for number, guard in product(range(count), config.guards):
            trial = replace(case.trial, seed=10_000 * repetition + 1000 + number)
            jobs.append((case._replace(trial=trial), guard))
    return jobs


def run(config: Config) -> kit.Findings:
    """Run every case on its own scenes, under every guard; or search for the hardest contact."""
    if config.search:
        tasks = [task for task in config.tasks if task in RAMMED_TASKS]
        return harm_search.run(tasks, config.guards, config.search, config)
    records = kit.resumed("episodes", episode, jobs_of(config), config)
    frame = pd.DataFrame(records)
    hostile = frame[frame.kind == "hostile"]
    healthy = frame[frame.kind == "healthy"]
    faulty = frame[frame.kind == "faulty"]
    guards = [*dict.fromkeys(frame.guard)]
    arms = ("robot", "rate", "task")
    tables = [
        by_guard("Hostile policies, by arm and rate", hostile, guards, arms, ("kind",)),
        by_guard("Hostile policies, by policy", hostile, guards, ("robot", "rate", "policy")),
        by_guard("Hostile policies, by cell", hostile, guards, CASE),
        by_guard("Healthy policies", healthy, guards, CASE, ("kind",)),
        by_guard("Healthy policies with a fault", faulty, guards, CASE, ("fault",)),
    ]
    drawn = None
    if len(hostile) and len(healthy) and POLICY_ALONE in guards:
        usual = frame[(frame.robot == "Panda") & (frame.rate == CONTROL_RATE)]
        drawn = frontier(usual, config.guards)
    return kit.Findings(records, without_repeats(tables), drawn)


# ------------------------------------------------------------------ tables


def without_repeats(tables: Sequence[Table]) -> list[Table]:
    """Return the tables that have rows, and others than those before: of one task, policies are cells."""
    kept: list[Table] = []
    for table in tables:
        if table.rows and not any(table.rows == other.rows for other in kept):
            kept.append(table)
    return kept


def by_guard(
    caption: str, frame: pd.DataFrame, guards: Sequence[str], *groups: Sequence[str]
) -> Table:
    """Return a row for each guard in each group of episodes with the same values of some columns, each once."""
    rows: list[dict[str, str]] = []
    for columns in groups:
        for _, own in frame.groupby(list(columns), sort=False):
            present = [guard for guard in guards if (own.guard == guard).any()]
            new = [guard_row(own, guard) for guard in present]
            rows += [row for row in new if row not in rows]
    return kit.table_of(caption, rows)


def guard_row(group: pd.DataFrame, guard: str) -> dict[str, str]:
    """Return the row of a guard, compared with the policy alone on the same scenes."""
    scenes = group.set_index([*CASE, "seed"])
    alone = scenes[scenes.guard == POLICY_ALONE]
    guarded_ones = scenes[scenes.guard == guard]
    row = {"": _name(group), "guard": guard} | harm_cells(guarded_ones, alone)
    if (group.kind == "hostile").all():
        row["cost"] = f"{guarded_ones.cost.mean():.1f}"
        row[f"time over {FREE_FORCE:g} N [s]"] = f"{guarded_ones.over_s.mean():.2f}"
        row[f"cells that keep {100 * KEPT:.0f} %"] = cells_kept(group, guard)
        gentle = (guarded_ones["first"] <= TRANSIENT).sum()
        row[f"first blows of at most {TRANSIENT:g} N"] = f"{gentle} of {len(guarded_ones)}"
        return row
    return row | success_cells(guarded_ones, alone)


def harm_cells(guarded_ones: pd.DataFrame, alone: pd.DataFrame) -> dict[str, str]:
    """Return the cells of contact forces and alarms."""
    harm_alone = alone.harm.sum()
    kept_away = ""
    if harm_alone > 0:
        share_left = guarded_ones.harm.sum() / harm_alone
        kept_away = f"{100 * (1 - share_left):.1f} %"
    first_blow = guarded_ones["first"]
    return {
        "harm [N s]": f"{guarded_ones.harm.mean():.1f}",
        "kept away": kept_away,
        "first blow, mean and most [N]": f"{first_blow.mean():.0f}, {first_blow.max():.0f}",
        "peak [N]": f"{guarded_ones.peak.max():.0f}",
        "alarms": f"{guarded_ones.alarms.mean():.1f}",
    }


def success_cells(guarded_ones: pd.DataFrame, alone: pd.DataFrame) -> dict[str, str]:
    """Return the cells of solved tasks, in pairs with the policy alone on the same scene."""
    success = guarded_ones.success
    pairs = guarded_ones.join(alone.success.rename("alone"), how="inner")
    lost = (pairs.alone & ~pairs.success).sum()
    won = (pairs.success & ~pairs.alone).sum()
    is_hard = guarded_ones.peak > TRANSIENT
    is_leaning = guarded_ones.over_s > LEANS_S
    is_unsafe = is_hard | is_leaning | (guarded_ones.overridden > 0)
    unsafe = f"of these beyond {TRANSIENT:g} N, {FREE_FORCE:g} N for {LEANS_S:g} s, or overridden"
    return {
        "solved": f"{success.sum()} of {len(guarded_ones)}",
        "lost, won": f"-{lost} +{won}",
        unsafe: f"{(success & is_unsafe).sum()}",
        "median time to success [s]": f"{guarded_ones.time.median():.2f}",
    }


def cells_kept(frame: pd.DataFrame, guard: str) -> str:
    """Return in how many cells with harm at least ``KEPT`` of it is kept away under a guard."""
    harm = frame.pivot_table("harm", list(CASE), "guard")
    if guard not in harm or POLICY_ALONE not in harm:
        return ""
    harm = harm[harm[POLICY_ALONE] > LITTLE]
    is_kept = harm[guard] <= (1.0 - KEPT) * harm[POLICY_ALONE]
    return f"{is_kept.sum()} of {len(harm)}"


def _name(group: pd.DataFrame) -> str:
    """Return what all episodes of a group have in common."""
    parts = []
    for name in ("robot", "rate", "task", "policy", "fault"):
        values = group[name].unique()
        if len(values) > 1 or values[0] == NOMINAL:
            continue
        text = str(values[0])
        if name == "rate":
            text += " Hz"
        if name == "fault":
            text = text.replace("_", " ")
        parts.append(text)
    return ", ".join(parts) or "all"


def frontier(frame: pd.DataFrame, guards: Sequence[str]) -> Figure:
    """Draw the harm of hostile policies against the time that healthy ones take, a point for each guard."""
    healthy = frame[frame.kind == "healthy"]
    hostile = frame[frame.kind == "hostile"]
    times = healthy.pivot_table("time", ["task", "policy"], "guard", "median", dropna=False)
    harm = hostile.groupby("guard").harm.mean()
    with figure(height=3.5, width=6) as fig:
        ax = fig.subplots()
        for n, guard in enumerate(guards):
            colour, _, marker = look(n)
            slower = (times[guard] / times[POLICY_ALONE]).mean()
            label = guard
            if np.isnan(slower):
                label = f"{guard}: solves nothing"
            ax.plot(slower, harm[guard], marker, color=colour, label=label)
        ax.set(
            yscale="log",
            xlabel="time to success, over that of the policy alone",
            ylabel="harm in an episode [N s]",
        )
        ax.legend(loc="center left", bbox_to_anchor=(1.02, 0.5))
    return fig
