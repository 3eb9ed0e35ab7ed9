"""The network of the papers on the Panda: six skills in one network that settles, learned from unlabelled episodes.

Every task is seen by the same senses: the body, where the thing is from the hand, and its goal from the thing. The
network is never told the skill. It commands the arm in closed loop, is surprised by its own energy of each row,

    F_t = Σ_i ½ (ε_i/σ_i)²,   ε_t = [x_t, a_t] - [x̂_t, â_t](μ_t),   log σ² = W f(μ_t);   ceilings by group of senses

leaves out a group that alone is over its ceiling, and yields where several are. Beside it, on the same episodes: a GRU
and an LSTM by backpropagation through time, the motor association that acts today, and a random forest for names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count, product
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.signal import lfilter
from scipy.stats import t as student
from sklearn.ensemble import RandomForestClassifier

from asm_gym.data.episode import Episode, load_episode
from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.statistics import auroc
from asm_gym.evaluation.tables import Table
from asm_gym.faults import Push
from asm_gym.faults.suite import possible
from asm_gym.memory.learning import Schedule
from asm_gym.memory.readout import KEPT, certainty, learn_readout
from asm_gym.memory.recall import follow, run_on
from asm_gym.memory.settling import learn_settling
from asm_gym.rollouts.run_folder import make_missing
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.expression import Backpropagated, read, trajectories
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.scripts.reproduce.recurrent import expected
from asm_gym.scripts.reproduce.workspace import (
    EVENT,
    FAULTS,
    HAND,
    LONGEST,
    SECOND,
    SEEN,
    SKILLS,
    SPEC,
    UNKNOWN,
    Associated,
    Demonstration,
    Floats,
    Recurrent,
    Settling,
    demonstrate,
    environment,
    express,
)
from asm_gym.wrappers import FaultInjection, NeuralASMSafety

OURS, CELLS, ACTS, FOREST = "settling", ("GRU", "LSTM"), "association", "random forest"
UNITS = {OURS: 320, "GRU": 164, "LSTM": 139}
"""All have about as many weights: 128,000."""
HOW = 64, 2e-3, 8, 1.0, 1.0, 0.0  # of ``Schedule``: chosen on the seeds 100 to 102
STEPS = 1, 20  # of inference a row, of which speed and accuracy are compared
ROWS = 2, 5, 10, 20, 40  # after which names are judged
HELD_OUT = 1000  # seeds of faulty episodes and of their twins begin here
RATE = 0.05  # healthy episodes over a ceiling, as far as so few can tell
WARM = 3  # rows that are not judged
STUCK, PUSHED, TWINS, ALARMS = "encoders stuck", "pushed", "twins", "share over a ceiling"
ALIKE = ("PickPlaceCan", "PickPlaceMilk")
TWO_FIT = (
    "objects hidden for a second: one of Can and Milk",
    "the right one",
    "rows until right, once seen",
)
CHANGED = ("another skill begins: right after a second", "rows until right")
SHORT = ("Lift", "Stack", "Can", "Milk", "Door", "Nut")
Note = Callable[[str, str, object, float], None]
"""Notes a measure of a model in a condition."""


@dataclass(frozen=True)
class Config(kit.Config):
    """The papers' network on the Panda: six skills."""

    seeds: int = option(10, quick=2, least=1)
    """Number of repetitions; they take the seeds that follow."""
    episodes: int = option(28, quick=4, least=4)
    """Episodes of each skill that are recorded; a seed learns from most of them."""
    epochs: int = option(40, quick=4, least=1)
    """Passes of the network over its episodes."""
    updates: int = option(1200, quick=20, least=1)
    """Batches of the recurrent networks."""
    faulty: int = option(2, quick=1, least=1)
    """Episodes of each skill with each kind of fault, and of each unknown skill."""
    trials: int = option(3, quick=1, least=1)
    """Times that each skill is expressed."""
    steps: int = option(LONGEST, quick=45, least=1)
    """Rows after which an expression is left."""
    film: bool = False
    """Also film the first seed: skills that change without notice, a push, and a sense that is lost."""


