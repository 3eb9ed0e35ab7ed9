"""Measure speeds as ratios against named rivals in the same run.

Machines differ and are noisy: rivals are called in turn, in random order, and the medians of their calls are compared.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, repeat
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from mujoco.rollout import Rollout
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from threadpoolctl import threadpool_limits

from asm_gym.data.episode import Episode
from asm_gym.envs.robosuite_backend import import_robosuite
from asm_gym.envs.vector import ThreadedVectorEnv, cores
from asm_gym.evaluation.statistics import Spread
from asm_gym.evaluation.tables import Table, markdown
from asm_gym.files import write_text
from asm_gym.monitors import NeuralASM, make_monitor
from asm_gym.scripts.command import Options, option, run
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.stream_source import StreamSource
from asm_gym.stream_view import StreamView
from asm_gym.tasks import env_id
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_number
from asm_gym.wrappers import NeuralASMSafety, VectorNeuralASMSafety
from asm_gym.wrappers.guarding import body_memory

BENCHMARK_NAMES = ("monitor", "safety", "env")
SECOND = 20  # control steps of a second
NEVER = 1e300  # threshold at which no step is overridden
PARTS = 10  # parts of a measurement; a ratio's spread is that of the ratios of their medians
Rivals = dict[str, Callable[[], Any]]


@dataclass(frozen=True)
class Args(Options):
    """Options of a benchmark."""

    what: tuple[str, ...] = option(BENCHMARK_NAMES, least=1, known=BENCHMARK_NAMES, positional=True)
    """monitor: a call of observe(); safety: steps with and without the guard; env: against MuJoCo and robosuite."""
    task: str = option("Lift", check=env_id, metavar="TASK")
    """Task of the environments, with the Panda."""
    steps: int = option(400, quick=20, least=1)
    """Control steps of each rival; five times as many calls of observe()."""
    members: tuple[int, ...] = option(
        (1, 2, 4, 16), quick=(1, 2), least=1, check=partial(check_number, "members", low=1)
    )
    """Numbers of environments in a vector, which runs one thread on each core."""
    out: Path = option(Path("runs/benchmark"), metavar="FOLDER")
    """Folder of benchmark.md."""


def take_turns(
    rivals: Rivals, turns: int, seed: int, console: Console
) -> dict[str, NDArray[np.float64]]:
    """Return the seconds of each rival's calls (turns,); the first call of each does not count."""
    for call in rivals.values():
        call()
    seconds: dict[str, list[float]] = {name: [] for name in rivals}
    order = list(rivals)
    rng = np.random.default_rng(seed)
    for _ in track(range(turns), "measuring", console=console, transient=True):
        rng.shuffle(order)  # the call before decides what the caches hold
        for name in order:
            start = time.perf_counter()
            rivals[name]()
            seconds[name].append(time.perf_counter() - start)
    return {name: np.array(times) for name, times in seconds.items()}


def ratio(seconds: NDArray[np.float64], others: NDArray[np.float64]) -> Spread:
    """Return how many times as long a call takes as another: mean and spread over parts of the measurement."""
    count = min(PARTS, len(seconds))
    parts = np.array_split(seconds, count)
    other_parts = np.array_split(others, count)
    ratios = []
    for part, other_part in zip(parts, other_parts, strict=True):
        ratios.append(np.median(part) / np.median(other_part))
    return Spread.of(ratios)


def measure_monitor(args: Args, console: Console) -> Table:
    """Compare one call of ``observe`` with that of a GRU under the same detection, on one thread."""
    rng = np.random.default_rng(args.seed)
    senses = [Channel(f"sense_{k}", 12, noise=0.01, group=f"group_{k}") for k in range(5)]
    spec = StreamSpec((*senses, Channel("action", 7, group=MOTOR)), dt=0.05)
    # enough for all parts
    learned = [Episode.from_stream(rng.normal(size=(60, spec.size)), spec) for _ in range(60)]
    memory = NeuralASM(spec, epochs=1).fit(learned)
    gru = make_monitor("gru+evidence", spec, hidden_size=256).fit(learned[:8])

    def observing(monitor: Any, batch: int = 1) -> Callable[[], None]:
        state = monitor.initial_state(batch)
        rows = rng.normal(size=(64, batch, spec.size))

        def call() -> None:
            nonlocal state
            state, _ = monitor.observe(state, rows[rng.integers(64)])

        return call

    many = "neural_asm, each of 64 streams"
    rival = "gru+evidence"
    rivals = {
        "neural_asm, one stream": observing(memory),
        many: observing(memory, 64),
        rival: observing(gru),
    }
    with threadpool_limits(1):
        seconds = take_turns(rivals, 5 * args.steps, args.seed, console)
    seconds[many] /= 64
    rows = []
    for name, own in seconds.items():
        median_us, slow_us = np.quantile(own, (0.5, 0.99)) * 1e6
        against = f"{ratio(own, seconds[rival]).text(digits=2)}× {rival}"
        rows.append((name, f"{median_us:.3g}", f"{slow_us:.3g}", against))
    return Table("observe(), 256 hidden units, 60 channels", ("", "µs", "p99", "against"), rows)


