"""Diagnosis: the cause of a surprise, by the senses whose precision has to go to 0 for the rest to agree again.

    E      = yᵀ P y                           the energy of a moment; y, P = (C + λ)⁻¹: see ``memory.completion``
    E_S    = E - g_Eᵀ (P_EE)⁻¹ g_E, g = P y    what is left of it once the senses S, which take part in E, are completed
    L_S    = log E / E_S                      how much of it S explains
    p      = softmax(W [L, log E/E₀, a] + b)  the families of causes; a: where the surprise is; W by the delta rule

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
from scipy.special import softmax

from asm_gym.blas import ONE_THREAD
from asm_gym.memory.completion import Completion
from asm_gym.spec import MOTOR

FAMILIES = ("sensor", "contact", "actuator", "action", "object", "unknown")
"""Of causes: a sensor; a contact of the body; a joint or gripper; an action that is not carried out; a handled object;
none of these, or none for sure."""

CLASSES: dict[str, tuple[str, tuple[str, ...]]] = {
    "sensor": ("sensor", ("sensor",)),
    "force sensor": ("sensor", ("force sensor",)),
    "torque sensor": ("sensor", ("measured torque",)),
    "contact": ("contact", ("external torque",)),
    "joint": ("actuator", ("joint",)),
    "gripper": ("actuator", ("gripper",)),
    "command": ("action", ("command",)),
    "object": ("object", ("gripper",)),
    "unknown": ("unknown", ()),
}
"""Classes of causes: the family of each, and the kinds of hypotheses that name its part."""

WINDOW = 3  # last rows that a diagnosis rests on

KINDS = (
    *(
        "sensor",
        "force sensor",
        "commanded torque",
        "measured torque",
        "external torque",
        "joint",
        "contact",
    ),
    *("wrist", "gripper", "hand", "command"),
)
"""Of hypotheses: a sensor that measures no force, one that does, torques of one joint, …"""

# of channels, whose share of the surprise is evidence
GROUPS = (
    "joint",
    "torque",
    "hand",
    "wrench",
    "gripper",
)

EVIDENCE = (*KINDS, "energy", "alone", *GROUPS)
"""In order: how much the best hypothesis of each kind explains; the energy; the largest share of the surprise in one
sensor, and the share in each group of channels."""

SETTLED, SETTLED_AFTER = 0.9, 3  # a belief of so much, after so many diagnoses, is final
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

    evidence: str  # which of ``EVIDENCE`` it counts for
    part: str
    columns: NDArray[np.intp]


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
        text = (
            resources.files("asm_gym.monitors").joinpath("causes.json").read_text(encoding="utf-8")
        )
        saved = json.loads(text)
        return cls(
            **{name: np.array(saved[name]) for name in ("mean", "spread", "weights", "bias")}
        )


def averaged(
    belief: NDArray[np.float64], newest: NDArray[np.float64], diagnoses: int
) -> NDArray[np.float64]:
    """Return the mean (F,) of all ``diagnoses`` of families so far, of which the newest counts a tenth at least.

    A belief that is sure stays: later rows are from places where a fault has brought the arm.
    """
    if diagnoses > SETTLED_AFTER and belief.max() >= SETTLED:
        return belief
    return belief + max(1 / diagnoses, 0.1) * (newest - belief)


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Names the cause of a surprise, by the completion of the memory that was surprised."""

    completion: Completion
    readout: Readout

    def __post_init__(self) -> None:
        """Invert what there is to invert now: an alarm does not wait for it."""
        with ONE_THREAD:
            _ = self._freed

    @cached_property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """All that may be wrong."""
        return _hypotheses(self.completion)

    @cached_property
    def _freed(self) -> list[tuple[NDArray[np.intp], NDArray[np.float64]]]:
        """Of each hypothesis the columns of y in it, and the inverse of their precision."""
        found = []
        for h in self.hypotheses:
            missing = np.zeros(self.completion.spec.size, bool)
            missing[h.columns] = True
            E = np.flatnonzero(self.completion.involved(missing))
            found.append(
                (E, np.linalg.inv(self.completion.precision[np.ix_(E, E)]).astype(np.float64))
            )
        return found

    def evidence(
        self,
        lifted: NDArray[np.float64],
        attribution: NDArray[np.float64],
        missing: NDArray[np.bool_] | None = None,
    ) -> tuple[NDArray[np.float64], dict[str, int]]:
        """Return the evidence (F,) in y (T, Y), and the best hypothesis of each kind; see ``__call__``."""
        energy, left = self._explained(lifted[-WINDOW:])
        usual = len(self.completion.covariance)
        total, rest = energy.mean() + 1.0, np.maximum(left.mean(axis=0), 0.0) + 1.0
        explains = np.log(total / rest)
        best: dict[str, int] = {}
        for i, h in enumerate(self.hypotheses):
            if missing is not None and missing[h.columns].all():
                continue
            if h.evidence not in best or explains[i] > explains[best[h.evidence]]:
                best[h.evidence] = i
        found = [explains[best[name]] if name in best else 0.0 for name in KINDS]
        shares = np.nan_to_num(attribution) / max(float(np.nan_to_num(attribution).sum()), 1e-12)
        alone = max(float(shares[columns].sum()) for _, columns in self.completion.sensors)
        names = np.array([c.group for c in self.completion.spec.channels for _ in range(c.size)])
        groups = [float(shares[names == group].sum()) for group in GROUPS]
        return np.array([*found, np.log(total / usual), alone, *groups]), best

    def _explained(
        self, lifted: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return E (T,), and E_S of each hypothesis (T, H), for y (T, Y)."""
        y = lifted - self.completion.centre
        g = y @ self.completion.precision
        energy = np.einsum("ty,ty->t", y, g)
        left = [energy - np.einsum("te,te->t", g[:, E] @ Q, g[:, E]) for E, Q in self._freed]
        return energy, np.stack(left, axis=1)

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
            certain = {name: float(name == "sensor") for name in FAMILIES}
            return Cause("sensor", stuck[0], 1.0, certain, stuck[1])
        with ONE_THREAD:  # the same to the last bit on any machine with these libraries
            evidence, best = self.evidence(self.completion.lift(rows), attribution, missing)
            p = self.readout(evidence[None])[0]
        probabilities = dict.fromkeys(FAMILIES, 0.0)
        for (family, _), q in zip(CLASSES.values(), p, strict=True):
            probabilities[family] += float(q)
        family = max(probabilities, key=lambda name: probabilities[name])
        which = max(
            (q, name)
            for (name, (own, _)), q in zip(CLASSES.items(), p, strict=True)
            if own == family
        )[1]
        able = [kind for kind in CLASSES[which][1] if kind in best]
        most = max(able, key=lambda kind: evidence[EVIDENCE.index(kind)], default="")
        named = self.hypotheses[best[most]] if most else Hypothesis("", "", np.zeros(0, np.intp))
        columns = named.columns if family == "sensor" else np.zeros(0, np.intp)
        return Cause(family, named.part, probabilities[family], probabilities, columns)

    def _stuck(
        self, rows: NDArray[np.floating[Any]], attribution: NDArray[np.float64]
    ) -> tuple[str, NDArray[np.intp]] | None:
        """Return the sensor with most of the surprise, where it repeats itself though it has noise."""
        if len(rows) < REPEATS:
            return None
        same = (np.ptp(rows[-REPEATS:], axis=0) == 0) & (self.completion.spec.noise > 0)
        most = max(self.completion.sensors, key=lambda sensor: float(attribution[sensor[1]].sum()))
        return most if same[most[1]].any() else None


def _hypotheses(completion: Completion) -> tuple[Hypothesis, ...]:
    """Return all that may be wrong in a stream, by the names of its channels."""
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
            kind = next(
                (k for k in ("commanded", "measured", "external") if f"{k}_torque" in bare),
                "measured",
            )
            found.append(Hypothesis(f"{kind} torque", name, columns))
        else:
            kind = "force sensor" if group == "wrench" or bare.endswith("force") else "sensor"
            found.append(Hypothesis(kind, name, columns))
    found += [
        Hypothesis("joint", name, np.array(columns, np.intp)) for name, columns in joints.items()
    ]

    wrist = np.array([groups[label] == "wrench" for label in labels])
    external = np.array(["external_torque" in label for label in labels])
    regions = {
        ("contact", "body"): wrist | external if external.any() else external,
        ("wrist", "wrist"): wrist,
        ("gripper", "gripper"): np.array([groups[label] == "gripper" for label in labels]),
        ("hand", "hand"): np.array([groups[label] == "hand" for label in labels]),
        ("command", "command"): np.array([groups[label] == MOTOR for label in labels]),
    }
    found += [
        Hypothesis(*named, np.flatnonzero(chosen))
        for named, chosen in regions.items()
        if chosen.any()
    ]
    return tuple(found)


def as_info(cause: Cause | None) -> dict[str, Any]:
    """Return ``info["asm"]["cause"]``; all empty where there is none."""
    family, part, probability, probabilities, _ = cause or ("", "", 0.0, {}, None)
    return {
        "family": family,
        "part": part,
        "probability": probability,
        "probabilities": probabilities,
    }