def one(
    seed: int, config: Config, files: dict[str, list[Path]]
) -> tuple[list[Record], dict[str, Floats]]:
    """Learn with one seed, and measure."""
    torch.set_num_threads(1)
    rng, records = np.random.default_rng(seed), list[Record]()
    parts: tuple[list[Episode], ...] = [], [], []
    for skill in SKILLS:
        own = [e for e in map(load_episode, files[skill]) if e.success]
        kept = max(1, len(own) // 8)
        for part, chosen in zip(
            parts, np.split(rng.permutation(len(own)), [-2 * kept, -kept]), strict=True
        ):
            part += [own[i] for i in chosen]
    train, held, tests = parts

    def note(measure: str, model: str, at: object, value: float) -> None:
        records.append(
            {"seed": seed, "measure": measure, "model": model, "at": str(at), "value": float(value)}
        )

    reader = StreamScaler.fit(SPEC, [e.stream for e in train])
    schedule = Schedule(config.epochs, *HOW)
    network: Any = learn_settling(
        trajectories(reader, train), UNITS[OURS], schedule, rng, lambda: None
    ).network
    ours = Settling(reader, network, train)
    highest = np.array([ours.felt(e.stream)[2][WARM:].max(axis=0) for e in held])  # (N, G)
    ours.ceilings = np.quantile(highest, 1.0 - RATE / highest.shape[1], axis=0)
    rivals = {
        cell: Backpropagated.learned(train, UNITS[cell], rng, config.updates, cell=cell, rate=1e-2)
        for cell in CELLS
    }
    predicted(note, ours, rivals, tests)
    named(note, ours, train, tests, rng)
    surprised(note, ours, tests, files)
    actors = {
        OURS: ours,
        **{c: Recurrent(m) for c, m in rivals.items()},
        ACTS: Associated(reader, train, rng),
    }
    if config.film and seed == config.seed:
        film(ours, config.out / "panda.gif", seed)
    return records, acted(note, actors, config, seed, rng)


def acted(
    note: Note, actors: dict[str, Any], config: Config, seed: int, rng: np.random.Generator
) -> dict[str, Floats]:
    """Measure the share solved in closed loop; return the largest energy of a group over time, of the first courses."""
    ours, drawn, act = actors[OURS], dict[str, Floats](), partial(express, steps=config.steps)
    for skill, trial in product(SKILLS, range(config.trials)):
        env, scene = environment(skill), 10_000 + 100 * seed + trial
        push = Push(newtons=20.0, direction=tuple(rng.standard_normal(3)), onset=EVENT, duration=10)
        pushed = FaultInjection(env, [push])
        before = environment(SKILLS[SKILLS.index(skill) - 1])
        courses = {name: act(model, env, scene) for name, model in actors.items()}
        courses |= {
            f"{OURS}, {event}{', reacts' * reacts}": act(
                ours, around, scene, event == STUCK, reacts
            )
            for (event, around), reacts in product(((STUCK, env), (PUSHED, pushed)), (False, True))
        }
        pushed.undo_faults()
        courses[f"{OURS}, guarded"] = act(ours, NeuralASMSafety(env), scene)
        express(ours, before, scene, steps=40)
        courses[f"{OURS}, after another"] = act(ours, env, scene, goes_on=True)
        for name, course in courses.items():
            note("solved", name, skill, course.solved)
            if len(course.energies) and name not in drawn:
                drawn[name] = course.energies.max(axis=1)
        stuck, thrust = (courses[f"{OURS}, {event}, reacts"] for event in (STUCK, PUSHED))
        note("reacted rightly", STUCK, skill, stuck.left_out == "joint")
        note("reacted rightly", PUSHED, skill, thrust.yielded and not thrust.left_out)
    return drawn


def film(ours: Settling, path: Path, seed: int) -> None:
    """Film the network: another skill begins without notice, the arm is pushed, and its encoders stick."""
    push = Push(newtons=20.0, direction=(0.0, 1.0, 0.0), onset=EVENT, duration=10)
    pictures: list[Image.Image] = []
    for skill, happens, anew, steps in (
        ("PickPlaceCan", "interrupted", True, 40),
        ("Lift", PUSHED, False, LONGEST),
        ("Door", STUCK, True, LONGEST),
    ):
        env, every = environment(skill), count()
        around = FaultInjection(env, [push] if happens == PUSHED else [])

        def watch(
            doing: str, env: Any = around, every: Any = every, what: str = f"{skill}, {happens}"
        ) -> None:
            if next(every) % 4 == 0:
                picture = Image.fromarray(env.render())
                text = ImageDraw.Draw(picture)
                text.multiline_text(
                    (6, 4), f"{what}\n{doing}", fill="white", stroke_width=1, stroke_fill="black"
                )
                pictures.append(picture)

        express(ours, around, 10_000 + 100 * seed, happens == STUCK, True, not anew, steps, watch)
        around.undo_faults()
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=100, loop=0)


