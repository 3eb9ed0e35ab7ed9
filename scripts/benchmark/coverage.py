"""Whether fresh nominal episodes alarm no more often than was promised: ``asm-gym benchmark coverage``.

    alarms of N fresh episodes ~ BetaBinomial(N, l, n + 1 - l),   l = ⌊(n + 1) rate⌋

is the law under a threshold from n calibration episodes, whatever the monitor, where all episodes are exchangeable and
no two maxima are equal (Vovk 2012, "Conditional validity of inductive conformal predictors", Proposition 2). Its mean,
l / (n + 1), is what is promised; its spread is wider than the binomial's, for the calibration episodes are drawn too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from scipy.stats import betabinom

from asm_gym.detection import conformal_episodes, conformal_threshold
from asm_gym.episode import Episode, load_episode
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.tables import ConsoleTable, Table
from asm_gym.monitors import MONITORS, make_monitor
from asm_gym.rollouts.collect import collect_to
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import claimed
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.scripts.command import BAD_NEWS, DONE
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_choice, check_number

CONFIDENCE = 0.99
"""That the law's interval holds the count, where the promise is kept."""
SPLITS = 200
"""Redrawn calibration sets, for what is promised on average over them."""


class Covered(NamedTuple):
    """Alarms in fresh nominal episodes at one rate."""

    rate: float
    threshold: float
    alarms: Share
    interval: tuple[int, int]  # of alarms, by the law
    redrawn: float  # mean share of alarms over redrawn calibration sets

    @property
    def kept(self) -> bool:
        """Whether the count is one that the law expects; fewer alarms than that are no breach, but no law either."""
        return self.interval[0] <= self.alarms.k <= self.interval[1]


def covered(
    calibration: NDArray[np.float64], fresh: NDArray[np.float64], rate: float, rng: np.random.Generator
) -> Covered:
    """What becomes of the promise.

    Args:
        calibration: (n,) the largest surprise of each calibration episode.
        fresh: (N,) the same of episodes that nobody has looked at.
        rate: promised.
    """
    n = len(calibration)
    threshold = conformal_threshold(calibration, rate)
    above = math.floor((n + 1) * rate + 1e-9)
    low, high = betabinom(len(fresh), above, n + 1 - above).interval(CONFIDENCE)
    everything, shares = np.concatenate([calibration, fresh]), []
    for _ in range(SPLITS):
        drawn = rng.permutation(everything)
        shares.append((drawn[n:] > conformal_threshold(drawn[:n], rate)).mean())
    return Covered(
        rate,
        threshold,
        Share(int((fresh > threshold).sum()), len(fresh)),
        (int(low), int(high)),
        float(np.mean(shares)),
    )


@dataclass
class CoverageCheck:
    """Alarms in fresh nominal episodes against the rates that were promised, and the law of their number."""

    task: str = "Lift"
    """Name of the task; the scripted expert acts."""
    monitor: str = "neural_asm"
    """Name of the monitor."""
    rates: tuple[float, ...] = (0.01, 0.02, 0.05)
    """False-alarm rates that are promised."""
    fit_episodes: int = 60
    """Episodes to learn from."""
    calibration_episodes: int = 200
    """Episodes to set the thresholds on."""
    episodes: int = 1000
    """Fresh episodes to test on."""
    horizon: int | None = None
    """Control steps of an episode; the task's own by default."""
    workers: int = 2
    """Processes."""
    seed: int = 0
    """Seed of the episodes and of the monitor."""
    out: Path = Path("runs/coverage")
    """Folder of the recordings: a second call goes on."""
    quick: bool = False
    """A tenth of the episodes: to see that everything runs."""

    def __post_init__(self) -> None:
        task_spec(self.task)
        check_choice("monitor", self.monitor, MONITORS)
        for name in ("fit_episodes", "calibration_episodes", "episodes", "workers"):
            check_number(name, getattr(self, name), low=1, whole=True)
        if self.quick:
            self.rates, self.episodes, self.calibration_episodes = (0.05, 0.1, 0.2), 20, 20
            self.fit_episodes = 12
        for rate in self.rates:
            if self.calibration_episodes < conformal_episodes(rate):
                raise ValueError(
                    f"a rate of {rate} needs {conformal_episodes(rate)} calibration_episodes, "
                    f"got {self.calibration_episodes}"
                )

    def run(self, console: Console) -> int:
        """Prints a row for each rate; 1 where a count is one that the law does not expect."""
        config = RolloutConfig(env_kwargs=(("horizon", self.horizon),) if self.horizon else ())
        with claimed(self.out, "coverage.json", {"task": self.task, "horizon": self.horizon, "seed": self.seed}):
            fit, calibration, fresh = (
                self._recorded(role, count, config, console)
                for role, count in (
                    ("fit", self.fit_episodes),
                    ("calibration", self.calibration_episodes),
                    ("nominal", self.episodes),
                )
            )
        monitor = make_monitor(self.monitor, fit[0].spec, seed=self.seed).fit(fit)
        nominal, tested = (np.array([s.value.max() for s in monitor.score_episodes(e)]) for e in (calibration, fresh))
        rng = np.random.default_rng(self.seed)
        found = [covered(nominal, tested, rate, rng) for rate in self.rates]
        console.print(ConsoleTable(_table(self, found, len(nominal), len(tested))))
        console.print(f"law: how many alarms {CONFIDENCE:.0%} of such runs have; redrawn: mean over {SPLITS} splits")
        return DONE if all(c.kept for c in found) else BAD_NEWS

    def _recorded(self, role: str, count: int, config: RolloutConfig, console: Console) -> list[Episode]:
        """The episodes of a role that succeeded: one that fails is no example of what should feel normal."""
        env_id = task_spec(self.task).id
        assert env_id in gym.registry
        with stage(f"recording {role}", console, {}) as progress:
            seeds = role_seeds(self.seed, self.task, role, count)
            files = collect_to(self.out / role, env_id, config, seeds, self.workers, progress)
        return [episode for episode in map(load_episode, files) if episode.success]


def _table(args: CoverageCheck, found: list[Covered], calibration: int, fresh: int) -> Table:
    rows = []
    for c in found:
        low, high = c.alarms.interval
        rows.append(
            (
                f"{100 * c.rate:g} %",
                f"{c.alarms.k} of {c.alarms.n}",
                f"{100 * c.alarms.value:.1f} % ({100 * low:.1f} to {100 * high:.1f})",
                f"{c.interval[0]} to {c.interval[1]}",
                f"{100 * c.redrawn:.2f} %",
                "yes" if c.kept else "no",
            )
        )
    title = f"{args.task}, {args.monitor}: {calibration} calibration and {fresh} fresh episodes, those that succeeded"
    return Table(title, ("promised", "alarms", "share, 95 %", "law", "redrawn", "inside"), rows)
