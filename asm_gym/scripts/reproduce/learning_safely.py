"""Learning from scratch: what a guard does for an agent that explores, and what it costs the agent.

PPO and SAC of stable-baselines3 learn four motions alone, under guards, and with the cost of alarms in the reward.
Harm is the contact force on the arm beyond 40 N, summed over all physics substeps of learning [N s], from the
simulator. Every run has a file of its own: the same command continues after a kill. A run of PPO takes about
1.5 minutes of one core and one of SAC five, the whole study some five hours of two cores, by estimate.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from gymnasium.vector import VectorEnv
from gymnasium.wrappers.vector import TransformAction
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from asm_gym.envs.vector import cores
from asm_gym.files import write_text
from asm_gym.guard.responses import CAUSES, PRESSING
from asm_gym.rollouts.executed_sac import ExecutedSAC
from asm_gym.rollouts.learner_vector import LearnerVector
from asm_gym.rollouts.learning_record import LearningRecord
from asm_gym.rollouts.priced_cost import Lagrangian, PricedCost
from asm_gym.rollouts.run_folder import claimed, make_missing
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit, learning_tables
from asm_gym.scripts.reproduce.learning_scenes import REACH, TASKS, SpeedLimited, vector
from asm_gym.tasks import ROBOTS
from asm_gym.wrappers import VectorNeuralASMSafety

ALGORITHMS = ("PPO", "SAC")
ALONE = "alone"
DEFAULT = "default"
SLOW = 0.15  # of the fixed speed limit [m/s]
SMALL = 0.3  # share of the actions with which a hand goes as fast as the guard lets it go where nothing is near
GOING_ON = {cause: "go on" for cause in CAUSES if not cause.endswith(PRESSING)}


@dataclass(frozen=True)
class Way:
    """One way to learn."""

    guard: dict[str, Any] | None = None
    """Settings of the wrapper; None for no guard."""
    hand_speed: float = math.inf
    """A fixed limit of the hand's speed, without a guard [m/s]."""
    action_share: float = 1.0
    """What a full action of the agent is of one of the environment; that of the fingers stays."""
    first_spread: float = 1.0
    """Standard deviation of PPO's actions when it begins, in full actions."""
    price: float = 0.0
    """What a step in alarm costs, in reward."""
    cost_limit: float | None = None
    """The mean cost of a step that the price is to lead to; None for a fixed price."""
    executed_stored: bool = False
    """SAC stores the action that the guard executed; else the one that it chose."""
    algorithms: tuple[str, ...] = ALGORITHMS
    """Which algorithms can learn so."""


WAYS = {
    ALONE: Way(),
    DEFAULT: Way(guard={}),
    "contact limits": Way(guard={"responses": GOING_ON}),
    "speed limit": Way(hand_speed=SLOW),
    "small actions": Way(action_share=SMALL),
    "small actions, guarded": Way(guard={}, action_share=SMALL),
    "small noise": Way(guard={}, first_spread=SMALL, algorithms=("PPO",)),
    "small noise, alone": Way(first_spread=SMALL, algorithms=("PPO",)),
    "cost in reward": Way(guard={"on_alarm": "monitor"}, price=0.1, algorithms=("PPO",)),
    "Lagrangian": Way(guard={"on_alarm": "monitor"}, cost_limit=0.05, algorithms=("PPO",)),
    "truncated": Way(guard={"on_alarm": "terminate", "truncate": True}),
    "executed action": Way(guard={}, executed_stored=True, algorithms=("SAC",)),
}
"""Ways by name.

- *contact limits* goes on at every alarm that is no pressing, *truncated* truncates the episode at an alarm.
- *small actions* tells what slow hands alone cost; *guarded*, that a full action is as fast as the guard lets it be.
- *small noise* begins with as much noise as the guard lets through where nothing is near; beside it the same alone.
- *executed action* is the default guard, and SAC stores what was executed.
"""
PRICE_RATE = 0.2  # of the price that follows a limit, for each rollout


class PPOSettings(NamedTuple):
    """Settings of PPO beside stable-baselines3's own."""

    n_steps: int = 256
    batch_size: int = 256
    gamma: float = 0.98


class SACSettings(NamedTuple):
    """Settings of SAC beside stable-baselines3's own: half an update for each step of a member."""

    learning_starts: int = 1_000
    batch_size: int = 128
    gradient_steps: int = 4  # after each step of the vector, of eight members by default
    gamma: float = 0.98


