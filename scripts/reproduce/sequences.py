"""Memory of sequences: the network that settles, as the paper on sequential memory asks it.

A sequence of patterns of ±1 is learned, and recalled from its first pattern alone. Patterns are drawn at random; or all
like one template (b = 0.5: three bits of four agree with it); or some come twice, as in A B C B A, so that a pattern
does not say what comes next, and only what came before does. Beside the network are what the paper compares with:

    asymmetric Hopfield    x_{t+1} = sign(Σ_i x_{i+1} x_iᵀ x_t)
    one layer              x_{t+1} = sign(W x_t),  W = argmin Σ_i ‖x_{i+1} - W x_i‖²    where its learning ends

and the network by traces, which the paper does not have.

Then the copy task: a symbol of eight is shown, and after a delay in which there is nothing it is to be expected again;
or two of four symbols, in their order. A GRU and an LSTM learn the same by backpropagation through time, with as many
weights as the settling network has with its units, and from as many rows.

Source: Tang, Barron and Bogacz 2023 (NeurIPS 36), and the scripts that they name, for the patterns and A B C B A, of
digits there. Sompolinsky and Kanter 1986 (PRL 57(22)) for the asymmetric Hopfield network. Hochreiter
and Schmidhuber 1997 (Neural Computation 9(8)) for the copy task.
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
from asm_gym.scripts.options import fixed, option
from asm_gym.scripts.reproduce import kit, recurrent
from asm_gym.scripts.reproduce.curves import points
from asm_gym.scripts.reproduce.kit import Findings, Record, over_seeds, shown
from asm_gym.validation import check_number

Patterns = NDArray[np.float64]

ALIKE = 0.5
"""b, of patterns like one template: each bit agrees with it with a probability of (1 + b)/2."""

RIGHT = 0.95
"""Share of the bits of a pattern that is recalled rightly."""

ALIASED = {"A B C B A": (0, 1, 2, 1, 0), "A B C B A D B C": (0, 1, 2, 1, 0, 3, 1, 2)}
"""Sequences in which patterns come again."""

MODELS = {
    "hopfield": "asymmetric Hopfield",
    "single": "one layer",
    "settling": "settling",
    "traces": "traces",
}


COPYING = {"settling": "settling", "traces": "traces", "gru": "GRU, BPTT", "lstm": "LSTM, BPTT"}
"""What learns to say again."""

COPIERS = {"settling": 32, "traces": 32, "gru": 16, "lstm": 14}
"""Units of each: 1,600 weights by settling, 3,000 by traces, 1,400 in a GRU, 1,500 in an LSTM."""

RATE = 3e-2
"""Of the networks trained by backpropagation through time, the best of 1e-2, 3e-2 and 6e-2."""

COPIED = {"one of 8": (8, 1), "two of 4": (4, 2)}
"""Symbols, and how many are shown."""

_LENGTH = partial(check_number, "the length of a sequence", low=2, whole=True)
_DELAY = partial(check_number, "a delay", low=1, whole=True)


@dataclass(frozen=True)
class Config(kit.Config):
    """Which sequences are recalled from their first pattern."""

    lengths: tuple[int, ...] = option((4, 8, 16, 32, 64), quick=(4, 8), least=1, check=_LENGTH)
    """Patterns in a sequence."""
    walks: tuple[int, ...] = option((8, 16), quick=(8,), check=_LENGTH)
    """Patterns in a sequence drawn from four."""
    size: int = option(100, least=1)
    """Bits of a pattern."""
    hidden: int = option(64, quick=16, least=1)
    """Hidden units."""
    updates: int = option(3000, quick=300, least=1)
    """Steps in which the synapses change, with 16 streams side by side."""
    delays: tuple[int, ...] = option((10, 30), quick=(5,), least=1, check=_DELAY)
    """Steps after which a symbol is to be said again."""
    copying: int = fixed(10000, quick=1000, least=1)
    """Steps in which the synapses change to learn that."""


def patterns(count: int, size: int, alike: float, rng: np.random.Generator) -> Patterns:
    """(count, size) of ±1, each bit as in one template with a probability of (1 + alike)/2."""
    template = rng.choice([-1.0, 1.0], size)
    return np.where(rng.random((count, size)) < (1 + alike) / 2, template, -template)


def tasks(config: Config, rng: np.random.Generator) -> dict[tuple[str, int], Patterns]:
    """Every sequence (P, N), by kind and length."""
    made = {}
    for (kind, alike), count in product((("random", 0.0), ("alike", ALIKE)), config.lengths):
        made[kind, count] = patterns(count, config.size, alike, rng)
    for name, order in ALIASED.items():
        made[name, len(order)] = patterns(4, config.size, 0.0, rng)[list(order)]
    for count in config.walks:
        made["of four", count] = patterns(4, config.size, 0.0, rng)[rng.integers(0, 4, count)]
    return made


def by_correlation(sequence: Patterns) -> Patterns:
    """What an asymmetric Hopfield network recalls from the first pattern."""
    return _stepped(sequence, sequence[:-1].T @ sequence[1:])


def by_one_layer(sequence: Patterns) -> Patterns:
    """What predictive coding without hidden units recalls, once it has settled on its weights."""
    return _stepped(sequence, np.linalg.lstsq(sequence[:-1], sequence[1:], rcond=None)[0])


def _stepped(sequence: Patterns, W: Patterns) -> Patterns:
    found = [sequence[0]]
    for _ in sequence[1:]:
        found.append(np.sign(found[-1] @ W))
    return np.array(found)


def by_network(sequence: Patterns, dynamics: str, config: Config, rng: np.random.Generator) -> Patterns:
    """What a temporal network recalls, once it has learned by its local rules."""
    how, one = DYNAMICS[dynamics], np.ones((len(sequence), 1), np.float32)
    x = sequence.astype(np.float32)
    epochs = max(1, round(16 * config.updates / len(x)))
    schedule = Schedule(epochs, 16, 3e-3, how.iterations, how.prior_precision, 1.0, 0.0)
    network = how.learn([Trajectory(x, one, x)], config.hidden, schedule, rng, lambda: None).network
    cued = follow(network, network.at_rest(1), x[:1, None], one[:1, None])
    alone = run_on(network, cued.traces, len(x) - 1).senses[:, 0]
    return np.vstack([sequence[:1], alone])


def recalled(found: Patterns, sequence: Patterns) -> tuple[float, float]:
    """Share of the patterns after the first that are right, and the mean squared error of a bit."""
    agree = np.mean(np.sign(found[1:]) == sequence[1:], axis=1)
    return float(np.mean(agree >= RIGHT)), float(np.mean((found[1:] - sequence[1:]) ** 2))


def copies(symbols: int, shown: int, delay: int) -> NDArray[np.float32]:
    """(N, T, symbols): every order of so many symbols, then nothing for ``delay`` steps, then the same again."""
    orders = list(product(range(symbols), repeat=shown))
    rows = np.zeros((len(orders), delay + 2 * shown, symbols), np.float32)
    for row, order in zip(rows, orders, strict=True):
        row[np.arange(shown), order] = row[np.arange(-shown, 0), order] = 2.0
    return rows


def said_again(model: str, rows: NDArray[np.float32], shown: int, updates: int, rng: np.random.Generator) -> float:
    """Share of the last ``shown`` symbols of rows (N, T, S) that are expected rightly, once learned."""
    N, T = rows.shape[:2]
    idle = np.tile(np.array([0.0, 1.0], np.float32), (T, 1))  # nothing is commanded
    taught = [Trajectory(x, idle, x) for x in rows]
    side_by_side, commands = rows.transpose(1, 0, 2), np.repeat(idle[:, None], N, axis=1)
    if model in DYNAMICS:
        how = DYNAMICS[model]
        schedule = Schedule(round(16 * updates / (N * T)) or 1, 16, 3e-3, how.iterations, how.prior_precision, 1.0, 0.0)
        network = how.learn(taught, COPIERS[model], schedule, rng, lambda: None).network
        expected = follow(network, network.at_rest(N), side_by_side, commands).senses
    else:
        made = recurrent.train(taught, model, COPIERS[model], max(1, round(updates / T)), rng, 0.0, RATE)
        expected, _ = recurrent.expected(made, side_by_side, commands, T)
    return float(np.mean(expected[-shown:].argmax(axis=2) == side_by_side[-shown:].argmax(axis=2)))


def one_seed(seed: int, config: Config) -> list[Record]:
    """Every sequence by every model."""
    rng, records = np.random.default_rng(seed), []
    for (kind, count), sequence in tasks(config, rng).items():
        models = {"hopfield": by_correlation(sequence), "single": by_one_layer(sequence)}
        models |= {name: by_network(sequence, name, config, rng) for name in DYNAMICS}
        for model, found in models.items():
            right, mse = recalled(found, sequence)
            records.append({"seed": seed, "kind": kind, "length": count, "model": model, "right": right, "mse": mse})
    for (kind, (symbols, many)), delay, model in product(COPIED.items(), config.delays, COPYING):
        share = said_again(model, copies(symbols, many, delay), many, config.copying, rng)
        records.append({"seed": seed, "kind": kind, "delay": delay, "model": model, "right": share})
    return records


def tables(records: Sequence[Record], config: Config) -> list[Table]:
    """Patterns recalled rightly, and errors."""
    asked = list(dict.fromkeys((r["kind"], r["length"]) for r in records if "length" in r))
    copied = {
        f"{kind}, {delay} steps": {"kind": kind, "delay": delay} for kind, delay in product(COPIED, config.delays)
    }
    copiers = {title: {"model": model} for model, title in COPYING.items()}
    return [
        Table(
            f"{title}, from the first alone; {config.size} bits, {config.hidden} units; mean ± SD over seeds",
            ("sequence", "patterns", *MODELS.values()),
            [
                (kind, str(count), *(shown(records, value, kind=kind, length=count, model=m) for m in MODELS))
                for kind, count in asked
            ],
        )
        for value, title in (("right", "Share of the patterns that are right"), ("mse", "Mean squared error of a bit"))
    ] + [kit.grid("The copy task: share of the symbols that are said again rightly", records, "right", copied, copiers)]


def drawn(records: Sequence[Record], config: Config) -> Figure:
    """Patterns recalled rightly, by length, of both kinds."""
    with figure(height=3.0, width=8) as fig:
        for ax, (kind, title) in zip(
            fig.subplots(1, 2, sharey=True),
            (("random", "patterns at random"), ("alike", "patterns like one template")),
            strict=True,
        ):
            for i, (model, label) in enumerate(MODELS.items()):
                found = [over_seeds(records, "right", kind=kind, length=n, model=model) for n in config.lengths]
                points(ax, config.lengths, found, i, label)
            ax.set(xlabel="patterns in a sequence", xscale="log", title=title)
        fig.axes[0].set(ylabel="share recalled rightly")
        fig.axes[1].legend(fontsize=7)
    return fig


def run(config: Config) -> Findings:
    """Every seed."""
    records = kit.together(kit.each("learning sequences", partial(one_seed, config=config), config.repetitions, config))
    return Findings(records, tables(records, config), drawn(records, config))
