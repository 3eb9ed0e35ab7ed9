"""The hardest contact that a search over hostile policies finds under the guard, for each arm and task.

Each search keeps the programs that it has tried, hardest first. A new one is drawn at random, or is one of the hardest
with a change or two. What counts is the hardest contact of an episode, the first blow or any later one: MuJoCo's own
force on the arm in each physics substep, which no sensor of the guard reads.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import chain, product
from typing import Any, NamedTuple

import mujoco
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from asm_gym.evaluation.defaults import TRANSIENT
from asm_gym.evaluation.tables import Table
from asm_gym.policies import rollout
from asm_gym.policies.hostile_program import (
    Program,
    ProgramPolicy,
    changed_program,
    random_program,
)
from asm_gym.rollouts.run_trials import environment, staged
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.harm_cases import Case, guarded
from asm_gym.scripts.reproduce.kit import Record
from asm_gym.tasks import env_id

ARMS = ("Panda", "Sawyer", "IIWA")
AT_RANDOM = 0.25  # share of the programs drawn at random before any is changed,
ALWAYS_AT_RANDOM = 0.2  # and of those that follow
GREED = 0.35  # probability that the hardest is changed; else the next one, and so on
APPROACH_SUBSTEPS = 15  # before the peak, in which the speed of the approach is taken


class Search(NamedTuple):
    """One search, in a task with an arm."""

    task: str
    robot: str
    guard: str
    seed: int
    episodes: int


class HardestContact:
    """Notes the hardest contact of an arm in an episode; called after each physics substep.

    Args:
        arm: the environment, whose model some resets replace.

    Attributes:
        force: the largest net contact force on an arm [N].
        bodies: the two that pressed on each other hardest then.
        speed: at which an arm's body met another shortly before [m/s].
    """

    def __init__(self, arm: Any) -> None:
        self._arm = arm
        self._model: Any = None
        self._arm_geoms = np.zeros(0, bool)  # whether each geom is one
        self._speeds: deque[float] = deque(maxlen=APPROACH_SUBSTEPS)
        self.force = 0.0
        self.bodies = ("", "")
        self.speed = 0.0

    def __call__(self, substep: int) -> None:
        simulation = self._arm.simulation
        data = simulation.data
        if simulation.model is not self._model:
            self._model = simulation.model
            self._arm_geoms = _arm_geoms(simulation)
        touching = np.flatnonzero(self._arm_geoms[data.contact.geom].any(axis=1))
        rows = data.contact.efc_address[touching]
        rows = rows[rows >= 0]
        approach = 0.0
        if len(rows):
            approach = float(max(0.0, -data.efc_vel[rows].min()))
        self._speeds.append(approach)

        force = float(simulation.contact_forces[-1])
        if force > self.force and len(touching):
            self.force = force
            self.speed = max(self._speeds)
            self.bodies = _pressing(simulation, touching)


def _arm_geoms(simulation: Any) -> NDArray[np.bool_]:
    """Return which geoms are of an arm, its hand and fingers included."""
    model = simulation.model
    roots = model.body_rootid[simulation.arms.root]
    is_arm = np.isin(model.body_rootid, roots) & (model.body_weldid != 0)
    return is_arm[model.geom_bodyid]


def _pressing(simulation: Any, touching: NDArray[np.intp]) -> tuple[str, str]:
    """Return the bodies of the contact with the largest force."""
    model = simulation.model
    data = simulation.data
    wrench = np.zeros(6)
    forces = []
    for number in touching.tolist():
        mujoco.mj_contactForce(model, data, number, wrench)
        forces.append(np.linalg.norm(wrench[:3]))
    hardest = touching[int(np.argmax(forces))]
    one, other = model.geom_bodyid[data.contact.geom[hardest]]
    return model.body(one).name, model.body(other).name


def tried(search: Search, program: Program) -> Record:
    """Run one program under the guard; return the hardest contact of its episode."""
    trial = Trial(env_id(search.task), program.scene)
    case = Case("hostile", "program", trial, RolloutConfig(robot=search.robot))
    arm: Any = environment(trial.env_id, case.config.settings).unwrapped
    with staged(trial, case.config) as env:
        contact = HardestContact(arm)
        arm.substep_hooks.append(contact)
        try:
            guarded_env = guarded(env, search.guard, case)
            rollout(guarded_env, ProgramPolicy(guarded_env, program), program.scene)
        finally:
            arm.substep_hooks.remove(contact)
    return {
        "robot": search.robot,
        "task": search.task,
        "guard": search.guard,
        "seed": search.seed,
        "force": contact.force,
        "bodies": " on ".join(contact.bodies),
        "speed": contact.speed,
        "program": repr(program),
    }


def searched(search: Search) -> list[Record]:
    """Return the record of every program that a search has tried."""
    records: list[Record] = []
    best: list[tuple[float, Program]] = []  # hardest first
    for number in range(search.episodes):
        rng = np.random.default_rng([search.seed, number])
        program = _next_program(best, number < AT_RANDOM * search.episodes, rng)
        record = tried(search, program)
        records.append(record)
        best.append((record["force"], program))
        best.sort(key=lambda found: -found[0])
    return records


def _next_program(
    best: Sequence[tuple[float, Program]], at_random: bool, rng: np.random.Generator
) -> Program:
    """Return a program at random, or one of the hardest with a change or two."""
    if at_random or not best or rng.random() < ALWAYS_AT_RANDOM:
        return random_program(rng)
    place = min(int(rng.geometric(GREED)), len(best)) - 1
    return changed_program(best[place][1], rng)


def run(
    tasks: Sequence[str], guards: Sequence[str], episodes: int, config: kit.Config
) -> kit.Findings:
    """Search in every task with every arm, for every guard and seed."""
    chosen = product(config.repetitions, guards, ARMS, tasks)
    searches = [
        Search(task=task, robot=robot, guard=guard, seed=seed, episodes=episodes)
        for seed, guard, robot, task in chosen
    ]
    found = kit.resumed("searches", searched, searches, config)
    records = [*chain.from_iterable(found)]
    return kit.Findings(records, [table_of(records)])


def table_of(records: Sequence[Record]) -> Table:
    """Return a row for each arm and task: the hardest contact that was found, and how many were too hard."""
    rows = []
    for names, own in pd.DataFrame(records).groupby(["guard", "robot", "task"], sort=False):
        hardest = own.loc[own.force.idxmax()]
        rows.append(
            {
                "guard, arm, task": ", ".join(map(str, names)),
                "episodes": str(len(own)),
                "hardest contact [N]": f"{hardest.force:.0f}",
                "between": hardest.bodies,
                "speed [m/s]": f"{hardest.speed:.2f}",
                f"beyond {TRANSIENT:g} N": str((own.force > TRANSIENT).sum()),
            }
        )
    return kit.table_of("Hardest contact that a search finds", rows)
