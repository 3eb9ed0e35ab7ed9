"""Measure speeds as ratios against named rivals in the same run.

Machines differ and are noisy: rivals are called in turn, in random order, and the medians of their calls are compared.
"""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.vector import SyncVectorEnv
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from threadpoolctl import threadpool_limits

import asm_gym  # noqa: F401  (registers the environments)
from asm_gym.envs.backend import import_robosuite
from asm_gym.episode import Episode
from asm_gym.evaluation.statistics import Spread
from asm_gym.evaluation.tables import ConsoleTable, Table, markdown
from asm_gym.monitors import NeuralASM, make_monitor
from asm_gym.scripts.command import run
from asm_gym.scripts.options import check_options, option
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.stream_source import StreamSource
from asm_gym.tasks import env_id
from asm_gym.tasks import task as task_spec
from asm_gym.wrappers import NeuralASMSafety, VectorNeuralASMSafety
from asm_gym.wrappers.robots import body_memory

PARTS = 10
"""Parts of a measurement; a ratio's spread is that of the ratios of their medians."""
ACTIONS, STEPS = 7, 60
"""Motor channels and rows of a synthetic episode."""


@dataclass(frozen=True)
class Args:
    """Speeds as ratios against rivals."""

    what: tuple[str, ...] = option(("memory", "safety", "env"), least=1, known=lambda: BENCHMARKS, positional=True)
    """One call of observe(); the safety wrapper's share of a step; an environment's step against robosuite's."""
    task: str = option("Lift", check=env_id, metavar="TASK")
    """Task of the environments, with the Panda."""
    steps: int = option(400, quick=20, least=1)
    """Control steps of each rival; five times as many calls of observe()."""
    members: int = option(4, least=1)
    """Environments under one vector wrapper."""
    seed: int = option(0, least=0)
    """Seed of actions, streams and the order of calls."""
    out: Path = option(Path("runs/benchmark"), metavar="FOLDER")
    """Folder of benchmark.md."""
    quick: bool = False
    """Few calls: to see that everything runs, not to judge the figures."""

    def __post_init__(self) -> None:
        check_options(self)


class Turns(NamedTuple):
    """Seconds of each rival's calls (n,), in the order they were made."""

    seconds: dict[str, NDArray[np.float64]]

    def row(self, name: str, rival: str, unit: float) -> tuple[str, ...]:
        """Return a row of a table: median and 99th percentile in ``unit`` seconds, and the ratio to a rival."""
        median, slow = (float(np.quantile(self.seconds[name], q)) / unit for q in (0.5, 0.99))
        return name, f"{median:.3g}", f"{slow:.3g}", f"{self.ratio(name, rival).text(digits=2)}×"

    def ratio(self, name: str, rival: str) -> Spread:
        """Return how many times as long a call takes as a rival's: mean and spread over parts of the measurement."""
        parts = min(PARTS, len(self.seconds[name]))
        one, other = (np.array([np.median(p) for p in np.array_split(self.seconds[n], parts)]) for n in (name, rival))
        return Spread.of((one / other).tolist())


def take_turns(rivals: dict[str, Callable[[], Any]], turns: int, args: Args, console: Console) -> Turns:
    """Time the calls of each rival; the first call of each does not count."""
    for call in rivals.values():
        call()
    seconds: dict[str, list[float]] = {name: [] for name in rivals}
    order, rng = list(rivals), np.random.default_rng(args.seed)
    for _ in track(range(turns), "measuring", console=console, transient=True):
        rng.shuffle(order)  # the call before decides what the caches hold
        for name in order:
            start = time.perf_counter()
            rivals[name]()
            seconds[name].append(time.perf_counter() - start)
    return Turns({name: np.array(times) for name, times in seconds.items()})


# ------------------------------------------------------------------ one call of observe()


def synthetic(channels: int, episodes: int, skills: int = 1, seed: int = 0, dt: float = 0.05) -> list[Episode]:
    """Return smooth, noisy streams of ``channels`` sensory channels in five groups, and seven actions."""
    sizes = [len(part) for part in np.array_split(np.arange(channels), 5)]
    senses = (Channel(f"sense_{g}", n, noise=0.01, group=f"group_{g}") for g, n in enumerate(sizes))
    spec = StreamSpec((*senses, Channel("action", ACTIONS, group=MOTOR)), dt=dt)
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(skills, 12, channels))
    made = []
    for n in range(episodes):
        times = np.arange(STEPS)[:, None]
        sources = np.sin(times * rng.uniform(0.05, 0.3, 12) + rng.uniform(0, 6, 12))
        stream = sources @ mixing[n % skills] + 0.01 * rng.normal(size=(STEPS, channels))
        made.append(Episode.from_stream(np.hstack([stream, np.tanh(rng.normal(size=(STEPS, ACTIONS)))]), spec))
    return made


def observing(monitor: Any, episode: Episode, batch: int = 1) -> Callable[[], None]:
    """Return a call that observes the next row of an episode, in ``batch`` streams at once."""
    rows = [np.repeat(row[None].astype(np.float64), batch, axis=0) for row in episode.stream]
    state, n = monitor.initial_state(batch), 0

    def call() -> None:
        nonlocal state, n
        state, _ = monitor.observe(state, rows[n % len(rows)])
        n += 1

    return call


