"""Diagnosis: the cause of a surprise, by the senses whose precision has to go to 0 for the rest to agree again.

    E      = yᵀ P y                           the energy of a moment; y, P = (C + λ)⁻¹: see ``memory.completion``
    E_S    = E - g_Eᵀ (P_EE)⁻¹ g_E, g = P y    what is left of it once the senses S, which take part in E, are completed
    L_S    = log E / E_S                      how much of it S explains
    p      = softmax(W [L, log E/E₀, a] + b)  the families of causes; a: where the surprise is; W by the delta rule

Source: Alcala and Qin 2009 (Automatica 45(7)) for contributions by reconstruction.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from importlib import resources
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from asm_gym.blas import ONE_THREAD
from asm_gym.memory.completion import Completion
from asm_gym.spec import MOTOR, StreamSpec

FAMILIES = ("sensor", "contact", "actuator", "action", "object", "unknown")
"""Of causes: a sensor; a contact of the body; a joint or gripper; an action that is not carried out; a handled object;
none of these, or none for sure."""


class CauseClass(NamedTuple):
    """A class of causes."""

    family: str  # one of ``FAMILIES``
    kinds: tuple[str, ...]  # of the hypotheses that name its part


CLASSES = {
    "sensor": CauseClass("sensor", ("sensor",)),
    "force sensor": CauseClass("sensor", ("force sensor",)),
    "torque sensor": CauseClass("sensor", ("measured torque",)),
    "contact": CauseClass("contact", ("external torque",)),
    "joint": CauseClass("actuator", ("joint",)),
    "gripper": CauseClass("actuator", ("gripper",)),
    "command": CauseClass("action", ("command",)),
    "object": CauseClass("object", ("gripper",)),
    "unknown": CauseClass("unknown", ()),
}

DIAGNOSED_ROWS = 3  # last rows that a diagnosis rests on

TORQUES = ("commanded", "measured", "external")

HYPOTHESIS_KINDS = (
    "sensor",
    "force sensor",
    "commanded torque",
    "measured torque",
    "external torque",
    "joint",
    "contact",
    "wrist",
    "gripper",
    "hand",
    "command",
)
"""Of hypotheses: a sensor that measures no force, one that does, torques of one joint, …"""

JUDGED_GROUPS = ("joint", "torque", "hand", "wrench", "gripper")
"""Of channels, whose share of the surprise is evidence."""

EVIDENCE_NAMES = (*HYPOTHESIS_KINDS, "energy", "alone", *JUDGED_GROUPS)
"""In order: how much the best hypothesis of each kind explains; the energy; the largest share of the surprise in one
sensor, and the share in each group of channels."""

SETTLED = 0.9  # a belief of so much, after so many diagnoses, is final
SETTLED_AFTER = 3
LEAST_NEWEST = 0.1  # share of the newest diagnosis in a belief
LEAST_SURPRISE = 1e-12  # that is shared among senses
REPEATS = 3  # equal readings of a noisy sensor after which it is stuck


class Cause(NamedTuple):
    """The likely cause of a surprise."""

    family: str  # one of ``FAMILIES``
    part: str  # such as ``encoder[3]`` or ``joint[3]``; may be empty
    probability: float  # of the family, calibrated
    probabilities: dict[str, float]  # of all families
    columns: NDArray[np.intp]  # (n,) of the stream, where the cause is a sensor


class Hypothesis(NamedTuple):
    """Columns of the stream that may be wrong together."""

    evidence: str  # which of ``EVIDENCE_NAMES`` it counts for
    part: str
    columns: NDArray[np.intp]


class FreedEntries(NamedTuple):
    """The entries of y that a hypothesis frees."""

    entries: NDArray[np.intp]  # E (e,)
    inverse: NDArray[np.float64]  # (P_EE)⁻¹ (e, e)


@dataclass(frozen=True)
class Readout:
    """Softmax regression of the class of a cause on evidence."""

    mean: NDArray[np.float64]  # (F,) of the evidence it learned from
    spread: NDArray[np.float64]  # (F,)
    weights: NDArray[np.float64]  # (C, F) for each of ``CLASSES``
    bias: NDArray[np.float64]  # (C,)

    def __call__(self, evidence: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the probabilities (N, C) of ``CLASSES`` for evidence (N, F)."""
        return softmax((evidence - self.mean) / self.spread @ self.weights.T + self.bias, axis=-1)

    @classmethod
    def shipped(cls) -> Self:
        """Return the readout that was learned from faults of an arm in simulation."""
        file = resources.files("asm_gym.monitors").joinpath("causes.json")
        saved = json.loads(file.read_text(encoding="utf-8"))
        return cls(**{field.name: np.array(saved[field.name]) for field in fields(cls)})


