"""Speed and accuracy: more inference, or slower movements, for more accuracy.

A row that is seen needs no inference: what comes next is expected from the traces in one pass. Inference is for what
is not seen. One memory of letters is asked where the pen is on one axis, in rows in which neither that nor the command
along it is read, with 1 to 200 steps of inference. The steps of this package are nearly as long as they can be and
settle in a few; neurons integrate slowly, so steps a twentieth as long are asked for too. The error is fitted by two
laws of the time that was taken, steps times their length: an exponential approach to a limit, as Fitts' law has it
(n = a + b log2 1/e), and a power law. Another memory learns letters at several speeds and writes them at each: its
error is fitted by the linear law of movements.

Sources: Fitts 1954 (J. Exp. Psychol. 47(6)); Wickelgren 1977 (Acta Psychologica 41(1)) for the approach to a limit;
Schmidt et al. 1979 (Psychological Review 86(5)) for error = a + b speed; Akaike 1974 for the comparison.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console

from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.tables import Table
from asm_gym.memory.inference import direct, expect, infer, sense
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import at_least
from asm_gym.scripts.reproduce.common import (
    Common,
    Findings,
    Record,
    over_seeds,
    reproduce,
    shown,
    wide_enough,
)
from asm_gym.scripts.reproduce.curves import points
from asm_gym.scripts.reproduce.expression import Memory, Rows, read
from asm_gym.scripts.reproduce.handwriting import NOISE, STEPS, Letter, check_letters, copybook, repertoire, written
from asm_gym.scripts.reproduce.laws import LAWS, Fit, fit

CUE = 20
SLIP = 5 * NOISE
"""How far the pen slips in a faulty writing [cm], from one step to the next and for good."""

WINDOW = 10
"""Steps that a writing goes on at least after a slip."""

HIDDEN_AXIS = 1
"""y."""

SHORTER = (20, 1)
"""How many times shorter than this package's steps of inference are, the slow ones first."""

MEASURES = {"completed_cm": "unseen axis [cm]"}


