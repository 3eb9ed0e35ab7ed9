"""Completion of senses that have failed: how near to what they would have said, against simpler ways.

Healthy episodes of an evaluation are replayed with senses missing from a third of their length on; whoever completes
them is told which. The truth is what was recorded.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console

from asm_gym.episode import Episode, load_episode
from asm_gym.evaluation.tables import Table
from asm_gym.memory.completion import Completion
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import files_in
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.reproduce.common import Common, Findings, Record, reproduce, shown

Floats = NDArray[np.float64]
Complete = Callable[[Floats, NDArray[np.bool_], int], Floats]
"""(T, M) what the missing columns (D,) of an episode (T, D) should say from a row on, at which all is still well."""

LOST: dict[str, tuple[str, ...]] = {
    "one encoder": ("encoder[3]",),
    "three encoders": ("encoder[1]", "encoder[3]", "encoder[5]"),
    "all encoders": tuple(f"encoder[{j}]" for j in range(7)),
    "the wrist": ("wrist",),
    "the hand's position": tuple(f"hand_position[{i}]" for i in range(3)),
}
"""What is missing, by the names of sensors."""

HIDDEN, BOTTLENECK, EPOCHS, RATE, SETTLED = 128, 24, 30, 1e-3, 20
"""Of the autoassociative network; it settles on what is missing in so many rounds."""

NETWORK = "autoassociative network"

TRAINED_ON = 1e-3
"""Ridge of the Kalman filter's model, and variance of what it reads; of standardised numbers."""


@dataclass(frozen=True)
class Args(Common):
    """Root mean square error of what is completed, by what is missing and by who completes it."""

    run: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/evaluate")
    """Folder of an evaluation, whose nominal episodes are learned from and replayed."""
    tasks: tuple[str, ...] = ("Lift", "Stack", "PickPlaceCan", "Door")
    """Names of tasks; the evaluation must have recorded them."""


def by_memory(completion: Completion) -> Complete:
    """All other senses, the command and what went before."""

    def complete(stream: Floats, missing: NDArray[np.bool_], onset: int) -> Floats:
        return completion.complete(completion.filling(missing), completion.lift(stream))

    return complete


def by_last_value(stream: Floats, missing: NDArray[np.bool_], onset: int) -> Floats:
    """What was sensed last."""
    return np.repeat(stream[onset - 1 : onset, missing], len(stream), axis=0)


def by_kalman(senses: StreamScaler, streams: Sequence[Floats]) -> Complete:
    """x_t = A x_{t-1} + B u_t + w, learned by ridge regression; what is missing is not observed."""
    sensory, motor = senses.spec.sensory, senses.spec.motor
    scaled = [(s - senses.mean) / senses.spread for s in streams]
    before = np.concatenate([np.hstack([s[:-1, sensory], s[1:, motor]]) for s in scaled])
    after = np.concatenate([s[1:, sensory] for s in scaled])
    model = np.linalg.solve(before.T @ before + TRAINED_ON * len(before) * np.eye(before.shape[1]), before.T @ after).T
    A, B, S = model[:, : len(sensory)], model[:, len(sensory) :], len(sensory)
    Q = np.cov((after - before @ model.T).T)

    def complete(stream: Floats, missing: NDArray[np.bool_], onset: int) -> Floats:
        x, gone = (stream - senses.mean) / senses.spread, missing[sensory]
        C = np.eye(S)[~gone]
        state, P, out = x[onset - 1, sensory], TRAINED_ON * np.eye(S), np.zeros((len(stream), int(gone.sum())))
        for t in range(onset, len(stream)):
            state, P = A @ state + B @ x[t, motor], A @ P @ A.T + Q
            K = np.linalg.solve(P[np.ix_(~gone, ~gone)] + TRAINED_ON * np.eye(len(C)), P[~gone]).T
            state, P = state + K @ (x[t, sensory][~gone] - state[~gone]), P - K @ P[~gone]
            out[t] = state[gone]
        columns = sensory[gone]
        return np.asarray(senses.mean[columns] + senses.spread[columns] * out)

    return complete


def by_autoassociation(senses: StreamScaler, streams: Sequence[Floats], seed: int, epochs: int) -> Complete:
    """A network with a bottleneck that reproduces a row, and settles on what is missing (Kramer 1992)."""
    import torch

    torch.manual_seed(seed)
    rows = torch.tensor(np.concatenate([(s - senses.mean) / senses.spread for s in streams]), dtype=torch.float32)
    D = rows.shape[1]
    sizes = D, HIDDEN, BOTTLENECK, HIDDEN
    layers = [m for a, b in pairwise(sizes) for m in (torch.nn.Linear(a, b), torch.nn.Tanh())]
    net = torch.nn.Sequential(*layers, torch.nn.Linear(HIDDEN, D))
    optimiser = torch.optim.Adam(net.parameters(), RATE)
    for _ in range(epochs):
        for batch in torch.split(torch.randperm(len(rows)), 256):
            x = rows[batch]
            # Rows of which some senses are another's, so that it learns to do without them.
            lost = torch.rand_like(x) < 0.1
            broken = torch.where(lost, x[torch.randperm(len(x))], x)
            loss = torch.mean((net(broken) - x) ** 2)
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()

    def complete(stream: Floats, missing: NDArray[np.bool_], onset: int) -> Floats:
        x = torch.tensor((stream - senses.mean) / senses.spread, dtype=torch.float32)
        gone = torch.tensor(missing)
        x[onset:, gone] = x[onset - 1, gone]
        with torch.no_grad():
            for _ in range(SETTLED):
                x[:, gone] = net(x)[:, gone]
        return np.asarray(senses.mean[missing] + senses.spread[missing] * x[:, gone].numpy().astype(np.float64))

    return complete


