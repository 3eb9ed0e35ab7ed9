"""Does surprise predict that an episode of a learned policy will fail, and how early?

The agents that come with the package act: as they are, weakened (every weight off by a random share, another one each
episode), and disturbed (something happens to the thing or to the body). Monitors learn from episodes of the agent as it
is that succeeded, without labels, and are calibrated on others. An episode goes on to its last step whether it has
succeeded or not, so that all are of one length.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from asm_gym.detection import conformal_episodes
from asm_gym.episode import Episode, EpisodeLabel, load_episode, save_episode
from asm_gym.evaluation import defaults
from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.scored_episode import NOMINAL
from asm_gym.evaluation.statistics import RESAMPLES, Estimate, Share, auroc
from asm_gym.evaluation.tables import Table, count
from asm_gym.monitors import MONITORS
from asm_gym.rollouts.run_folder import make_missing
from asm_gym.rollouts.seeds import draw_onset, role_seeds
from asm_gym.rollouts.staging import play, staged
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.failure_rivals import NAMES, scored
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.scripts.reproduce.weakened import weakened
from asm_gym.tasks import env_id
from asm_gym.tasks import task as task_spec
from asm_gym.wrappers import StreamRecorder

AGENTS = {"Lift": "lift_sac", "Stack": "stack_sac", "Door": "door_sac"}
KINDS = {
    "Door": ("weak_joint", "stuck_joint", "joint_friction", "sign_flip"),
    **dict.fromkeys(("Lift", "Stack"), ("teleport", "snatch", "slip", "gripper_opens")),
}
"""What disturbs the agent of a task, in turn."""

TESTED = ("as it is", "weakened", "disturbed")
SHARES = (0.25, 0.5, 1.0)
"""Of an episode, after which it is asked whether it will fail."""


@dataclass(frozen=True)
class Config(kit.Config):
    """Failures of learned policies, told beforehand."""

    seeds: int = option(1, least=1)
    """How often it repeats itself, with other episodes."""
    tasks: tuple[str, ...] = option(("Lift", "Stack"), quick=("Lift",), least=1, known=AGENTS)
    """Tasks that have an agent; one monitor learns all of them."""
    monitors: tuple[str, ...] = option(
        ("memory_skill", "neural_asm", "logpzo", "rnd", "gru+evidence"),
        quick=("memory_skill", "neural_asm"),
        least=1,
        known=(*MONITORS, *NAMES),
    )
    """Names of monitors, and of rivals that read commands; memory_skill is skill surprise."""
    episodes: int = option(40, quick=6, least=2)
    """Episodes of each task to learn from, to calibrate on, and to test on for each way of acting."""
    false_alarm_rate: float = option(defaults.FALSE_ALARM_RATE, quick=0.5, check=conformal_episodes)
    """Share of the agent's successful episodes that may raise an alarm."""


def labels(config: Config, seed: int) -> list[EpisodeLabel]:
    """What is recorded for one repetition."""
    made = []
    for task in config.tasks:
        for role in ("fit", "calibration", *TESTED):
            for n, s in enumerate(role_seeds(seed, task, f"agent/{role}", config.episodes)):
                happens = (KINDS[task][n % len(KINDS[task])], "strong") if role == "disturbed" else ("", "")
                onset = draw_onset(s, task_spec(task).horizon) if role == "disturbed" else None
                made.append(EpisodeLabel(task, role.replace(" ", "_"), *happens, s, onset))
    return made


def record(label: EpisodeLabel, folder: Path) -> Path:
    """Records the episode of ``label``, to its last step."""
    name = AGENTS[label.task]
    acting = RolloutConfig(partial(weakened, name=name) if label.role == "weakened" else name)
    trial = Trial(env_id(label.task), label.seed, label.kind or NOMINAL, label.severity, label.onset)
    with staged(trial, acting) as env:
        recorder = StreamRecorder(env)
        play(trial, acting, recorder)
    made = recorder.finish()
    kept = Episode(made.stream, made.spec, made.success, made.seed, label=label, info={"skill": label.task})
    return save_episode(folder / label.path, kept)


