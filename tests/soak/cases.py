"""The cases of one shard: ``python -m tests.soak.cases AREA SEED FIRST LAST`` tells each, and then its verdict."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import io
import json
import os
import resource
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from stable_baselines3 import PPO

from asm_gym import episode as one_episode
from asm_gym.data import datasets, logs
from asm_gym.monitors import load_monitor
from asm_gym.policies import make_policy
from asm_gym.policies.network import NetworkPolicy
from asm_gym.scripts import cli, command
from tests.fakes import FakeEnv
from tests.soak.targets import Good, public
from tests.soak.verdicts import judge, names
from tests.test_fuzz import NASTY

MEMORY = 6 * 2**30
"""Address space of a shard beyond what it has when it begins [bytes]: who asks for more has no bounds."""


def parameters(call: Callable[..., Any]) -> list[str]:
    kinds = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [n for n, p in inspect.signature(call).parameters.items() if p.kind not in kinds and n != "progress"]


class Calls:
    """Public constructors and functions, with one or two hostile arguments."""

    def __init__(self) -> None:
        self.targets = public(Good())

    def draw(self, rng: np.random.Generator) -> tuple[str, Callable[[], tuple[str, str]]]:
        name = list(self.targets)[rng.integers(len(self.targets))]
        call, base = self.targets[name]
        own = parameters(call)
        count = min(len(own), 1 + int(rng.random() < 0.2))
        hostile = {own[i]: NASTY[rng.integers(len(NASTY))] for i in rng.permutation(len(own))[:count]}
        shown = ", ".join(f"{n}={_short(v)}" for n, v in hostile.items())
        return f"{name}({shown})", lambda: judge(call, base() | hostile, hostile)


TOKENS = ("", "0", "-1", "1e9", "nan", "inf", "None", "True", "..", "/dev/null", "x" * 5000, "\u2603", "--", "-", "[]")
LINES = (
    *("collect Lift --episodes 3 --seed 0 --out o", "evaluate --tasks Lift --false-alarm-rate 0.05 --window 1 --out o"),
    *("train Lift --seed 0 --out o", "fit good.csv --out m.asm --seed 0", "watch good.csv --monitor good.asm"),
    *("demo --quick --seed 0", "doctor", "reproduce laws", "reproduce harm --tasks Lift", "reproduce parts"),
    *("benchmark env --steps 5", "benchmark experts --tasks Lift --episodes 1", "reproduce harm --seed 1"),
)


class CommandLines:
    """Lines as typed, with tokens lost, doubled, swapped or hostile; options are looked at, and no work is done."""

    def __init__(self) -> None:
        parse = command.parse

        def parsed(*args: Any, **kwargs: Any) -> None:
            parse(*args, **kwargs)

        command.parse = parsed  # type: ignore[assignment]
        good = Good()
        _ = good.memory_file, good.log_file, good.episode_file

    def draw(self, rng: np.random.Generator) -> tuple[str, Callable[[], tuple[str, str]]]:
        tokens = LINES[rng.integers(len(LINES))].split()
        for _ in range(1 + int(rng.integers(2))):
            at = int(rng.integers(len(tokens) + 1))
            hostile = TOKENS[rng.integers(len(TOKENS))]
            match rng.integers(4):
                case 0:
                    tokens[at : at + 1] = [hostile]
                case 1:
                    tokens.insert(at, hostile)
                case 2:
                    del tokens[at : at + 1]
                case _:
                    tokens[at:at] = tokens[at : at + 1]
        return f"asm-gym {' '.join(map(_short, tokens))}", lambda: self.run(tokens)

    def run(self, tokens: list[str]) -> tuple[str, str]:
        said = io.StringIO()
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            try:
                code = cli.main(tokens)
            except BaseException as error:
                return "raw", f"{type(error).__name__}: {error}"[:300]
        text = said.getvalue().strip()
        if code == 0:
            return "fine", ""
        return ("clear" if code == 2 and len(text.splitlines()) == 1 else "raw"), text[:300]


class Format(NamedTuple):
    """A kind of file."""

    good: Path
    read: Callable[[Path], Any]  # what it holds, to be compared
    is_checked: bool = True  # by sums of its own: where other numbers are numbers, nobody could tell


class Files:
    """Files of every format with bytes flipped, cut, doubled, overwritten or put in."""

    def __init__(self) -> None:
        good = Good()
        table = Path("good.parquet").resolve()
        rows = good.episodes[0].stream
        pq.write_table(pa.table({label: rows[:, k] for k, label in enumerate(good.spec.labels)}), table)
        PPO("MlpPolicy", FakeEnv(), device="cpu").save("good.zip")
        layout, env = logs.LogLayout(spec=good.spec), FakeEnv()
        self.formats = {
            "memory": Format(good.memory_file, lambda p: _arrays(load_monitor(p).learned_)),
            "episode": Format(good.episode_file, lambda p: _content(one_episode.load_episode(p))),
            "agent": Format(good.agent_file, lambda p: _acts(NetworkPolicy.load(p), 37)),
            "agent of SB3": Format(Path("good.zip").resolve(), lambda p: _acts(make_policy(str(p), env), 2)),
            "dataset": Format(next(good.dataset.rglob("*.hdf5")), _dataset),
            "CSV": Format(good.log_file, lambda p: [_content(e) for _, e in logs.read_logs(p, layout)], False),
            "Parquet": Format(table, lambda p: [_content(e) for _, e in logs.read_logs(p, layout)], False),
        }
        self.whole = {name: (f.good.read_bytes(), f.read(f.good)) for name, f in self.formats.items()}

    def draw(self, rng: np.random.Generator) -> tuple[str, Callable[[], tuple[str, str]]]:
        name = list(self.formats)[rng.integers(len(self.formats))]
        whole, _ = self.whole[name]
        at, length = int(rng.integers(len(whole))), int(rng.integers(1, 200))
        noise = rng.bytes(length)
        how = ("flip", "cut", "double", "overwrite", "insert")[rng.integers(5)]
        damaged = {
            "flip": whole[:at] + bytes([whole[at] ^ (1 << rng.integers(8))]) + whole[at + 1 :],
            "cut": whole[:at],
            "double": whole[: at + length] + whole[at:],
            "overwrite": whole[:at] + noise + whole[at + length :],
            "insert": whole[:at] + noise + whole[at:],
        }[how]
        return f"{name}: {how} at {at}", lambda: self.read(name, damaged)

    def read(self, name: str, damaged: bytes) -> tuple[str, str]:
        kind = self.formats[name]
        with tempfile.TemporaryDirectory(dir=".") as folder:
            if name == "dataset":
                shutil.copytree(kind.good.parents[1], Path(folder) / "x", dirs_exist_ok=True)
                path = Path(folder).resolve() / "x" / "data" / kind.good.name
            else:
                path = Path(folder).resolve() / f"damaged{kind.good.suffix}"
            path.write_bytes(damaged)
            try:
                found = kind.read(path)
            except Exception as error:
                said = f"{type(error).__name__}: {error}"[:300]
                clear = isinstance(error, (ValueError, OSError)) and names(
                    said, {path.name: None, Path(folder).name: None}
                )
                return ("clear" if clear else "raw"), said
        return ("fine" if not kind.is_checked or found == self.whole[name][1] else "silent"), ""


def _arrays(held: Mapping[str, NDArray[Any]]) -> list[tuple[str, bytes]]:
    return sorted((name, array.tobytes()) for name, array in held.items())


def _acts(agent: Any, size: int) -> bytes:
    """What it does at a few observations of this size."""
    rows = [np.full(size, x, np.float32) for x in (-1.0, 0.1, 2.0)]
    return b"".join(agent.predict(row, deterministic=True)[0].tobytes() for row in rows)


def _dataset(file: Path) -> list[tuple[Any, ...]]:
    return [_content(episode) for episode in datasets.read_dataset(file.parents[1])]


def _content(episode: one_episode.Episode) -> tuple[Any, ...]:
    return episode.stream.tobytes(), episode.spec, episode.success, episode.seed, episode.actions.tobytes()


def _short(value: Any) -> str:
    with contextlib.suppress(Exception):
        text = value if isinstance(value, str) else repr(value)
        return text if len(text) <= 40 else f"{text[:39]}…"
    return type(value).__name__


AREAS: dict[str, type[Any]] = {"calls": Calls, "command lines": CommandLines, "files": Files}


def main(area: str, seed: str, first: str, last: str) -> None:
    """Tells each case before it begins, for whoever it takes along."""
    out = os.fdopen(os.dup(1), "w", buffering=1)
    cases = AREAS[area]()
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    for i in range(int(first), int(last)):
        name, call = cases.draw(np.random.default_rng([int(seed), i]))
        out.write(json.dumps({"begin": name}) + "\n")
        with contextlib.redirect_stdout(io.StringIO()):
            verdict, said = call()
        out.write(json.dumps({"verdict": verdict, "said": said}) + "\n")


if __name__ == "__main__":
    importlib.import_module("tests.soak.cases").main(*sys.argv[1:])