@dataclass(frozen=True)
class Config(kit.Config):
    """Agents that learn from scratch, alone and under guards."""

    seeds: int = option(5, quick=2, least=1)
    """Number of repetitions; they take the seeds that follow."""
    tasks: tuple[str, ...] = option(TASKS, quick=(REACH,), known=TASKS, metavar="TASK")
    """What is learned. Reach is Lift's scene with the reward of its first part: the hand moves to the cube."""
    algorithms: tuple[str, ...] = option(
        ALGORITHMS, quick=("PPO",), known=ALGORITHMS, metavar="NAME"
    )
    """How it is learned."""
    ways: tuple[str, ...] = option(
        (ALONE, DEFAULT, "contact limits", "speed limit", "cost in reward", "Lagrangian"),
        quick=(ALONE, DEFAULT),
        known=WAYS,
        metavar="NAME",
    )
    """Under which guard, or at which price of alarms."""
    robot: str = option("Panda", known=ROBOTS)
    """The arm."""
    steps: int = option(40_960, quick=1_024, least=1)
    """Control steps of each run; PPO rounds up to whole rollouts, of 256 steps of each environment."""
    envs: int = option(8, quick=2, least=1)
    """Environments side by side."""
    evaluation_episodes: int = option(24, quick=2, least=1)
    """Episodes of the trained policy, alone and under the default guard."""
    pace_envs: tuple[int, ...] = option((8, 16), quick=(2,))
    """Sizes of vectors in which steps a second are compared, with a guard and without."""
    pace_blocks: int = option(6, quick=2, least=0)
    """How often they are compared; 0 for not at all."""


@dataclass(frozen=True)
class Run:
    """One agent that learns."""

    task: str
    algorithm: str
    way: str
    seed: int
    robot: str
    steps: int
    envs: int
    evaluation_episodes: int
    threads: int = 1

    @property
    def key(self) -> kit.Record:
        """What distinguishes it from other runs of a study."""
        names = ("robot", "task", "algorithm", "way", "seed")
        return {name: getattr(self, name) for name in names}

    @property
    def file_name(self) -> str:
        """Name of its file."""
        parts = [str(value).replace(",", "").replace(" ", "_") for value in self.key.values()]
        return "-".join(parts) + ".json"


