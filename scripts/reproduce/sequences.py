"""Memory of sequences: a settling network recalls a sequence of patterns from its first pattern.

Claim: a hidden state tells what a pattern alone does not, so that sequences in which patterns repeat are recalled. The
patterns are ±1, drawn at random, all similar to one template (three bits of four agree with it), or repeated as in
A B C B A. The network is compared with the network by traces and with

    asymmetric Hopfield    x_{t+1} = sign(Σ_i x_{i+1} x_iᵀ x_t)
    one layer              x_{t+1} = sign(W x_t),  W = argmin Σ_i ‖x_{i+1} - W x_i‖²

Sources: Tang, Barron and Bogacz 2023 (NeurIPS 36) for the question and the patterns; Sompolinsky and Kanter 1986 (PRL
57(22)) for the asymmetric Hopfield network.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from asm_gym.evaluation.figures import figure
from asm_gym.evaluation.tables import Table
from asm_gym.memory.dynamics import DYNAMICS
from asm_gym.memory.learning import Schedule, Trajectory
from asm_gym.memory.recall import follow, run_on
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.curves import points
from asm_gym.scripts.reproduce.kit import Findings, Record, over_seeds, shown
from asm_gym.validation import check_number

Patterns = NDArray[np.float64]

SIMILAR = 0.5
"""b: each bit agrees with the template with a probability of (1 + b)/2."""

RIGHT = 0.95
"""Share of right bits in a pattern that counts as recalled."""

REPEATED = {"A B C B A": (0, 1, 2, 1, 0), "A B C B A D B C": (0, 1, 2, 1, 0, 3, 1, 2)}

MODELS = {"hopfield": "asymmetric Hopfield", "single": "one layer", "settling": "settling", "traces": "traces"}

_LENGTH = partial(check_number, "the length of a sequence", low=2, whole=True)


@dataclass(frozen=True)
class Config(kit.Config):
    """Sequences recalled from their first pattern."""

    lengths: tuple[int, ...] = option((4, 8, 16, 32, 64), quick=(4, 8), least=1, check=_LENGTH)
    """Patterns in a sequence."""
    walks: tuple[int, ...] = option((8, 16), quick=(8,), check=_LENGTH)
    """Patterns in a sequence drawn from four."""
    size: int = option(100, least=1)
    """Bits of a pattern."""
    hidden: int = option(64, quick=16, least=1)
    """Hidden units."""
    updates: int = option(3000, quick=300, least=1)
    """Batches of 16 rows."""


def patterns(count: int, size: int, similar: float, rng: np.random.Generator) -> Patterns:
    """Return (count, size) of ±1, each bit as in one template with a probability of (1 + similar)/2."""
    template = rng.choice([-1.0, 1.0], size)
    return np.where(rng.random((count, size)) < (1 + similar) / 2, template, -template)


def tasks(config: Config, rng: np.random.Generator) -> dict[tuple[str, int], Patterns]:
    """Return every sequence (P, N) by kind and length."""
    made = {}
    for (kind, similar), count in product((("random", 0.0), ("similar", SIMILAR)), config.lengths):
        made[kind, count] = patterns(count, config.size, similar, rng)
    for name, order in REPEATED.items():
        made[name, len(order)] = patterns(4, config.size, 0.0, rng)[list(order)]
    for count in config.walks:
        made["of four", count] = patterns(4, config.size, 0.0, rng)[rng.integers(0, 4, count)]
    return made


def by_correlation(sequence: Patterns) -> Patterns:
    """Recall by an asymmetric Hopfield network."""
    return _stepped(sequence, sequence[:-1].T @ sequence[1:])


def by_one_layer(sequence: Patterns) -> Patterns:
    """Recall by predictive coding without hidden units, after its learning has converged."""
    return _stepped(sequence, np.linalg.lstsq(sequence[:-1], sequence[1:], rcond=None)[0])


def _stepped(sequence: Patterns, W: Patterns) -> Patterns:
    found = [sequence[0]]
    for _ in sequence[1:]:
        found.append(np.sign(found[-1] @ W))
    return np.array(found)


def by_network(sequence: Patterns, dynamics: str, config: Config, rng: np.random.Generator) -> Patterns:
    """Recall by a temporal network that has learned by its local rules."""
    how, one = DYNAMICS[dynamics], np.ones((len(sequence), 1), np.float32)
    x = sequence.astype(np.float32)
    epochs = max(1, round(16 * config.updates / len(x)))
    schedule = Schedule(epochs, 16, 3e-3, how.iterations, how.prior_precision, 1.0, 0.0)
    network = how.learn([Trajectory(x, one, x)], config.hidden, schedule, rng, lambda: None).network
    cued = follow(network, network.at_rest(1), x[:1, None], one[:1, None])
    return np.vstack([sequence[:1], run_on(network, cued.traces, len(x) - 1).senses[:, 0]])


def recalled(found: Patterns, sequence: Patterns) -> tuple[float, float]:
    """Return the share of right patterns after the first, and the mean squared error of a bit."""
    agree = np.mean(np.sign(found[1:]) == sequence[1:], axis=1)
    return float(np.mean(agree >= RIGHT)), float(np.mean((found[1:] - sequence[1:]) ** 2))


def one_seed(seed: int, config: Config) -> list[Record]:
    """Measure every sequence and model."""
    rng, records = np.random.default_rng(seed), []
    for (kind, count), sequence in tasks(config, rng).items():
        models = {"hopfield": by_correlation(sequence), "single": by_one_layer(sequence)}
        models |= {name: by_network(sequence, name, config, rng) for name in DYNAMICS}
        for model, found in models.items():
            right, mse = recalled(found, sequence)
            records.append({"seed": seed, "kind": kind, "length": count, "model": model, "right": right, "mse": mse})
    return records


def table(records: Sequence[Record], config: Config) -> Table:
    """Return the share of right patterns by sequence and model."""
    asked = list(dict.fromkeys((r["kind"], r["length"]) for r in records))
    caption = f"Share of right patterns after the first; {config.size} bits, {config.hidden} units; mean ± SD"
    rows = [
        (kind, str(count), *(shown(records, "right", kind=kind, length=count, model=m) for m in MODELS))
        for kind, count in asked
    ]
    return Table(caption, ("sequence", "patterns", *MODELS.values()), rows)


def drawn(records: Sequence[Record], config: Config) -> Figure:
    """Draw the share of right patterns by length."""
    with figure(height=3.0, width=8) as fig:
        kinds = ("random", "random patterns"), ("similar", "patterns similar to one template")
        for ax, (kind, title) in zip(fig.subplots(1, 2, sharey=True), kinds, strict=True):
            for i, (model, label) in enumerate(MODELS.items()):
                found = [over_seeds(records, "right", kind=kind, length=n, model=model) for n in config.lengths]
                points(ax, config.lengths, found, i, label)
            ax.set(xlabel="patterns in a sequence", xscale="log", title=title)
        fig.axes[0].set(ylabel="share recalled rightly")
        fig.axes[1].legend(fontsize=7)
    return fig


def run(config: Config) -> Findings:
    """Run every seed."""
    records = kit.together(kit.each("learning sequences", partial(one_seed, config=config), config.repetitions, config))
    return Findings(records, [table(records, config)], drawn(records, config))
