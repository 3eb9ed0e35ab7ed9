"""The spinal reflex: how soon an arm feels what it should not, at which rate of false alarms, and what that is worth.

A band for each task, on a memory of the body whose own alarms are switched off, so that nothing else reacts. What is
felt is compared with a twin of the same seed in which nothing happens: they are the same to the last bit until the
first touch.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import tyro
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console

from asm_gym.envs.backend import PHYSICS_FREQ
from asm_gym.evaluation.scored import IDEAL, POLICY_ALONE
from asm_gym.evaluation.tables import Table
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.contact_band import ContactBand
from asm_gym.policies import rollout
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.staging import environment, policy_for, staged
from asm_gym.rollouts.substeps import band_of_task
from asm_gym.rollouts.trial import AFTER_S, PASSING, RolloutConfig, Trial
from asm_gym.scripts.command import at_least
from asm_gym.scripts.reproduce.common import Common, Findings, Record, reproduce
from asm_gym.tasks import env_id
from asm_gym.wrappers import NeuralASMSafety

KINDS = (PASSING, "collision")
SPINAL = "spinal"
SEVERITY = "medium"
OUT_OF_REACH = 1e12
"""A threshold of the memory's own that nothing exceeds."""

SOON_S = 0.01
"""What counts as soon [s]."""