def predicted(
    note: Note, ours: Settling, rivals: dict[str, Backpropagated], tests: Sequence[Episode]
) -> None:
    """Measure the error of the next row, in that of the last, and the hand a second from memory [cm].

    Every network expects each row, and the change of what moves slowly; the change is counted from the last row.
    """
    reader, network, X = ours.reader, ours.network, len(SPEC.sensory)
    at, gain = (
        np.searchsorted(SPEC.sensory, reader.slow),
        (reader.change / reader.spread)[reader.slow],
    )
    hand, scale = np.isin(reader.slow, np.arange(SPEC.size)[HAND]), reader.change[HAND]
    streams = np.stack(
        [e.stream[: EVENT + SECOND] for e in tests if len(e) >= EVENT + SECOND], axis=1
    )
    senses, commands = read(reader, streams.astype(np.float64))
    rest = network.at_rest(senses.shape[1])
    online = {
        f"{OURS}, {n}": follow(network.with_iterations(n), rest, senses, commands).senses
        for n in STEPS
    }
    alone = {
        OURS: run_on(
            network, follow(network, rest, senses[:EVENT], commands[:EVENT]).traces, SECOND
        ).senses
    }
    for cell, model in rivals.items():
        online[cell] = expected(model.network, senses, commands, len(senses))[0]
        alone[cell] = expected(model.network, senses, commands, EVENT)[0][EVENT:]
    alone["stands still"] = np.zeros_like(alone[OURS])
    still = np.mean((senses[2:, :, :X] - senses[1:-1, :, :X]) ** 2)
    for name, rows in online.items():
        told = rows[2:, :, :X].copy()
        told[:, :, at] = senses[1:-1, :, at] + gain * rows[2:, :, X:]
        note("next row", name, "error", np.mean((told - senses[2:, :, :X]) ** 2) / still)
    for name, rows in alone.items():
        path = streams[EVENT - 1, :, HAND] + np.cumsum(scale * rows[:, :, X:][:, :, hand], axis=0)
        note(
            "from memory",
            name,
            "cm",
            100 * np.linalg.norm(path - streams[EVENT:, :, HAND], axis=2).mean(),
        )


def hidden(stream: NDArray[Any], until: int | None) -> Floats:
    """Return a stream (T, D) in which no object is seen before row ``until``; None for never."""
    rows = np.array(stream, np.float64)
    rows[:until, SEEN] = np.nan
    return rows


def named(
    note: Note,
    ours: Settling,
    train: Sequence[Episode],
    tests: Sequence[Episode],
    rng: np.random.Generator,
) -> None:
    """Measure how soon the right skill is named: with all senses, blind, and after another skill."""

    def seen_by_forest(stream: Floats) -> Floats:
        """Return each row and its change over a quarter of a second; what is not seen is far off."""
        return np.nan_to_num(
            np.hstack([stream, stream - stream[np.maximum(np.arange(len(stream)) - 5, 0)]]),
            nan=-9.0,
        )

    both = [hidden(e.stream, until) for until in (0, None) for e in train]
    labels = np.concatenate(
        [np.full(len(e), SKILLS.index(str(e.info["skill"]))) for e in (*train, *train)]
    )
    states = np.concatenate([ours.felt(s)[0] for s in both]).astype(np.float32)
    weights = learn_readout(lambda chosen: states[chosen], labels, len(SKILLS), rng)
    forest = RandomForestClassifier(100, min_samples_leaf=3, random_state=int(rng.integers(2**31)))
    forest.fit(np.concatenate([seen_by_forest(s) for s in both])[::3], labels[::3])
    tellers: dict[str, Callable[[Floats], Floats]] = {
        OURS: lambda stream: np.asarray(
            certainty(ours.felt(stream)[0].astype(np.float32), *weights), np.float64
        ),
        FOREST: lambda stream: np.asarray(forest.predict_proba(seen_by_forest(stream))),
    }
    kinds = np.array([SKILLS.index(str(e.info["skill"])) for e in tests])
    others = [tests[rng.choice(np.flatnonzero(kinds != kind))] for kind in kinds]
    for (teller, likely), (e, other, kind) in product(
        tellers.items(), zip(tests, others, kinds, strict=True)
    ):
        joined = np.concatenate([other.stream[:40], e.stream[:60]])
        whole, blind, late, changed = (
            lfilter([1.0], [1.0, -float(KEPT)], np.log(likely(s) + 1e-3), axis=0).argmax(axis=1)
            for s in (
                hidden(e.stream, 0),
                hidden(e.stream, None),
                hidden(e.stream, SECOND),
                hidden(joined, 0),
            )
        )
        for row in ROWS:
            note("named", teller, row, whole[row - 1] == kind)
            note("named blind", teller, row, blind[row - 1] == kind)
        note("context", teller, CHANGED[0], changed[40 + SECOND - 1] == kind)
        note("context", teller, CHANGED[1], rows_until(changed[40:] == kind))
        if SKILLS[kind] in ALIKE:
            note("context", teller, TWO_FIT[0], SKILLS[late[SECOND - 1]] in ALIKE)
            note("context", teller, TWO_FIT[1], late[SECOND - 1] == kind)
            note("context", teller, TWO_FIT[2], rows_until(late[SECOND:] == kind))


