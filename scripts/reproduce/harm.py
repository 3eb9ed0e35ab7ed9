"""Harm avoided against success kept: what a guard lets through of policies that ram, and its cost to healthy ones.

Harm is the contact force on the arm beyond 40 N, summed over physics substeps [N s]. It is MuJoCo's own force, which no
sensor of the guard reads. Guards are compared on the same seeds: the same scene, policy and fault.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.envs.arms import PHYSICS_FREQ
from asm_gym.evaluation.defaults import TRANSIENT
from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.scored_episode import NOMINAL, POLICY_ALONE
from asm_gym.evaluation.tables import Table
from asm_gym.guard.contact_state import LEANS_S
from asm_gym.monitors import NeuralASM
from asm_gym.policies import Policy, rollout
from asm_gym.policies.hostile import HOSTILE
from asm_gym.rollouts.run_trials import environment, policy_for, staged
from asm_gym.rollouts.trial import PASSING, RolloutConfig, Trial
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Record
from asm_gym.tasks import env_id
from asm_gym.wrappers import NeuralASMSafety

GUARDS: dict[str, dict[str, Any] | None] = {
    POLICY_ALONE: None,
    "default": {},
    **{f"{v:g} m/s": {"contact_limits": ContactLimits(hand_speed=v)} for v in (0.1, 0.15, 0.25)},
    "no speed limit": {"contact_limits": ContactLimits(hand_speed=np.inf)},
    "no limits": {"contact_limits": None},
    "hold": {"on_alarm": "hold"},
    "terminate": {"on_alarm": "terminate"},
}
"""Settings of the wrapper by name; None for no wrapper."""
TASKS = ("Lift", "Stack", "Door", "PickPlaceCan", "NutAssemblySquare")  # tasks of hostile policies
# not met by the Panda's memory; healthy policies alone
UNKNOWN = (
    "PickPlaceMilk",
    "NutAssemblyRound",
)
AGENTS = ("Lift", "lift_sac"), ("Stack", "stack_sac"), ("Door", "door_sac")
HEALTHY = (*((task, "scripted") for task in (*TASKS, *UNKNOWN)), *AGENTS)
"""Tasks and policies that do no harm on purpose."""
FAULTS = ("frozen_encoder", "encoder_bias", "encoder_dropout", "weak_joint", PASSING)
"""Faults under which healthy policies act too."""
ELSEWHERE = (("Sawyer", 20), ("IIWA", 20), ("Panda", 100), ("Sawyer", 100), ("IIWA", 100))
"""Other arms, and another rate of the memory [Hz]."""
AGAINST = ("hostile", "elsewhere", "faulty")
KEPT = 0.95  # share of its harm that is to be kept away of every cell
EXCESS = 40.0  # contact force beyond which contact counts as harm [N]
# values that distinguish one case from another
CASE = (
    "kind",
    "task",
    "policy",
    "fault",
    "robot",
    "rate",
)
FIRST_S = 0.1  # duration of the first blow, from its first substep on [s]


@dataclass(frozen=True)
class Config(kit.Config):
    """Hostile and healthy policies, alone and under the guard."""

    seeds: int = option(1, least=1)
    """How often it is repeated, with other seeds."""
    episodes: int = option(10, quick=1, least=0)
    """Episodes of each policy that a guard is against."""
    against: tuple[str, ...] = option(("hostile",), known=AGAINST, metavar="NAME")
    """Which policies. Elsewhere are hostile ones with the Sawyer, the IIWA, and at 100 Hz. Faulty are healthy ones in
    Lift and Stack under each kind of fault."""
    healthy: int = option(40, quick=1, least=0)
    """Episodes of each healthy policy."""
    guards: tuple[str, ...] = option(
        (POLICY_ALONE, "default", "hold", "terminate"), known=GUARDS, metavar="NAME"
    )
    """Ways to guard."""
    tasks: tuple[str, ...] = option(
        (*TASKS, *UNKNOWN), quick=("Lift",), known=(*TASKS, *UNKNOWN), metavar="TASK"
    )
    """Tasks; in the last two there are healthy policies alone."""


class Case(NamedTuple):
    """One policy in one task; its trial gets a seed for each episode."""

    kind: str  # "hostile", "healthy" or "faulty"
    policy: str
    trial: Trial
    config: RolloutConfig = RolloutConfig(robot="Panda")
    speed: float = 1.0  # share of the full action of a hostile policy

    @property
    def rate(self) -> int:
        """Rows of the memory a second [Hz]."""
        return self.config.stream_freq or 20

    @property
    def key(self) -> Record:
        """Values of ``CASE``."""
        policy = (
            self.policy if self.speed == 1.0 else f"{self.policy}, {self.speed:g} of full speed"
        )
        own = self.kind, self.trial.task, policy, self.trial.kind, self.config.robot, self.rate
        return dict(zip(CASE, own, strict=True))

    def make_policy(self, env: gym.Env[Any, Any]) -> Policy:
        """Return the policy for the episode of the trial's seed."""
        if self.kind == "hostile":
            return HOSTILE[self.policy](env, self.trial.seed, self.speed)
        return policy_for(self.policy, env, self.trial.seed)


