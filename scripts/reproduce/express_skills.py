"""Express skills: one memory of four robosuite skills closes the loop; what it expects to be commanded is commanded.

It has watched the scripted experts of Lift, Stack, PickPlaceCan and Door, was never told which was which, and is put in
front of new scenes. A GRU policy that was cloned by backpropagation through time from the same episodes reads the same.
The scripted experts themselves are the ceiling.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from asm_gym.episode import Episode
from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.statistics import wilson_interval
from asm_gym.evaluation.tables import Table
from asm_gym.monitors import NeuralASM
from asm_gym.policies import NeuralASMPolicy, make_policy, rollout
from asm_gym.policies.base import Policy
from asm_gym.policies.registry import EXPERTS
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.staging import environment
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.apprentices import CONSISTENT, SETTINGS, Clone, demonstrate, stream_of
from asm_gym.scripts.reproduce.kit import Findings, Record, over_seeds, shown
from asm_gym.scripts.reproduce.recordings import wide_enough

MODELS = ("memory", "gru", "expert")
INPUTS = 75
"""Numbers read of the four tasks."""

CALLED = {"memory": "Neural ASM, no BPTT", "gru": "GRU, BPTT", "expert": "scripted expert"}


@dataclass(frozen=True)
class Config(kit.Config):
    """Skills expressed in closed loop, against a clone by backpropagation and the expert."""

    tasks: tuple[str, ...] = option(("Lift", "Stack", "PickPlaceCan", "Door"), quick=("Lift",), least=1)
    """Whose skills one memory learns."""
    demonstrations: int = option(80, quick=6, least=1)
    """Demonstrations of each task; those that fail are left out."""
    units: int = option(512, check=partial(wide_enough, channels=INPUTS))
    """Hidden units of the motor association of the memory."""
    hidden: int = option(256, check=partial(wide_enough, channels=INPUTS))
    """Units of the GRU, which have several times as many weights."""
    updates: int = option(600, quick=20, least=1)
    """Updates of the GRU, 16 episodes each."""
    trials: int = option(34, quick=2, least=1)
    """Scenes of each task, for each seed other ones."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.tasks)) < len(self.tasks):
            raise ValueError(f"a task was named twice: {', '.join(self.tasks)}")
        for task in self.tasks:
            if task not in EXPERTS or task.startswith("TwoArm"):
                known = ", ".join(t for t in EXPERTS if not t.startswith("TwoArm"))
                raise ValueError(f"unknown skill {task!r}; there is an expert of one arm for: {known}")


class Scenes(NamedTuple):
    """Scenes of a task, for one policy."""

    task: str
    model: str
    seed: int
    scenes: tuple[int, ...]


class TrainedModel(NamedTuple):
    """Somebody who has learned."""

    seed: int
    model: str
    brain: NeuralASM | Clone
    seconds: float


def learn(what: tuple[str, int], episodes: Sequence[Episode], config: Config) -> TrainedModel:
    """(model, seed) after the lessons."""
    model, seed = what
    start = time.perf_counter()
    brain: NeuralASM | Clone
    if model == "gru":
        brain = Clone.learned(episodes, config.hidden, config.updates, np.random.default_rng(seed))
    else:
        # What watches may be small here, for only what acts is measured.
        sizes = {"hidden_size": 32, "association_size": 32, "epochs": 1, "iterations": 5}
        brain = NeuralASM(episodes[0].spec, seed=seed, **sizes).fit(episodes)  # type: ignore[arg-type]
        brain.learn_to_act(episodes, config.units)
    return TrainedModel(seed, model, brain, time.perf_counter() - start)


def attempt(trial: Scenes, brains: Mapping[tuple[str, int], NeuralASM | Clone]) -> list[Record]:
    """How each scene went."""
    env = environment(f"asm_gym/{trial.task}-v0", SETTINGS)
    where = {"task": trial.task, "model": trial.model, "seed": trial.seed}
    records = []
    for scene in trial.scenes:
        policy: Policy
        brain = brains.get((trial.model, trial.seed))
        if brain is None:
            policy = make_policy("scripted", env, seed=scene, style=CONSISTENT)
        else:
            policy = NeuralASMPolicy(brain, env) if isinstance(brain, NeuralASM) else brain.bound(env)
        steps: list[bool] = []
        success = rollout(env, policy, scene, lambda info, s=steps: s.append(True))  # type: ignore[misc]
        records.append({**where, "scene": scene, "success": float(success), "steps": len(steps)})
    return records