def rows_until(right: NDArray[np.bool_]) -> int:
    """Return after how many rows it is right for good."""
    return 1 if right.all() else int(len(right) - np.argmin(right[::-1])) + 1


def surprised(
    note: Note, ours: Settling, tests: Sequence[Episode], files: dict[str, list[Path]]
) -> None:
    """Measure how well energy tells each kind of fault from its twins, and unknown skills from known ones."""

    def over(episodes: Sequence[Episode], rows: slice) -> Floats:
        """Return the largest energy of any group, in its ceiling (N,)."""
        return np.array([ours.felt(e.stream)[2][rows].max() for e in episodes])

    whole, around = slice(WARM, None), slice(EVENT, EVENT + SECOND)
    healthy, twins = over(tests, whole), over([load_episode(f) for f in files[TWINS]], around)
    note(ALARMS, OURS, "healthy", float(np.mean(healthy > 1.0)))
    for kind in (*FAULTS, *UNKNOWN):
        rows, compared = (around, twins) if kind in FAULTS else (whole, healthy)
        found = over([load_episode(f) for f in files[kind]], rows)
        note("AUROC", OURS, kind, auroc(found, compared))
        note(ALARMS, OURS, kind, float(np.mean(found > 1.0)))


# ------------------------------------------------------------------ all seeds


def claims(records: Sequence[Record]) -> Table:
    """Return what was measured of each claim, and the number that refutes it, which stood before the seeds were run."""

    def of(measure: str, model: str, **at: str) -> Any:
        return kit.by_seed(records, "value", measure=measure, model=model, **at)

    solved = partial(of, "solved")
    faults = kit.by_seed([r for r in records if r["at"] in FAULTS], "value", measure="AUROC")
    names, forest = (of("named", teller, at=str(SECOND)) for teller in (OURS, FOREST))
    further = of("from memory", OURS) / np.minimum(*(of("from memory", cell) for cell in CELLS))
    slow, quick = (of("next row", f"{OURS}, {steps}") for steps in (STEPS[-1], STEPS[0]))
    behind = solved(OURS) - np.maximum(*(solved(cell) for cell in CELLS))
    lines = (
        (
            "one network learns a repertoire by local rules",
            "error of the next row, in the last's",
            slow,
            1.0,
            True,
        ),
        (
            "it expresses skills as well as BPTT does",
            "share solved, less the better rival's",
            behind,
            -0.1,
            False,
        ),
        ("no skill is selected", "right names after a second", names, 0.8, False),
        ("", "the same, less a random forest's", names - forest, -0.1, False),
        (
            "predictive surprise across the repertoire",
            "AUROC of its own energy",
            faults,
            0.8,
            False,
        ),
        (
            "speed against accuracy",
            "error with 1 step of inference, less with 20",
            quick - slow,
            0.0,
            False,
        ),
        (
            "one energy for detection, reaction and expression",
            "share solved with stuck encoders: reacting, less not",
            solved(f"{OURS}, {STUCK}, reacts") - solved(f"{OURS}, {STUCK}"),
            0.0,
            False,
        ),
        (
            "comparable to recurrent networks",
            "off from memory, in the better rival's",
            further,
            1.25,
            True,
        ),
    )
    rows = []
    for claim, what, values, bound, above in lines:
        half = student.ppf(0.975, len(values) - 1) * values.sem() if len(values) > 1 else np.inf
        refuted = values.mean() >= bound if above else values.mean() <= bound
        limit = f"{bound:g} or {'more' if above else 'less'}"
        rows.append(
            (
                claim,
                what,
                f"{values.mean():.2f} ± {half:.2f}",
                limit,
                "refuted" if refuted else "holds",
            )
        )
    heads = ("claim", "measured", "found", "refuted if", "")
    return Table(
        f"The claims on the Panda: mean of {len(names)} seeds ± half of its 95 % interval",
        heads,
        rows,
    )


