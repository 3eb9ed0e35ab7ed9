"""Diagnosis: what is wrong, from which precision has to go to 0 for the rest to make sense again.

    E      = yᵀ P y                           the energy of a moment; y, P = (C + λ)⁻¹: see ``memory.completion``
    E_S    = E - g_Eᵀ (P_EE)⁻¹ g_E, g = P y    what is left of it once the senses S, which take part in E, are completed
    L_S    = log E / E_S                      how much of it S explains
    p      = softmax(W [L, log E/E₀] + b)     the families of causes; W by the delta rule, local

A sensor at fault is explained by that sensor, a command that is not carried out by the command, a contact by external
torques and the wrist's forces together, a joint by the torques of that joint.

Source: Alcala and Qin 2009 (Automatica 45(7)) for contributions by reconstruction.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.completion import PENALTY, Completion
from asm_gym.stream import MOTOR

FAMILIES = ("sensor", "contact", "actuator", "action", "object", "unknown")
"""Of causes: a sensor; something that touches the body; a joint or gripper; what becomes of an action on its way; a
thing that is handled; none of these, or none for sure."""

WINDOW = 3
"""Rows that a diagnosis looks at: the last ones."""

EVIDENCE = (
    *("sensor", "force sensor", "commanded torque", "measured torque", "external torque", "joint", "contact"),
    *("wrist", "gripper", "hand", "command", "energy"),
)
"""What is weighed, in order: how much the best sensor explains that measures no force, the best that does, …"""


class Cause(NamedTuple):
    """What seems to be wrong.

    Attributes:
        family: one of ``FAMILIES``.
        part: a sensor such as ``encoder[3]``, a joint such as ``joint[3]``, or what else explains it; may be empty.
        probability: of the family; calibrated: 0.9 means nine of ten.
        probabilities: of all families.
        columns: (n,) of the stream, whose precision goes to 0 where the cause is a sensor.
    """

    family: str
    part: str
    probability: float
    probabilities: dict[str, float]
    columns: NDArray[np.intp]


class Hypothesis(NamedTuple):
    """Senses that may be wrong together."""

    evidence: str  # which of ``EVIDENCE`` it counts for
    part: str
    columns: NDArray[np.intp]


@dataclass(frozen=True)
class Readout:
    """Tells families apart by evidence.

    Args:
        mean, spread: (F,) of the evidence it learned from.
        weights: (families, F). bias: (families,).
    """

    mean: NDArray[np.float64]
    spread: NDArray[np.float64]
    weights: NDArray[np.float64]
    bias: NDArray[np.float64]

    def __call__(self, evidence: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, families) probabilities for evidence (N, F)."""
        return softmax((evidence - self.mean) / self.spread @ self.weights.T + self.bias)

    @classmethod
    def fit(
        cls,
        evidence: NDArray[np.float64],
        families: NDArray[np.intp],
        weight: NDArray[np.float64],
        shrinkage: float = 1e-3,
        steps: int = 3000,
        rate: float = 0.5,
    ) -> Self:
        """By the delta rule, ΔW ∝ (target - p) evidenceᵀ, on examples (N, F) of families (N,) that count ``weight``."""
        mean, spread = evidence.mean(axis=0), evidence.std(axis=0) + 1e-9
        x = (evidence - mean) / spread
        target = np.eye(len(FAMILIES))[families]
        W, b = np.zeros((len(FAMILIES), x.shape[1])), np.zeros(len(FAMILIES))
        share = (weight / weight.sum())[:, None]
        for _ in range(steps):
            error = share * (target - softmax(x @ W.T + b))
            W += rate * (error.T @ x - shrinkage * W)
            b += rate * error.sum(axis=0)
        return cls(mean, spread, W, b)

    @classmethod
    def shipped(cls) -> Self:
        """Learned from faults of an arm in simulation: see ``asm-gym reproduce diagnosis``."""
        text = resources.files("asm_gym.monitors").joinpath("causes.json").read_text(encoding="utf-8")
        saved = json.loads(text)
        return cls(**{name: np.array(saved[name]) for name in ("mean", "spread", "weights", "bias")})