def measure_memory(args: Args, console: Console) -> Table:
    """Compare one call of ``observe`` with that of a GRU under the same detection, on one thread."""
    *learned, episode = synthetic(60, 9, seed=args.seed)
    memory = NeuralASM(episode.spec, epochs=1).fit(learned)
    gru = make_monitor("gru+evidence", episode.spec, hidden_size=256).fit(learned)
    rivals = {
        "neural_asm, one stream": observing(memory, episode),
        "neural_asm, each of 64 streams": observing(memory, episode, 64),
        "gru+evidence, one stream": observing(gru, episode),
    }
    with threadpool_limits(1):
        turns = take_turns(rivals, 5 * args.steps, args, console)
    turns.seconds["neural_asm, each of 64 streams"] /= 64
    rows = [turns.row(name, "gru+evidence, one stream", 1e-6) for name in rivals]
    return Table("observe(), 256 hidden units, 60 channels", ("", "µs", "p99", "against the GRU"), rows)


# ------------------------------------------------------------------ a control step under the wrapper


def _made(task: str, rate: int | None = None, **settings: Any) -> gym.Env[Any, Any]:
    return gym.make(env_id(task), horizon=10**9, stream_freq=rate, disable_env_checker=True, **settings)


def _memory(env: gym.Env[Any, Any]) -> NeuralASM:
    """Return the shipped memory, with a threshold out of reach: no step is overridden."""
    return body_memory(env, StreamSource(env).spec).with_threshold(1e300)


def measure_safety(args: Args, console: Console) -> Table:
    """Compare a step under the wrapper with the same step without it, at 20 and 100 Hz and of several members."""
    envs: dict[str, Any] = {}
    pairs: list[tuple[str, str]] = []
    for rate, name in ((None, "20 Hz"), (100, "100 Hz")):
        envs[name], inner = _made(args.task, rate), _made(args.task, rate)
        envs[f"{name}, guarded"] = NeuralASMSafety(inner, _memory(inner), monitor_freq=rate)
        pairs.append((name, f"{name}, guarded"))
    bare, within = (SyncVectorEnv([partial(_made, args.task)] * args.members) for _ in range(2))
    name = f"{args.members} members"
    envs |= {name: bare, f"{name}, guarded": VectorNeuralASMSafety(within, _memory(envs["20 Hz"]))}
    pairs.append((name, f"{name}, guarded"))
    rivals: dict[str, Callable[[], Any]] = {}
    for each, env in envs.items():
        env.reset(seed=args.seed)
        rivals[each] = partial(env.step, np.zeros(env.action_space.shape, np.float32))
    turns = take_turns(rivals, args.steps, args, console)
    rows = [turns.row(each, pair[0], 1e-3) for pair in pairs for each in pair]
    for env in envs.values():
        env.close()
    return Table(f"A control step of {args.task}, shipped memory", ("", "ms", "p99", "against unguarded"), rows)


# ------------------------------------------------------------------ an environment's step


def _robosuite(task: str) -> Any:
    """Return robosuite's own environment of a task."""
    robosuite = import_robosuite()
    arms = task_spec(task).arms
    env = robosuite.make(
        task,
        robots=["Panda"] * arms,
        controller_configs=[robosuite.load_composite_controller_config(robot="Panda")] * arms,
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        reward_shaping=True,
        ignore_done=True,
    )
    env.reset()
    return env


def measure_env(args: Args, console: Console) -> Table:
    """Compare a control step with robosuite's, and with its physics alone."""
    ours, bare, floor = _made(args.task), _made(args.task, stream=(), sensor_noise=0.0), _made(args.task)
    for env in (ours, bare, floor):
        env.reset(seed=args.seed)
    simulation: Any = floor.get_wrapper_attr("simulation")
    rng = np.random.default_rng(args.seed)

    def drive(step: Callable[[Any], Any], size: int) -> Callable[[], Any]:
        # Each action is held for a second, as a policy's are: noise alone would keep the arm in place.
        actions = np.repeat(rng.uniform(-0.3, 0.3, (2 + args.steps // 20, size)), 20, axis=0).astype(np.float32)
        turns = iter(actions)
        return lambda: step(next(turns))

    (size,) = ours.action_space.shape or (0,)
    rivals: dict[str, Callable[[], Any]] = {
        "asm_gym": drive(ours.unwrapped.step, size),
        "asm_gym, no stream": drive(bare.unwrapped.step, size),
        "robosuite": drive(_robosuite(args.task).step, size),
        "mj_step alone": partial(mujoco.mj_step, simulation.model, simulation.data, simulation.substeps),
    }
    turns = take_turns(rivals, args.steps, args, console)
    rows = [turns.row(name, "robosuite", 1e-3) for name in rivals]
    return Table(f"A control step of {args.task} at 20 Hz", ("", "ms", "p99", "against robosuite"), rows)


BENCHMARKS: dict[str, Callable[[Args, Console], Table]] = {
    "memory": measure_memory,
    "safety": measure_safety,
    "env": measure_env,
}


def machine(share: float) -> str:
    """Return the processor's name, and the share of one core that this process had while it measured."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    name = names[0] if names else platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores; this process had {share:.1f} of one. ±: spread over {PARTS} parts."


def measure(args: Args, console: Console) -> None:
    """Print a table for each benchmark and write them to a file."""
    args.out.mkdir(parents=True, exist_ok=True)
    texts = []
    for name in args.what:
        wall, own = time.perf_counter(), time.process_time()
        table = BENCHMARKS[name](args, console)
        share = (time.process_time() - own) / (time.perf_counter() - wall)
        table = replace(table, caption=f"{table.caption}. {machine(share)}")
        console.print(ConsoleTable(table))
        texts.append(markdown(table))
    file = args.out / "benchmark.md"
    file.write_text("\n\n".join(texts) + "\n", encoding="utf-8")
    console.print(f"Wrote {file}")


def main(argv: list[str] | None = None) -> int:
    """Run benchmarks and return the exit code."""
    return run("benchmark", Args, measure, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