def tables(records: Sequence[Record]) -> list[Table]:
    """Return the claims, and a table of each measure by model and condition; mean ± SD over seeds."""
    made = [claims(records)]
    for measure in dict.fromkeys(r["measure"] for r in records):
        own = [r for r in records if r["measure"] == measure]
        rows, columns = (kit.by(key, dict.fromkeys(r[key] for r in own)) for key in ("model", "at"))
        made.append(kit.grid(measure, own, "value", rows, columns))
    return made


def drawn(records: Sequence[Record], energies: dict[str, Floats]) -> Figure:
    """Draw who solves what, how soon names are right, and the energy over time."""
    with figure(height=3.5, width=11) as fig:
        first, second, third = fig.subplots(1, 3)
        for n, model in enumerate((OURS, *CELLS, ACTS)):
            solved = [
                kit.over_seeds(records, "value", measure="solved", model=model, at=s).mean
                for s in SKILLS
            ]
            first.bar(
                np.arange(len(SKILLS)) + 0.2 * n - 0.3, solved, 0.2, color=look(n)[0], label=model
            )
        first.set_xticks(range(len(SKILLS)), SHORT, fontsize=7)
        told = product((OURS, FOREST), ("named", "named blind"))
        for n, (model, measure) in enumerate(told):
            right = [
                kit.over_seeds(records, "value", measure=measure, model=model, at=str(r)).mean
                for r in ROWS
            ]
            label = f"{model}{', blind' * (measure != 'named')}"
            second.plot(
                SPEC.dt * np.array(ROWS), right, color=look(n)[0], linestyle=look(n)[1], label=label
            )
        for n, name in enumerate((OURS, f"{OURS}, {PUSHED}", f"{OURS}, {STUCK}")):
            energy = energies[name]
            third.plot(
                SPEC.dt * np.arange(len(energy)),
                energy,
                color=look(n)[0],
                linestyle=look(n)[1],
                label=name,
            )
        third.axhline(1.0, color="#888888", linewidth=1)
        first.set(ylabel="share solved", ylim=(0, 1.02))
        second.set(xlabel="time [s]", ylabel="share of right names", ylim=(0, 1.02))
        third.set(xlabel="time [s]", ylabel="energy, in its ceiling", yscale="log")
        for ax in (first, second, third):
            ax.legend(fontsize=6, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    return fig


def run(config: Config) -> Findings:
    """Record the experts once, and run every seed."""
    folder = (config.out / "panda").resolve()
    asked = {s: [Demonstration(s, n) for n in range(config.episodes)] for s in SKILLS}
    asked |= {u: [Demonstration(u, n) for n in range(3 * config.faulty)] for u in UNKNOWN}
    asked[TWINS] = twins = [
        Demonstration(s, HELD_OUT + n) for s in SKILLS for n in range(config.faulty)
    ]
    asked |= {
        k: [
            d._replace(fault=k)
            for d in twins
            if possible(k, cast(Any, environment(d.skill)).unwrapped)
        ]
        for k in FAULTS
    }
    with kit.stage("recording experts") as tell:
        wanted = [d for own in asked.values() for d in own]
        make_missing(
            partial(demonstrate, folder=folder),
            wanted,
            lambda d: folder / d.name,
            config.workers,
            tell,
        )
    files = {name: [folder / d.name for d in own] for name, own in asked.items()}
    found = kit.each(
        "learning and acting", partial(one, config=config, files=files), config.repetitions, config
    )
    records = [record for own, _ in found for record in own]
    return Findings(records, tables(records), drawn(records, found[0][1]))
