"""``asm-gym benchmark safety``: what the safety wrappers add to a control step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import SyncVectorEnv
from rich.console import Console

from asm_gym.evaluation.tables import ConsoleTable, Table
from asm_gym.monitors import NeuralASM
from asm_gym.scripts.benchmark.turns import take_turns
from asm_gym.stream_source import StreamSource
from asm_gym.wrappers import NeuralASMSafety, VectorNeuralASMSafety
from asm_gym.wrappers.factory import body_memory


@dataclass
class Safety:
    """What the safety wrapper adds to a control step, at the control rate and within control steps."""

    task: str = "Lift"
    """Name of the task."""
    steps: int = 400
    """Control steps of each rival."""
    monitor_freq: int = 100
    """Rows watched a second, where it watches within control steps [Hz]."""
    members: int = 4
    """Environments side by side under one wrapper, against as many without; 0 for none."""
    even_if_busy: bool = False
    """Print figures though the machine has too much else to do."""

    def run(self, console: Console) -> int:
        """Prints the table."""
        plain = self._make(None)
        memory = self._memory(plain)
        guarded = "step under the wrapper"
        envs = {"step": plain, guarded: NeuralASMSafety(self._make(None), memory)}
        envs[f"{guarded}, info flat"] = NeuralASMSafety(self._make(None), memory, info="flat")
        rate = self.monitor_freq
        often = self._make(rate)
        watched = NeuralASMSafety(self._make(rate), self._memory(often), monitor_freq=rate)
        envs |= {f"step, stream at {rate} Hz": often, f"step under the wrapper at {rate} Hz": watched}
        action = np.zeros(plain.action_space.shape or (), np.float32)
        for env in envs.values():
            env.reset(seed=0)
        rivals: dict[str, Callable[[], Any]] = {name: partial(env.step, action) for name, env in envs.items()}
        turns = take_turns(rivals, self.steps, console, self.even_if_busy)
        caption = f"{self.task}, 20 Hz, shipped memories: a control step"
        rows = [
            (name, *(f"{1e3 * turns.quantile(name, q):.2f}" for q in (0.5, 0.99)), turns.times(name, "step"))
            for name in rivals
        ]
        console.print(ConsoleTable(Table(caption, ("", "ms", "p99", "against step"), rows)))
        if self.members:
            console.print(self._side_by_side(memory, console))
        console.print(turns.where())
        return 0

    def _side_by_side(self, memory: NeuralASM, console: Console) -> str:
        """What share of its speed a vector environment keeps under the wrapper."""
        n = self.members
        bare, inner = (SyncVectorEnv([partial(self._make, None)] * n) for _ in range(2))
        guarded = VectorNeuralASMSafety(inner, memory)
        bare.reset(seed=0)
        guarded.reset(seed=0)
        actions = np.zeros(bare.action_space.shape or (), np.float32)
        rivals: dict[str, Callable[[], Any]] = {
            "bare": partial(bare.step, actions),
            "guarded": partial(guarded.step, actions),
        }
        turns = take_turns(rivals, max(1, self.steps // n), console, self.even_if_busy)
        kept = turns.ratio("bare", "guarded")
        return f"{n} side by side under one wrapper keep {kept.text(digits=2)} of their speed."

    def _make(self, rate: int | None) -> gym.Env[Any, Any]:
        env_id = f"asm_gym/{self.task}-v0"
        return gym.make(env_id, horizon=10**9, stream_freq=rate, disable_env_checker=True)

    def _memory(self, env: gym.Env[Any, Any]) -> NeuralASM:
        """The shipped one, with a threshold out of reach: nothing is to be held."""
        return body_memory(env, StreamSource(env).spec).with_threshold(1e300)