@dataclass(frozen=True)
class Args(Common):
    """A push of 20 N for 0.3 s, and an obstacle in the way, on the tasks' scripted experts."""

    memory: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "panda"
    """A shipped memory, or the file of one, of the body that acts."""
    tasks: tuple[str, ...] = ("Lift", "Door")
    """Names of tasks; each has a band of its own."""
    fit_episodes: int = 100
    """Nominal episodes of each task that its band is fitted on."""
    calibration_episodes: int = 200
    """Nominal episodes of each task that its band is calibrated on."""
    rate: float = 0.01
    """Nominal episodes that may leave the band."""
    seeds: int = 1
    """How often it is done anew; each time a task has another band, and other episodes are pushed."""
    episodes: int = 30
    """Episodes of each kind and task."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(8, self, "fit_episodes")
        at_least(1, self, "episodes")


class Felt(NamedTuple):
    """What came of one episode."""

    felt: NDArray[np.float64]  # (T K, N) in every substep
    left_s: tuple[float, ...]  # when the band was left, since the episode began
    force: float  # the largest on the arm from outside, from the onset on [N]


def run(trial: Trial, config: RolloutConfig, memory: NeuralASM, band: ContactBand, onset: int) -> Felt:
    """Plays one trial under the band; ``"policy alone"`` and ``"ideal"`` are not touched by it."""
    felt: list[NDArray[np.float64]] = []
    left: list[float] = []
    forces: list[float] = []
    with staged(trial, config) as env:
        arm: Any = env.unwrapped
        act = "hold" if trial.acting == SPINAL else "monitor"
        guarded: Any = NeuralASMSafety(env, memory, on_alarm=act, band=band, on_overrun="ignore")

        def keep(info: dict[str, Any]) -> None:
            if not math.isnan(after := info["asm"]["severity"]["left_s"]):
                left.append(len(felt) * band.spec.dt + after)
            felt.append(arm.felt)
            if len(felt) > onset:
                forces.append(info["external_force"])

        rollout(guarded, policy_for(config.policy, guarded, trial.seed), trial.seed, keep, trial.steps_in(env))
    return Felt(np.concatenate(felt), tuple(left), max(forces, default=math.nan))


def measured(seed: int, task: str, kind: str, memory: NeuralASM, band: ContactBand) -> Record:
    """One episode of a kind, with its twin."""
    config, trial = RolloutConfig(), Trial(env_id(task), seed, kind, SEVERITY, acting=POLICY_ALONE, after_s=AFTER_S)
    onset = trial.begins(environment(trial.env_id, config.settings))
    quiet = run(Trial(trial.env_id, seed, onset=onset, after_s=AFTER_S), config, memory, band, onset)
    alone, spinal, ideal = (
        run(Trial(trial.env_id, seed, kind, SEVERITY, acting=who, after_s=AFTER_S), config, memory, band, onset)
        for who in (POLICY_ALONE, SPINAL, IDEAL)
    )
    length = min(len(quiet.felt), len(alone.felt))
    differs = np.flatnonzero((quiet.felt[:length] != alone.felt[:length]).any(axis=1))
    touched = float(differs[0]) / PHYSICS_FREQ if differs.size else None
    found = None if touched is None else next((s for s in alone.left_s if s > touched), None)
    late = None if found is None or touched is None else found - touched
    dt = band.spec.dt
    return {
        "task": task,
        "kind": kind,
        "seed": seed,
        "false_alarm": bool(quiet.left_s),
        "touched_s": touched,
        "latency_ms": None if late is None else 1e3 * late,
        # The same band, looked at when the step has ended.
        "at_control_rate_ms": None if found is None else 1e3 * (math.ceil(found / dt - 1e-9) * dt - (touched or 0.0)),
        **{f"force_{name}": f.force for name, f in (("alone", alone), ("spinal", spinal), ("ideal", ideal))},
    }


def study(args: Args, console: Console, seconds: dict[str, float]) -> Findings:
    """Bands from nominal episodes, then trials on seeds that no band has seen."""
    memory = NeuralASM.load(args.memory) if Path(args.memory).is_file() else NeuralASM.pretrained(args.memory)
    memory = memory.with_threshold(OUT_OF_REACH)
    fit, calibration, episodes, rate = args.fit_episodes, args.calibration_episodes, args.episodes, args.rate
    if args.quick:
        fit, calibration, episodes, rate = 8, 9, 2, 0.1
    records: list[Record] = []
    facts: dict[str, Any] = {}
    for task, again in product(args.tasks, args.repetitions):
        with stage(f"recording {task}", console, seconds):
            band = band_of_task(memory, task, RolloutConfig(), (fit, calibration), rate, again)
        if task not in facts:
            facts[task] = band.export(args.out / f"spinal_{task}.json")
        with stage(f"pushing {task}", console, seconds) as progress:
            for n, seed in enumerate(role_seeds(again, task, "spinal trials", episodes)):
                records += [measured(seed, task, kind, memory, band) for kind in KINDS]
                progress(n + 1, episodes)
    return Findings(records, [table(records, facts)], figure(records), facts)


def table(records: Sequence[Record], facts: dict[str, Any]) -> Table:
    """A row for each task and kind."""
    rows = []
    for task in facts:
        for kind in KINDS:
            mine = [r for r in records if (r["task"], r["kind"]) == (task, kind)]
            touched = [r for r in mine if r["touched_s"] is not None]
            late, slow = (
                np.array([math.inf if r[name] is None else r[name] for r in touched])
                for name in ("latency_ms", "at_control_rate_ms")
            )
            alone, spinal, ideal = (np.array([r[f"force_{w}"] for r in touched]) for w in ("alone", SPINAL, IDEAL))
            rows.append(
                (
                    task,
                    kind.replace("_", " "),
                    _count([r["false_alarm"] for r in mine]),
                    _count(np.isfinite(late)),
                    _count(late <= 1e3 * SOON_S),
                    _ms(late),
                    _ms(slow),
                    f"{np.median(alone):.0f}",
                    f"{np.median(spinal):.0f}",
                    f"{np.median(ideal):.0f}",
                )
            )
    promised = "; ".join(f"{t} {100 * f['promise']['rate']:.2g} %" for t, f in facts.items())
    return Table(
        f"The spinal reflex alone: nominal twins that leave the band (promised: {promised}), touches felt at all and "
        f"within {1e3 * SOON_S:g} ms of the first touch, median from the first touch over all touches [ms], beside the "
        "same band looked at once a control step, and the median of the largest force on the arm since the onset [N].",
        (
            "Task",
            "Fault",
            "False alarms",
            "Felt",
            f"Within {1e3 * SOON_S:g} ms",
            "Median [ms]",
            "At 20 Hz [ms]",
            "Force, alone [N]",
            "spinal",
            "ideal",
        ),
        rows,
    )


def _count(happened: Sequence[bool] | NDArray[np.bool_]) -> str:
    return f"{int(np.sum(happened))} of {len(happened)}"


def _ms(late: NDArray[np.float64]) -> str:
    """The median; a touch that was never felt is later than any."""
    middle = float(np.sort(late)[(len(late) - 1) // 2]) if late.size else math.nan
    return f"{middle:.0f}" if math.isfinite(middle) else "never"


def figure(records: Sequence[Record]) -> Figure:
    """Share of touches that are felt, by time since the first touch."""
    drawn = Figure(figsize=(6, 3), layout="constrained")
    axes: Any = drawn.add_subplot()
    for task, kind in dict.fromkeys((r["task"], r["kind"]) for r in records):
        mine = [r for r in records if (r["task"], r["kind"]) == (task, kind) and r["touched_s"] is not None]
        late = np.sort([r["latency_ms"] for r in mine if r["latency_ms"] is not None])
        axes.step(late, np.arange(1, len(late) + 1) / max(1, len(mine)), where="post", label=f"{task}, {kind}")
    axes.set(xscale="log", xlabel="since the first touch [ms]", ylabel="share felt", ylim=(0, 1))
    axes.legend(fontsize=8)
    return drawn


def main(argv: list[str] | None = None) -> int:
    """Runs the study, and returns the exit code."""
    return reproduce("spinal", study, Args, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
