"""How fast a hand may go by place, direction and load: what of healthy motion is slowed, and how fast it would hit.

Rules are learned from some healthy episodes of a task and asked about others, and about where hostile policies hit
first, all without a guard. Each knows the 95 % quantile of speed in cubes of 2 cm, by itself, by the direction of
motion and by whether the hand carries something; what it does not know goes at 0.05 m/s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.contact_limits import ContactLimits
from asm_gym.evaluation.tables import Column, Table, tabulate
from asm_gym.familiar_speed import PLACE, UNKNOWN, VELOCITY, FamiliarSpeed
from asm_gym.policies import Policy, rollout
from asm_gym.rollouts.staging import environment
from asm_gym.scripts.reproduce.kit import Record
from asm_gym.spec import StreamSpec
from asm_gym.tasks import env_id

RULES = "no place", "place", "place and direction", "place, direction and load"

RAM = "down", "aside and down", "forward"
"""Hostile policies that hit what is in their way."""

MOVES = 0.01
"""A slower hand has no direction [m/s]."""

CARRIES = 2.0
"""A gripper that presses with more does [N]."""

FIRM = 40.0
"""[N]"""


def kinds(rows: NDArray[np.floating[Any]], spec: StreamSpec, rule: str) -> NDArray[np.intp]:
    """(T,) which of its tables a rule asks about rows (T, D)."""
    velocity = rows[:, spec.slices[VELOCITY]]
    axis = np.abs(velocity).argmax(axis=1)
    way = 1 + 2 * axis + (np.take_along_axis(velocity, axis[:, None], axis=1)[:, 0] < 0)
    way[np.linalg.norm(velocity, axis=1) < MOVES] = 0
    carries = np.abs(rows[:, spec.slices["gripper_force"]]).max(axis=1) > CARRIES
    direction = way if "direction" in rule else np.zeros_like(way)
    return np.asarray(direction + 10 * carries if "load" in rule else direction, np.intp)


def limits_by(rule: str, known: Sequence[NDArray[Any]], rows: NDArray[Any], spec: StreamSpec) -> NDArray[np.float64]:
    """(T,) how fast the hand may go in rows (T, D) [m/s], by other episodes (T', D)."""
    most = np.full(len(rows), ContactLimits().hand_speed)
    if rule == RULES[0]:
        return most
    learned = np.concatenate(known)
    theirs, asked = kinds(learned, spec, rule), kinds(rows, spec, rule)
    for kind in np.unique(asked):
        speeds = FamiliarSpeed.learned([learned[theirs == kind]], spec) if (theirs == kind).any() else None
        for t in np.flatnonzero(asked == kind):
            place = rows[t, spec.slices[PLACE]]
            most[t] = min(most[t], UNKNOWN if speeds is None else speeds.at(place))
    return most


def speeds(
    job: tuple[str, tuple[str, ...]], episodes: int, make: Callable[[str, gym.Env[Any, Any], int], Policy]
) -> list[Record]:
    """What each rule makes of a task, by so many episodes of each of its healthy policies."""
    task, policies = job
    env = environment(env_id(task))
    spec: StreamSpec = env.get_wrapper_attr("stream_spec")

    def lived(name: str, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        infos: list[dict[str, Any]] = []
        rollout(env, make(name, env, seed), seed, infos.append)
        return np.stack([i["stream"] for i in infos]).astype(np.float64), np.array([i["contact_force"] for i in infos])

    healthy = [lived(name, 500 + n)[0] for n in range(episodes) for name in policies]
    half = len(healthy) // 2
    known, others = healthy[:half], np.concatenate(healthy[half:])
    before: list[NDArray[np.float64]] = []  # rows before a first blow
    for name in RAM:
        for n in range(max(1, episodes // 4)):
            rows, force = lived(name, 700 + n)
            before += [rows[t - 1] for t in np.flatnonzero(force > FIRM)[:1] if t > 0]
    fast = np.linalg.norm(others[:, spec.slices[VELOCITY]], axis=1)
    found = []
    for rule in RULES:
        most = limits_by(rule, known, others, spec)
        hits = limits_by(rule, known, np.stack(before), spec) if before else np.zeros(0)
        slowed = {"slowed": float((fast > most).mean()), "halved": float((fast > 2 * most).mean())}
        found.append({"task": task, "rule": rule, **slowed, "hits": hits.tolist()})
    return found


def speeds_table(records: Sequence[Record]) -> Table:
    """A row for each rule."""

    def mean(value: str, task: str, rule: str) -> str:
        own = [r[value] for r in records if r["rule"] == rule and task in ("", r["task"])]
        return f"{100 * np.mean(own):.1f} %"

    def blow(rule: str) -> str:
        hits = [speed for r in records if r["rule"] == rule for speed in r["hits"]]
        return f"{np.mean(hits):.3f} ({len(hits)} hits)" if hits else ""

    tasks = dict.fromkeys(r["task"] for r in records)
    columns: list[Column[str]] = [Column("what is known of speed", str)]
    columns += [Column(f"{task}: healthy rows faster than that", partial(mean, "slowed", task)) for task in tasks]
    columns.append(Column("twice as fast, all tasks", partial(mean, "halved", "")))
    columns.append(Column("limit where hostile policies hit first [m/s]", blow))
    return tabulate("Speed by place, direction and load", columns, RULES)
