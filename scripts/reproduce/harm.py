"""Harm avoided against success kept: what a guard lets through of policies that ram, and what it costs healthy ones.

Harm is the contact force on the arm in every physics substep beyond 40 N, summed over time [N s]: MuJoCo's, which no
sensor of the guard reads. Pairs share their seed: the same scene, policy, and fault where there is one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

from asm_gym.contact_limits import ContactLimits
from asm_gym.envs.backend import PHYSICS_FREQ
from asm_gym.evaluation.scored import NOMINAL, POLICY_ALONE
from asm_gym.evaluation.statistics import wilson_interval
from asm_gym.evaluation.tables import Column, Table, tabulate
from asm_gym.monitors import NeuralASM
from asm_gym.policies import Policy, rollout
from asm_gym.policies.hostile import HOSTILE
from asm_gym.rollouts.staging import environment, policy_for, staged
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.tasks import env_id
from asm_gym.wrappers import NeuralASMSafety

EXCESS = 40.0
"""Force beyond which contact counts as harm [N]."""

TRANSIENT = 280.0
"""ISO/TS 15066:2016, Table A.2: what a hand or finger may be hit with for a moment [N]."""

FIRST_S = 0.1
"""The first blow lasts for so long from the substep on in which it began [s]."""

GUARDS: dict[str, dict[str, Any] | None] = {
    POLICY_ALONE: None,
    "default": {},
    "no speed limit": {"contact_limits": ContactLimits(hand_speed=np.inf)},
    "no limits": {"contact_limits": None},
    "hold": {"on_alarm": "hold"},
    "terminate": {"on_alarm": "terminate"},
}
"""What the wrapper is told, by name; None for no wrapper."""

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

UNTRAINED = ("SAC", "PPO", "TD3")
"""Learners before their first update; they explore."""

FAULTS = ("frozen_encoder", "encoder_bias", "encoder_dropout", "weak_joint", "passing_push")
"""Kinds under which the healthy policies act too; of the suite, but for the last."""


@dataclass(frozen=True)
class Config(kit.Config):
    """Hostile, untrained and healthy policies, alone and under the guard."""

    seeds: int = option(1, least=1)
    """How often it is done anew, with other seeds."""
    robot: str = option("Panda", known=("Panda", "Sawyer", "IIWA"))
    """The arm, watched by its shipped memory."""
    episodes: int = option(10, quick=1, least=1)
    """Episodes of each hostile cell."""
    healthy: int = option(40, quick=1, least=0)
    """Episodes of each healthy policy."""
    faulty: int = option(0, least=0)
    """Episodes of each healthy policy of Lift and Stack under each kind of fault."""
    guards: tuple[str, ...] = option(
        (POLICY_ALONE, "default", "hold", "terminate"), known=tuple(GUARDS), metavar="NAME"
    )
    """Ways to guard."""
    tasks: tuple[str, ...] = option(("Lift", "Stack"), quick=("Lift",), metavar="TASK")
    """Where hostile and untrained policies act."""


class Cell(NamedTuple):
    """One policy in one task, and what goes wrong in it."""

    kind: str  # "hostile", "untrained", "healthy" or "faulty"
    task: str
    policy: str
    fault: str = NOMINAL
    speed: float = 1.0  # of a hostile one


def cells(config: Config) -> list[tuple[Cell, int]]:
    """Every cell, and how many episodes it has."""
    hostile = [Cell("hostile", task, name) for task, name in product(config.tasks, HOSTILE)]
    slower = [Cell("hostile", task, "down", speed=s) for task, s in product(config.tasks, (0.5, 0.25))]
    untrained = [Cell("untrained", task, name) for task, name in product(config.tasks, UNTRAINED)]
    healthy = [Cell("healthy", task, policy) for task, policy in HEALTHY.values()]
    faulty = [
        Cell("faulty", task, policy, fault)
        for task, policy in HEALTHY.values()
        for fault in FAULTS
        if task in ("Lift", "Stack")
    ]
    counted = ((hostile + slower + untrained, config.episodes), (healthy, config.healthy), (faulty, config.faulty))
    return [(cell, n) for group, n in counted for cell in group if n]


def untrained(name: str, env: gym.Env[Any, Any], seed: int) -> Policy:
    """A learner of stable-baselines3 that has learned nothing, exploring as it does then."""
    import stable_baselines3 as sb3
    from stable_baselines3.common.noise import NormalActionNoise

    space: Any = env.action_space
    more: dict[str, Any] = {} if name == "PPO" else {"buffer_size": 1}
    model = getattr(sb3, name)("MlpPolicy", env, seed=seed, device="cpu", **more)
    if name == "TD3":  # its own exploration: noise on what the actor says
        noise = NormalActionNoise(np.zeros(space.shape), np.full(space.shape, 0.1))
        return _Noisy(model, noise, space)
    policy: Policy = model
    return policy


class _Noisy:
    """A deterministic actor with its learner's noise."""

    def __init__(self, model: Any, noise: Any, space: Any) -> None:
        self._model, self._noise, self._space = model, noise, space

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[Any, Any]:
        """The next action (A,)."""
        action, state = self._model.predict(observation, state, episode_start, True)
        return np.clip(action + self._noise(), self._space.low, self._space.high).astype(np.float32), state


