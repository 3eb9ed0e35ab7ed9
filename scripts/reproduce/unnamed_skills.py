"""Unnamed skills: how many there are in a stream, and where each begins, found without a label.

A memory has learned letters, and nobody said how many. Then it reads one long stream of letters in random order, each
broken off somewhere after its middle, and is never told where one ends. ``segments`` says how it finds that, and which
are the same. The adjusted Rand index (Hubert and Arabie 1985) says how well the segments, step by step, are the letters
that were written. The same is asked of the rows alone. Then all of it is asked of robosuite skills: whole episodes in
random order, and some in which one skill follows another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from asm_gym.episode import Episode
from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.tables import Table
from asm_gym.scripts.options import fixed, option
from asm_gym.scripts.reproduce import kit, robot_unnamed
from asm_gym.scripts.reproduce.curves import curves
from asm_gym.scripts.reproduce.expression import Memory, Rows
from asm_gym.scripts.reproduce.handwriting import STEPS, check_letters, copybook, repertoire
from asm_gym.scripts.reproduce.kit import Findings, Record, shown
from asm_gym.scripts.reproduce.recordings import SENSED, demonstrations, wide_enough
from asm_gym.scripts.reproduce.segments import NEAR, SOURCES, judged, parted, unnamed
from asm_gym.scripts.reproduce.skill_switch import Switch, switches
from asm_gym.tasks import task as task_spec

USUAL = 0.999
"""Quantile of what is usual within letters."""

EARLY = slice(10, 20)
"""Steps of a segment by which its letter is known: all segments are long enough."""


@dataclass(frozen=True)
class Config(kit.Config):
    """What a memory finds in a stream that nobody has labelled."""

    repertoires: tuple[int, ...] = option((3, 6, 12), quick=(3,), check=partial(check_letters, least=2))
    """How many letters there are to be found."""
    hidden: int = option(64, quick=32, check=partial(wide_enough, channels=4))
    """Hidden units."""
    steps: int = option(12000, quick=1500, least=1)
    """Steps in which the synapses change."""
    tasks: tuple[str, ...] = option(
        ("Lift", "Stack", "Door", "PickPlaceCan", "PickPlaceMilk", "NutAssemblySquare"), least=1, check=task_spec
    )
    """The robosuite skills."""
    robot_episodes: int = option(16, quick=0, least=0)
    """Episodes of each robosuite skill to learn from; 0 leaves robosuite out."""
    switches: int = option(8, least=0)
    """Episodes in the stream in which one skill follows another."""
    writings: int = fixed(8, quick=4, least=1)
    """Writings of each letter to learn from."""
    length: int = fixed(8, least=2)
    """How often each letter comes in the stream."""
    robot_asked: int = fixed(6, least=1)
    """Episodes of each in the stream."""
    robot_hidden: int = fixed(256, check=partial(wide_enough, channels=SENSED))
    """Hidden units for robosuite."""
    robot_steps: int = fixed(4000, least=1)
    """Steps in which the synapses change, for robosuite."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.repertoires or self.robot_episodes):
            raise ValueError("there is nothing to find: repertoires and robot_episodes are both left out")


def one(condition: tuple[int, int], config: Config) -> list[Record]:
    """What is found by one memory, for (seed, letters)."""
    seed, count = condition
    rng = np.random.default_rng(condition)
    letters = repertoire(count, 2, rng)
    train = copybook(letters, config.writings, 2, rng)
    memory = Memory.learned(train, config.hidden, rng, config.steps)
    stream, skill, begins = strung(copybook(letters, config.length, 2, rng), rng)
    records = []
    for source, found in parted(memory, train, stream, USUAL).items():
        named, skills = unnamed(found, 2 * count + 2, EARLY)
        where = {"domain": "letters", "seed": seed, "skills": count, "source": source, "skills_found": skills}
        records.append(where | judged(found, named, skill, begins))
    return records


