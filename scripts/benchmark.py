"""Measure speeds as ratios against named rivals in the same run.

Machines differ and are noisy: rivals are called in turn, in random order, and the medians of their calls are compared.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.vector import SyncVectorEnv
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from threadpoolctl import threadpool_limits

from asm_gym.data.episode import Episode
from asm_gym.envs.backend import import_robosuite
from asm_gym.evaluation.statistics import Spread
from asm_gym.evaluation.tables import Table, markdown
from asm_gym.monitors import NeuralASM, make_monitor
from asm_gym.scripts.command import Options, option, run
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.stream_source import StreamSource
from asm_gym.tasks import env_id
from asm_gym.tasks import task as task_spec
from asm_gym.wrappers import NeuralASMSafety, VectorNeuralASMSafety
from asm_gym.wrappers.robots import body_memory

NAMES = "monitor", "safety", "env"
PARTS = 10  # parts of a measurement; a ratio's spread is that of the ratios of their medians
Rivals = dict[str, Callable[[], Any]]


@dataclass(frozen=True)
class Args(Options):
    """Speeds as ratios against rivals."""

    what: tuple[str, ...] = option(NAMES, least=1, known=NAMES, positional=True)
    """One call of observe(); the safety wrapper's share of a step; an environment's step against robosuite's."""
    task: str = option("Lift", check=env_id, metavar="TASK")
    """Task of the environments, with the Panda."""
    steps: int = option(400, quick=20, least=1)
    """Control steps of each rival; five times as many calls of observe()."""
    members: int = option(4, least=1)
    """Environments under one vector wrapper."""
    out: Path = option(Path("runs/benchmark"), metavar="FOLDER")
    """Folder of benchmark.md."""


def take_turns(rivals: Rivals, turns: int, seed: int, console: Console) -> dict[str, NDArray[np.float64]]:
    """Return the seconds of each rival's calls (turns,); the first call of each does not count."""
    for call in rivals.values():
        call()
    seconds: dict[str, list[float]] = {name: [] for name in rivals}
    order, rng = list(rivals), np.random.default_rng(seed)
    for _ in track(range(turns), "measuring", console=console, transient=True):
        rng.shuffle(order)  # the call before decides what the caches hold
        for name in order:
            start = time.perf_counter()
            rivals[name]()
            seconds[name].append(time.perf_counter() - start)
    return {name: np.array(times) for name, times in seconds.items()}


def ratio(seconds: NDArray[np.float64], others: NDArray[np.float64]) -> Spread:
    """Return how many times as long a call takes as another: mean and spread over parts of the measurement."""
    parts = min(PARTS, len(seconds))
    one, other = (np.array([np.median(p) for p in np.array_split(s, parts)]) for s in (seconds, others))
    return Spread.of((one / other).tolist())


def compared(caption: str, unit: str, seconds: dict[str, NDArray[np.float64]], rival: dict[str, str]) -> Table:
    """Return a row for each name: median and 99th percentile of its calls, and the ratio to its rival's."""
    scale = {"µs": 1e6, "ms": 1e3}[unit]
    rows = []
    for name, other in rival.items():
        median, slow = np.quantile(seconds[name], (0.5, 0.99)) * scale
        against = f"{ratio(seconds[name], seconds[other]).text(digits=2)}× {other}"
        rows.append((name, f"{median:.3g}", f"{slow:.3g}", against))
    return Table(caption, ("", unit, "p99", "against"), rows)


def measure_monitor(args: Args, console: Console) -> Table:
    """Compare one call of ``observe`` with that of a GRU under the same detection, on one thread."""
    senses = (Channel(f"sense_{k}", 12, noise=0.01, group=f"group_{k}") for k in range(5))
    spec, rng = StreamSpec((*senses, Channel("action", 7, group=MOTOR)), dt=0.05), np.random.default_rng(args.seed)
    learned = [Episode.from_stream(rng.normal(size=(60, spec.size)), spec) for _ in range(8)]
    memory = NeuralASM(spec, epochs=1).fit(learned)
    gru = make_monitor("gru+evidence", spec, hidden_size=256).fit(learned)

    def observing(monitor: Any, batch: int = 1) -> Callable[[], None]:
        state, rows = monitor.initial_state(batch), rng.normal(size=(64, batch, spec.size))

        def call() -> None:
            nonlocal state
            state, _ = monitor.observe(state, rows[rng.integers(64)])

        return call

    one, many, rival = "neural_asm, one stream", "neural_asm, each of 64 streams", "gru+evidence"
    rivals = {one: observing(memory), many: observing(memory, 64), rival: observing(gru)}
    with threadpool_limits(1):
        seconds = take_turns(rivals, 5 * args.steps, args.seed, console)
    seconds[many] /= 64
    return compared("observe(), 256 hidden units, 60 channels", "µs", seconds, dict.fromkeys(rivals, rival))


