"""What watching an agent while it learns is worth: violations on the way, and success in the end. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.statistics import Estimate, Spread, bootstrap, gain, reduction
from asm_gym.evaluation.tables import Table
from asm_gym.rollouts.training.outcome import TrainingOutcome


@dataclass(frozen=True)
class Worth:
    """A condition against training alone, over the seeds they share.

    Args:
        condition: which.
        over, contacts, limited: how much fewer, as a share of those alone; NaN where there were none.
        gained: difference of the final shares of success.
    """

    condition: str
    over: Estimate
    contacts: Estimate
    limited: Estimate
    gained: Estimate


def worth(alone: Sequence[TrainingOutcome], guarded: Sequence[TrainingOutcome], seed: int = 0) -> Worth:
    """One condition against training alone, paired by seed.

    Args:
        alone, guarded: of the same seeds, in any order.
        seed: of the resampling.

    Raises:
        ValueError: they are not pairs.
    """
    first, second = ({o.seed: o for o in outcomes} for outcomes in (alone, guarded))
    if first.keys() != second.keys() or not first:
        raise ValueError(f"runs must come in pairs, got the seeds {sorted(first)} and {sorted(second)}")
    rng = np.random.default_rng(seed)

    def fewer(name: str) -> Estimate:
        pairs = np.array([[o[s].each_10k(name) for o in (first, second)] for s in first])
        if not pairs[:, 0].any():  # nothing there that could be less
            return Estimate(math.nan, math.nan, math.nan)
        return bootstrap(reduction, pairs, rng)

    solved = np.array([[o[s].success for o in (first, second)] for s in first])
    return Worth(
        condition=guarded[0].condition,
        over=fewer("over"),
        contacts=fewer("contacts"),
        limited=fewer("limited"),
        gained=bootstrap(gain, solved, rng),
    )


def counts_table(outcomes: Mapping[str, Sequence[TrainingOutcome]], limit: float) -> Table:
    """Violations of each condition, and success in the end.

    Args:
        outcomes: by condition.
        limit: of the force [N].
    """
    names = ("over", "contacts", "limited", "touched", "alarms", "acted")
    rows = []
    for condition, runs in outcomes.items():
        rates = [Spread.of([o.each_10k(name) for o in runs]).text(1, 0) for name in names]
        noticed = sum(sum(o.noticed) for o in runs) / max(1, sum(sum(o.contacts) for o in runs))
        solved = Spread.of([100 * o.success for o in runs]).text(1, 1)
        rows.append((condition, *rates, f"{100 * noticed:.0f} %", solved))
    one = next(iter(outcomes.values()))[0]
    return Table(
        f"Of 10,000 control steps, mean and standard deviation over {len(next(iter(outcomes.values())))} seeds of "
        f"{one.steps} steps each: steps with more than {limit:g} N from outside, contacts that these make up, steps "
        "throughout which a motor stood at its torque limit, steps in which one touched it, steps in alarm, steps in "
        "which the reflex acted. Then contacts with an alarm in their first step, and success in "
        f"{one.episodes} episodes without the wrapper.",
        (
            *("", f"Steps above {limit:g} N", "Contacts", "At torque limit", "Touched it", "In alarm"),
            *("Held", "Contacts noticed", "Success [%]"),
        ),
        rows,
    )


def worth_table(outcomes: Mapping[str, Sequence[TrainingOutcome]], alone: str, limit: float) -> Table:
    """Each condition against training alone.

    Args:
        outcomes: by condition.
        alone: which of them is training alone.
        limit: of the force [N].
    """
    found = [worth(outcomes[alone], runs) for name, runs in outcomes.items() if name != alone]
    rows = [(w.condition, *(e.percent("none alone") for e in (w.over, w.contacts, w.limited, w.gained))) for w in found]
    return Table(
        "Against training alone, paired by seed; in brackets 95 % bootstrap intervals over seeds, which for so few of "
        "them are too narrow rather than too wide.",
        ("", f"Steps above {limit:g} N less by", "Contacts less by", "At torque limit less by", "Success gained"),
        rows,
    )


def learning_figure(outcomes: Mapping[str, Sequence[TrainingOutcome]], limit: float) -> Figure:
    """Violations so far and success against steps: the mean over seeds thick, each seed thin.

    Args:
        outcomes: by condition.
        limit: of the force [N].
    """
    panels = {"over": f"steps above {limit:g} N so far", "limited": "steps at a torque limit so far"}
    with figure(height=3.6, width=11.0) as fig:
        axes = fig.subplots(1, 3)
        for i, (condition, runs) in enumerate(outcomes.items()):
            colour, line, _ = look(i)
            for ax, name in zip(axes, panels, strict=False):
                steps = np.minimum(runs[0].span * (1 + np.arange(len(runs[0].over))), runs[0].steps)
                sums = np.array([np.cumsum(getattr(o, name)) for o in runs])
                ax.plot(steps, sums.T, color=colour, linewidth=0.6, alpha=0.4)
                ax.plot(steps, sums.mean(axis=0), color=colour, linestyle=line, linewidth=2, label=condition)
            curves = 100 * np.array([[share for _, share in o.curve] for o in runs])
            at = [step for step, _ in runs[0].curve]
            axes[2].plot(at, curves.T, color=colour, linewidth=0.6, alpha=0.4)
            axes[2].plot(at, curves.mean(axis=0), color=colour, linestyle=line, linewidth=2)
        for ax, label in zip(axes, (*panels.values(), "success without the wrapper [%]"), strict=True):
            ax.set(xlabel="control steps", ylabel=label)
            ax.set_ylim(bottom=0)
            ax.grid(color="#dddddd", linewidth=0.6)
        axes[2].set_ylim(0, 102)
        fig.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(outcomes))
    return fig
