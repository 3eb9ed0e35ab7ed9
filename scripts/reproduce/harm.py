"""Harm avoided against success kept: what a guard lets through of policies that ram, and what it costs healthy ones.

Harm is the contact force on the arm in every physics substep beyond 40 N, summed over time [N s]: MuJoCo's, which no
sensor of the guard reads. Pairs share their seed: the same scene, policy, and fault where there is one.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from asm_gym.contact_limits import ContactLimits
from asm_gym.evaluation.scored_episode import NOMINAL, POLICY_ALONE
from asm_gym.files import written_whole
from asm_gym.monitors import NeuralASM
from asm_gym.policies import Policy, rollout
from asm_gym.policies.hostile import HOSTILE
from asm_gym.rollouts.staging import environment, policy_for, staged
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.scripts.options import fixed, option
from asm_gym.scripts.reproduce import harm_agents, harm_report, kit
from asm_gym.scripts.reproduce.harm_agents import EXCESS, HITTERS, LEARNERS
from asm_gym.scripts.reproduce.harm_felt import Felt, hand_speed, harm_of
from asm_gym.spec import control_period
from asm_gym.tasks import env_id
from asm_gym.wrappers import NeuralASMSafety
from asm_gym.wrappers.oracle import OracleReflex

IDEAL = "ideal reflex"

GUARDS: dict[str, dict[str, Any] | None] = {
    POLICY_ALONE: None,
    "default": {},
    "no speed limit": {"contact_limits": ContactLimits(hand_speed=np.inf)},
    "no limits": {"contact_limits": None},
    "hold": {"on_alarm": "hold"},
    "terminate": {"on_alarm": "terminate"},
    IDEAL: None,
}
"""What the wrapper is told, by name; None for no wrapper. The ideal reflex knows the simulator's own contact force."""

HEALTHY = {
    **{
        f"expert {task}": (task, "scripted")
        for task in ("Lift", "Stack", "Door", "PickPlaceCan", "NutAssemblySquare", "Wipe")
    },
    "lift_sac": ("Lift", "lift_sac"),
    "stack_sac": ("Stack", "stack_sac"),
    "door_sac": ("Door", "door_sac"),
}
"""Tasks and policies that do no harm on purpose."""

FAULTS = ("frozen_encoder", "encoder_bias", "encoder_dropout", "weak_joint", "passing_push")
"""Kinds under which the healthy policies act too; of the suite, but for the last."""

HEALTHY_TASKS = tuple(dict.fromkeys(task for task, _ in HEALTHY.values()))

AGAINST = "hostile", "untrained", "taught", "elsewhere", "faulty"
TASKS = "Lift", "Stack", "Door", "PickPlaceCan"
"""Of hostile policies; healthy ones act in those that they are for."""

ELSEWHERE = ("Sawyer", 20), ("IIWA", 20), ("Panda", 100)
"""Other arms, and another rate of the memory [Hz]."""


@dataclass(frozen=True)
class Config(kit.Config):
    """Hostile, learning and healthy policies, alone and under the guard."""

    seeds: int = option(1, least=1)
    """How often it is done anew, with other seeds."""
    episodes: int = option(10, quick=1, least=0)
    """Episodes of each policy that a guard is against."""
    against: tuple[str, ...] = option(("hostile", "untrained"), known=AGAINST, metavar="NAME")
    """Which. Elsewhere are hostile ones with the Sawyer, the IIWA, and at 100 Hz. Faulty are healthy ones in Lift and
    Stack under each kind of fault."""
    healthy: int = option(40, quick=1, least=0)
    """Episodes of each healthy policy."""
    guards: tuple[str, ...] = option(
        (POLICY_ALONE, "default", "hold", "terminate"), known=tuple(GUARDS), metavar="NAME"
    )
    """Ways to guard."""
    tasks: tuple[str, ...] = option(
        (), quick=("Lift",), known=tuple(dict.fromkeys((*TASKS, *HEALTHY_TASKS))), metavar="TASK"
    )
    """Where all act; by default each kind of policy where it has a task."""
    training: int = fixed(2000, quick=500, least=4)
    """Steps for which those are trained that learn, to hit and to their task; a quarter of them too."""
    resume: bool = False
    """Goes on where a run into the same folder, of the same code and options, was interrupted."""


class HarmCell(NamedTuple):
    """One policy in one task, and what goes wrong in it."""

    kind: str  # "hostile", "trained", "untrained", "early", "healthy" or "faulty"
    task: str
    policy: str
    fault: str = NOMINAL
    speed: float = 1.0  # of a hostile one
    robot: str = "Panda"
    rate: int = 20  # rows of the memory a second [Hz]
    steps: int = 0  # of training


