"""Everything that can watch a stream: the Neural ASM and its rivals, behind one protocol."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from asm_gym.checkpoint import kind_of
from asm_gym.choices import check_choice
from asm_gym.extras import needed_for
from asm_gym.monitors.base import (
    ExpectsActions,
    ForgetsEvidence,
    LearnsOnTheJob,
    Monitor,
    NamesSkills,
    Surprise,
)
from asm_gym.monitors.baselines.base import EVIDENCE, Baseline, with_evidence
from asm_gym.monitors.neural_asm import NeuralASM
from asm_gym.stream import StreamSpec

__all__ = [
    "EVIDENCE",
    "MONITORS",
    "ExpectsActions",
    "ForgetsEvidence",
    "LearnsOnTheJob",
    "Monitor",
    "NamesSkills",
    "NeuralASM",
    "Surprise",
    "load_monitor",
    "make_monitor",
    "monitor_class",
]

_RIVALS = {
    "skill_library": "skill_library:SkillLibrary",
    "logpzo": "fail_detect:LogpZO",
    "rnd": "fail_detect:RND",
    "lstm_vae": "lstm_vae:LSTMVAE",
    "gru": "gru:GRU",
    "kalman": "kalman:Kalman",
    "autoregression": "autoregression:Autoregression",
    "elapsed_time": "elapsed_time:ElapsedTime",
}
_LIMITS = {"external_torque_limit": "limits:ExternalTorqueLimit", "force_limit": "limits:ForceLimit"}

MONITORS = ("neural_asm", *(n for r in _RIVALS for n in (r, r + EVIDENCE)), *_LIMITS)
"""The name of every monitor. A rival's plain name scores as its authors did; with ``+evidence``, its errors are judged
as those of the Neural ASM are."""


def monitor_class(name: str) -> type[Any]:
    """The class of the monitor of that name; torch is imported only for those that need it.

    Raises:
        ValueError: there is no monitor of that name; the message lists what exists.
    """
    check_choice("monitor", name, MONITORS)
    if name == "neural_asm":
        return NeuralASM
    module, _, attribute = (_RIVALS | _LIMITS)[name.removesuffix(EVIDENCE)].partition(":")
    with needed_for(f"monitor {name}"):
        found: type[Any] = getattr(importlib.import_module(f"asm_gym.monitors.baselines.{module}"), attribute)
    return with_evidence(found) if name.endswith(EVIDENCE) and issubclass(found, Baseline) else found


def make_monitor(name: str, spec: StreamSpec, **kwargs: Any) -> Monitor:
    """A monitor by name, not yet fitted.

    Args:
        name: for example ``neural_asm``.
        spec: the stream it is to watch.
        **kwargs: hyperparameters of that monitor.

    Raises:
        ValueError: there is no monitor of that name, or it has no such hyperparameter; the message lists what exists.
    """
    kind = monitor_class(name)
    for parameter in kwargs:
        check_choice(f"hyperparameter of {name}", parameter, kind.hyperparameters)
    monitor: Monitor = kind(spec, **kwargs)
    return monitor


def load_monitor(path: str | Path) -> Any:
    """Whatever monitor was saved there. Raises FileNotFoundError, or ValueError where it is none that can be read."""
    return monitor_class(kind_of(path)).load(path)
