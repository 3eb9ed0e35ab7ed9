"""Surprise in the study of six skills: of the networks, of parts of their energy, and of movement primitives.

An observer who knows a faulty episode and its healthy twin sees the fault where the difference d of their rows exceeds
the noise σ of the senses: S = Σ (d/σ)² over the second after the onset is 25 or more (Van Trees 1968, section 2.2).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.evaluation.statistics import auroc
from asm_gym.scripts.reproduce.closed_loop import LocalNetwork
from asm_gym.scripts.reproduce.group_energy import WHOLE, SurprisedModel
from asm_gym.scripts.reproduce.skill_claims import ALARMS, RECURRENT, SEEN
from asm_gym.scripts.reproduce.skill_envelope import MODES, SkillEnvelope
from asm_gym.scripts.reproduce.workspace import (
    EVENT,
    FAULTS,
    GROUP_OF,
    SECOND,
    SPEC,
    UNKNOWN,
    Floats,
)

if TYPE_CHECKING:
    from asm_gym.scripts.reproduce.skill_measures import Repetition

TWINS = "twins"  # healthy episodes of the same seeds as the faulty ones
RATE = 0.05  # share of healthy episodes over a ceiling
WARM = 3  # first rows, which are not judged
VISIBLE = 25.0  # S from which an observer who knows the twin sees a fault
COARSEST = {"object": 0.005, "joint": 2e-4, "hand": 5e-4, "gripper": 2e-4}
"""Noise of senses whose channels declare none or less, by group."""
PROMP = "ProMP, told"
PRIMITIVES = {PROMP: MODES, "envelope of a DMP, told": 0}  # and their modes
ROW_ALONE = (1.0,)  # gain of evidence that forgets all rows but the last
ABLATIONS = {
    "one variance for all states": WHOLE._replace(by_state=False),
    "unit precision": WHOLE._replace(by_state=False, calibrated=False),
    "no evidence over time": WHOLE._replace(gains=ROW_ALONE),
    "unit precision, no evidence over time": WHOLE._replace(
        by_state=False, calibrated=False, gains=ROW_ALONE
    ),
}
"""Parts that are left out of the energy of the recurrent network."""


def largest_energies(model: SurprisedModel, episodes: Sequence[Episode], rows: slice) -> Floats:
    """Return the largest energy of any group in some rows of each episode (N,) [ceiling]."""
    readings = [model.read_stream(e.stream) for e in episodes]
    return np.array([reading.energy[rows].max() for reading in readings])


def set_ceiling(model: SurprisedModel, healthy: Sequence[Episode]) -> None:
    """Set the ceiling that a share ``RATE`` of healthy episodes passes."""
    highest = largest_energies(model, healthy, slice(WARM, None))
    model.ceiling = float(np.quantile(highest, 1.0 - RATE))


def learn_primitives(repetition: Repetition) -> dict[str, SkillEnvelope]:
    """Return the movement primitives by name, with their ceilings."""
    learned = {}
    for name, modes in PRIMITIVES.items():
        model = SkillEnvelope.learned(repetition.reader, repetition.train, modes)
        set_ceiling(model, repetition.calibration)
        learned[name] = model
    return learned


def ablated(repetition: Repetition) -> dict[str, LocalNetwork]:
    """Return the recurrent network without parts of its energy, by name, with their ceilings."""
    network = repetition.networks[RECURRENT].network
    variants = {}
    for name, parts in ABLATIONS.items():
        model = LocalNetwork(repetition.reader, network, repetition.train, parts)
        set_ceiling(model, repetition.calibration)
        variants[f"{RECURRENT}, {name}"] = model
    return variants


def detect(repetition: Repetition, models: Mapping[str, SurprisedModel]) -> None:
    """Measure how well energy tells each kind of fault from its twins, and unknown skills from known ones."""
    whole = slice(WARM, None)
    around = slice(EVENT, EVENT + SECOND)
    twins = repetition.load(TWINS)
    episodes = {at: repetition.load(at) for at in (*FAULTS, *UNKNOWN)}
    seen = {kind: is_visible(episodes[kind], twins) for kind in FAULTS}
    note = repetition.note
    for kind in FAULTS:
        note("share visible", "ideal observer", kind, seen[kind].mean())
    for name, model in models.items():
        usual = largest_energies(model, repetition.tests, whole)
        of_twins = largest_energies(model, twins, around)
        note(ALARMS, name, "healthy", np.mean(usual > 1.0))
        for at, own in episodes.items():
            if at in FAULTS:
                energies = largest_energies(model, own, around)
                compared = of_twins
                if seen[at].any():
                    note(SEEN, name, at, auroc(energies[seen[at]], of_twins))
            else:
                energies = largest_energies(model, own, whole)
                compared = usual
            note("AUROC", name, at, auroc(energies, compared))
            note(ALARMS, name, at, np.mean(energies > 1.0))


def is_visible(episodes: Sequence[Episode], twins: Sequence[Episode]) -> NDArray[np.bool_]:
    """Return whether an observer who knows its twin sees the fault of each episode (N,)."""
    floor = np.array([COARSEST.get(group, 0.1) for group in GROUP_OF])
    noise = np.maximum(SPEC.noise, floor)
    twin_of = {(twin.info["skill"], twin.seed): twin for twin in twins}
    visible = []
    for episode in episodes:
        twin = twin_of[episode.info["skill"], episode.seed]
        end = min(len(episode), len(twin), EVENT + SECOND)
        difference = episode.stream[EVENT:end].astype(np.float64) - twin.stream[EVENT:end]
        difference[:, SPEC.motor] = 0.0  # commands answer to the fault
        visible.append(np.sum((difference / noise) ** 2) >= VISIBLE)
    return np.array(visible)