def softmax(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Along the last axis."""
    powers = np.exp(x - x.max(axis=-1, keepdims=True))
    found: NDArray[np.float64] = powers / powers.sum(axis=-1, keepdims=True)
    return found


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Names the cause of a surprise.

    Args:
        completion: of the memory that was surprised.
        readout: tells families apart.
    """

    completion: Completion
    readout: Readout

    @cached_property
    def precision(self) -> NDArray[np.float64]:
        """(Y, Y) P."""
        C = self.completion.covariance
        found: NDArray[np.float64] = np.linalg.inv(C + PENALTY * np.eye(len(C)))
        return found

    @cached_property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """What may be wrong."""
        return hypotheses_of(self.completion)

    @cached_property
    def _freed(self) -> list[tuple[NDArray[np.intp], NDArray[np.float64]]]:
        """For each hypothesis what takes part in it, and the inverse of its precision."""
        found = []
        for h in self.hypotheses:
            missing = np.zeros(self.completion.spec.size, bool)
            missing[h.columns] = True
            E = np.flatnonzero(self.completion.involved(missing))
            found.append((E, np.linalg.inv(self.precision[np.ix_(E, E)])))
        return found

    def explained(self, lifted: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """E (T,), and E_S of each hypothesis (T, H), for y (T, Y)."""
        y = lifted - self.completion.centre
        g = y @ self.precision
        energy = np.einsum("ty,ty->t", y, g)
        left = [energy - np.einsum("te,ef,tf->t", g[:, E], Q, g[:, E]) for E, Q in self._freed]
        return energy, np.stack(left, axis=1)

    def evidence(self, lifted: NDArray[np.float64]) -> tuple[NDArray[np.float64], dict[str, int]]:
        """(F,) what is weighed, for the last rows of y (T, Y); and the best hypothesis of each kind of evidence."""
        energy, left = self.explained(lifted[-WINDOW:])
        usual = len(self.completion.covariance)
        total, rest = energy.mean() + 1.0, np.maximum(left.mean(axis=0), 0.0) + 1.0
        explains = np.log(total / rest)
        best: dict[str, int] = {}
        for i, h in enumerate(self.hypotheses):
            if h.evidence not in best or explains[i] > explains[best[h.evidence]]:
                best[h.evidence] = i
        found = [explains[best[name]] if name in best else 0.0 for name in EVIDENCE[:-1]]
        return np.array([*found, np.log(total / usual)]), best

    def __call__(self, lifted: NDArray[np.float64]) -> Cause:
        """The cause of the surprise in the last row of y (T, Y)."""
        evidence, best = self.evidence(lifted)
        p = self.readout(evidence[None])[0]
        which = int(p.argmax())
        family = FAMILIES[which]
        named = self._named(family, evidence, best)
        columns = named.columns if named is not None and family == "sensor" else np.zeros(0, np.intp)
        probabilities = {name: float(q) for name, q in zip(FAMILIES, p, strict=True)}
        return Cause(family, named.part if named else "", float(p[which]), probabilities, columns)

    def _named(self, family: str, evidence: NDArray[np.float64], best: dict[str, int]) -> Hypothesis | None:
        """The part that explains most, of those that a family has."""
        able = [name for name in PARTS[family] if name in best]
        if not able:
            return None
        return self.hypotheses[best[max(able, key=lambda name: evidence[EVIDENCE.index(name)])]]


PARTS: dict[str, tuple[str, ...]] = {
    "sensor": ("sensor", "force sensor", "measured torque"),
    "contact": ("external torque",),
    "actuator": ("joint", "gripper"),
    "action": ("command",),
    "object": ("gripper",),
    "unknown": (),
}
"""Where the part of a cause is looked for."""


def hypotheses_of(completion: Completion) -> tuple[Hypothesis, ...]:
    """All that may be wrong in a stream, by the names of its channels."""
    spec = completion.spec
    groups = {label: c.group for c in spec.channels for label in c.labels}
    labels = np.array(spec.labels)
    found: list[Hypothesis] = []
    joints: dict[str, list[int]] = {}
    for name, columns in completion.sensors:
        bare = name.split("[")[0]
        group = groups[labels[columns[0]]]
        if bare.endswith("torque") and group == "torque":
            joints.setdefault("joint" + name[len(bare) :], []).extend(columns.tolist())
            kind = next((k for k in ("commanded", "measured", "external") if f"{k}_torque" in bare), "measured")
            found.append(Hypothesis(f"{kind} torque", name, columns))
        else:
            kind = "force sensor" if group == "wrench" or bare.endswith("force") else "sensor"
            found.append(Hypothesis(kind, name, columns))
    found += [Hypothesis("joint", name, np.array(columns, np.intp)) for name, columns in joints.items()]

    wrist = np.array([groups[label] == "wrench" for label in labels])
    external = np.array(["external_torque" in label for label in labels])
    regions = {
        ("contact", "body"): wrist | external if external.any() else external,
        ("wrist", "wrist"): wrist,
        ("gripper", "gripper"): np.array([groups[label] == "gripper" for label in labels]),
        ("hand", "hand"): np.array([groups[label] == "hand" for label in labels]),
        ("command", "command"): np.array([groups[label] == MOTOR for label in labels]),
    }
    found += [Hypothesis(*named, np.flatnonzero(chosen)) for named, chosen in regions.items() if chosen.any()]
    return tuple(found)


def as_info(cause: Cause | None, force: Any = None) -> dict[str, Any]:
    """What ``info["asm"]["cause"]`` says; all empty where there is nothing to explain."""
    if cause is None:
        return {"family": "", "part": "", "probability": 0.0, "force": None, "probabilities": {}}
    named = {"family": cause.family, "part": cause.part, "probability": cause.probability}
    return {**named, "force": force, "probabilities": cause.probabilities}