def runs(config: Config) -> list[Run]:
    """Return the runs of a study, seed by seed; ValueError where no algorithm learns in any way."""
    found = []
    threads = max(1, cores() // config.workers)
    conditions = product(config.repetitions, config.tasks, config.algorithms, config.ways)
    for seed, task, algorithm, way in conditions:
        if algorithm not in WAYS[way].algorithms:
            continue
        run = Run(
            task=task,
            algorithm=algorithm,
            way=way,
            seed=seed,
            robot=config.robot,
            steps=config.steps,
            envs=config.envs,
            evaluation_episodes=config.evaluation_episodes,
            threads=threads,
        )
        found.append(run)
    if not found:
        algorithms = ", ".join(config.algorithms)
        raise ValueError(f"{algorithms} cannot learn in the ways {', '.join(config.ways)}")
    return found


# ------------------------------------------------------------------ one run


def recorded(envs: VectorEnv[Any, Any, Any], way: Way) -> LearningRecord:
    """Return a vector under the guard of a way, with a record of its episodes."""
    if math.isfinite(way.hand_speed):
        envs = SpeedLimited(envs, way.hand_speed)
    if way.guard is not None:
        envs = VectorNeuralASMSafety(envs, **way.guard)
    return LearningRecord(envs)


def seen_by_learner(record: LearningRecord, way: Way) -> LearnerVector:
    """Return a recorded vector as the agent of a way steps it."""
    if way.action_share == 1.0:
        return LearnerVector(record)
    return LearnerVector(TransformAction(record, partial(smaller, way.action_share)))


def smaller(share: float, actions: Any) -> Any:
    """Return actions (N, A) that move hands by a share of what they did; the last number moves the fingers."""
    return np.concatenate([share * actions[:, :-1], actions[:, -1:]], axis=1)


class Learner(NamedTuple):
    """An agent, and what it learns from."""

    agent: BaseAlgorithm
    scaled: VecNormalize
    callbacks: list[BaseCallback]


def make_learner(algorithm: str, record: LearningRecord, way: Way, seed: int) -> Learner:
    """Return an untrained agent in a recorded vector."""
    learned_from: Any = seen_by_learner(record, way)
    callbacks: list[BaseCallback] = []
    if way.price > 0 or way.cost_limit is not None:
        learned_from = PricedCost(learned_from, way.price)
        if way.cost_limit is not None:
            callbacks.append(Lagrangian(learned_from, way.cost_limit, PRICE_RATE))
    scaled = VecNormalize(learned_from, norm_reward=False)
    agent: BaseAlgorithm
    if algorithm == "PPO":
        on_policy = PPOSettings()._asdict()
        spread = {"log_std_init": math.log(way.first_spread)}
        agent = PPO("MlpPolicy", scaled, seed=seed, device="cpu", policy_kwargs=spread, **on_policy)
    else:
        kind = ExecutedSAC if way.executed_stored else SAC
        off_policy = SACSettings()._asdict()
        agent = kind("MlpPolicy", scaled, seed=seed, device="cpu", **off_policy)
    return Learner(agent, scaled, callbacks)


def learn(run: Run, folder: Path) -> Path:
    """Train the agent of a run, judge it, and write what came of it; return the file."""
    torch.set_num_threads(1)  # more of them slow networks this small down
    way = WAYS[run.way]
    with vector(run.task, run.robot, run.envs, run.threads) as envs:
        record = recorded(envs, way)
        learner = make_learner(run.algorithm, record, way, run.seed)
        processor = time.process_time()
        learner.agent.learn(run.steps, learner.callbacks)
        processor_seconds = time.process_time() - processor
        period = float(envs.get_attr("dt")[0])
        rounds = math.ceil(run.evaluation_episodes / run.envs)
        trained = {
            name: play(learner, recorded(envs, WAYS[name]), way, rounds, run.seed)
            for name in (ALONE, DEFAULT)
        }
    result = {
        **run.key,
        "period": period,
        "processor_seconds": processor_seconds,
        "steps": record.steps,
        "learning": columns(record.episodes),
        "trained": trained,
    }
    path = folder / run.file_name
    write_text(path, json.dumps(result) + "\n")
    return path


def play(learner: Learner, record: LearningRecord, way: Way, rounds: int, seed: int) -> kit.Record:
    """Return the columns of ``rounds`` episodes of each member under a trained policy, without exploration."""
    vector = seen_by_learner(record, way)
    vector.seed(10_000 + 100 * seed)  # scenes that learning has not begun with
    observations = vector.reset()
    while True:
        scaled = learner.scaled.normalize_obs(observations)
        actions, _ = learner.agent.predict(scaled, deterministic=True)
        observations, *_ = vector.step(actions)
        first: list[kit.Record] = []  # episodes of each member: a member of short ones ends more
        for number in range(record.num_envs):
            own = [each for each in record.episodes if each["member"] == number]
            first += own[:rounds]
        if len(first) == rounds * record.num_envs:
            return columns(first)


def columns(episodes: Sequence[kit.Record]) -> kit.Record:
    """Return the episodes as lists by name."""
    return pd.DataFrame(list(episodes)).to_dict(orient="list")


# ------------------------------------------------------------------ pace


class Pace(NamedTuple):
    """A comparison of steps a second, alone and under the default guard."""

    task: str
    robot: str
    envs: int
    blocks: int

    @property
    def file_name(self) -> str:
        """Name of its file."""
        return f"pace-{self.robot}-{self.task}-{self.envs}-{self.blocks}.json"


def paces(config: Config) -> list[Pace]:
    """Return the comparisons of a study: in its first task, for vectors of each size."""
    if not config.pace_blocks:
        return []
    return [
        Pace(task=config.tasks[0], robot=config.robot, envs=count, blocks=config.pace_blocks)
        for count in config.pace_envs
    ]


def measure(pace: Pace, folder: Path) -> Path:
    """Measure how many steps a second PPO makes in a vector, alone and guarded in turn; return the file.

    Both learn in the same environments, block after block, so that a busy machine slows both down.
    """
    found = []
    with vector(pace.task, pace.robot, pace.envs, cores()) as envs:
        learners = {}
        for name in (ALONE, DEFAULT):
            way = WAYS[name]
            learners[name] = make_learner("PPO", recorded(envs, way), way, seed=0)
        block_steps = PPOSettings().n_steps * pace.envs
        for block in range(pace.blocks + 1):
            for name, learner in learners.items():
                wall = time.perf_counter()
                processor = time.process_time()
                learner.agent.learn(block_steps)
                record: kit.Record = {
                    "task": pace.task,
                    "robot": pace.robot,
                    "envs": pace.envs,
                    "way": name,
                    "seed": block,
                    "steps_s": block_steps / (time.perf_counter() - wall),
                    "processor_steps_s": block_steps / (time.process_time() - processor),
                }
                if block > 0:  # in the first some code is still compiled
                    found.append(record)
    path = folder / pace.file_name
    write_text(path, json.dumps(found) + "\n")
    return path


# ------------------------------------------------------------------ the study


def run(config: Config) -> kit.Findings:
    """Run what is missing, and sum it up."""
    folder = config.out / "learning"
    settings = {
        "steps": config.steps,
        "envs": config.envs,
        "evaluation_episodes": config.evaluation_episodes,
    }
    wanted = runs(config)
    compared = paces(config)
    with claimed(folder, "settings.json", settings):
        with kit.stage("learning") as report:
            files = make_missing(
                partial(learn, folder=folder),
                wanted,
                lambda run: folder / run.file_name,
                config.workers,
                report,
            )
        with kit.stage("pace") as report:
            pace_files = make_missing(
                partial(measure, folder=folder),
                compared,
                lambda pace: folder / pace.file_name,
                1,  # alone on the machine
                report,
            )
    results = [json.loads(path.read_text(encoding="utf-8")) for path in files]
    measured: list[kit.Record] = []
    for path in pace_files:
        measured += json.loads(path.read_text(encoding="utf-8"))
    return learning_tables.findings(results, measured)
