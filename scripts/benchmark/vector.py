"""Steps a second of many environments at once: on threads, in processes, one after another, and of physics alone."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from mujoco.rollout import Rollout
from rich.console import Console

from asm_gym.envs.threaded_vector import ThreadVectorEnv
from asm_gym.evaluation.tables import Table
from asm_gym.scripts.benchmark.turns import check_quiet, take_turns

THREADS, PROCESSES, ONE_BY_ONE, PHYSICS = "ThreadVectorEnv", "AsyncVectorEnv", "SyncVectorEnv", "mujoco.rollout"


def vector_table(
    make: Callable[[], gym.Env[Any, Any]], members: tuple[int, ...], steps: int, console: Console, even_if_busy: bool
) -> Table:
    """Steps of all members together a second, and the ratio to one member after another in the same run.

    Args:
        make: makes one environment of this package, whose episodes have no end.
        members: how many stand side by side.
        steps: of each rival, for each number of members.

    Raises:
        BusyError: the machine has too much else to do, unless ``even_if_busy``.
    """
    if not even_if_busy:
        check_quiet(1.0, os.getloadavg()[0], os.cpu_count() or 1)
    rows = []
    for n in members:
        with rivals(make, n) as calls:
            # All but one of them use other cores too: their own share of one says nothing.
            turns = take_turns(calls, steps, console, even_if_busy=True)
        rate = {name: f"{n / turns.median(name):.0f}" for name in calls}
        faster = [f"{rate[name]} ({turns.faster(name, ONE_BY_ONE)})" for name in (THREADS, PROCESSES, PHYSICS)]
        rows.append((str(n), rate[ONE_BY_ONE], *faster))
    names = "members", ONE_BY_ONE, THREADS, PROCESSES, f"{PHYSICS}, mj_step alone"
    return Table(f"steps/s of all members, median of {steps} steps on {os.cpu_count()} cores", names, rows)


@contextmanager
def rivals(make: Callable[[], gym.Env[Any, Any]], n: int) -> Iterator[dict[str, Callable[[], Any]]]:
    """One step of ``n`` members by the name of who does it; all are closed in the end."""
    with ExitStack() as stack:
        many = AsyncVectorEnv([make] * n)  # processes are forked before there are threads
        stack.callback(many.close)
        envs = ThreadVectorEnv([make] * n)
        stack.callback(envs.close)
        for each in (many, envs):
            each.reset(seed=0)
        # Held, as a policy's actions are: noise alone would keep the arms in place.
        actions = np.full_like(envs.action_space.sample(), 0.1)
        # One after another are the same members, each waited for: another loaded model each is hundreds of megabytes.
        calls: dict[str, Callable[[], Any]] = {
            ONE_BY_ONE: partial(SyncVectorEnv.step, envs, actions),
            THREADS: partial(envs.step, actions),
            PROCESSES: partial(many.step, actions),
        }
        first: Any = envs.envs[0].unwrapped
        sim = first.simulation
        data = [mujoco.MjData(sim.model) for _ in range(n)]
        state = np.zeros((n, mujoco.mj_stateSize(sim.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        for row in state:
            mujoco.mj_getState(sim.model, sim.data, row, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        pool = stack.enter_context(Rollout(nthread=n))
        calls[PHYSICS] = partial(pool.rollout, sim.model, data, state, nstep=sim.substeps)
        yield calls