@dataclass(frozen=True)
class Args(Common):
    """What accuracy costs."""

    iterations: tuple[int, ...] = (1, 2, 3, 5, 8, 12, 20, 35, 60, 100, 200)
    """Steps of inference."""
    speeds: tuple[float, ...] = (0.6, 0.8, 1.0, 1.25, 1.6, 2.0)
    """Speeds of writing, as multiples of the usual one."""
    skills: int = 4
    """Letters."""
    hidden: int = 64
    """Hidden units."""
    writings: int = 12
    """Writings of each letter."""
    steps: int = 16000
    """Steps in which the synapses change."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_letters(self.skills)
        at_least(1, self, "writings", "steps")
        if len(set(self.iterations)) < 4 or min(self.iterations) < 1:
            raise ValueError(f"a curve needs 4 different numbers of iterations, at least 1 each, got {self.iterations}")
        if len(set(self.speeds)) < 3 or not all(0.2 <= s <= 4 for s in self.speeds):
            raise ValueError(f"a line needs 3 different speeds from 0.2 to 4, got {self.speeds}")
        wide_enough(self.hidden, 4)

    def scaled(self) -> Args:
        """With ``quick``, little of everything."""
        if not self.quick:
            return self
        few = {"iterations": (1, 3, 8, 20, 60), "speeds": (0.8, 1.25, 2.0), "hidden": 32, "steps": 1500}
        return replace(self, seeds=min(self.seeds, 2), skills=2, writings=4, **few)  # type: ignore[arg-type]


def one_seed(seed: int, args: Args) -> list[Record]:
    """Both questions, for one repertoire."""
    rng = np.random.default_rng(seed)
    letters = repertoire(args.skills, 2, rng)
    return by_iterations(seed, letters, args, rng) + by_speed(seed, letters, args, rng)


def by_iterations(seed: int, letters: Sequence[Letter], args: Args, rng: np.random.Generator) -> list[Record]:
    """Completion and time of one memory, by steps of inference."""
    memory = Memory.learned(copybook(letters, args.writings, 2, rng), args.hidden, rng, args.steps)
    rows = np.stack([e.stream for e in copybook(letters, 12, 2, rng)], axis=1).astype(np.float64)
    records = []
    for count, shorter in product(args.iterations, SHORTER):
        since = time.perf_counter()
        error = completed(memory, rows, count, shorter)
        took = time.perf_counter() - since
        where = {"seed": seed, "iterations": count, "shorter": shorter}
        records.append({**where, "completed_cm": error, "us": 1e6 * took / rows[:, :, 0].size})
    return records


def completed(memory: Memory, rows: Rows, iterations: int, shorter: int) -> float:
    """Mean error [cm] of a hidden axis in each row after the cue, inferred from the other and the past.

    Args:
        shorter: how many times shorter the steps of inference are than they could be.
    """
    net, (senses, commands) = memory.network, read(memory.reader, rows)
    w, motor, S = net.weights, memory.reader.spec.motor, senses.shape[2]
    c, errors = net.at_rest(rows.shape[1]), []
    unseen = np.ones(S + len(motor), np.float32)
    unseen[[HIDDEN_AXIS, S - len(motor) + HIDDEN_AXIS, S + HIDDEN_AXIS]] = 0.0  # where, how fast, and the command
    for t, (x, u) in enumerate(zip(senses, commands, strict=True)):
        if t >= CUE:
            mu, taken = expect(c, w.W_C), u.copy()
            taken[:, HIDDEN_AXIS] = (direct(c, u, w.W_D) + sense(mu, w.W_F))[:, S + HIDDEN_AXIS]
            past = direct(c, taken, w.W_D)
            left = np.hstack([x, u[:, :-1]]) - past
            precision = np.broadcast_to(net.sensory_precision * unseen, left.shape).copy()
            z = infer(mu, left, w.W_F, net.prior_precision, precision, net.curvature * shorter, iterations)
            found = (past + sense(z, w.W_F))[:, HIDDEN_AXIS]
            errors.append(np.abs(found - x[:, HIDDEN_AXIS]) * memory.reader.spread[HIDDEN_AXIS])
        c = net.follow(c, u, x, np.ones_like(x)).traces
    return float(np.mean(errors))


def slips(rows: Rows, rng: np.random.Generator) -> tuple[Rows, NDArray[np.intp]]:
    """The same writings with a slip of the pen each, and the step it comes at (B,)."""
    onset = rng.integers(CUE, len(rows) - WINDOW, rows.shape[1])
    angle = rng.uniform(-math.pi, math.pi, rows.shape[1])
    after = np.arange(len(rows))[:, None] >= onset
    moved = rows.copy()
    moved[:, :, 0] += SLIP * after * np.cos(angle)
    moved[:, :, 1] += SLIP * after * np.sin(angle)
    return moved, onset


def by_speed(seed: int, letters: Sequence[Letter], args: Args, rng: np.random.Generator) -> list[Record]:
    """Where a memory of letters at all speeds has the hand at the end of one, after a third of it as a cue."""
    each = max(2, args.writings // 3)
    memory = Memory.learned(copybook(letters, each, 2, rng, args.speeds), args.hidden, rng, args.steps)
    records = []
    for speed in args.speeds:
        tests = [written(letter, 2, rng, speed) for letter in letters for _ in range(8)]
        rows = np.stack([e.stream for e in tests], axis=1).astype(np.float64)
        hand = memory.express(rows, len(rows) // 3)[len(rows) // 3 :, :, :2]
        errors = np.linalg.norm(hand - rows[-len(hand) :, :, :2], axis=2)
        pace = float(np.linalg.norm(rows[:, :, 2:], axis=2).mean())
        where = {"seed": seed, "speed": speed, "cm_per_s": pace}
        records.append({**where, "end_cm": float(errors[-1].mean()), "path_cm": float(errors.mean())})
    return records


def fits(records: Sequence[Record]) -> dict[tuple[str, str], Fit]:
    """Each law that could be fitted to each measure, over all seeds."""
    found = {}
    for value in MEASURES:
        timed = [{**r, "time": r["iterations"] / r["shorter"]} for r in records if value in r]
        for law in ("exponential", "power"):
            if (one := fit(law, *_within_seeds(timed, "time", value))) is not None:
                found[value, law] = one
    for value in ("end_cm", "path_cm"):
        if (one := fit("linear", *_within_seeds([r for r in records if value in r], "cm_per_s", value))) is not None:
            found[value, "linear"] = one
    return found


def _within_seeds(records: Sequence[Record], x: str, y: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points, each seed's moved to the mean of all: how hard its letters are is no noise of the law."""
    seed, xs, ys = (np.array([r[k] for r in records], np.float64) for k in ("seed", x, y))
    for s in np.unique(seed):
        ys[seed == s] += np.mean([r[y] for r in records]) - ys[seed == s].mean()
    return xs, ys


