"""One energy: F finds faults; ``abstract`` shows that completion, reaction and learning descend it.

Claim: F, the sum of what is unexpected to the temporal network, to association and to the motor association
(``asm_gym.memory.free_energy``), rises at faults of robosuite skills that ``asm-gym evaluate`` recorded. F and each of
its parts are compared with the surprise in use.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import conformal_episodes, conformal_threshold
from asm_gym.episode import Episode
from asm_gym.evaluation import defaults
from asm_gym.evaluation.metrics import detected, false_alarms, time_matched_auroc
from asm_gym.evaluation.scored_episode import NOMINAL, ScoredEpisode
from asm_gym.evaluation.scoring import recorded
from asm_gym.memory.dynamics import DYNAMICS
from asm_gym.memory.free_energy import FreeEnergy
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.skills import learn_to_act
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.validation import check_number

Floats = NDArray[np.float64]
Roles = Mapping[str, Sequence[Episode]]

MEAN_ROWS = 4
"""F is judged by its mean over so many rows: 0.2 s in robosuite."""

PARTS = ("F", "time", "association", "motor", "in use")


@dataclass(frozen=True)
class Config(kit.Config):
    """F of the memory, by traces and by settling."""

    run: Path = option(Path("runs/evaluate"), metavar="FOLDER")
    """Folder of an evaluation, whose recordings are learned from and judged."""
    false_alarm_rate: float = option(defaults.FALSE_ALARM_RATE, check=conformal_episodes)
    """Share of nominal episodes that may raise an alarm."""
    window: float = option(defaults.WINDOW_S, check=partial(check_number, "window", above=0))
    """How soon after its onset a fault must be noticed [s]."""


def in_turn(episodes: Sequence[Episode]) -> list[Episode]:
    """Return all episodes, one of each task after another, in random order."""
    tasks: dict[str, list[Episode]] = {}
    for episode in episodes:
        tasks.setdefault(episode.labelled.task, []).append(episode)
    rng = np.random.default_rng(0)
    shuffled = [[own[i] for i in rng.permutation(len(own))] for own in tasks.values()]
    return [e for turn in zip_longest(*shuffled) for e in turn if e is not None]


def by_part(energy: FreeEnergy, episode: Episode) -> dict[str, Floats]:
    """Return F of each row (T,), whole and by its parts, smoothed; the first rows repeat the first known."""
    found = [energy.terms(m, row, energy.inferred(m, row)) for m, row in energy.moments(episode.stream)]
    early = len(episode) - len(found) + MEAN_ROWS - 1
    each = {"F": [t.total for t in found]} | {p: [getattr(t, p) for t in found] for p in PARTS[1:-1]}
    mean = np.full(MEAN_ROWS, 1.0 / MEAN_ROWS)
    return {p: np.convolve(np.concatenate([np.full(early, own[0]), own]), mean, "valid") for p, own in each.items()}


def faults_by(part: str, courses: dict[str, list[dict[str, Floats]]], roles: Roles, config: Config) -> list[Record]:
    """Measure what one part of F tells of faults, at a threshold of its own."""
    threshold = conformal_threshold(np.array([c[part].max() for c in courses["calibration"]]), config.false_alarm_rate)

    def judged(e: Episode, own: dict[str, Floats]) -> ScoredEpisode:
        label = e.labelled
        kind = label.kind or NOMINAL
        return ScoredEpisode(kind, label.seed, e.spec.dt, threshold, own[part], label.onset, task=label.task)

    nominal = [judged(e, c) for e, c in zip(roles["nominal"], courses["nominal"], strict=True)]
    made: list[Record] = [{"part": part, "alarm": false_alarms([t]).value} for t in nominal]
    for e, own in zip(roles["faulty"], courses["faulty"], strict=True):
        scored = judged(e, own)
        auroc = time_matched_auroc([scored], nominal, config.window)
        found = detected([scored], config.window).value
        made.append({"part": part, "auroc": None if np.isnan(auroc) else auroc, "found": found})
    return made


def one(job: tuple[str, int], roles: Roles, config: Config) -> list[Record]:
    """Measure everything for one dynamics and one seed."""
    dynamics, seed = job
    asm = NeuralASM(roles["fit"][0].spec, dynamics=dynamics, seed=seed).fit(roles["fit"])
    learn_to_act(asm, roles["fit"])  # F has a term of the motor association
    energy = asm.model.free_energy(roles["spreads"])
    judged = {name: roles[name] for name in ("calibration", "nominal", "faulty")}
    courses = {name: [by_part(energy, e) for e in own] for name, own in judged.items()}
    for name, own in judged.items():
        for found, surprise in zip(courses[name], asm.score_episodes(own), strict=True):
            found["in use"] = surprise.value
    records = [r for part in PARTS for r in faults_by(part, courses, roles, config)]
    return [{"dynamics": dynamics, "seed": seed, **r} for r in records]


def run(config: Config) -> Findings:
    """Run both dynamics and every seed."""
    roles = dict(recorded(config.run).roles)
    roles["faulty"] = [e for e in roles["faulty"] if len(e) > (e.labelled.onset or 0)]
    healthy = in_turn(roles["calibration"])  # a fifth sets τ, and no threshold
    roles["spreads"], roles["calibration"] = healthy[: len(healthy) // 5], healthy[len(healthy) // 5 :]
    jobs = [(d, seed) for d in DYNAMICS for seed in config.repetitions]
    records = kit.together(kit.each("learning and judging", partial(one, roles=roles, config=config), jobs, config))
    both, parts = kit.by("dynamics", DYNAMICS), kit.by("part", PARTS)
    rate = f"{100 * config.false_alarm_rate:g} % of nominal episodes may alarm"
    values = {"auroc": "AUROC", "found": f"Found in {config.window:g} s", "alarm": "Nominal episodes in alarm"}
    tables = [kit.grid(f"{label} by F and its parts; {rate}", records, v, parts, both) for v, label in values.items()]
    return Findings(records, tables)
