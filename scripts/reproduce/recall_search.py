"""The same search for everything that recalls: nine settings of each, on the same letters, with the same practice.

Letters of a seed that no page reports: 100 and what follows. What ``memorise_and_recall`` uses is the setting with the
least error, mean over repertoires, cues and seeds.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from asm_gym.evaluation.figures import figure
from asm_gym.evaluation.tables import Table
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import at_least
from asm_gym.scripts.reproduce.common import Common, Findings, Record, over_seeds, reproduce, shown, wide_enough
from asm_gym.scripts.reproduce.expression import mean_demonstrations, recalled
from asm_gym.scripts.reproduce.handwriting import STEPS, check_letters
from asm_gym.scripts.reproduce.recall_rivals import (
    CALLED,
    MODELS,
    WIDER,
    WIDEST,
    Condition,
    Practice,
    Setting,
    learned,
    writings,
)
from asm_gym.validation import check_choice


def grid(**values: Sequence[float]) -> tuple[Setting, ...]:
    """Every combination."""
    return tuple(dict(zip(values, chosen, strict=True)) for chosen in product(*values.values()))


_MEMORY = grid(rate=(3e-3, 6e-3, 1e-2), gain=(1.0, 4.0, 8.0))
_RECURRENT = grid(rate=(1e-2, 3e-2, 6e-2), noise=(0.1, 0.3, 0.6))
SETTINGS: dict[str, tuple[Setting, ...]] = {
    "memory": _MEMORY,
    "memory_wide": _MEMORY,
    "gru": _RECURRENT,
    "rnn": _RECURRENT,
    "gru_one_step": _RECURRENT,
    "hopfield": grid(window=(3, 5, 8), beta=(30.0, 100.0, 300.0)),
    "library": grid(bases=(10, 20, 40), stiffness=(12.5, 25.0, 50.0)),
}


@dataclass(frozen=True)
class Args(Common):
    """Which settings recall best."""

    seed: int = 100
    """The first seed; none of those of a table."""
    models: tuple[str, ...] = MODELS
    """What recalls."""
    repertoires: tuple[int, ...] = (16, 32)
    """How many letters one network learns."""
    hidden: int = 64
    """Hidden units."""
    cues: tuple[int, ...] = (5, 10, 30)
    """Steps that are read before recall begins."""
    writings: int = 8
    """Writings of each letter to learn from."""
    steps: int = 8000
    """Steps in which the synapses of the memory change."""
    updates: int = 533
    """Updates of the networks trained by backpropagation through time, by 16 letters each."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.models:
            check_choice("model", name, SETTINGS)
        check_letters(*self.repertoires)
        at_least(1, self, "repertoires", "cues", "writings", "steps", "updates")
        wide_enough(self.hidden, 4)
        for cue in self.cues:
            if cue >= STEPS:
                raise ValueError(f"a cue must be shorter than the letter, 1 to {STEPS - 1} steps, got {cue}")
        if not (self.models and self.repertoires and self.cues):
            raise ValueError("there must be at least one model, one repertoire and one cue")
        if "memory_wide" in self.models and WIDER * self.hidden > WIDEST:
            raise ValueError(f"the wide memory would have {WIDER * self.hidden} units, more than {WIDEST}")

    def scaled(self) -> Args:
        """With ``quick``, little of everything."""
        if not self.quick:
            return self
        return replace(self, seeds=min(self.seeds, 2), repertoires=(2,), hidden=16, writings=2, steps=100, updates=5)


def score(job: tuple[int, int, str, Setting], args: Args) -> list[Record]:
    """What one model recalls, as it is set: (seed, letters, model, setting)."""
    seed, skills, name, setting = job
    rng = np.random.default_rng([seed, 2])
    train, tests = writings(Condition(seed, skills, args.hidden, 2), args.writings, rng)
    practice = Practice(args.writings, args.steps, args.updates)
    model = learned(name, setting, train, tests, args.hidden, practice, rng)
    means = mean_demonstrations(train, 2)
    records = []
    for cue in args.cues:
        error, right = recalled(model, tests, means, cue)
        where = {"seed": seed, "skills": skills, "model": name, "setting": in_brief(setting), "cue": cue}
        records.append({**where, "error_cm": error, "right": right})
    return records


def in_brief(setting: Setting) -> str:
    """What is set."""
    return ", ".join(f"{name} {value:g}" for name, value in setting.items())


def tables(records: Sequence[Record], args: Args) -> list[Table]:
    """A row a setting, the best of each model first."""
    asked = [(n, cue) for n in args.repertoires for cue in args.cues]
    rows = []
    for name in args.models:
        settings = {r["setting"]: None for r in records if r["model"] == name}
        mean = {s: over_seeds(records, "error_cm", model=name, setting=s).mean for s in settings}
        for setting in sorted(settings, key=lambda s: mean[s]):
            where = {"model": name, "setting": setting}
            each = [
                f"{shown(records, 'error_cm', skills=n, cue=c, **where)} "
                f"({over_seeds(records, 'right', skills=n, cue=c, **where).mean:.2f})"
                for n, c in asked
            ]
            rows.append((CALLED[name], setting, f"{mean[setting]:.2f}", *each))
    heads = ("Model", "Setting", "Mean", *(f"{n} letters, cue of {cue}" for n, cue in asked))
    return [Table("Offline error [cm], and share of right letters; the best of each first.", heads, rows)]


def scatter(records: Sequence[Record], args: Args) -> Figure:
    """Mean error of every setting, a line a model."""
    with figure(height=3.5, width=7.0) as fig:
        ax = fig.subplots()
        for i, name in enumerate(args.models):
            settings = {r["setting"]: None for r in records if r["model"] == name}
            own = [over_seeds(records, "error_cm", model=name, setting=s).mean for s in settings]
            ax.plot(own, [-i] * len(own), "o", alpha=0.6)
        ax.set_yticks([-i for i in range(len(args.models))], [CALLED[m] for m in args.models])
        ax.set_xlabel("offline error [cm]")
        ax.grid(color="#dddddd", linewidth=0.6)
    return fig


def study(args: Args, console: Console, seconds: dict[str, float]) -> Findings:
    """Every setting of every model, on every repertoire."""
    args = args.scaled()
    jobs = [
        (s, n, m, how) for s in args.repetitions for n in args.repertoires for m in args.models for how in SETTINGS[m]
    ]
    with stage("learning letters", console, seconds) as progress:
        found = parallel_map(partial(score, args=args), jobs, args.workers, progress)
    records = [r for own in found for r in own]
    return Findings(records, tables(records, args), scatter(records, args), {})


def main(argv: list[str] | None = None) -> int:
    """Searches, and returns the exit code."""
    return reproduce("recall_search", study, Args, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
