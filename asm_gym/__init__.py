"""Neural associative skill memories that watch robots.

Importing this registers the environments with Gymnasium, and little else: each name is imported when it is asked for.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium

if not hasattr(gymnasium.vector, "AutoresetMode"):  # since 1.1
    raise ImportError(
        f"asm-gym needs Gymnasium 1.1 or newer, got {gymnasium.__version__}: "
        "pip install --upgrade gymnasium"
    )

from asm_gym import exceptions
from asm_gym.extras import needed_for
from asm_gym.tasks import TASKS
from asm_gym.version import __version__  # noqa: F401

if TYPE_CHECKING:
    from asm_gym.data.episode import Episode as Episode
    from asm_gym.data.schema import LogSchema as LogSchema
    from asm_gym.exceptions import AsmGymError as AsmGymError
    from asm_gym.exceptions import DamagedFile as DamagedFile
    from asm_gym.exceptions import LimitsLacking as LimitsLacking
    from asm_gym.exceptions import NotEnoughEpisodes as NotEnoughEpisodes
    from asm_gym.exceptions import NotFitted as NotFitted
    from asm_gym.exceptions import SpecMismatch as SpecMismatch
    from asm_gym.exceptions import UnsupportedEnvironment as UnsupportedEnvironment
    from asm_gym.faults.suite import register_fault as register_fault
    from asm_gym.monitors import NeuralASM as NeuralASM
    from asm_gym.monitors import make_monitor as make_monitor
    from asm_gym.monitors import register_monitor as register_monitor
    from asm_gym.policies import make_policy as make_policy
    from asm_gym.policies.registry import register_policy as register_policy
    from asm_gym.rollouts.pretraining.body_memory import harmless as harmless
    from asm_gym.rollouts.run_trials import collect as collect
    from asm_gym.spec import Channel as Channel
    from asm_gym.spec import StreamSpec as StreamSpec
    from asm_gym.tasks import register_task as register_task
    from asm_gym.wrappers import FaultInjection as FaultInjection
    from asm_gym.wrappers import NeuralASMSafety as NeuralASMSafety
    from asm_gym.wrappers import StreamRecorder as StreamRecorder
    from asm_gym.wrappers import VectorNeuralASMSafety as VectorNeuralASMSafety

_NAMES: dict[str, Iterable[str]] = {
    "data.episode": ("Episode",),
    "data.schema": ("LogSchema",),
    "exceptions": exceptions.__all__,
    "faults.suite": ("register_fault",),
    "monitors": ("NeuralASM", "make_monitor", "register_monitor"),
    "policies": ("make_policy",),
    "policies.registry": ("register_policy",),
    "rollouts.run_trials": ("collect",),
    "rollouts.pretraining.body_memory": ("harmless",),
    "spec": ("Channel", "StreamSpec"),
    "tasks": ("register_task",),
    "wrappers": ("FaultInjection", "NeuralASMSafety", "StreamRecorder", "VectorNeuralASMSafety"),
}
"""Public names of each module."""

_HOME = {name: module for module, names in _NAMES.items() for name in names}

__all__ = [*_HOME]

for _task in TASKS.values():
    # No max_episode_steps: the environment truncates itself, so `horizon` is an ordinary argument.
    gymnasium.register(
        _task.id,
        f"asm_gym.envs:{_task.name}",
        vector_entry_point="asm_gym.envs.vector:make",
        kwargs={"task": _task.name},
    )

gymnasium.register(id="asm_gym/SyntheticArm-v0", entry_point="asm_gym.synthetic_arm:SyntheticArm")


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with needed_for(name):
        value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value  # found without this function from now on
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
