"""Speed and accuracy: more inference, or slower movements, for more accuracy; by a state that settles, and by traces.

A network that settles knows the past by its state alone, which is inferred row by row: with little inference it lags
behind the senses. Traces lead to what comes next in one pass, and inference is for what is unseen. Both learn the same
letters, and both are asked, with 1 to 100 steps of inference a row,

    recalled     where the pen goes after a cue, from memory alone
    next row     where it will be in the next row, while it is seen
    unseen axis  where it is on one axis, in rows in which neither that nor the command along it is read
    slips told   whether it slipped: surprise there against surprise in good writings, AUROC

The steps of this package are nearly as long as they can be and settle in a few; neurons integrate slowly, so steps a
twentieth as long are asked for too. Nor can neurons jump. This package begins at the expected state, so the same
network is also asked with inference that begins where the row before left it ("lagging"), as in the authors' script for
the Kalman filter. Errors are fitted by laws of the time that was taken, steps times their length. Another memory
learns letters at several speeds and is asked at each, with as much inference a second, whatever the speed: its error is
fitted by the linear law of movements. The first is also asked with noisier senses, and to prepare a movement: by longer
cues, or by more inference on each of their rows.

Sources: Fitts 1954 (J. Exp. Psychol. 47(6)); Wickelgren 1977 (Acta Psychologica 41(1)) for the approach to a limit;
Schmidt et al. 1979 (Psychological Review 86(5)) for error = a + b speed; Akaike 1974 for the comparison.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from asm_gym.evaluation.statistics import auroc
from asm_gym.memory.dynamics import DYNAMICS
from asm_gym.memory.inference import direct, expect, infer, iterations_within, sense
from asm_gym.memory.network import Network
from asm_gym.memory.recall import follow, run_on, to_rows
from asm_gym.memory.settling import SettlingNetwork
from asm_gym.scripts.options import fixed, option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.expression import ExpressionMemory, Rows, read
from asm_gym.scripts.reproduce.handwriting import DT, NOISE, STEPS, Letter, check_letters, copybook, repertoire, written
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.scripts.reproduce.lagging import LaggingNetwork
from asm_gym.scripts.reproduce.recordings import wide_enough
from asm_gym.scripts.reproduce.speed_accuracy_report import drawn, fits, tables
from asm_gym.validation import check_number

CUE = 20
SLIP = 5 * NOISE
"""How far the pen slips in a faulty writing [cm], from one step to the next and for good."""

WINDOW = 10
"""Steps after its onset within which a slip is to be seen."""

HIDDEN_AXIS = 1
"""y."""

SHORTER = (20, 1)
"""How many times shorter than this package's steps of inference are, the slow ones first."""

CUES = (5, 10, 20, 30)
PREPARED = (1, 3, 10, 30, 100)
"""Long steps of inference on each row of a cue."""

NOISES = (0.0, 0.02, 0.05, 0.1, 0.2)
"""Standard deviations of what is added to the pen's sensed position [cm]."""

LAGGING = "lagging"
"""By settling, from the state of the row before on."""

TESTS = 8
"""Writings of each letter that are asked for."""


_COUNT = partial(check_number, "iterations", low=1, whole=True)