def _made(task: str, rate: int | None = None) -> gym.Env[Any, Any]:
    return gym.make(env_id(task), horizon=10**9, stream_freq=rate, disable_env_checker=True)


def vectors_of(
    envs: Sequence[gym.Env[Any, Any]], counts: Iterable[int]
) -> dict[int, ThreadedVectorEnv]:
    """Return vectors of the first few environments, which share them and close them when they are collected."""
    return {n: ThreadedVectorEnv([partial(envs.__getitem__, i) for i in range(n)]) for n in counts}


def stepping(step: Callable[[Any], Any], actions: Iterable[Any]) -> Callable[[], None]:
    """Return a function that takes the steps of the next second."""
    remaining = iter(actions)

    def second() -> None:
        for action in islice(remaining, SECOND):
            step(action)

    return second


def speeds(name: object, members: int, seconds: dict[str, NDArray[np.float64]]) -> tuple[str, ...]:
    """Return a row: steps a second of all members together, and the first's as a share of each other's."""
    ours, *others = seconds.values()
    rates = [f"{SECOND * members / np.median(own):,.0f}" for own in seconds.values()]
    shares = [ratio(other, ours).text(digits=2) for other in others]
    return str(name), *rates, *shares


def observing_steps(
    env: Any, memory: NeuralASM, view: StreamView, count: int
) -> Callable[[Any], None]:
    """Return a step of ``count`` environments whose rows a memory observes: no guard can cost less."""
    state = memory.initial_state(count)

    def step(action: Any) -> None:
        nonlocal state
        info = env.step(action)[-1]
        rows = np.asarray(info.get("streams", info["stream"]))
        for row in rows.reshape(-1, count, rows.shape[-1]):
            state, _ = memory.observe(state, view.rows(row))

    return step