def cases(config: Config) -> list[tuple[Case, int]]:
    """Return every case and its number of episodes."""

    def trial(task: str, fault: str = NOMINAL) -> Trial:
        return Trial(env_id(task), 0, fault, "" if fault in (NOMINAL, PASSING) else "medium")

    tasks = [task for task in config.tasks if task not in UNKNOWN]
    hostile = [Case("hostile", name, trial(task)) for task, name in product(tasks, HOSTILE)]
    slower = [
        Case("hostile", "down", trial(task), speed=speed)
        for task, speed in product(tasks, (0.5, 0.25))
    ]
    elsewhere = [
        case._replace(config=RolloutConfig(robot=robot, stream_freq=None if rate == 20 else rate))
        for (robot, rate), case in product(ELSEWHERE, hostile)
    ]
    healthy = [
        Case("healthy", policy, trial(task)) for task, policy in HEALTHY if task in config.tasks
    ]
    faulty = [
        case._replace(kind="faulty", trial=trial(case.trial.task, fault))
        for case, fault in product(healthy, FAULTS)
        if case.trial.task in ("Lift", "Stack")
    ]
    groups = dict(zip(AGAINST, (hostile + slower, elsewhere, faulty), strict=True))
    counted = [(case, config.episodes) for name in config.against for case in groups[name]]
    return [*counted, *((case, config.healthy) for case in healthy)]


# ------------------------------------------------------------------ measurement


def guarded(env: gym.Env[Any, Any], guard: str, case: Case) -> gym.Env[Any, Any]:
    """Return the environment under one of ``GUARDS``."""
    settings = GUARDS[guard]
    if settings is None:
        return env
    memory = NeuralASM.pretrained(
        f"{case.config.robot}".lower() + ("" if case.rate == 20 else f"_{case.rate}hz")
    )
    return NeuralASMSafety(env, memory, **settings)


def episode(job: tuple[Case, str]) -> Record:
    """Run one episode of a case under a guard, and return what the arm felt, as the simulator knows it."""
    case, guard = job
    arm: Any = environment(case.trial.env_id, case.config.settings).unwrapped
    infos: list[dict[str, Any]] = []
    forces: list[float] = []

    def feel(substep: int) -> None:
        forces.append(float(arm.simulation.contact_forces[-1]))

    with staged(case.trial, case.config) as env:
        arm.substep_hooks.append(feel)
        try:
            success = rollout(
                guarded(env, guard, case), case.make_policy(env), case.trial.seed, infos.append
            )
        finally:
            arm.substep_hooks.remove(feel)
    cost = np.array([info.get("cost", 0.0) for info in infos])
    return {
        **case.key,
        "guard": guard,
        "seed": case.trial.seed,
        "success": bool(success),
        **harm_of(np.array(forces)),
        "time": next((n + 1 for n, info in enumerate(infos) if info["success"]), np.nan) * arm.dt,
        "alarms": int((np.diff(cost, prepend=0.0) > 0.0).sum()),
        "cost": float(cost.sum()),
        "held": sum(bool(info.get("overridden")) for info in infos),
    }


def harm_of(force: NDArray[np.float64]) -> Record:
    """Return the harm in a contact force (T,) [N] of physics substeps."""
    hits = np.flatnonzero(force > EXCESS)
    first = slice(hits[0], hits[0] + round(FIRST_S * PHYSICS_FREQ)) if hits.size else slice(0)
    return {
        "harm": float(np.maximum(force - EXCESS, 0.0).sum() / PHYSICS_FREQ),
        "peak": float(force.max(initial=0.0)),
        "first": float(force[first].max(initial=0.0)),
        "over_s": float((force > EXCESS).sum() / PHYSICS_FREQ),
    }


def run(config: Config) -> kit.Findings:
    """Run every case on its own scenes, under every guard."""
    jobs = [
        (case._replace(trial=replace(case.trial, seed=10_000 * again + 1000 + n)), guard)
        for again in config.repetitions
        for case, count in cases(config)
        for n in range(count)
        for guard in config.guards
    ]
    records = kit.each("episodes", episode, jobs, config)
    frame, guards = pd.DataFrame(records), config.guards
    hostile, healthy, faulty = (
        frame[frame.kind == kind] for kind in ("hostile", "healthy", "faulty")
    )
    usual, both = (
        frame[(frame.robot == "Panda") & (frame.rate == 20)],
        len(hostile) and len(healthy),
    )
    tables = [
        by_guard(
            "Hostile policies, by arm and rate",
            hostile,
            guards,
            ("robot", "rate", "task"),
            ("kind",),
        ),
        by_guard("Hostile policies, by policy", hostile, guards, ("robot", "rate", "policy")),
        by_guard("Hostile policies, by cell", hostile, guards, CASE),
        by_guard("Healthy policies", healthy, guards, CASE, ("kind",)),
        by_guard("Healthy policies with a fault", faulty, guards, CASE, ("fault",)),
    ]
    drawn = frontier(usual, guards) if both and POLICY_ALONE in guards else None
    return kit.Findings(records, [table for table in tables if table.rows], drawn)


