"""Monitors by name: one row for each model, and one for each detection, and any of them go together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from asm_gym.checkpoint import read_checkpoint, read_header
from asm_gym.detection import EvidenceDetection
from asm_gym.extras import needed_for
from asm_gym.monitors.calibrated_monitor import CalibratedMonitor
from asm_gym.monitors.monitor_files import restored
from asm_gym.monitors.stream_model import StreamModel, made, parameter_names
from asm_gym.registries import Registry, target
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_choice, typed

# End of the name of a monitor whose errors are judged by the detection of the Neural ASM.
EVIDENCE = "+evidence"

DETECTIONS: dict[str, Any] = {
    "evidence": EvidenceDetection,
    "squares": "asm_gym.detection.scores:Squares",
    "mahalanobis": "asm_gym.detection.scores:Mahalanobis",
    "moving_mean": "asm_gym.detection.scores:MovingMean",
    "largest": "asm_gym.detection.scores:Largest",
}
"""The class of each detection, or ``module:class``."""


@dataclass(frozen=True)
class MonitorKind:
    """How the monitors of one name are made and loaded."""

    # Class of its model, or of the whole monitor; or ``module:class``, imported when it is needed.
    model: Any
    detection: str = "evidence"

    @property
    def model_class(self) -> Any:
        return target(self.model)

    @property
    def parts(self) -> tuple[Any, ...]:
        """Classes of its model and its detection, or of the whole monitor alone."""
        if not issubclass(self.model_class, CalibratedMonitor):
            return self.model_class, target(DETECTIONS[self.detection])
        check_choice(f"detection of {self.model_class.kind}", self.detection, ["evidence"])
        return (self.model_class,)

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        """Names that ``make_monitor`` takes beside the spec."""
        names = [name for part in self.parts for name in parameter_names(part)]
        return tuple(dict.fromkeys([*names, "seed"]))

    def __call__(self, spec: StreamSpec, **hyperparameters: Any) -> CalibratedMonitor:
        """Return the monitor, not yet fitted."""
        parts = []
        for kind in self.parts:
            names = [name for name in parameter_names(kind) if name in hyperparameters]
            parts.append(made(kind, spec, {name: hyperparameters[name] for name in names}))
        if len(parts) == 1:
            return parts[0]
        model, detection = parts
        return CalibratedMonitor(model, detection, seed=hyperparameters.get("seed", 0))


def _rival(model: str, detection: str) -> MonitorKind:
    """Return a rival, by its model in this folder and the detection that its authors judged it by."""
    return MonitorKind(f"asm_gym.monitors.{model}", detection)


RIVALS = {
    "logpzo": _rival("baselines.torch_baselines:LogpZO", "moving_mean"),
    "gru": _rival("baselines.torch_baselines:GRU", "mahalanobis"),
    "kalman": _rival("baselines.kalman:Kalman", "mahalanobis"),
    "association_linear": _rival("baselines.change_regression:LinearAssociation", "mahalanobis"),
    "association_values": _rival("torque.value_association:ValueAssociation", "largest"),
}

BY_EVIDENCE = {
    name + EVIDENCE: replace(kind, detection="evidence") for name, kind in RIVALS.items()
}

MONITORS: Registry[MonitorKind] = Registry(
    "monitor",
    "asm_gym.monitors.monitor_registry:MONITORS",
    {"neural_asm": MonitorKind("asm_gym.monitors.neural_asm:NeuralASM"), **RIVALS, **BY_EVIDENCE},
)
"""Every monitor by name. A baseline's plain name scores as its authors did; with ``+evidence``, its errors are judged
as those of the Neural ASM are. ``+`` and the name of any other detection will do as well."""


@typed
def register_monitor(name: str, model: type[Any] | str, detection: str = "evidence") -> None:
    """Register a model for ``make_monitor(name)`` and ``name+evidence``.

    It is known in this process and its workers.

    Args:
        name: the ``kind`` of the model, which its files contain too.
        model: a subclass of ``StreamModel`` or of a monitor; or its ``module:class``.
        detection: its default detection, a name in ``DETECTIONS``.

    Raises:
        ValueError: the name is taken or is not that of the model's ``kind``, or there is no such
            detection.

    Example:
        >>> from asm_gym import NeuralASM, register_monitor
        >>> class Watchman(NeuralASM):
        ...     kind = "watchman"
        >>> register_monitor("watchman", Watchman)
    """
    check_choice("detection", detection, DETECTIONS)
    if not isinstance(model, str) and getattr(model, "kind", None) != name:
        raise ValueError(
            f"{model.__name__} is of the kind {getattr(model, 'kind', None)!r}, "
            f"got the name {name!r}"
        )
    row = MonitorKind(model, detection)
    MONITORS.register(name, row)
    MONITORS[name + EVIDENCE] = replace(row, detection="evidence")


def check_monitor_name(name: str) -> None:
    """Raise ValueError unless there is such a monitor, or such a model and detection.

    A model that goes by ``module:class`` is imported and registered by its kind; nothing else is imported.
    """
    model, plus, detection = name.partition("+")
    if ":" in model and model not in MONITORS:
        own: Any = target(model)
        if not isinstance(own, type) or not issubclass(own, StreamModel | CalibratedMonitor):
            raise ValueError(
                f"{name} is no model: derive from asm_gym.monitors.stream_model.StreamModel"
            )
        kind = getattr(own, "kind", "")
        if kind not in MONITORS:
            register_monitor(kind, own, getattr(own, "detection", "evidence"))
        MONITORS[model] = MONITORS[kind]
    if plus and name not in MONITORS and model in MONITORS:
        check_choice("detection", detection, DETECTIONS)
    else:
        check_choice("monitor", name, MONITORS)


@typed
def monitor_class(name: str) -> MonitorKind:
    """Return the kind of the monitors of that name.

    Raises:
        ValueError: there is no monitor of that name, or no such detection; the message lists what exists.
        ImportError: a package that it needs is not installed; the message says what to install.
    """
    check_monitor_name(name)
    model, _, detection = name.partition("+")
    kind = MONITORS[name] if name in MONITORS else replace(MONITORS[model], detection=detection)
    with needed_for(f"monitor {name}"):
        _ = kind.parts
    return kind


@typed
def make_monitor(name: str, spec: StreamSpec, **hyperparameters: Any) -> CalibratedMonitor:
    """Return a monitor by name, not yet fitted.

    Args:
        name: for example ``neural_asm``, or ``gru+evidence``, which is ``gru`` with the detection ``evidence``.
        spec: the stream to watch.
        **hyperparameters: of that monitor.

    Raises:
        ValueError: an unknown monitor or hyperparameter; the message lists the known ones.

    Example:
        >>> from asm_gym import Channel, StreamSpec, make_monitor
        >>> spec = StreamSpec((Channel("position", 3, "m"),), dt=0.05)
        >>> make_monitor("kalman+evidence", spec, ridge=1e-3).detection.name
        'evidence'
    """
    kind = monitor_class(name)
    for parameter in hyperparameters:
        check_choice(f"hyperparameter of {name}", parameter, kind.hyperparameters)
    return kind(spec, **hyperparameters)


@typed
def load_monitor(path: str | Path) -> CalibratedMonitor:
    """Read the file of any monitor, with its detection.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, from a newer version, of a monitor that is not registered, or something else.
    """
    kind = monitor_class(str(read_header(path).get("kind")))
    saved = read_checkpoint(path, kind.model_class.kind)
    return restored(
        path, saved, replace(kind, detection=saved.header.get("detection", kind.detection))
    )