def measure_safety(args: Args, console: Console) -> Table:
    """Compare guarded steps with bare ones, and with those whose rows the memory observes without a guard."""
    rows = []
    turns = max(1, args.steps // SECOND)
    for rate, name in ((None, "one environment"), (100, "one, its stream at 100 Hz")):
        with closing(_made(args.task, rate)) as bare, closing(_made(args.task, rate)) as inner:
            spec = StreamSource(inner).spec
            memory = body_memory(inner, spec).with_threshold(NEVER)
            observing = observing_steps(bare, memory, StreamView(spec, memory.spec), 1)
            rivals = _guarded_rivals(NeuralASMSafety(inner, memory), bare, observing, args.seed)
            rows.append(speeds(name, 1, take_turns(rivals, turns, args.seed, console)))

    most = max(args.members)
    alone = vectors_of([_made(args.task) for _ in range(most)], args.members)
    watched = vectors_of([_made(args.task) for _ in range(most)], args.members)
    for n, vector in watched.items():
        spec = vector.get_attr("stream_spec")[0]
        memory = body_memory(vector, spec).with_threshold(NEVER)
        observing = observing_steps(alone[n], memory, StreamView(spec, memory.spec), n)
        wrapped = VectorNeuralASMSafety(vector, memory)
        rivals = _guarded_rivals(wrapped, alone[n], observing, args.seed)
        seconds = take_turns(rivals, turns, args.seed, console)
        rows.append(speeds(f"vector of {n}", n, seconds))
    headings = (
        "",
        "guarded",
        "memory alone",
        "bare",
        "guarded / memory alone",
        "guarded / bare",
    )
    return Table(f"Control steps of {args.task} a second, shipped memory", headings, rows)


def _guarded_rivals(guarded: Any, bare: Any, observing: Callable[[Any], None], seed: int) -> Rivals:
    """Return a second of environments: guarded, bare, and bare with a memory that is ``observing``."""
    steps = {
        "guarded": guarded.step,
        "memory alone": observing,
        "bare": bare.step,
    }
    action = np.zeros(bare.action_space.shape, np.float32)
    for env in (guarded, bare):
        env.reset(seed=seed)
    return {name: stepping(step, repeat(action)) for name, step in steps.items()}


def physics_alone(
    envs: Sequence[gym.Env[Any, Any]], actions: NDArray[np.float32]
) -> Callable[[], None]:
    """Return a function that simulates the next second by ``mujoco.rollout``, on as many threads as there are cores.

    It has the environments' models, states and motor commands, recorded here as they take ``actions`` (T, n, A): the
    same motion to the last bit.
    """
    simulations = [env.get_wrapper_attr("simulation") for env in envs]
    models = [simulation.model for simulation in simulations]
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    size = mujoco.mj_stateSize(models[0], kind)
    recorded = []
    for start in range(0, len(actions), SECOND):
        states = np.empty((len(envs), size))
        warm = []
        controls = []
        for i, env in enumerate(envs):
            data = simulations[i].data
            torques: list[NDArray[np.float64]] = []  # of each step of physics
            mujoco.mj_getState(models[i], data, states[i], kind)
            warm.append(data.qacc_warmstart.copy())
            hooks = env.get_wrapper_attr("substep_hooks")
            hooks.append(lambda _, data=data, torques=torques: torques.append(data.ctrl.copy()))
            for action in actions[start : start + SECOND, i]:
                env.step(action)
            hooks.clear()
            controls.append(torques)
        recorded.append((states, np.array(controls), np.array(warm)))
    remaining = iter(recorded)
    threads = min(cores(), len(envs))
    pool_threads = 0  # none beside this one
    if threads > 1:
        pool_threads = threads
    pool = Rollout(nthread=pool_threads)
    buffers = [mujoco.MjData(models[0]) for _ in range(threads)]

    def second() -> None:
        states, controls, warm = next(remaining)
        pool.rollout(models, buffers, states, controls, initial_warmstart=warm)

    return second


def measure_env(args: Args, console: Console) -> Table:
    """Compare vectors with MuJoCo's own threads and with robosuite's step.

    MuJoCo's threads only simulate the same motion.
    """
    rows = []
    turns = max(1, args.steps // SECOND)
    envs = [_made(args.task) for _ in range(max(args.members))]
    robosuite = import_robosuite()
    robots = ["Panda"] * task_spec(args.task).arms
    theirs = robosuite.make(
        args.task,
        robots,
        controller_configs=[
            robosuite.load_composite_controller_config(robot=robot) for robot in robots
        ],
        reward_shaping=True,
        ignore_done=True,
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
    )
    for n, ours in vectors_of(envs, args.members).items():
        rng = np.random.default_rng(args.seed)
        # Each action is held for a second, as a policy's are: noise alone keeps the arm in place.
        held = rng.uniform(-0.3, 0.3, (turns + 1, *(ours.action_space.shape or ())))
        actions = np.repeat(held, SECOND, axis=0).astype(np.float32)
        ours.reset(seed=args.seed)
        physics = physics_alone(envs[:n], actions)
        ours.reset(seed=args.seed)
        theirs.reset()
        rivals: Rivals = {
            "asm_gym": stepping(ours.step, actions),
            "mujoco.rollout": physics,
            "robosuite": stepping(theirs.step, actions[:, 0]),
        }
        seconds = take_turns(rivals, turns, args.seed, console)
        seconds["robosuite"] *= n  # which has no vectors
        rows.append(speeds(n, n, seconds))
    headings = (
        "members",
        "asm_gym",
        "mujoco.rollout",
        "robosuite",
        "asm_gym / mujoco.rollout",
        "asm_gym / robosuite",
    )
    return Table(f"Control steps of {args.task} a second, at 20 Hz", headings, rows)


BENCHMARKS = {"monitor": measure_monitor, "safety": measure_safety, "env": measure_env}


def measure(args: Args, console: Console) -> None:
    """Print a table for each benchmark and write them to a file."""
    args.out.mkdir(parents=True, exist_ok=True)
    machine = f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
    tables = []
    for name in args.what:
        table = BENCHMARKS[name](args, console)
        table = replace(table, caption=f"{table.caption}. {machine}; ±: spread over {PARTS} parts.")
        console.print(table)
        tables.append(markdown(table))
    file = args.out / "benchmark.md"
    write_text(file, "\n\n".join(tables) + "\n")
    console.print(f"Wrote {file}")


main = partial(run, "benchmark", Args, measure)