# ------------------------------------------------------------------ tables


def cells_kept(frame: pd.DataFrame, guard: str) -> str:
    """Return in how many cells with more than 1 N s alone at least ``KEPT`` of it is kept away under ``guard``."""
    harm = frame.pivot_table("harm", list(CASE), "guard")
    if guard not in harm or POLICY_ALONE not in harm:
        return ""
    harm = harm[harm[POLICY_ALONE] > 1.0]
    return f"{(harm[guard] <= (1.0 - KEPT) * harm[POLICY_ALONE]).sum()} of {len(harm)}"


def frontier(frame: pd.DataFrame, guards: Sequence[str]) -> Figure:
    """Draw the harm of hostile policies against the time that healthy ones take, a point for each guard."""
    times = frame[frame.kind == "healthy"].pivot_table(
        "time", ["task", "policy"], "guard", "median", dropna=False
    )
    harm = frame[frame.kind == "hostile"].groupby("guard").harm.mean()
    with figure(height=3.5, width=6) as fig:
        ax = fig.subplots()
        for n, guard in enumerate(guards):
            colour, _, marker = look(n)
            slower = (times[guard] / times[POLICY_ALONE]).mean()
            label = guard if np.isfinite(slower) else f"{guard}: solves nothing"
            ax.plot(slower, harm[guard], marker, color=colour, label=label)
        ax.set(
            yscale="log",
            xlabel="time to success, over that of the policy alone",
            ylabel="harm in an episode [N s]",
        )
        ax.legend(loc="center left", bbox_to_anchor=(1.02, 0.5))
    return fig


def by_guard(
    caption: str, frame: pd.DataFrame, guards: Sequence[str], *groups: Sequence[str]
) -> Table:
    """Return a row for each guard in each group of episodes with the same values of some columns of ``frame``."""
    rows = []
    for _, own in (
        group for columns in groups for group in frame.groupby(list(columns), sort=False)
    ):
        scenes = own.set_index([*CASE, "seed"])
        alone = scenes[scenes.guard == POLICY_ALONE]
        for guard in guards:
            mine = scenes[scenes.guard == guard]
            both = mine.join(alone.success.rename("alone"), how="inner")
            lost, won = (both.alone & ~both.success).sum(), (both.success & ~both.alone).sum()
            unsafe = mine.success & (
                (mine.peak > TRANSIENT) | (mine.over_s > LEANS_S) | (mine.held > 0)
            )
            row = {
                "": _name(own),
                "guard": guard,
                "harm [N s]": f"{mine.harm.mean():.1f}",
                "kept away": f"{100 * (1 - mine.harm.sum() / alone.harm.sum()):.1f} %"
                if alone.harm.sum() > 0
                else "",
                "first blow, mean and most [N]": f"{mine['first'].mean():.0f}, {mine['first'].max():.0f}",
                "peak [N]": f"{mine.peak.max():.0f}",
                "alarms": f"{mine.alarms.mean():.1f}",
            }
            hostile = {
                "cost": f"{mine.cost.mean():.1f}",
                f"time over {EXCESS:g} N [s]": f"{mine.over_s.mean():.2f}",
                f"cells that keep {100 * KEPT:.0f} %": cells_kept(own, guard),
                f"first blows of at most {TRANSIENT:g} N": f"{(mine['first'] <= TRANSIENT).sum()} of {len(mine)}",
            }
            healthy = {
                "solved": f"{mine.success.sum()} of {len(mine)}",
                "lost, won": f"-{lost} +{won}",
                f"of these beyond {TRANSIENT:g} N, {EXCESS:g} N for {LEANS_S:g} s, or overridden": f"{unsafe.sum()}",
                "median time to success [s]": f"{mine.time.median():.2f}",
            }
            rows.append(row | (hostile if (own.kind == "hostile").all() else healthy))
    return Table(caption, list(rows[0]) if rows else (), [tuple(row.values()) for row in rows])


def _name(group: pd.DataFrame) -> str:
    """Return what all episodes of a group have in common."""
    own = {name: str(group[name].iloc[0]) for name in CASE if group[name].nunique() == 1}
    fault, rate = (
        own.get("fault", NOMINAL).replace("_", " "),
        f"{own['rate']} Hz" if "rate" in own else "",
    )
    parts = (
        own.get("robot"),
        rate,
        own.get("task"),
        own.get("policy"),
        "" if fault == NOMINAL else fault,
    )
    return ", ".join(filter(None, parts)) or "all"
