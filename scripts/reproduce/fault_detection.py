"""Fault detection: surprise across a whole repertoire, against a library that is told the right or the wrong skill.

One Neural ASM learns all skills without labels and has one threshold. The library of movement primitives holds a skill
each with the usual course of every sense, and has to be told which one is running: the right one, a wrong one, or the
one that has matched best so far. Letters with slips of the pen, and robosuite skills with faults of body, actuators,
sensors and actions. Each fault is compared with nominal episodes of its own skill in the same steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from asm_gym.detection import conformal_episodes, conformal_threshold
from asm_gym.episode import Episode
from asm_gym.evaluation import defaults
from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.metrics import detected, false_alarms, time_matched_auroc
from asm_gym.evaluation.scored import NOMINAL, ScoredEpisode
from asm_gym.evaluation.tables import Table
from asm_gym.faults.suite import KINDS, SEVERITIES
from asm_gym.monitors import NeuralASM, make_monitor
from asm_gym.scripts.options import fixed, option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.fault_sets import FaultSet, robot_fault_set, written_fault_set
from asm_gym.scripts.reproduce.handwriting import check_letters
from asm_gym.scripts.reproduce.kit import Findings, Record, over_seeds, shown
from asm_gym.scripts.reproduce.recordings import SENSED, SKILLS, wide_enough
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_choice, check_number

WAYS = {
    "memory": "Neural ASM, told nothing",
    "right": "library, told the right skill",
    "best": "library, best match so far",
    "wrong": "library, told a wrong skill",
    "right+evidence": "library, right, our detection",
    "wrong+evidence": "library, wrong, our detection",
}
WINDOW = 20
"""Steps after its onset within which a fault is to be seen: 1 s in robosuite."""

RATE = defaults.FALSE_ALARM_RATE
"""Share of nominal episodes that may raise an alarm."""


@dataclass(frozen=True)
class Config(kit.Config):
    """Surprise without selection against a library that needs it."""

    letters: int = option(8, quick=3, check=partial(check_letters, least=2))
    """Letters in the repertoire of handwriting."""
    writings: int = option(16, quick=8, least=1)
    """Writings of each letter to learn from; as many more to calibrate on, and to judge."""
    hidden: int = option(128, quick=32, check=partial(wide_enough, channels=4))
    """Hidden units."""
    tasks: tuple[str, ...] = option(SKILLS, check=task_spec)
    """Robosuite skills."""
    robot_episodes: int = option(30, quick=0, least=0)
    """Episodes of each robosuite skill to learn from, and half as many to calibrate on; 0 leaves them out."""
    faults: tuple[str, ...] = option(
        ("push", "weak_joint", "encoder_bias", "wrist_bias", "action_delay"),
        check=partial(check_choice, "kind of fault", known=KINDS),
    )
    """Kinds of fault."""
    severity: str = fixed("medium", check=partial(check_choice, "severity", known=SEVERITIES))
    """How bad they are."""
    faulty_episodes: int = fixed(4, least=1)
    """Faulty episodes of each robosuite skill and kind."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.tasks)) < 2 or not self.faults:
            raise ValueError("there must be at least two tasks and a kind of fault")
        if len(set(self.tasks)) < len(self.tasks):
            raise ValueError(f"a task was named twice: {', '.join(self.tasks)}")
        needed = conformal_episodes(RATE)
        given = {"letters": self.letters * self.writings, "tasks": len(self.tasks) * (self.robot_episodes // 2)}
        for what, count in given.items():
            if count < needed and not (what == "tasks" and self.robot_episodes == 0):
                raise ValueError(f"a false-alarm rate of {RATE} needs {needed} calibration episodes of {what}")
        if self.robot_episodes:
            check_number(f"hidden (robosuite's {SENSED} channels take twice as many)", self.hidden, low=-(-SENSED // 2))


Scores = list[NDArray[np.float64]]


def told(monitor: Any, episodes: Sequence[Episode], skills: Sequence[str], how: str) -> Scores:
    """The surprise of every step of each episode, with the skill that a library is told.

    Args:
        how: ``right``, ``wrong`` (the next one by name) or ``best``, at every step the one that has surprised least
            up to then.
    """
    if how == "best":
        each = [_as(monitor, episodes, [s] * len(episodes)) for s in skills]
        return [_best(np.stack([own[n] for own in each])) for n in range(len(episodes))]
    shift = 1 if how == "wrong" else 0
    return _as(monitor, episodes, [skills[(skills.index(_skill(e)) + shift) % len(skills)] for e in episodes])


def _as(monitor: Any, episodes: Sequence[Episode], names: Sequence[str]) -> Scores:
    renamed = [replace(e, info={**e.info, "skill": n}) for e, n in zip(episodes, names, strict=True)]
    return [s.value for s in monitor.score_episodes(renamed)]


def _best(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """(T,) of (K, T): at each step the surprise of the skill whose mean surprise has been least so far."""
    chosen = np.cumsum(values, axis=1).argmin(axis=0)
    picked: NDArray[np.float64] = values[chosen, np.arange(values.shape[1])]
    return picked


def _skill(episode: Episode) -> str:
    return str(episode.info["skill"])


def judged(seed: int, trial: FaultSet, config: Config) -> tuple[list[Record], dict[str, Any]]:
    """Every way of telling faults, on one domain; and the surprise in one faulty episode, for the figure."""
    skills = sorted({_skill(e) for e in trial.fit})
    spec = trial.fit[0].spec
    hidden = config.hidden if trial.domain == "letters" else 2 * config.hidden
    # With few rows a wide association would learn them by heart.
    size = 240 if trial.domain == "robosuite" else 64
    memory = NeuralASM(spec, hidden, size, iterations=10, seed=seed).fit(trial.fit)
    library = make_monitor("skill_library", spec, seed=seed).fit(trial.fit)
    evident = make_monitor("skill_library+evidence", spec, seed=seed).fit(trial.fit)
    records: list[Record] = []
    example: dict[str, Any] = {}
    shown_one = next((n for n, (_, k, e) in enumerate(trial.faulty) if len(e) > k + WINDOW), 0)
    for way in WAYS:
        monitor = memory if way == "memory" else evident if way.endswith("+evidence") else library
        how = "right" if way == "memory" else way.removesuffix("+evidence")
        # Nobody who calibrates means to name the wrong skill.
        before = told(monitor, trial.calibration, skills, "right" if how == "wrong" else how)
        threshold = conformal_threshold(np.array([v.max() for v in before]), RATE)
        values = told(monitor, trial.nominal, skills, how)
        nominal = [_trace(e, v, threshold) for e, v in zip(trial.nominal, values, strict=True)]
        values = told(monitor, [e for _, _, e in trial.faulty], skills, how)
        faulty = [
            _trace(e, v, threshold, kind, onset) for (kind, onset, e), v in zip(trial.faulty, values, strict=True)
        ]
        where = {"domain": trial.domain, "way": way, "seed": seed}
        records += [{**where, "alarm": false_alarms([t]).value} for t in nominal]
        records += [{**where, "kind": t.kind, **_found(t, nominal)} for t in faulty]
        example[way] = faulty[shown_one].surprise / threshold
    example["onset"] = trial.faulty[shown_one][1]
    return records, example


def _trace(
    episode: Episode, values: NDArray[np.float64], threshold: float, kind: str = NOMINAL, onset: int | None = None
) -> ScoredEpisode:
    return ScoredEpisode(kind, episode.seed or 0, episode.spec.dt, threshold, values, onset, task=_skill(episode))


def _found(fault: ScoredEpisode, nominal: Sequence[ScoredEpisode]) -> Record:
    """AUROC against nominal episodes of the same skill in the same steps, and whether an alarm was raised in time."""
    window_s = WINDOW * fault.dt
    score = time_matched_auroc([fault], nominal, window_s)
    return {"auroc": None if math.isnan(score) else score, "found": detected([fault], window_s).value}


def tables(records: Sequence[Record], config: Config) -> list[Table]:
    """By domain, and by kind."""
    made = []
    for domain in dict.fromkeys(r["domain"] for r in records):
        rows = [
            (label, *(shown(records, v, domain=domain, way=way) for v in ("auroc", "found", "alarm")))
            for way, label in WAYS.items()
        ]
        caption = f"{domain}: thresholds for {100 * RATE:g} % of nominal episodes; mean ± SD over seeds"
        made.append(Table(caption, ("", "AUROC", "found within 20 steps", "nominal episodes in alarm"), rows))
    if config.robot_episodes:
        ways = {label: {"way": way, "domain": "robosuite"} for way, label in WAYS.items()}
        kinds = {kind.replace("_", " "): {"kind": kind} for kind in config.faults}
        made.append(kit.grid(f"AUROC by kind of fault, {config.severity}", records, "auroc", ways, kinds))
    return made


def drawn(records: Sequence[Record], example: dict[str, Any]) -> Figure:
    """AUROC, found and false alarms of each way; surprise over time in one episode."""
    domains = list(dict.fromkeys(r["domain"] for r in records))
    panels = (
        ("auroc", "AUROC"),
        ("found", "found"),
        ("alarm", "false alarms"),
    )
    with figure(height=3.6, width=11) as fig:
        axes = fig.subplots(1, 4, width_ratios=(1, 1, 1, 1.3))
        for ax, (value, label) in zip(axes, panels, strict=False):
            for i, domain in enumerate(domains):
                mean, spread = np.array([over_seeds(records, value, domain=domain, way=w) for w in WAYS]).T
                y = np.arange(len(WAYS)) + 0.38 * (i - (len(domains) - 1) / 2)
                ax.barh(y, mean, 0.36, xerr=spread, color=look(i)[0], label=domain, error_kw={"linewidth": 1})
            ax.set_yticks(range(len(WAYS)), list(WAYS.values()) if ax is axes[0] else [""] * len(WAYS))
            ax.invert_yaxis()
            ax.set(xlabel=label, xlim=(0.4 if value == "auroc" else 0, 1))
        axes[1].legend(loc="lower right", fontsize=8)
        for i, way in enumerate(("memory", "right", "wrong")):
            axes[3].plot(example[way], color=look(i)[0], linestyle=look(i)[1], label=WAYS[way])
        axes[3].axhline(1, color="#444444", linewidth=1)
        axes[3].axvline(example["onset"], color="#e69f00", linewidth=1.5)
        axes[3].set(yscale="log", xlabel="step", ylabel="surprise / threshold")
        axes[3].set_ylim(top=30 * axes[3].get_ylim()[1])  # room for the legend
        axes[3].set_title("one episode, fault at the line", fontsize=8)
        axes[3].legend(fontsize=7, loc="upper right")
    return fig


def run(config: Config) -> Findings:
    """Letters for every seed, then robosuite."""
    found = kit.each("letters", partial(_letters, config=config), config.repetitions, config)
    if config.robot_episodes:
        faults = config.faults, config.severity, config.faulty_episodes
        trial = robot_fault_set(config, config.tasks, config.robot_episodes, *faults)
        found += kit.each("robosuite", partial(judged, trial=trial, config=config), config.repetitions, config)
    records = [r for own, _ in found for r in own]
    example = found[-1][1]
    facts = {"false_alarm_rate": RATE, "example": {k: np.asarray(v).tolist() for k, v in example.items()}}
    return Findings(records, tables(records, config), drawn(records, example), facts)


def _letters(seed: int, config: Config) -> tuple[list[Record], dict[str, Any]]:
    return judged(seed, written_fault_set(seed, config.letters, config.writings), config)