def _made(task: str, rate: int | None = None, **settings: Any) -> gym.Env[Any, Any]:
    return gym.make(env_id(task), horizon=10**9, stream_freq=rate, disable_env_checker=True, **settings)


def measure_safety(args: Args, console: Console) -> Table:
    """Compare a step under the wrapper with the same step without it, at 20 and 100 Hz and of several members."""
    envs: dict[str, Any] = {}
    memories: dict[str, NeuralASM] = {}
    for rate, name in ((None, "20 Hz"), (100, "100 Hz")):
        envs[name], inner = _made(args.task, rate), _made(args.task, rate)
        memories[name] = body_memory(inner, StreamSource(inner).spec).with_threshold(1e300)  # no step is overridden
        envs[f"{name}, guarded"] = NeuralASMSafety(inner, memories[name], monitor_freq=rate)
    name = f"{args.members} members"
    envs[name], within = (SyncVectorEnv([partial(_made, args.task)] * args.members) for _ in range(2))
    envs[f"{name}, guarded"] = VectorNeuralASMSafety(within, memories["20 Hz"])
    rivals: Rivals = {}
    for each, env in envs.items():
        env.reset(seed=args.seed)
        rivals[each] = partial(env.step, np.zeros(env.action_space.shape, np.float32))
    seconds = take_turns(rivals, args.steps, args.seed, console)
    for env in envs.values():
        env.close()
    unguarded = {each: each.removesuffix(", guarded") for each in envs}
    return compared(f"A control step of {args.task}, shipped memory", "ms", seconds, unguarded)


def measure_env(args: Args, console: Console) -> Table:
    """Compare a control step with robosuite's, and with its physics alone."""
    ours, bare, floor = _made(args.task), _made(args.task, stream=(), sensor_noise=0.0), _made(args.task)
    for env in (ours, bare, floor):
        env.reset(seed=args.seed)
    simulation: Any = floor.get_wrapper_attr("simulation")
    robosuite, robots = import_robosuite(), ["Panda"] * task_spec(args.task).arms
    control = [robosuite.load_composite_controller_config(robot=robot) for robot in robots]
    blind = dict.fromkeys(("has_renderer", "has_offscreen_renderer", "use_camera_obs"), False)
    theirs = robosuite.make(
        args.task, robots, controller_configs=control, reward_shaping=True, ignore_done=True, **blind
    )
    theirs.reset()
    rng = np.random.default_rng(args.seed)

    def drive(step: Callable[[Any], Any]) -> Callable[[], Any]:
        # Each action is held for a second, as a policy's are: noise alone would keep the arm in place.
        actions = rng.uniform(-0.3, 0.3, (2 + args.steps // 20, *(ours.action_space.shape or ())))
        turns = iter(np.repeat(actions, 20, axis=0).astype(np.float32))
        return lambda: step(next(turns))

    rivals: Rivals = {
        "asm_gym": drive(ours.unwrapped.step),
        "asm_gym, no stream": drive(bare.unwrapped.step),
        "robosuite": drive(theirs.step),
        "mj_step alone": partial(mujoco.mj_step, simulation.model, simulation.data, simulation.substeps),
    }
    seconds = take_turns(rivals, args.steps, args.seed, console)
    return compared(f"A control step of {args.task} at 20 Hz", "ms", seconds, dict.fromkeys(rivals, "robosuite"))


BENCHMARKS: dict[str, Callable[[Args, Console], Table]] = {
    "monitor": measure_monitor,
    "safety": measure_safety,
    "env": measure_env,
}


def measure(args: Args, console: Console) -> None:
    """Print a table for each benchmark and write them to a file."""
    args.out.mkdir(parents=True, exist_ok=True)
    texts = []
    for name in args.what:
        table = BENCHMARKS[name](args, console)
        machine = f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
        table = replace(table, caption=f"{table.caption}. {machine}; ±: spread over {PARTS} parts.")
        console.print(table)
        texts.append(markdown(table))
    file = args.out / "benchmark.md"
    file.write_text("\n\n".join(texts) + "\n", encoding="utf-8")
    console.print(f"Wrote {file}")


main = partial(run, "benchmark", Args, measure)

if __name__ == "__main__":
    raise SystemExit(main())