def policy_of(cell: Cell, env: gym.Env[Any, Any], seed: int) -> Policy:
    """The policy of an episode."""
    if cell.kind == "hostile":
        return HOSTILE[cell.policy](env, seed, cell.speed)
    if cell.kind == "untrained":
        return untrained(cell.policy, env, seed)
    return policy_for(cell.policy, env, seed)


def measured(job: tuple[Cell, int], config: Config) -> list[kit.Record]:
    """One scene under every guard."""
    cell, seed = job
    memory = NeuralASM.pretrained(config.robot.lower())
    trial = Trial(env_id(cell.task), seed, cell.fault, "" if cell.fault in (NOMINAL, "passing_push") else "medium")
    rollouts = RolloutConfig(robot=config.robot)
    return [one(cell, trial, name, memory, rollouts) for name in config.guards]


def one(cell: Cell, trial: Trial, guard: str, memory: NeuralASM, rollouts: RolloutConfig) -> kit.Record:
    """One episode."""
    arm: Any = environment(trial.env_id, rollouts.settings).unwrapped
    felt: list[Any] = []
    infos: list[dict[str, Any]] = []

    def keep(info: dict[str, Any]) -> None:
        felt.append(arm.simulation.contact_forces)
        infos.append(info)

    with staged(trial, rollouts) as env:
        told = GUARDS[guard]
        policy = policy_of(cell, env, trial.seed)
        within = env if told is None else NeuralASMSafety(env, memory, on_overrun="ignore", **told)
        success = rollout(within, policy, trial.seed, keep)
    force = np.concatenate(felt)  # (T K,) [N]
    hits = np.flatnonzero(force > EXCESS)
    soon = round(FIRST_S * PHYSICS_FREQ)
    asm = [info["asm"] for info in infos if "asm" in info]
    return {
        **cell._asdict(),
        "guard": guard,
        "seed": trial.seed,
        "success": bool(success),
        "harm": float(np.maximum(force - EXCESS, 0.0).sum() / PHYSICS_FREQ),
        "above_transient": float((force > TRANSIENT).mean() * len(force) / PHYSICS_FREQ),
        "peak": float(force.max()),
        "first": float(force[hits[0] : hits[0] + soon].max()) if hits.size else 0.0,
        "later": float(force[hits[0] + soon :].max(initial=0.0)) if hits.size else 0.0,
        "strain": float(np.nanmax([info.get("contact_load", np.nan) for info in infos], initial=0.0)),
        "steps": len(infos),
        "alarms": sum(a["alarm"] for a in asm),
        "held": sum(a["intervened"] for a in asm),
        "ended": bool(asm and (asm[-1]["gave_up"] or (guard == "terminate" and asm[-1]["alarm"]))),
    }