class Watched(NamedTuple):
    """What a monitor made of an episode: the greatest surprise so far after each of ``SHARES``, and its alarm."""

    failed: bool
    how: str  # one of TESTED
    greatest: tuple[float, ...]
    alarmed_after: float  # share of the episode; infinite without an alarm


def watched(name: str, seed: int, recordings: Sequence[Episode], config: Config) -> list[Watched]:
    """What one monitor, fitted and calibrated, made of all test episodes."""

    def of(role: str) -> list[Episode]:
        return [e for e in recordings if e.labelled.role == role and e.success]

    roles = {how.replace(" ", "_"): how for how in TESTED}
    tested = [e for e in recordings if e.labelled.role in roles]
    values, threshold = scored(name, seed, of("fit"), of("calibration"), tested, config.false_alarm_rate)
    found = []
    for episode, value in zip(tested, values, strict=True):
        so_far = np.maximum.accumulate(value)
        over = np.flatnonzero(so_far > threshold)
        greatest = tuple(float(so_far[max(1, round(share * len(so_far))) - 1]) for share in SHARES)
        alarmed = float(over[0] + 1) / len(so_far) if len(over) else np.inf
        found.append(Watched(not episode.success, roles[episode.labelled.role], greatest, alarmed))
    return found


def run(config: Config) -> Findings:
    """Records the agents, and asks every monitor."""
    folder = config.out.resolve()
    wanted = {seed: labels(config, seed) for seed in config.repetitions}
    with kit.stage("recording agents") as progress:
        every = [label for own in wanted.values() for label in own]
        make_missing(partial(record, folder=folder), every, lambda label: folder / label.path, config.workers, progress)
    jobs = [(name, seed) for seed in config.repetitions for name in config.monitors]
    made = kit.each("fitting and judging", partial(_job, folder=folder, wanted=wanted, config=config), jobs, config)
    by_monitor: dict[str, list[Watched]] = {}
    for (name, _), found in zip(jobs, made, strict=True):
        by_monitor.setdefault(name, []).extend(found)
    records: list[Record] = [
        {"monitor": name, **w._asdict(), "greatest": list(w.greatest)} for name, own in by_monitor.items() for w in own
    ]
    outcomes = {how: Share.of([w.failed for w in made[0] if w.how == how]) for how in TESTED}
    facts = {"failed": {how: [share.k, share.n] for how, share in outcomes.items()}}
    return Findings(records, [early(by_monitor, config), ways(by_monitor), order(by_monitor)], curve(by_monitor), facts)


def _job(
    job: tuple[str, int], folder: Path, wanted: Mapping[int, Sequence[EpisodeLabel]], config: Config
) -> list[Watched]:
    name, seed = job
    return watched(name, seed, [load_episode(folder / label.path) for label in wanted[seed]], config)


def separated(own: Sequence[Watched], share: int) -> Estimate:
    """AUROC of failures against successes by the greatest surprise so far, over episodes drawn anew."""
    failed, score = np.array([w.failed for w in own]), np.array([w.greatest[share] for w in own])
    if failed.all() or not failed.any():
        return Estimate(np.nan, np.nan, np.nan)
    rng, drawn = np.random.default_rng(0), []
    for _ in range(RESAMPLES):
        i = rng.integers(len(own), size=len(own))
        if 0 < failed[i].sum() < len(i):
            drawn.append(auroc(score[i][failed[i]], score[i][~failed[i]]))
    low, high = np.quantile(drawn, [0.025, 0.975])
    return Estimate(auroc(score[failed], score[~failed]), float(low), float(high))


def _shown(found: Estimate) -> str:
    return "" if np.isnan(found.value) else f"{found.value:.3f} ({found.low:.2f}–{found.high:.2f})"