def tables(records: Sequence[Record], args: Args) -> list[Table]:
    """By iterations, by speed, and the laws."""
    labels = {**MEASURES, "us": "time a row [µs]"}
    return [
        Table(
            f"By steps of inference, {args.skills} letters, cue of {CUE}; mean ± SD over seeds",
            ("", *map(str, args.iterations)),
            [
                (
                    label + (", long steps" if shorter == 1 else ""),
                    *(shown(records, v, 0 if v == "us" else 3, iterations=k, shorter=shorter) for k in args.iterations),
                )
                for shorter in SHORTER
                for v, label in labels.items()
                if v != "us" or shorter == 1
            ],
        ),
        Table(
            "By speed of writing, cue of a third",
            ("", *(f"{s:g}×" for s in args.speeds)),
            [
                (label, *(shown(records, v, speed=s) for s in args.speeds))
                for v, label in {"end_cm": "end point [cm]", "path_cm": "path [cm]"}.items()
            ],
        ),
        Table(
            "Laws, with 95 % intervals",
            ("", "law", "parameters", "AIC"),
            [(v, law, one.text, f"{one.aic:.1f}") for (v, law), one in fits(records).items()],
        ),
    ]


def drawn(records: Sequence[Record], args: Args) -> Figure:
    """Each measure by steps of inference with its laws, and error by speed."""
    laws = fits(records)
    with figure(height=3.0, width=8) as fig:
        axes = fig.subplots(1, 2)
        for ax, (value, label) in zip(axes, MEASURES.items(), strict=False):
            for i, shorter in enumerate(SHORTER):
                found = [over_seeds(records, value, iterations=k, shorter=shorter) for k in args.iterations]
                time = [k / shorter for k in args.iterations]
                points(ax, time, found, 3 * i, "long steps" if shorter == 1 else f"steps 1/{shorter} as long")
            x = np.geomspace(min(args.iterations) / max(SHORTER), max(args.iterations), 200)
            for i, law in enumerate(("exponential", "power")):
                if (one := laws.get((value, law))) is not None:
                    ax.plot(x, LAWS[law][0](x, *one.values), color=look(i + 1)[0], linestyle=look(i + 1)[1], label=law)
            ax.set(xlabel="time of inference [long steps]", ylabel=label, xscale="log")
        for i, (value, label) in enumerate((("end_cm", "end point"), ("path_cm", "path"))):
            pace = [over_seeds(records, "cm_per_s", speed=s)[0] for s in args.speeds]
            points(axes[1], pace, [over_seeds(records, value, speed=s) for s in args.speeds], i, label)
            if (line := laws.get((value, "linear"))) is not None:
                ends = np.array([min(pace), max(pace)])
                axes[1].plot(ends, LAWS["linear"][0](ends, *line.values), color=look(i)[0], linewidth=1)
        axes[1].set(xlabel="mean speed [cm/s]", ylabel="recalled, offline [cm]", ylim=0)
        for ax in axes:
            ax.legend(fontsize=7)
    return fig


def study(args: Args, console: Console, seconds: dict[str, float]) -> Findings:
    """Every seed."""
    args = args.scaled()
    with stage("learning letters", console, seconds) as progress:
        found = parallel_map(partial(one_seed, args=args), list(args.repetitions), args.workers, progress)
    records = [r for own in found for r in own]
    laws = {f"{value}, {law}": one._asdict() for (value, law), one in fits(records).items()}
    return Findings(records, tables(records, args), drawn(records, args), {"laws": laws, "letter_steps": STEPS})


def main(argv: list[str] | None = None) -> int:
    """Runs the study, and returns the exit code."""
    return reproduce("speed_accuracy", study, Args, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