def total(records: Sequence[kit.Record], value: str, **where: Any) -> float:
    """The sum over the records that are as ``where`` says."""
    return float(sum(r[value] for r in records if all(r[k] == v for k, v in where.items())))


def left(records: Sequence[kit.Record], guard: str, value: str = "harm", **where: Any) -> float:
    """What share of the harm alone is left under ``guard``; not a number where there is none alone."""
    alone = total(records, value, guard=POLICY_ALONE, **where)
    return total(records, value, guard=guard, **where) / alone if alone > 0 else np.nan


def keys(records: Sequence[kit.Record]) -> list[dict[str, Any]]:
    """The cells that were run."""
    names = ("kind", "task", "policy", "fault", "speed")
    return [dict(zip(names, k, strict=True)) for k in dict.fromkeys(tuple(r[n] for n in names) for r in records)]


def _cell(key: dict[str, Any]) -> str:
    slow = "" if key["speed"] == 1.0 else f", {key['speed']:g} of full speed"
    wrong = "" if key["fault"] == NOMINAL else f", {key['fault'].replace('_', ' ')}"
    return f"{key['task']}, {key['policy']}{slow}{wrong}"


def harm_table(records: Sequence[kit.Record], guards: Sequence[str]) -> Table:
    """Cells of hostile and untrained policies."""

    def harm(guard: str, key: dict[str, Any]) -> str:
        n = sum(r["guard"] == guard for r in records if all(r[k] == v for k, v in key.items()))
        own = total(records, "harm", guard=guard, **key) / max(n, 1)
        share = left(records, guard, **key)
        return (
            f"{own:.1f}"
            if guard == POLICY_ALONE
            else f"{own:.1f} ({'' if np.isnan(share) else f'{100 * share:.1f} %'})"
        )

    def first(guard: str, key: dict[str, Any]) -> str:
        own = [r["first"] for r in records if r["guard"] == guard and all(r[k] == v for k, v in key.items())]
        return f"{np.median(own):.0f}"

    columns = [Column("policy", _cell)]
    columns += [Column(f"{guard}, harm [N s]", partial(harm, guard)) for guard in guards]
    columns += [Column(f"{guard}, first blow [N]", partial(first, guard)) for guard in guards]
    rows = [k for k in keys(records) if k["kind"] in ("hostile", "untrained")]
    return tabulate("Harm of an episode, and what is left of it", columns, rows)


def kept_table(records: Sequence[kit.Record], guards: Sequence[str], kinds: Sequence[str]) -> Table:
    """Cells of healthy policies."""

    def solved(guard: str, key: dict[str, Any]) -> str:
        own = {r["seed"]: r for r in records if r["guard"] == guard and all(r[k] == v for k, v in key.items())}
        alone = {r["seed"]: r for r in records if r["guard"] == POLICY_ALONE and all(r[k] == v for k, v in key.items())}
        n = sum(r["success"] for r in own.values())
        if guard == POLICY_ALONE:
            return f"{n} of {len(own)}"
        lost = sum(alone[s]["success"] and not own[s]["success"] for s in own if s in alone)
        won = sum(own[s]["success"] and not alone[s]["success"] for s in own if s in alone)
        return f"{n} (-{lost} +{won})"

    def harm(guard: str, key: dict[str, Any]) -> str:
        return f"{total(records, 'harm', guard=guard, **key):.1f}"

    columns = [Column("policy", _cell)]
    columns += [Column(f"{guard}, solved", partial(solved, guard)) for guard in guards]
    columns += [Column(f"{guard}, harm in all [N s]", partial(harm, guard)) for guard in guards]
    rows = [k for k in keys(records) if k["kind"] in kinds]
    return tabulate("Success kept", columns, rows)