@dataclass(frozen=True)
class Config(kit.Config):
    """What accuracy costs."""

    iterations: tuple[int, ...] = option((1, 2, 3, 5, 8, 12, 20, 35, 60, 100), quick=(1, 3, 8, 20, 60), check=_COUNT)
    """Steps of inference."""
    speeds: tuple[float, ...] = option((0.6, 0.8, 1.0, 1.25, 1.6, 2.0), quick=(0.8, 1.25, 2.0))
    """Speeds of writing, as multiples of the usual one."""
    budgets: tuple[int, ...] = option((120, 6000), check=partial(iterations_within, dt=DT))
    """Short steps of inference a second, at every speed; a row takes one at least."""
    skills: int = option(4, quick=2, check=check_letters)
    """Letters."""
    hidden: int = option(64, quick=32)
    """Hidden units."""
    writings: int = fixed(12, quick=4, least=1)
    """Writings of each letter."""
    steps: int = option(16000, quick=1500, least=1)
    """Steps in which the synapses change."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.iterations)) < 4:
            raise ValueError(f"a curve needs 4 different numbers of iterations, got {self.iterations}")
        if len(set(self.speeds)) < 3 or not all(0.2 <= s <= 4 for s in self.speeds):
            raise ValueError(f"a line needs 3 different speeds from 0.2 to 4, got {self.speeds}")
        wide_enough(self.hidden, 4)


def one_seed(seed: int, config: Config) -> list[Record]:
    """Both questions, of both dynamics, for one repertoire."""
    rng, records = np.random.default_rng(seed), []
    letters = repertoire(config.skills, 2, rng)
    for name in DYNAMICS:
        records += by_iterations(seed, letters, config, rng, name) + by_speed(seed, letters, config, rng, name)
    return records


def asked(memory: ExpressionMemory, iterations: int, shorter: int = 1) -> ExpressionMemory:
    """The memory with so many steps of inference a row, which are ``shorter`` times shorter than they could be."""
    network = memory.network.with_iterations(iterations)
    network.curvature *= np.float32(shorter)  # a step is as long as its inverse
    return ExpressionMemory(memory.reader, network)


def each_way(memory: ExpressionMemory, dynamics: str) -> dict[str, ExpressionMemory]:
    """The memory as it is, and one that settles as it is where its units cannot jump."""
    found = {dynamics: memory}
    if isinstance(memory.network, SettlingNetwork):
        found[LAGGING] = ExpressionMemory(memory.reader, LaggingNetwork.of(memory.network))
    return found


def by_iterations(
    seed: int, letters: Sequence[Letter], config: Config, rng: np.random.Generator, dynamics: str
) -> list[Record]:
    """What one memory makes of letters, and how long it takes, by steps of inference, cues and noise."""
    memory = ExpressionMemory.learned(
        copybook(letters, config.writings, 2, rng), config.hidden, rng, config.steps, dynamics=dynamics
    )
    rows = np.stack([e.stream for e in copybook(letters, TESTS, 2, rng)], axis=1).astype(np.float64)
    slipped, onset = slips(rows, rng)
    noise = rng.standard_normal((*rows.shape[:2], 2))
    records = []
    for name, one in each_way(memory, dynamics).items():
        own = by_steps(one, rows, slipped, onset, config) + by_noise(one, rows, noise) + by_preparation(one, rows)
        records += [{"seed": seed, "dynamics": name, **r} for r in own]
    return records


def by_steps(
    memory: ExpressionMemory, rows: Rows, slipped: Rows, onset: NDArray[np.intp], config: Config
) -> list[Record]:
    """All that is asked, by steps of inference a row."""
    records = []
    for count, shorter in product(config.iterations, SHORTER):
        own = asked(memory, count, shorter)
        hand, online = own.express(rows, CUE)[CUE:, :, :2], own.express(rows, len(rows))[1:, :, :2]
        records.append(
            {
                "iterations": count,
                "shorter": shorter,
                "recalled_cm": off(hand, rows),
                "next_cm": off(online, rows),
                "completed_cm": completed(own, rows),
                "auroc": told_apart(own, rows, slipped, onset),
                "us": 1e6 * _seconds_a_row(own, rows),
            }
        )
    return records


def off(hand: Rows, rows: Rows) -> float:
    """Mean distance [cm] of the hand (T', B, 2) in the last rows."""
    return float(np.linalg.norm(hand - rows[-len(hand) :, :, :2], axis=2).mean())


def by_noise(memory: ExpressionMemory, rows: Rows, noise: Rows) -> list[Record]:
    """Where the pen is in the next row, and goes after a cue, while the senses are noisier than those learned from."""
    records = []
    for more, count in product(NOISES, (PREPARED[0], PREPARED[-1])):
        own, seen = asked(memory, count), rows.copy()
        seen[:, :, :2] += more * noise
        next_row, recalled = own.express(seen, len(rows))[1:, :, :2], own.express(seen, CUE)[CUE:, :, :2]
        records.append({"noise": more, "long": count, "noisy_cm": off(next_row, rows), "cued_cm": off(recalled, rows)})
    return records


def by_preparation(memory: ExpressionMemory, rows: Rows) -> list[Record]:
    """Where the pen goes after a cue, by the cue's length and the inference on its rows; then inference is plenty."""
    records, plenty = [], asked(memory, PREPARED[-1]).network
    for cue, count in product(CUES, PREPARED):
        network = asked(memory, count).network
        cued = follow(network, network.at_rest(rows.shape[1]), *read(memory.reader, rows[:cue]))
        hand = to_rows(memory.reader, run_on(plenty, cued.traces, STEPS - max(CUES)))[:, :, :2]
        ahead = rows[cue : cue + len(hand)]
        records.append({"cue": cue, "prepared": count, "begun_cm": off(hand, ahead)})
    return records


def completed(memory: ExpressionMemory, rows: Rows) -> float:
    """Mean error [cm] of a hidden axis in each row after the cue, inferred from the other and the past."""
    net, (senses, commands) = memory.network, read(memory.reader, rows)
    c, errors, S = net.at_rest(rows.shape[1]), [], senses.shape[2]
    for t, (x, u) in enumerate(zip(senses, commands, strict=True)):
        if t >= CUE:
            taken = u.copy()
            taken[:, HIDDEN_AXIS] = net.predict(c, u)[:, S + HIDDEN_AXIS]
            found = _filled_in(memory, c, taken, x)
            errors.append(np.abs(found - x[:, HIDDEN_AXIS]) * memory.reader.spread[HIDDEN_AXIS])
        c = net.follow(c, u, x, np.ones_like(x)).traces
    return float(np.mean(errors))


def _filled_in(
    memory: ExpressionMemory, c: NDArray[np.float32], taken: NDArray[np.float32], x: NDArray[np.float32]
) -> Rows:
    """(B,) the hidden axis, standardised, where neither it nor the command along it was read."""
    net, S, motor = memory.network, x.shape[1], len(memory.reader.spec.motor)
    unseen = np.ones(S + motor, np.float32)
    unseen[[HIDDEN_AXIS, S - motor + HIDDEN_AXIS, S + HIDDEN_AXIS]] = 0.0  # where, how fast, and the command
    if isinstance(net, Network):
        w = net.weights
        past = direct(c, taken, w.W_D)
        left = np.hstack([x, taken[:, :-1]]) - past
        precision = np.broadcast_to(net.sensory_precision * unseen, left.shape).copy()
        z = infer(expect(c, w.W_C), left, w.W_F, net.prior_precision, precision, net.curvature, net.iterations)
        return np.asarray((past + sense(z, w.W_F))[:, HIDDEN_AXIS])
    z, own = net.follow(c, taken, x, np.broadcast_to(unseen[:S], x.shape).copy()).z, net.weights
    return np.asarray((sense(z, own.W_F) + own.b_F)[:, HIDDEN_AXIS])


def slips(rows: Rows, rng: np.random.Generator) -> tuple[Rows, NDArray[np.intp]]:
    """The same writings with a slip of the pen each, and the step it comes at (B,)."""
    onset = rng.integers(CUE, len(rows) - WINDOW, rows.shape[1])
    angle = rng.uniform(-math.pi, math.pi, rows.shape[1])
    after = np.arange(len(rows))[:, None] >= onset
    moved = rows.copy()
    moved[:, :, 0] += SLIP * after * np.cos(angle)
    moved[:, :, 1] += SLIP * after * np.sin(angle)
    return moved, onset


def told_apart(memory: ExpressionMemory, rows: Rows, slipped: Rows, onset: NDArray[np.intp]) -> float:
    """AUROC of the greatest surprise within the window, each slip against all good writings in the same steps."""
    good, bad = (_errors(memory, x) for x in (rows, slipped))
    spread = good.std(axis=(0, 1))
    good, bad = (np.sum((x / spread) ** 2, axis=2) for x in (good, bad))  # (T, B)
    own = [auroc([bad[k : k + WINDOW, n].max()], good[k : k + WINDOW].max(axis=0)) for n, k in enumerate(onset)]
    return float(np.mean(own))


def _errors(memory: ExpressionMemory, rows: Rows) -> Rows:
    """(T, B, S) of the senses expected before they were read."""
    senses, commands = read(memory.reader, rows)
    expected = follow(memory.network, memory.network.at_rest(rows.shape[1]), senses, commands).senses
    return (senses - expected).astype(np.float64)


def _seconds_a_row(memory: ExpressionMemory, rows: Rows) -> float:
    """Of what is needed to watch one stream."""
    net, (senses, commands) = memory.network, read(memory.reader, rows[:, :1])
    c, seen, taken = net.at_rest(1), np.ones_like(senses[0]), []
    for x, u in zip(senses, commands, strict=True):
        since = time.perf_counter()
        c = net.carry_on(c, u, x, seen)[1]
        taken.append(time.perf_counter() - since)
    return float(np.median(taken))


def by_speed(
    seed: int, letters: Sequence[Letter], config: Config, rng: np.random.Generator, dynamics: str
) -> list[Record]:
    """A memory of letters at all speeds: where it has the hand in the next row, and after a third of a letter."""
    each = max(2, config.writings // 3)
    memory = ExpressionMemory.learned(
        copybook(letters, each, 2, rng, config.speeds), config.hidden, rng, config.steps, dynamics=dynamics
    )
    records = []
    for speed in config.speeds:
        tests = [written(letter, 2, rng, speed) for letter in letters for _ in range(TESTS)]
        rows = np.stack([e.stream for e in tests], axis=1).astype(np.float64)
        pace = float(np.linalg.norm(rows[:, :, 2:], axis=2).mean())
        for (name, one), budget in product(each_way(memory, dynamics).items(), config.budgets):
            own, third = asked(one, iterations_within(budget, DT), SHORTER[0]), len(rows) // 3
            hand, online = own.express(rows, third)[third:, :, :2], own.express(rows, len(rows))[1:, :, :2]
            path, ahead = (np.linalg.norm(h - rows[-len(h) :, :, :2], axis=2) for h in (hand, online))
            where = {"seed": seed, "dynamics": name, "speed": speed, "cm_per_s": pace, "budget": budget}
            errors = {"end_cm": path[-1], "path_cm": path, "ahead_cm": ahead}
            records.append({**where, **{name: float(e.mean()) for name, e in errors.items()}})
    return records


def run(config: Config) -> Findings:
    """Every seed."""
    records = kit.together(kit.each("learning letters", partial(one_seed, config=config), config.repetitions, config))
    laws = {", ".join(key): one._asdict() for key, one in fits(records).items()}
    asked_for = f"{config.skills} letters, cue of {CUE}"
    return Findings(records, tables(records, asked_for), drawn(records), {"laws": laws, "letter_steps": STEPS})
