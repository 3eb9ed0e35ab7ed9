"""Networks that learn by local rules on the Panda: six skills in one network, learned from unlabelled episodes.

Every task is seen by the same senses: the body, torques and the wrist, where the thing is from the hand, and its goal
from the thing. Two networks of the package, ``recurrent`` and ``settling``, are never told the skill. Each commands the
arm in closed loop, is surprised by the energy of its own errors (``closed_loop``), leaves out a group of senses that
alone is over its ceiling, and yields where several are. Beside them, on the same episodes: a GRU and an LSTM by
backpropagation through time, the motor association that acts today, a random forest for names, and two movement
primitives (``skill_envelope``) for surprise and action.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from PIL import Image, ImageDraw

from asm_gym.faults import Push
from asm_gym.rollouts.run_folder import make_missing
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.closed_loop import (
    LONGEST,
    Actor,
    Associated,
    Cell,
    Conditions,
    LocalNetwork,
    Reaction,
    Rollout,
    run_policy,
)
from asm_gym.scripts.reproduce.group_energy import SurprisedModel
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.scripts.reproduce.skill_claims import (
    ACTS,
    PUSHED,
    RECURRENT,
    STUCK,
    claims,
    drawn,
    tables,
)
from asm_gym.scripts.reproduce.skill_envelope import SkillEnvelope
from asm_gym.scripts.reproduce.skill_measures import Repetition, name_skills, predict
from asm_gym.scripts.reproduce.skill_surprise import (
    PROMP,
    TWINS,
    ablated,
    detect,
    learn_primitives,
)
from asm_gym.scripts.reproduce.workspace import (
    EVENT,
    FAULTS,
    SKILLS,
    UNKNOWN,
    Demonstration,
    Floats,
    demonstrate,
    environment,
)
from asm_gym.wrappers import FaultInjection, NeuralASMSafety

HELD_OUT = 1000  # seeds of faulty episodes and of their twins begin here
PARTS = {
    "prediction": "next rows, missing senses, and the hand from memory",
    "names": "names of skills",
    "surprise": "energy of the networks",
    "primitives": "surprise and closed loop of movement primitives",
    "ablations": "energy without its parts",
    "action": "closed loop of the networks and their rivals",
}


@dataclass(frozen=True)
class Config(kit.Config):
    """Two local networks on the Panda: six skills."""

    seeds: int = option(10, quick=2, least=1)
    """Number of repetitions; they take the seeds that follow."""
    episodes: int = option(36, quick=6, least=6)
    """Episodes of each skill that are recorded; a seed learns from most of them."""
    epochs: int = option(40, quick=4, least=1)
    """Passes of the local networks over their episodes."""
    updates: int = option(1200, quick=20, least=1)
    """Batches of the recurrent networks."""
    faulty: int = option(5, quick=1, least=1)
    """Episodes of each skill with each kind of fault, and of each unknown skill."""
    trials: int = option(3, quick=1, least=1)
    """Times that each skill is expressed."""
    steps: int = option(LONGEST, quick=45, least=1)
    """Rows after which an expression is left."""
    parts: tuple[str, ...] = option(tuple(PARTS), least=1, known=PARTS)
    """Parts of the study to run; the claims need all."""
    film: bool = False
    """Also film the first seed: skills that change without notice, a push, and a sense that is lost."""


def run(config: Config) -> Findings:
    """Record the experts once, and run every seed."""
    folder = (config.out / "panda").resolve()
    wanted = demonstrations(config)
    with kit.stage("recording experts") as report:
        make_missing(
            partial(demonstrate, folder=folder),
            [one for own in wanted.values() for one in own],
            lambda one: folder / one.name,
            config.workers,
            report,
        )
    files = {name: [folder / one.name for one in own] for name, own in wanted.items()}
    work = partial(one_seed, config=config, files=files)
    repetitions = kit.each("learning and acting", work, config.repetitions, config)
    records = [record for own, _ in repetitions for record in own]
    frame = pd.DataFrame(records)
    if set(config.parts) < set(PARTS):
        return Findings(records, tables(frame))
    _, energies = repetitions[0]
    return Findings(records, [*claims(frame), *tables(frame)], drawn(frame, energies))


def demonstrations(config: Config) -> dict[str, list[Demonstration]]:
    """Return the episodes to record, by skill, by kind of fault, and the twins of the faulty ones."""
    wanted = {}
    for skill in SKILLS:
        wanted[skill] = [Demonstration(skill, n) for n in range(config.episodes)]
    for skill in UNKNOWN:
        wanted[skill] = [Demonstration(skill, n) for n in range(3 * config.faulty)]
    held_out = product(SKILLS, range(HELD_OUT, HELD_OUT + config.faulty))
    wanted[TWINS] = [Demonstration(skill, seed) for skill, seed in held_out]
    for kind in FAULTS:
        faulty = [twin._replace(fault=kind) for twin in wanted[TWINS]]
        wanted[kind] = [one for one in faulty if one.is_possible]
    return wanted


# ------------------------------------------------------------------ one seed


def one_seed(
    seed: int, config: Config, files: dict[str, list[Path]]
) -> tuple[list[Record], dict[str, Floats]]:
    """Learn with one seed, and measure; return the records, and energies as ``act`` does."""
    torch.set_num_threads(1)
    repetition = Repetition(seed, config, files)
    repetition.learn()
    parts = config.parts
    if not {"prediction", "action"}.isdisjoint(parts):
        repetition.learn_rivals()
    if "prediction" in parts:
        predict(repetition)
    if "names" in parts:
        name_skills(repetition)
    primitives: dict[str, SkillEnvelope] = {}
    if "primitives" in parts:
        primitives = learn_primitives(repetition)
    measure_surprise(repetition, primitives)
    if config.film and seed == config.seed:
        film(repetition.networks[RECURRENT], config.out / "panda.gif", seed)
    actors: dict[str, Actor] = {}
    networks: dict[str, LocalNetwork] = {}
    if "action" in parts:
        networks = repetition.networks
        actors |= networks
        actors |= {cell: Cell(model) for cell, model in repetition.rivals.items()}
        actors[ACTS] = Associated(repetition.reader, repetition.train, repetition.rng)
    if primitives:
        actors[PROMP] = primitives[PROMP]
        actors[f"{PROMP}, from the first row alone"] = primitives[PROMP].after(1)
    return repetition.records, act(repetition, actors, networks)


def measure_surprise(repetition: Repetition, primitives: dict[str, SkillEnvelope]) -> None:
    """Measure the surprise of all that the wanted parts of the study name."""
    parts = repetition.config.parts
    models: dict[str, SurprisedModel] = {}
    if "surprise" in parts:
        models |= repetition.networks
    models |= primitives
    if "ablations" in parts:
        models |= ablated(repetition)
    if models:
        detect(repetition, models)


# ------------------------------------------------------------------ action


def push_along(direction: Any) -> Push:
    """Return a push in a direction (3,) that begins at row ``EVENT``."""
    return Push(newtons=20.0, direction=tuple(direction), onset=EVENT, duration=10)


def scene_of(seed: int, trial: int = 0) -> int:
    """Return the seed of a scene."""
    return 10_000 + 100 * seed + trial


def act(
    repetition: Repetition, actors: dict[str, Actor], networks: dict[str, LocalNetwork]
) -> dict[str, Floats]:
    """Measure the share solved in closed loop.

    Args:
        repetition: of the study.
        actors: act in each scene.
        networks: also act where something happens.

    Returns:
        The largest energy of a group over time (T,) in the first rollout of each actor that has energies.
    """
    energies: dict[str, Floats] = {}
    note = repetition.note
    for skill, trial in product(SKILLS, range(repetition.config.trials)):
        push = push_along(repetition.rng.standard_normal(3))
        conditions = Conditions(scene_of(repetition.seed, trial), steps=repetition.config.steps)
        env = environment(skill)
        rollouts = {name: run_policy(actor, env, conditions) for name, actor in actors.items()}
        for name, network in networks.items():
            own = rollouts_of(skill, network, push, conditions)
            rollouts |= {f"{name}, {condition}": rollout for condition, rollout in own.items()}
            stuck = own[f"{STUCK}, reacts"]
            pushed = own[f"{PUSHED}, reacts"]
            note("reacted rightly", f"{name}, {STUCK}", skill, stuck.left_out == "joint")
            yielded = pushed.yielded and not pushed.left_out
            note("reacted rightly", f"{name}, {PUSHED}", skill, yielded)
        for name, rollout in rollouts.items():
            note("solved", name, skill, rollout.solved)
            if len(rollout.energies):
                energies.setdefault(name, rollout.energies.max(axis=1))
    return energies


def rollouts_of(
    skill: str, network: LocalNetwork, push: Push, conditions: Conditions
) -> dict[str, Rollout]:
    """Return the rollouts of a local network in one scene, by what happens in them."""
    env = environment(skill)
    pushed = FaultInjection(env, [push])
    stuck = replace(conditions, encoders_stick=True)
    rollouts = {}
    for event, around, faulty in ((STUCK, env, stuck), (PUSHED, pushed, conditions)):
        reacting = replace(faulty, reacts=True)
        rollouts[event] = run_policy(network, around, faulty)
        rollouts[f"{event}, reacts"] = run_policy(network, around, reacting)
    pushed.undo_faults()
    rollouts["guarded"] = run_policy(network, NeuralASMSafety(env), conditions)

    skill_before = environment(SKILLS[SKILLS.index(skill) - 1])
    run_policy(network, skill_before, Conditions(conditions.seed, steps=40))
    continued = replace(conditions, keeps_state=True)
    rollouts["after another"] = run_policy(network, env, continued)
    return rollouts


def film(ours: LocalNetwork, path: Path, seed: int) -> None:
    """Film a network: another skill begins without notice, the arm is pushed, and its encoders stick."""
    reacting = Conditions(scene_of(seed), reacts=True)
    push = push_along((0.0, 1.0, 0.0))
    film: list[Image.Image] = []
    for skill, event, faults, conditions in (
        ("PickPlaceCan", "interrupted", [], replace(reacting, steps=40)),
        ("Lift", PUSHED, [push], replace(reacting, keeps_state=True)),
        ("Door", STUCK, [], replace(reacting, encoders_stick=True)),
    ):
        env = FaultInjection(environment(skill), faults)
        pictures: list[Image.Image] = []
        watch = partial(take_picture, pictures, env, f"{skill}, {event}")
        run_policy(ours, env, conditions, watch)
        env.undo_faults()
        film += pictures[::4]
    film[0].save(path, save_all=True, append_images=film[1:], duration=100, loop=0)


def take_picture(pictures: list[Image.Image], env: Any, caption: str, reaction: Reaction) -> None:
    """Append a picture of the environment, with a caption and what the network does."""
    picture = Image.fromarray(env.render())
    ImageDraw.Draw(picture).multiline_text(
        (6, 4), f"{caption}\n{reaction}", fill="white", stroke_width=1, stroke_fill="black"
    )
    pictures.append(picture)
