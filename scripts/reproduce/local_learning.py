"""Local learning: the Hebbian changes against the exact gradient of backpropagation through time, and what each costs.

A memory learns letters by its local rules. On the way, with the weights held still, the local change summed along a
batch is compared with three gradients of the same network: of the energy, of the error of predicting the next row, and
of the error of running on alone after a cue, in which each prediction leads to the next. An angle below 90° lowers what
the gradient descends. Then the same network learns from the same letters by either, and the time and the memory of a
change are measured, by length of the episode.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice

import numpy as np
import torch
from matplotlib.figure import Figure

from asm_gym.evaluation.figures import figure
from asm_gym.evaluation.tables import Table
from asm_gym.memory.inference import Weights
from asm_gym.memory.learning import Batch, Learner, Schedule, Trajectory, batches, cosine_decay, side_by_side
from asm_gym.memory.network import initial_weights
from asm_gym.memory.scheduled_sampling import ScheduledSampling, one_after_another
from asm_gym.memory.traces import fit_gains
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.options import fixed, option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.curves import curve, curves
from asm_gym.scripts.reproduce.expression import trajectories
from asm_gym.scripts.reproduce.gradients import COMPARED, CUE, Changes, cosine, exact, local
from asm_gym.scripts.reproduce.handwriting import check_letters, copybook, repertoire
from asm_gym.scripts.reproduce.kit import Findings, Record, over_seeds
from asm_gym.scripts.reproduce.recordings import wide_enough
from asm_gym.validation import check_number

TARGETS = {
    "energy": "gradient of the energy",
    "error": "gradient of the prediction error",
    "alone": f"gradient of the error alone, after a cue of {CUE}",
}
RATES = {"local": 3e-3, "backpropagation": 1e-2}
"""Of a change per step, and of one per batch."""
PRIOR_PRECISION = 30.0
"""Π_z."""


@dataclass(frozen=True)
class Config(kit.Config):
    """Angles between local changes and exact gradients."""

    skills: int = option(8, quick=2, check=check_letters)
    """Letters."""
    hidden: int = option(64, quick=16, check=partial(wide_enough, channels=4))
    """Hidden units."""
    writings: int = option(8, quick=4, least=1)
    """Writings of each letter."""
    epochs: int = option(40, quick=3, least=1)
    """Passes over them."""
    iterations: tuple[int, ...] = option(
        (1, 5, 20, 60), quick=(1, 5), least=1, check=partial(check_number, "iterations", low=1, whole=True)
    )
    """Steps of inference at which angles are measured; the memory learns with 5."""
    lengths: tuple[int, ...] = fixed((30, 60, 120), quick=(30, 60))
    """Steps of the episodes along which the costs of a change are measured."""


def usual(config: Config) -> int:
    """Steps of inference at which angles are followed over learning."""
    return 5 if 5 in config.iterations else max(config.iterations)


def checkpoints(epochs: int) -> list[int]:
    """Epochs before which angles are measured: dense at first."""
    return sorted({0, *(round(epochs ** (k / 6)) for k in range(7)), epochs})


def one_seed(seed: int, config: Config) -> list[Record]:
    """Angles over learning, and the error that either way of learning reaches."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(seed)
    letters = repertoire(config.skills, 2, rng)
    train, tests = copybook(letters, config.writings, 2, rng), copybook(letters, 2, 2, rng)
    reader = StreamScaler.fit(train[0].spec, [e.stream for e in train])
    learned, judged = trajectories(reader, train), side_by_side(trajectories(reader, tests))
    weights = initial_weights(config.hidden, reader.size, 2, rng)
    weights.gains[:] = fit_gains([np.hstack([t.senses, t.commands]) for t in learned])
    probe, start = side_by_side(learned[:: max(1, len(learned) // 16)]), Weights(*(w.copy() for w in weights))
    records: list[Record] = []
    measured = checkpoints(config.epochs)
    learner = Learner(weights, Schedule(config.epochs, 16, RATES["local"], 5, PRIOR_PRECISION, 1.0, 0.0), rng)
    streams, moments = ScheduledSampling(learner, 16), one_after_another(learned, 16, rng)
    steps = -(-sum(len(t.senses) for t in learned) // 16)
    for epoch in range(config.epochs + 1):
        if epoch in measured:
            last = epoch == config.epochs
            records += angles(weights, probe, config.iterations if last else (usual(config),), seed, epoch)
            records.append(_reached("local", weights, judged, seed, epoch))
        if epoch < config.epochs:
            streams.run(islice(moments, steps), cosine_decay(RATES["local"], epoch / config.epochs), 0.0)
    return records + backpropagated(start, learned, judged, config, seed)


def angles(weights: Weights, probe: Batch, iterations: Sequence[int], seed: int, epoch: int) -> list[Record]:
    """Cosines between the local change and each gradient, of all synapses and of each array."""
    records = []
    for count in iterations:
        read, alone = (local(weights, probe, count, PRIOR_PRECISION, alone) for alone in (False, True))
        for target, theirs in exact(weights, probe, count, PRIOR_PRECISION).items():
            ours = alone if target == "alone" else read
            where = {"seed": seed, "epoch": epoch, "iterations": count, "target": target}
            for name in (*COMPARED, "all"):
                value = min(1.0, cosine(ours, theirs, COMPARED if name == "all" else (name,)))
                records.append({**where, "array": name, "cosine": value, "degrees": math.degrees(math.acos(value))})
    return records


def backpropagated(
    weights: Weights, learned: Sequence[Trajectory], judged: Batch, config: Config, seed: int
) -> list[Record]:
    """The same network, from the same weights, by Adam on the exact gradient of the prediction error."""
    rng, records = np.random.default_rng(seed), []
    W = {name: torch.from_numpy(getattr(weights, name)) for name in COMPARED}  # shares memory with the weights
    adam = torch.optim.Adam(W.values(), RATES["backpropagation"])
    for epoch in range(config.epochs + 1):
        if epoch in checkpoints(config.epochs):
            records.append(_reached("backpropagation", weights, judged, seed, epoch))
        for group in adam.param_groups:
            group["lr"] = cosine_decay(RATES["backpropagation"], epoch / config.epochs)
        for batch in batches(learned, 16, rng) if epoch < config.epochs else ():
            gradient = exact(weights, batch, 5, PRIOR_PRECISION, ("error",))["error"].arrays
            for name, w in W.items():
                w.grad = torch.from_numpy(-gradient[name].astype(np.float32))
            adam.step()
    return records


def _reached(how: str, weights: Weights, judged: Batch, seed: int, epoch: int) -> Record:
    """Mean squared error of a predicted number [variance of the stream]; inference as in learning."""
    error = local(weights, judged, 5, PRIOR_PRECISION).error
    numbers = judged.senses[:, 0].size + judged.commands[:, 0, :-1].size
    return {"seed": seed, "epoch": epoch, "learned_by": how, "mse": 2 * error / numbers}


def costs(config: Config) -> list[Record]:
    """Time and memory of one change, by length of the episode."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(config.seed)
    weights, records = initial_weights(config.hidden, 4, 2, rng), []
    for length in config.lengths:
        senses = rng.normal(size=(length, 16, 4)).astype(np.float32)
        commands = rng.normal(size=(length, 16, 3)).astype(np.float32)
        batch = Batch(senses, commands, np.full(length, 16))
        ways: dict[str, Callable[[], Changes]] = {
            "local": partial(local, weights, batch, 5, PRIOR_PRECISION),
            "backpropagation": partial(_exact_error, weights, batch),
        }
        for how, change in ways.items():
            saved, taken = change().saved, []
            for _ in range(3):
                since = time.perf_counter()
                change()
                taken.append(time.perf_counter() - since)
            records.append(
                {"seed": config.seed, "cost_of": how, "steps": length, "ms": 1e3 * min(taken), "bytes": saved}
            )
    return records


def _exact_error(weights: Weights, batch: Batch) -> Changes:
    return exact(weights, batch, 5, PRIOR_PRECISION, ("error",))["error"]


def tables(records: Sequence[Record], config: Config) -> list[Table]:
    """Angles over learning, by array, by iterations; errors; costs."""
    epochs = checkpoints(config.epochs)

    epochs_of = kit.by("epoch", epochs)
    usually: Record = {"array": "all", "iterations": usual(config)}
    targets = {label: {"target": t} for t, label in TARGETS.items()}
    angles_of = partial(kit.grid, records=records, value="degrees", digits=0)
    caption = (
        f"Angle [°] between the local change and the exact one, before so many epochs, {usual(config)} iterations; "
        "mean ± SD over seeds"
    )
    return [
        angles_of(caption, rows=targets, columns=epochs_of, **usually),
        angles_of(
            "Of each array, to the gradient of the prediction error",
            rows=kit.by("array", COMPARED),
            columns=epochs_of,
            target="error",
            iterations=usual(config),
        ),
        angles_of(
            "By iterations, after learning",
            rows=targets,
            columns=kit.by("iterations", config.iterations),
            array="all",
            epoch=config.epochs,
        ),
        kit.grid(
            "Mean squared error of the next row [variance], before so many epochs",
            records,
            "mse",
            kit.by("learned_by", RATES),
            epochs_of,
            3,
        ),
        Table(
            "A change along a batch of 16: time [ms] / kept for the way back [KiB], by steps",
            ("", *(str(r["steps"]) for r in records if r.get("cost_of") == "local")),
            [
                (how, *(f"{r['ms']:.1f} / {r['bytes'] / 1024:.0f}" for r in records if r.get("cost_of") == how))
                for how in RATES
            ],
        ),
    ]


def drawn(records: Sequence[Record], config: Config) -> Figure:
    """Angles, errors, costs."""
    epochs = checkpoints(config.epochs)
    where = {"array": "all", "iterations": usual(config)}
    with figure(height=3.3, width=11) as fig:
        axes = fig.subplots(1, 4)
        targets = {label: {"target": t} for t, label in TARGETS.items()}
        curves(axes[0], records, "degrees", ("epoch", epochs), targets, **where)
        curves(
            axes[1], records, "degrees", ("iterations", config.iterations), targets, array="all", epoch=config.epochs
        )
        for i, how in enumerate(RATES, len(TARGETS)):
            curve(axes[2], epochs, [over_seeds(records, "mse", learned_by=how, epoch=e) for e in epochs], i, how)
            own = [r for r in records if r.get("cost_of") == how]
            curve(axes[3], [r["steps"] for r in own], [(r["bytes"] / 1024, 0.0) for r in own], i, how)
        axes[0].set(xlabel="epochs", ylabel="angle to the local change [°]", ylim=(0, 95), xscale="symlog")
        axes[1].set(xlabel="iterations of inference", ylim=(0, 95), xscale="log")
        axes[2].set(xlabel="epochs", ylabel="error of the next row [variance]", yscale="log", xscale="symlog")
        axes[3].set(xlabel="steps of the episode", ylabel="kept for the way back [KiB]", yscale="log")
        for ax in axes[:2]:
            ax.axhline(90, color="#999999", linewidth=1)
        for ax in (axes[0], axes[2]):
            ax.set_xlim(0, 1.2 * config.epochs)
        ways = [ax.get_legend_handles_labels() for ax in (axes[0], axes[2])]
        handles, labels = ([*first, *second] for first, second in zip(*ways, strict=True))
        fig.legend(handles, labels, loc="outside upper center", ncols=5, fontsize=8)
    return fig


def run(config: Config) -> Findings:
    """Every seed, then the costs."""
    found = kit.each("learning both ways", partial(one_seed, config=config), config.repetitions, config)
    with kit.stage("measuring costs"):
        records = kit.together(found) + costs(config)
    return Findings(records, tables(records, config), drawn(records, config), {"rates": RATES})
