"""Does surprise predict that an episode of a learned policy will fail, and how early?

The shipped agents act as they are, weakened (every weight off by a random share, drawn anew each episode), and
disturbed (a fault of the object or of the body). Monitors learn from successful episodes of the agent as it is, without
labels, and are calibrated on others. Every episode runs to its last step, so that all have the same length.

A rival reads the commands alone: ``inconsistency`` is Σ_t ‖a_t - a_{t-1}‖, the change from one plan to the next, after
STAC (Agia et al. 2025, CoRL, PMLR 270).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import conformal_episodes, conformal_threshold
from asm_gym.episode import Episode, EpisodeLabel, load_episode, save_episode
from asm_gym.evaluation import defaults
from asm_gym.evaluation.scored_episode import NOMINAL
from asm_gym.evaluation.statistics import Estimate, Share, auroc
from asm_gym.evaluation.tables import Table, count
from asm_gym.monitors import MONITORS, make_monitor
from asm_gym.policies import make_policy
from asm_gym.policies.network import NetworkPolicy
from asm_gym.rollouts.run_folder import make_missing
from asm_gym.rollouts.seeds import draw_onset, role_seeds
from asm_gym.rollouts.staging import play, staged
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.tasks import env_id
from asm_gym.tasks import task as task_spec
from asm_gym.wrappers import StreamRecorder

AGENTS = {"Lift": "lift_sac", "Stack": "stack_sac", "Door": "door_sac"}
KINDS = {
    "Door": ("weak_joint", "stuck_joint", "joint_friction", "sign_flip"),
    **dict.fromkeys(("Lift", "Stack"), ("teleport", "snatch", "slip", "gripper_opens")),
}
"""Faults that disturb the agent of a task, in turn."""
TESTED = {"as_it_is": "as it is", "weakened": "weakened", "disturbed": "disturbed"}
"""Roles of the episodes to test on, in words."""
SHARES = (0.25, 0.5, 1.0)
"""Shares of an episode after which failure is predicted."""
RESAMPLES = 2000
"""Resamples of the bootstrap."""
INCONSISTENCY = "inconsistency"
WEAKEST = 0.3
"""Largest standard deviation of the share that a weight is off by; that of an episode is drawn below it."""


@dataclass(frozen=True)
class Config(kit.Config):
    """Failures of learned policies, predicted."""

    seeds: int = option(1, least=1)
    """Number of repetitions, with other episodes."""
    tasks: tuple[str, ...] = option(("Lift", "Stack"), quick=("Lift",), least=1, known=AGENTS)
    """Tasks that have an agent; one monitor learns all of them."""
    monitors: tuple[str, ...] = option(
        ("memory_skill", "neural_asm", "logpzo", INCONSISTENCY),
        quick=("memory_skill", "neural_asm"),
        least=1,
        known=(*MONITORS, INCONSISTENCY),
    )
    """Monitors, and a rival that reads commands; memory_skill is skill surprise."""
    episodes: int = option(40, quick=6, least=2)
    """Episodes of each task to learn from, to calibrate on, and to test on for each way of acting."""
    false_alarm_rate: float = option(defaults.FALSE_ALARM_RATE, quick=0.5, check=conformal_episodes)
    """Share of the agent's successful episodes that may raise an alarm."""


def run(config: Config) -> Findings:
    """Record the agents and judge them by every monitor."""
    folder = config.out.resolve()
    wanted = [label for seed in config.repetitions for label in labels(config, seed)]
    with kit.stage("recording agents") as progress:
        recording = partial(record, folder=folder)
        make_missing(recording, wanted, lambda label: folder / label.path, config.workers, progress)
    jobs = [(name, seed) for seed in config.repetitions for name in config.monitors]
    made = kit.each("fitting and judging", partial(judged, folder=folder, config=config), jobs, config)
    by_monitor: dict[str, list[Verdict]] = {}
    for (name, _), found in zip(jobs, made, strict=True):
        by_monitor.setdefault(name, []).extend(found)
    records: list[Record] = [{"monitor": name, **v._asdict()} for name, own in by_monitor.items() for v in own]
    outcomes = {how: Share.of([v.failed for v in made[0] if v.how == how]) for how in TESTED.values()}
    return Findings(records, [table(by_monitor, config)], facts={"failed": {h: [*s] for h, s in outcomes.items()}})


# ------------------------------------------------------------------ recordings


class Weakened:
    """An agent of which every weight is off, by another draw in each episode."""

    def __init__(self, env: gym.Env[Any, Any], name: str) -> None:
        agent = make_policy(name, env)
        if not isinstance(agent, NetworkPolicy):
            raise TypeError(f"{name} is no network whose weights could be off")
        self._agent, self._layers, self.predict = agent, agent.layers, agent.predict

    def set_random_seed(self, seed: int) -> None:
        """Draw the weights of an episode."""
        rng = np.random.default_rng([seed, 3])
        size = WEAKEST * rng.random()
        self._agent.layers = [
            ((W * (1.0 + size * rng.standard_normal(W.shape))).astype(np.float32), b) for W, b in self._layers
        ]