def strung(episodes: Sequence[Episode], rng: np.random.Generator) -> tuple[Rows, NDArray[np.str_], NDArray[np.intp]]:
    """One stream (T, D) of all episodes in random order, each broken off; (T,) its skill, and where each begins."""
    order = rng.permutation(len(episodes))
    lengths = rng.integers(STEPS // 2, STEPS + 1, len(order))
    parts = [episodes[n].stream[:k] for n, k in zip(order, lengths, strict=True)]
    skill = np.repeat([str(episodes[n].info["skill"]) for n in order], lengths)
    return np.concatenate(parts).astype(np.float64), skill, np.cumsum(lengths) - lengths


def tables(records: Sequence[Record], config: Config) -> list[Table]:
    """Skills, beginnings and segments; of letters, and of robosuite."""
    made = []
    if config.repertoires:
        counts = kit.by("skills", config.repertoires)
        sources = {label: {"domain": "letters", "source": s} for s, label in SOURCES.items()}
        captions = {
            "skills_found": "Skills found, by how many there are; mean ± SD over seeds",
            "index": "Adjusted Rand index of the segments",
            "found": f"Beginnings found [share of those that are], within {NEAR} steps",
            "true": f"Beginnings that are true [share of those found], within {NEAR} steps",
        }
        made += [
            kit.grid(said, records, value, sources, counts, 1 if value == "skills_found" else 2)
            for value, said in captions.items()
        ]
    if config.robot_episodes:
        asked = {
            f"skills found, of {len(config.tasks)}": ("skills_found", 1),
            "adjusted Rand index": ("index", 2),
            "the same, of episodes with one skill": ("index_single", 2),
            "beginnings of episodes, found": ("starts", 2),
            "changes within an episode, found": ("changes", 2),
            "beginnings that are true, of those found": ("true", 2),
        }
        of = {"domain": "robosuite"}
        each = [
            (label, *(shown(records, value, digits, source=s, **of) for s in SOURCES))
            for label, (value, digits) in asked.items()
        ]
        episodes = f"{config.robot_asked} episodes of each skill, {config.switches} with a change"
        made.append(Table(f"Robosuite, {episodes}; mean ± SD over seeds", ("", *SOURCES.values()), each))
    return made


def drawn(records: Sequence[Record], config: Config) -> Figure:
    """Skills found, and the index; of letters by how many there are, or of robosuite."""
    with figure(height=3.0, width=7) as fig:
        axes = fig.subplots(1, 2)
        letters = bool(config.repertoires)
        counts = config.repertoires if letters else (len(config.tasks),)
        domain = "letters" if letters else "robosuite"
        sources = {label: {"domain": domain, "source": s} for s, label in SOURCES.items()}
        for ax, value in zip(axes, ("skills_found", "index"), strict=True):
            curves(ax, records, value, ("skills", counts), sources)
        axes[0].plot(counts, counts, color="#888888", linewidth=1, linestyle=look(0)[1])
        axes[0].set(xlabel="skills there are", ylabel="skills found", ylim=0)
        axes[1].set(xlabel="skills there are", ylabel="adjusted Rand index", ylim=(0, 1.02))
        axes[1].legend(fontsize=8)
    return fig


def run(config: Config) -> Findings:
    """Every seed and repertoire, and robosuite."""
    jobs: list[Callable[[], list[Record]]] = []
    if config.robot_episodes:
        train = demonstrations(config, config.tasks, "fit", config.robot_episodes)
        asked = demonstrations(config, config.tasks, "nominal", config.robot_asked)
        paths = switches(config, config.switches)
        asked += [Switch.read(path, train[0].spec).episode for path in paths]
        sizes = config.robot_hidden, config.robot_steps
        jobs += [partial(robot_unnamed.found, seed, train, asked, *sizes) for seed in config.repetitions]
    jobs += [partial(one, (seed, count), config) for seed in config.repetitions for count in config.repertoires]
    found = kit.each("learning skills, and finding them", kit.called, jobs, config)
    records = kit.together(found)
    return Findings(records, tables(records, config), drawn(records, config))