def early(by_monitor: Mapping[str, Sequence[Watched]], config: Config) -> Table:
    """A row a monitor: how well, and how early, it tells failures from successes."""

    def row(name: str, own: Sequence[Watched]) -> tuple[str, ...]:
        failures, successes = ([w for w in own if w.failed is failed] for failed in (True, False))
        asked = [_shown(separated(own, k)) for k in range(len(SHARES))]
        known = [Share.of([w.alarmed_after <= share for w in failures]) for share in (0.5, 1.0)]
        false = [Share.of([w.alarmed_after <= 1.0 for w in successes if w.how == TESTED[0]])]
        return (name, *asked, *map(count, (*known, *false)))

    percent = [f"{100 * share:g} %" for share in SHARES]
    return Table(
        f"Failures told from successes by the greatest surprise after {', '.join(percent)} of an episode: AUROC, in "
        "brackets 95 % intervals over episodes drawn anew. Failures with an alarm before half of the episode and at "
        f"all, and alarms in successful episodes of the agent as it is, at {100 * config.false_alarm_rate:g} %.",
        ("Monitor", *(f"AUROC at {p}" for p in percent), "known by half", "known", "false alarms"),
        [row(name, own) for name, own in by_monitor.items()],
    )


def ways(by_monitor: Mapping[str, Sequence[Watched]]) -> Table:
    """A row a monitor, a column a way of acting: AUROC at half."""
    first = next(iter(by_monitor.values()))
    failed = {how: Share.of([w.failed for w in first if w.how == how]) for how in TESTED}
    rows = [
        (name, *(_shown(separated([w for w in own if w.how == how], SHARES.index(0.5))) for how in TESTED))
        for name, own in by_monitor.items()
    ]
    return Table(
        "AUROC after half of an episode, within one way of acting.",
        ("Monitor", *(f"{how}, {share.k} of {share.n} failed" for how, share in failed.items())),
        rows,
    )


def order(by_monitor: Mapping[str, Sequence[Watched]]) -> Table:
    """A row a monitor: whether success known <= success new < failure known <= failure new."""
    groups: dict[str, Callable[[Watched], bool]] = {
        "success, as it is": lambda w: not w.failed and w.how == TESTED[0],
        "success, otherwise": lambda w: not w.failed and w.how != TESTED[0],
        "failure, as it is": lambda w: w.failed and w.how == TESTED[0],
        "failure, otherwise": lambda w: w.failed and w.how != TESTED[0],
    }
    rows = []
    for name, own in by_monitor.items():
        shares = [Share.of([w.alarmed_after <= 1.0 for w in own if of(w)]) for of in groups.values()]
        rows.append((name, *map(count, shares), "yes" if in_order(shares) else "no"))
    return Table(
        "Episodes with an alarm; wanted is an order: success known ≤ success new < failure known ≤ failure new.",
        ("Monitor", *groups, "in order"),
        rows,
    )


def in_order(shares: Sequence[Share]) -> bool:
    """Of alarms in successes known and new, and in failures known and new; a group without episodes is passed over."""
    there = [(share.value, failed) for share, failed in zip(shares, (0, 0, 1, 1), strict=True) if share.n]
    return all(a <= b if of_a == of_b else a < b for (a, of_a), (b, of_b) in pairwise(there))


def curve(by_monitor: Mapping[str, Sequence[Watched]]) -> Figure:
    """Failures known over the share of the episode that has passed."""
    with figure(height=4.0) as fig:
        ax = fig.subplots()
        passed = np.linspace(0.0, 1.0, 101)
        for i, (name, own) in enumerate(by_monitor.items()):
            known = np.array([w.alarmed_after for w in own if w.failed])
            shares = [100 * float((known <= p).mean()) if len(known) else 0.0 for p in passed]
            colour, line, _ = look(i)
            ax.plot(100 * passed, shares, color=colour, linestyle=line, linewidth=1.8, label=name)
        ax.set(xlabel="of the episode passed [%]", ylabel="failures with an alarm [%]", ylim=(0, 100))
        ax.grid(color="#dddddd", linewidth=0.6)
        fig.legend(loc="outside upper center", ncols=4, handlelength=3.5)
    return fig