def labels(config: Config, seed: int) -> list[EpisodeLabel]:
    """Return the episodes of one repetition."""
    made = []
    for task in config.tasks:
        for role in ("fit", "calibration", *TESTED):
            seeds = role_seeds(seed, task, f"agent/{TESTED.get(role, role)}", config.episodes)
            for n, s in enumerate(seeds):
                happens = (KINDS[task][n % len(KINDS[task])], "strong") if role == "disturbed" else ("", "")
                onset = draw_onset(s, task_spec(task).horizon) if role == "disturbed" else None
                made.append(EpisodeLabel(task, role, *happens, s, onset))
    return made


def record(label: EpisodeLabel, folder: Path) -> Path:
    """Record the episode of ``label``, to its last step."""
    name = AGENTS[label.task]
    acting = RolloutConfig(partial(Weakened, name=name) if label.role == "weakened" else name)
    trial = Trial(env_id(label.task), label.seed, label.kind or NOMINAL, label.severity, label.onset)
    with staged(trial, acting) as env:
        recorder = StreamRecorder(env)
        play(trial, acting, recorder)
    made = recorder.finish()
    kept = Episode(made.stream, made.spec, made.success, made.seed, label=label, info={"skill": label.task})
    return save_episode(folder / label.path, kept)


# ------------------------------------------------------------------ verdicts


class Verdict(NamedTuple):
    """Verdict of a monitor on one episode."""

    failed: bool
    how: str  # one of TESTED's words
    greatest: list[float]  # greatest surprise so far, after each of SHARES
    alarmed_after: float  # share of the episode; infinite without an alarm


def inconsistency(episode: Episode) -> NDArray[np.float64]:
    """Return the summed change of the commands (T,)."""
    a = episode.stream[:, episode.spec.motor].astype(np.float64)
    found: NDArray[np.float64] = np.cumsum(np.append(0.0, np.linalg.norm(np.diff(a, axis=0), axis=1)))
    return found


def judged(job: tuple[str, int], folder: Path, config: Config) -> list[Verdict]:
    """Return the verdicts of one monitor, fitted and calibrated, on all test episodes of one repetition."""
    (name, seed), rate = job, config.false_alarm_rate
    recordings = [load_episode(folder / label.path) for label in labels(config, seed)]
    fit, calibration = ([e for e in recordings if e.labelled.role == r and e.success] for r in ("fit", "calibration"))
    tested = [e for e in recordings if e.labelled.role in TESTED]
    if name == INCONSISTENCY:
        values = [inconsistency(e) for e in tested]
        threshold = conformal_threshold(np.array([inconsistency(e).max() for e in calibration]), rate)
    else:
        monitor = make_monitor(name, fit[0].spec, seed=seed).fit(fit).calibrate(calibration, rate)
        values, threshold = [s.value for s in monitor.score_episodes(tested)], monitor.threshold
    found = []
    for episode, value in zip(tested, values, strict=True):
        so_far = np.maximum.accumulate(value)
        over = np.flatnonzero(so_far > threshold)
        greatest = [float(so_far[max(1, round(share * len(so_far))) - 1]) for share in SHARES]
        alarmed = float(over[0] + 1) / len(so_far) if len(over) else np.inf
        found.append(Verdict(not episode.success, TESTED[episode.labelled.role], greatest, alarmed))
    return found


def separated(own: Sequence[Verdict], share: int) -> Estimate:
    """Return the AUROC of failures against successes by the greatest surprise so far, with its bootstrap interval."""
    failed, score = np.array([v.failed for v in own]), np.array([v.greatest[share] for v in own])
    if failed.all() or not failed.any():
        return Estimate(np.nan, np.nan, np.nan)
    rng, drawn = np.random.default_rng(0), []
    for _ in range(RESAMPLES):
        i = rng.integers(len(own), size=len(own))
        if 0 < failed[i].sum() < len(i):
            drawn.append(auroc(score[i][failed[i]], score[i][~failed[i]]))
    low, high = np.quantile(drawn, [0.025, 0.975])
    return Estimate(auroc(score[failed], score[~failed]), float(low), float(high))


def table(by_monitor: Mapping[str, Sequence[Verdict]], config: Config) -> Table:
    """Return a row for each monitor: how well, and how early, it separates failures from successes."""

    def cell(found: Estimate) -> str:
        return "" if np.isnan(found.value) else f"{found.value:.3f} ({found.low:.2f}–{found.high:.2f})"

    def row(name: str, own: Sequence[Verdict]) -> tuple[str, ...]:
        failures, successes = ([v for v in own if v.failed is failed] for failed in (True, False))
        known = [Share.of([v.alarmed_after <= share for v in failures]) for share in (0.5, 1.0)]
        false = Share.of([v.alarmed_after <= 1.0 for v in successes if v.how == TESTED["as_it_is"]])
        areas = (cell(separated(own, k)) for k in range(len(SHARES)))
        return (name, *areas, *map(count, (*known, false)))

    percent = [f"{100 * share:g} %" for share in SHARES]
    return Table(
        f"Failures separated from successes by the greatest surprise after {', '.join(percent)} of an episode: AUROC, "
        "with 95 % bootstrap intervals over episodes. Failures with an alarm before half of the episode, and at all; "
        f"alarms in successful episodes of the agent as it is, at {100 * config.false_alarm_rate:g} %.",
        ("Monitor", *(f"AUROC at {p}" for p in percent), "known by half", "known", "false alarms"),
        [row(name, own) for name, own in by_monitor.items()],
    )