def updated_belief(
    belief: NDArray[np.float64], newest: NDArray[np.float64], diagnoses: int
) -> NDArray[np.float64]:
    """Return the mean probabilities of the families (F,) after so many diagnoses.

    The newest counts a tenth at least. A belief that is sure stays: later rows are from places where a fault has
    brought the arm.
    """
    if diagnoses > SETTLED_AFTER and belief.max() >= SETTLED:
        return belief
    return belief + max(1 / diagnoses, LEAST_NEWEST) * (newest - belief)


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Names the cause of a surprise, by the completion of the memory that was surprised."""

    completion: Completion
    readout: Readout

    def __post_init__(self) -> None:
        """Invert matrices in advance: an alarm must not wait for it."""
        with ONE_THREAD:
            _ = self._freed

    @cached_property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """All that may be wrong, by the names of the stream's channels."""
        sensors = [
            Hypothesis(_kind_of_sensor(name, self._groups[columns[0]]), name, columns)
            for name, columns in self.completion.sensors
        ]
        return (*sensors, *_torque_joints(sensors), *_regions(self.completion.spec, self._groups))

    @cached_property
    def _groups(self) -> NDArray[np.str_]:
        """The group (D,) of each column."""
        return np.array(self.completion.spec.groups)

    @cached_property
    def _freed(self) -> list[FreedEntries]:
        """Of each hypothesis the entries of y in it."""
        freed = []
        for hypothesis in self.hypotheses:
            missing = np.zeros(self.completion.spec.size, bool)
            missing[hypothesis.columns] = True
            entries = np.flatnonzero(self.completion.involved(missing))
            precision = self.completion.precision[np.ix_(entries, entries)]
            freed.append(FreedEntries(entries, np.linalg.inv(precision).astype(np.float64)))
        return freed

    def evidence(
        self,
        lifted: NDArray[np.float64],
        attribution: NDArray[np.float64],
        missing: NDArray[np.bool_] | None = None,
    ) -> tuple[NDArray[np.float64], dict[str, Hypothesis]]:
        """Return the evidence (F,) in y (T, Y), and the best hypothesis of each kind; see ``__call__``."""
        energy, rest = self._energies(lifted[-DIAGNOSED_ROWS:])
        total = energy.mean() + 1.0
        left = np.maximum(rest.mean(axis=0), 0.0) + 1.0
        explained = dict.fromkeys(HYPOTHESIS_KINDS, 0.0)
        best: dict[str, Hypothesis] = {}
        for hypothesis, share in zip(self.hypotheses, np.log(total / left), strict=True):
            kind = hypothesis.evidence
            if missing is not None and missing[hypothesis.columns].all():
                continue
            if kind not in best or share > explained[kind]:
                best[kind] = hypothesis
                explained[kind] = share

        surprise = np.nan_to_num(attribution)
        shares = surprise / max(float(surprise.sum()), LEAST_SURPRISE)
        alone = max(float(shares[columns].sum()) for _, columns in self.completion.sensors)
        groups = [float(shares[self._groups == group].sum()) for group in JUDGED_GROUPS]
        relative_energy = np.log(total / len(self.completion.covariance))
        return np.array([*explained.values(), relative_energy, alone, *groups]), best

    def _energies(
        self, lifted: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return E (T,), and E_S of each hypothesis (T, H), for y (T, Y)."""
        y = lifted - self.completion.centre
        g = y @ self.completion.precision
        energy = np.einsum("ty,ty->t", y, g)
        rest = []
        for freed in self._freed:
            g_E = g[:, freed.entries]
            rest.append(energy - np.einsum("te,te->t", g_E @ freed.inverse, g_E))
        return energy, np.stack(rest, axis=1)

    def __call__(
        self,
        rows: NDArray[np.floating[Any]],
        attribution: NDArray[np.float64],
        missing: NDArray[np.bool_] | None = None,
    ) -> Cause:
        """Return the cause of the surprise in the last row.

        Args:
            rows: (T, D) the last ones of the stream.
            attribution: (D,) share of each number in the surprise.
            missing: (D,) senses that are completed already, and so are the cause no more.
        """
        stuck = self._stuck(rows, attribution)
        if stuck is not None:
            return stuck
        with ONE_THREAD:  # the same to the last bit on any machine with these libraries
            evidence, best = self.evidence(self.completion.lift(rows), attribution, missing)
            of_classes = self.readout(evidence[None])[0]

        by_class = dict(zip(CLASSES, of_classes.tolist(), strict=True))
        probabilities = dict.fromkeys(FAMILIES, 0.0)
        for name, probability in by_class.items():
            probabilities[CLASSES[name].family] += probability
        family = max(FAMILIES, key=lambda name: probabilities[name])
        classes = [name for name in CLASSES if CLASSES[name].family == family]
        likeliest = max(classes, key=lambda name: (by_class[name], name))

        kinds = [kind for kind in CLASSES[likeliest].kinds if kind in best]
        part = ""
        columns = np.zeros(0, np.intp)
        if kinds:
            explained = dict(zip(EVIDENCE_NAMES, evidence, strict=True))
            hypothesis = best[max(kinds, key=lambda kind: explained[kind])]
            part = hypothesis.part
            if family == "sensor":
                columns = hypothesis.columns
        return Cause(family, part, probabilities[family], probabilities, columns)

    def _stuck(
        self, rows: NDArray[np.floating[Any]], attribution: NDArray[np.float64]
    ) -> Cause | None:
        """Return the sensor with most of the surprise, where it repeats itself though it has noise."""
        if len(rows) < REPEATS:
            return None
        name, columns = max(
            self.completion.sensors, key=lambda sensor: float(attribution[sensor[1]].sum())
        )
        repeats = np.ptp(rows[-REPEATS:], axis=0) == 0
        is_noisy = self.completion.spec.noise > 0
        if not (repeats & is_noisy)[columns].any():
            return None
        certain = dict.fromkeys(FAMILIES, 0.0) | {"sensor": 1.0}
        return Cause("sensor", name, 1.0, certain, columns)


def _kind_of_sensor(name: str, group: str) -> str:
    """Return the kind of the hypothesis that a sensor, such as ``measured_torque[3]``, is wrong."""
    bare = name.split("[")[0]
    if group == "torque" and bare.endswith("torque"):
        for kind in TORQUES:
            if f"{kind}_torque" in bare:
                return f"{kind} torque"
        return "measured torque"
    if group == "wrench" or bare.endswith("force"):
        return "force sensor"
    return "sensor"


def _torque_joints(sensors: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return for each joint that all of its torques are wrong together."""
    joints: dict[str, list[int]] = {}
    for sensor in sensors:
        if sensor.evidence.endswith("torque"):
            element = sensor.part.removeprefix(sensor.part.split("[")[0])
            joints.setdefault("joint" + element, []).extend(sensor.columns.tolist())
    return [Hypothesis("joint", name, np.array(own, np.intp)) for name, own in joints.items()]


def _regions(spec: StreamSpec, groups: NDArray[np.str_]) -> list[Hypothesis]:
    """Return the parts of a robot whose columns, of these groups (D,), may be wrong together."""
    wrist = groups == "wrench"
    contact = np.array(["external_torque" in label for label in spec.labels])
    if contact.any():
        contact |= wrist
    regions = [
        ("contact", "body", contact),
        ("wrist", "wrist", wrist),
        ("gripper", "gripper", groups == "gripper"),
        ("hand", "hand", groups == "hand"),
        ("command", "command", groups == MOTOR),
    ]
    return [
        Hypothesis(kind, part, np.flatnonzero(chosen))
        for kind, part, chosen in regions
        if chosen.any()
    ]


def as_info(cause: Cause | None) -> dict[str, Any]:
    """Return ``info["asm"]["cause"]``; all empty where there is none."""
    if cause is None:
        return {"family": "", "part": "", "probability": 0.0, "probabilities": {}}
    info = cause._asdict()
    del info["columns"]
    return info