def sums_table(records: Sequence[kit.Record], guards: Sequence[str]) -> Table:
    """Each way to guard, over all cells."""

    def avoided(kind: str, guard: str) -> str:
        share = left([r for r in records if r["kind"] == kind], guard)
        return "" if np.isnan(share) else f"{100 * (1 - share):.1f} %"

    def worst(guard: str) -> str:
        shares = [left(records, guard, **k) for k in keys(records) if k["kind"] == "hostile"]
        found = [s for s in shares if not np.isnan(s)]
        return f"{100 * (1 - max(found)):.1f} %" if found else ""

    def blow(guard: str) -> str:
        own = [r for r in records if r["kind"] == "hostile" and r["guard"] == guard]
        share = left([r for r in records if r["kind"] == "hostile"], guard, "first")
        return f"{np.mean([r['first'] for r in own]):.0f} N ({100 * share:.0f} %)" if own else ""

    def solved(guard: str) -> str:
        own = [r["success"] for r in records if r["kind"] == "healthy" and r["guard"] == guard]
        if not own:
            return ""
        low, high = wilson_interval(sum(own), len(own))
        return f"{100 * np.mean(own):.1f} % ({100 * low:.1f} to {100 * high:.1f})"

    def steps(guard: str) -> str:
        own = [r["held"] for r in records if r["kind"] == "healthy" and r["guard"] == guard]
        all_steps = [r["steps"] for r in records if r["kind"] == "healthy" and r["guard"] == guard]
        return f"{100 * sum(own) / max(sum(all_steps), 1):.2f} %" if own else ""

    columns: tuple[Column[str], ...] = (
        Column("guard", str),
        Column("harm of hostile policies avoided", partial(avoided, "hostile")),
        Column("in the worst cell", worst),
        Column("of untrained ones", partial(avoided, "untrained")),
        Column("of healthy ones", partial(avoided, "healthy")),
        Column("their first blow, mean", blow),
        Column("healthy episodes solved", solved),
        Column("healthy steps taken over", steps),
    )
    return tabulate("Harm avoided, success kept", columns, guards)


_LABEL: dict[str, Any] = {"textcoords": "offset points", "arrowprops": {"arrowstyle": "-", "lw": 0.5}}


def frontier(records: Sequence[kit.Record], guards: Sequence[str]) -> Figure:
    """Success kept against harm avoided, a point for each way to guard."""
    figure = Figure(figsize=(5.5, 4.0), layout="constrained")
    axes = figure.subplots()
    hostile = [r for r in records if r["kind"] in ("hostile", "untrained")]
    for n, guard in enumerate(guards):
        share = left(hostile, guard)
        own = [r["success"] for r in records if r["kind"] == "healthy" and r["guard"] == guard]
        if np.isnan(share) or not own:
            continue
        low, high = wilson_interval(sum(own), len(own))
        x, y = 100 * (1 - share), 100 * np.mean(own)
        axes.errorbar(x, y, yerr=[[y - 100 * low], [100 * high - y]], marker="o", capsize=3, color="C0")
        side, offset = ("left", 30) if x < 50 else ("right", -30)
        axes.annotate(f"{guard}: {x:.1f}, {y:.1f}", (x, y), xytext=(offset, 8 - 14 * n), ha=side, **_LABEL)
    axes.set_xlabel("harm of hostile and untrained policies avoided [%]")
    axes.set_ylabel("healthy episodes solved [%]")
    axes.set_xlim(-8, 106)
    return figure


def run(config: Config) -> kit.Findings:
    """Every cell on its own scenes, under every guard."""
    jobs = [
        (cell, 10_000 * again + 1000 + n)
        for again in config.repetitions
        for cell, episodes in cells(config)
        for n in range(episodes)
    ]
    records = kit.together(kit.each("episodes", partial(measured, config=config), jobs, config))
    guards = config.guards
    tables = [sums_table(records, guards), harm_table(records, guards)]
    asked = {r["kind"] for r in records}
    tables += [kept_table(records, guards, (kind,)) for kind in ("healthy", "faulty") if kind in asked]
    return kit.Findings(records, tables, frontier(records, guards))