def measured(
    ways: Mapping[str, Complete], completion: Completion, episodes: Sequence[Episode], seed: int
) -> list[Record]:
    """One record for each way, what is missing, and episode."""
    spec, found = completion.spec, []
    for lost, names in LOST.items():
        missing = np.zeros(spec.size, bool)
        for name, columns in completion.sensors:
            missing[columns] |= name in names
        # Of a sensor's numbers the first channel is what it is named after: positions, not velocities as well.
        judged = np.flatnonzero(missing)
        first = spec.labels[judged[0]].split("[")[0]
        own = np.array([spec.labels[c].split("[")[0] == first for c in judged])
        for number, episode in enumerate(episodes):
            stream, onset = episode.stream.astype(np.float64), len(episode) // 3
            errors = {}
            for name, complete in ways.items():
                off = complete(stream, missing, onset)[onset:, own] - stream[onset:, judged[own]]
                errors[name] = np.sqrt(np.mean(off**2, axis=1))  # (T,)
            for name, error in errors.items():
                worse = _worse_from(error, errors["last value"]) if name != "last value" else None
                record = {"seed": seed, "lost": lost, "way": name, "episode": number, "unit": spec.channels[0].unit}
                found.append({**record, "rmse": float(np.sqrt(np.mean(error**2))), "worse_from": worse})
    return found


def _worse_from(error: Floats, rival: Floats) -> int | None:
    """From which row on the squared error so far is above the rival's for good; None where it is not in the end."""
    above = np.cumsum(error**2) > np.cumsum(rival**2)
    return None if not above[-1] else int(len(above) - np.argmin(above[::-1])) if not above.all() else 0


def study(args: Args, console: Console, seconds: dict[str, float]) -> Findings:
    """Learns every way from the same episodes, and lets each complete the same senses."""

    def role(name: str) -> list[Episode]:
        return [e for e in map(load_episode, files_in(args.run, args.tasks, name)) if e.success]

    fit, fresh = role("fit"), role("nominal")
    if not fit or not fresh:
        raise ValueError(f"{args.run} has no recordings of {', '.join(args.tasks)}: run asm-gym evaluate first")
    fresh = fresh[:: max(1, len(fresh) // 4)] if args.quick else fresh
    streams = [e.stream.astype(np.float64) for e in fit]
    senses = StreamScaler.fit(fit[0].spec, [e.stream for e in fit])
    completion = Completion.fit(senses, streams)
    assert completion is not None
    records: list[Record] = []
    with stage("completing", console, seconds):
        fixed = {"memory": by_memory(completion), "last value": by_last_value, "kalman": by_kalman(senses, streams)}
        records += measured(fixed, completion, fresh, args.seed)
        for seed in args.repetitions:  # of the network alone: nothing is drawn for the others
            network = by_autoassociation(senses, streams, seed, 2 if args.quick else EPOCHS)
            both = measured({"last value": by_last_value, NETWORK: network}, completion, fresh, seed)
            records += [r for r in both if r["way"] == NETWORK]
    return Findings(records, [table(records, len(fit), len(fresh))], figure(records), {})


def table(records: Sequence[Record], learned: int, replayed: int) -> Table:
    """A row for each thing that is missing and each way to complete it."""
    rows = []
    for lost in LOST:
        for way in dict.fromkeys(r["way"] for r in records):
            mine = [r for r in records if (r["lost"], r["way"]) == (lost, way)]
            worse = sum(r["worse_from"] is not None for r in mine)
            rows.append((lost, way, shown(records, "rmse", 4, lost=lost, way=way), f"{worse} of {len(mine)}"))
    return Table(
        "Senses missing from a third of an episode to its end: root mean square error of what completes them [rad, N, "
        "m], of the network mean and standard deviation over seeds; episodes in which the last value would have done "
        f"better. Learned from {learned} healthy episodes, replayed on {replayed} others.",
        ("Missing", "Completed by", "Error", "Worse than the last value"),
        rows,
    )


def figure(records: Sequence[Record]) -> Figure:
    """Bars of the errors, on a logarithmic scale, relative to the last value."""
    drawn = Figure(figsize=(7, 3), layout="constrained")
    axes: Any = drawn.add_subplot()
    ways = list(dict.fromkeys(r["way"] for r in records))
    for k, way in enumerate(ways):
        means = [np.mean([r["rmse"] for r in records if (r["lost"], r["way"]) == (lost, way)]) for lost in LOST]
        last = [np.mean([r["rmse"] for r in records if (r["lost"], r["way"]) == (lost, "last value")]) for lost in LOST]
        axes.bar(np.arange(len(LOST)) + 0.2 * (k - 1.5), np.divide(means, last), 0.2, label=way)
    axes.set(yscale="log", ylabel="error / that of the last value")
    axes.set_xticks(np.arange(len(LOST)), LOST)
    axes.legend(fontsize=8)
    return drawn


def main(argv: list[str] | None = None) -> int:
    """Runs the study, and returns the exit code."""
    return reproduce("completion", study, Args, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