def trials(config: Config) -> list[Scenes]:
    """Every policy in every scene, a task after the other, so that a process seldom makes a new environment."""
    plan = []
    for task in config.tasks:
        for seed in config.repetitions:
            scenes = tuple(role_seeds(seed, task, "express", config.trials))
            plan += [Scenes(task, m, seed, scenes[i : i + 17]) for m in MODELS for i in range(0, len(scenes), 17)]
    return plan


def tables(records: Sequence[Record], config: Config) -> list[Table]:
    """Success, and how long it took."""
    columns = ("", *config.tasks)
    of = {m: [r for r in records if r["model"] == m] for m in MODELS}

    def row(model: str, value: str, scale: float, digits: int) -> tuple[str, ...]:
        own = [{**r, value: scale * r[value]} for r in of[model] if value == "success" or r["success"]]
        return (CALLED[model], *(shown(own, value, digits, task=t) for t in config.tasks))

    intervals = []
    for model in MODELS:
        bounds = []
        for task in config.tasks:
            won = [r["success"] for r in of[model] if r["task"] == task]
            low, high = wilson_interval(int(sum(won)), len(won))
            bounds.append(f"{100 * low:.0f} to {100 * high:.0f}")
        intervals.append((CALLED[model], *bounds))
    scenes = f"{config.trials} scenes a task and seed, {config.demonstrations} demonstrations a task, one network"
    return [
        Table(f"Success [%], {scenes}; mean ± SD over seeds", columns, [row(m, "success", 100, 1) for m in MODELS]),
        Table("Success [%], 95 % Wilson interval over all scenes and seeds", columns, intervals),
        Table("Steps to success; mean ± SD over seeds", columns, [row(m, "steps", 1, 0) for m in MODELS]),
    ]


def drawn(records: Sequence[Record], config: Config) -> Figure:
    """Success by task, and how soon."""
    with figure(height=3.4, width=9.0) as fig:
        bars, curves = fig.subplots(1, 2)
        for i, model in enumerate(MODELS):
            found = [over_seeds(records, "success", task=t, model=model) for t in config.tasks]
            mean, spread = 100 * np.array(found).T
            x = np.arange(len(config.tasks)) + 0.26 * (i - 1)
            bars.bar(x, mean, 0.24, yerr=spread, color=look(i)[0], error_kw={"linewidth": 1}, label=CALLED[model])
            own = [r for r in records if r["model"] == model]
            ended = np.sort([r["steps"] if r["success"] else np.inf for r in own])
            steps = np.arange(1 + max(r["steps"] for r in records))
            share = 100 * np.searchsorted(ended, steps, side="right") / len(ended)
            curves.plot(steps, share, color=look(i)[0], linestyle=look(i)[1])
        bars.set_xticks(range(len(config.tasks)), list(config.tasks))
        bars.set(ylabel="success [% of scenes]", ylim=(0, 105))
        curves.set(xlabel="steps", ylabel="solved so far, all tasks [%]", ylim=(0, 105), xlim=0)
        fig.legend(loc="outside upper center", ncols=3)
    return fig


def run(config: Config) -> Findings:
    """Shows, teaches, and lets everybody try."""
    spec = stream_of(config.tasks)
    plan = [(t, s) for t in config.tasks for s in role_seeds(0, t, "demonstrate", config.demonstrations)]
    shown_ones = kit.each("demonstrating", partial(demonstrate, spec=spec), plan, config)
    episodes = [e for e in shown_ones if e is not None]
    # Those who take longest first, so that nobody waits for the last of them.
    wanted = [(m, s) for m in ("gru", "memory") for s in config.repetitions]
    learned = kit.each("learning", partial(learn, episodes=episodes, config=config), wanted, config)
    brains = {(p.model, p.seed): p.brain for p in learned}
    found = kit.each("acting", partial(attempt, brains=brains), trials(config), config)
    records = [r for each in found for r in each]
    facts = {
        "demonstrations": {t: sum(e.info["skill"] == t for e in episodes) for t in config.tasks},
        "steps": sum(map(len, episodes)),
        "seconds_to_learn": {m: [round(p.seconds, 1) for p in learned if p.model == m] for m in ("memory", "gru")},
    }
    return Findings(records, tables(records, config), drawn(records, config), facts)