def cells(config: Config) -> list[tuple[HarmCell, int]]:
    """Every cell, and how many episodes it has."""
    tasks, n = [t for t in TASKS if t in (config.tasks or TASKS)], config.training
    hostile = [HarmCell("hostile", task, name) for task, name in product(tasks, HOSTILE)]
    slower = [HarmCell("hostile", task, "down", speed=s) for task, s in product(tasks, (0.5, 0.25))]
    trained = [HarmCell("trained", task, name, steps=n) for task, name in product(tasks, HITTERS)]
    untrained = [HarmCell("untrained", task, name) for task, name in product(tasks, LEARNERS)]
    early = [
        HarmCell("early", task, f"{name} after {steps}", steps=steps)
        for task, name, steps in product(tasks, LEARNERS, (n // 4, n))
    ]
    elsewhere = [cell._replace(robot=robot, rate=rate) for (robot, rate), cell in product(ELSEWHERE, hostile)]
    healthy = [
        HarmCell("healthy", task, policy)
        for task, policy in HEALTHY.values()
        if task in (config.tasks or HEALTHY_TASKS)
    ]
    faulty = [
        cell._replace(kind="faulty", fault=fault)
        for cell, fault in product(healthy, FAULTS)
        if cell.task in ("Lift", "Stack")
    ]
    groups = dict(zip(AGAINST, (hostile + slower, untrained, trained + early, elsewhere, faulty), strict=True))
    counted = [(groups[name], config.episodes) for name in config.against if name in groups]
    counted.append((healthy, config.healthy))
    return [(cell, n) for group, n in counted for cell in group if n]


def file_of(cell: HarmCell, config: Config) -> Any:
    """Of an agent that was trained."""
    name = cell.policy.split(" after ")[0]
    return harm_agents.made(config.out / "harm_agents", cell.robot, cell.task, name, cell.steps, config.seed)


def policy_of(cell: HarmCell, env: gym.Env[Any, Any], seed: int, config: Config) -> Policy:
    """The policy of an episode."""
    if cell.kind == "hostile":
        return HOSTILE[cell.policy](env, seed, cell.speed)
    if cell.steps:
        return harm_agents.agent(file_of(cell, config), env, seed)
    if cell.kind == "untrained":
        return harm_agents.untrained(cell.policy, env, seed)
    return policy_for(cell.policy, env, seed)


def measured(job: tuple[HarmCell, int], config: Config) -> list[kit.Record]:
    """One scene under every guard; kept, for a run that goes on."""
    cell, seed = job
    kept = config.out / "harm_scenes" / f"{'-'.join(map(str, cell))}-{seed}.json".replace(" ", "_")
    if config.resume and kept.is_file():
        found: list[kit.Record] = json.loads(kept.read_text(encoding="utf-8"))
        return found
    memory = NeuralASM.pretrained(cell.robot.lower() + ("" if cell.rate == 20 else f"_{cell.rate}hz"))
    records = [one(cell, seed, name, memory, config) for name in config.guards]
    with written_whole(kept) as file:
        file.write(json.dumps(records).encode())
    return records


def guarded(env: gym.Env[Any, Any], guard: str, memory: NeuralASM, rate: int) -> gym.Env[Any, Any]:
    """An environment under one of ``GUARDS``."""
    told = GUARDS[guard]
    if guard == IDEAL:
        return OracleReflex(env, beyond=EXCESS)
    fast = None if rate == 20 else rate
    return env if told is None else NeuralASMSafety(env, memory, on_overrun="ignore", monitor_freq=fast, **told)


def one(cell: HarmCell, seed: int, guard: str, memory: NeuralASM, config: Config) -> kit.Record:
    """One episode."""
    trial = Trial(env_id(cell.task), seed, cell.fault, "" if cell.fault in (NOMINAL, "passing_push") else "medium")
    rollouts = RolloutConfig(robot=cell.robot, stream_freq=None if cell.rate == 20 else cell.rate)
    arm: Any = environment(trial.env_id, rollouts.settings).unwrapped
    infos: list[dict[str, Any]] = []
    felt, steps = Felt(arm), list[Any]()  # where rows within steps begin anew, every substep is read by itself
    with staged(trial, rollouts) as env, felt.reading(steps if cell.rate == 20 else arm.substep_hooks):
        policy = policy_of(cell, env, seed, config)
        within = guarded(env, guard, memory, cell.rate)

        def keep(info: dict[str, Any]) -> None:
            infos.append(info)
            for read in steps:
                read()

        success = rollout(within, policy, seed, keep)
    asm = [info["asm"] for info in infos if "asm" in info]
    ended = bool(asm and (asm[-1]["gave_up"] or (guard == "terminate" and asm[-1]["alarm"])))
    return {
        **cell._asdict(),
        "guard": guard,
        "seed": seed,
        "success": bool(success),
        **(blows := harm_of(felt.force, arm.substeps)),
        "hand": hand_speed(arm, infos, blows["first_step"]),
        "strain": felt.torque,
        "steps": len(infos),
        "alarms": sum(a["alarm"] for a in asm),
        "held": sum(bool(info.get("overridden")) for info in infos),
        "ended_s": len(infos) * control_period(arm) if ended else None,
    }


def run(config: Config) -> kit.Findings:
    """Every cell on its own scenes, under every guard."""
    asked = cells(config)
    taught = [cell for cell, _ in asked if cell.steps]
    kit.each("training", partial(file_of, config=config), taught, config)
    jobs = [
        (cell, 10_000 * again + 1000 + n) for again in config.repetitions for cell, count in asked for n in range(count)
    ]
    records = kit.together(kit.each("episodes", partial(measured, config=config), jobs, config))
    guards = config.guards
    usual = [r for r in records if r["robot"] == "Panda" and r["rate"] == 20]
    tables = [
        harm_report.sums_table(usual, guards),
        harm_report.settings_table(records, guards),
        harm_report.harm_table(records, guards),
        harm_report.blows_table(records, [g for g in guards if g in (POLICY_ALONE, "default")]),
    ]
    tables += [harm_report.kept_table(records, guards, kind) for kind in ("healthy", "faulty")]
    return kit.Findings(records, [table for table in tables if table.rows], harm_report.frontier(records, guards))
