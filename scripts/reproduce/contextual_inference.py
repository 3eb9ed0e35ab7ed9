"""Contextual inference: the state says which skill is running, and nobody told it.

A memory learns letters without labels, among them pairs that begin alike and part later. A readout, for us and not for
the memory, is then taught to name the skill from the inferred state, from the present row alone, or from both: what
the state knows beyond the row, it has inferred from what came before. Clusters of the states, found without any label,
are compared with the skills. The reference is told every mean demonstration and compares it with the whole past.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.optimize import linear_sum_assignment

from asm_gym.episode import Episode
from asm_gym.memory.readout import certainty, learn_readout
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.contextual_report import SPLICE, TIMES, Example, drawn, tables
from asm_gym.scripts.reproduce.expression import ExpressionMemory, Rows
from asm_gym.scripts.reproduce.handwriting import (
    NAMES,
    STEPS,
    Letter,
    branching,
    check_letters,
    chosen,
    copybook,
    detoured,
    repertoire,
)
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.scripts.reproduce.recordings import wide_enough
from asm_gym.validation import check_choice

SHARED = 2
"""Strokes that the letters of a pair have in common."""

MIRRORED = 2.6
"""Turn of the stroke that is mirrored [rad]."""


@dataclass(frozen=True)
class Config(kit.Config):
    """Which skill is running, read from the state."""

    skills: tuple[str, ...] = ("a", "b", "c", "d", "e", "f")
    """Letters to learn, of a to p; the second half of the repertoire begins as the first half does."""
    repertoire: int = option(6, check=partial(check_letters, least=2))
    """How many letters there are."""
    hidden: int = option(128, quick=32, check=partial(wide_enough, channels=4))
    """Hidden units."""
    writings: int = option(16, quick=6, least=2)
    """Writings of each letter to learn from; as many others are judged."""
    steps: int = option(12000, quick=1500, least=1)
    """Steps in which the synapses change."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.skills:
            check_choice("skill", name, NAMES[: self.repertoire])
        if len(set(self.skills)) < 2:
            raise ValueError(
                f"two skills at least are needed to tell them apart, got {', '.join(self.skills) or 'none'}"
            )


def alphabet(config: Config, rng: np.random.Generator) -> list[Letter]:
    """Letters, and from the second half on letters that begin as one of the first half does."""
    first = repertoire(-(-config.repertoire // 2), 2, rng)
    twins = [branching(first[n], NAMES[len(first) + n], SHARED, rng) for n in range(config.repertoire - len(first))]
    return chosen([*first, *twins], sorted(set(config.skills)))


def one_seed(seed: int, config: Config) -> tuple[list[Record], Example]:
    """Learns the letters, and asks at every step which is being written."""
    rng = np.random.default_rng(seed)
    letters = alphabet(config, rng)
    train, tests = copybook(letters, config.writings, 2, rng), copybook(letters, config.writings, 2, rng)
    memory = ExpressionMemory.learned(train, config.hidden, rng, config.steps)
    names = [letter.name for letter in letters]
    (rows, skill), (seen, truth) = (_stacked(e, names) for e in (train, tests))
    features = _features(memory, rows, seen)
    records, readouts = one_middle(seed, config), {}
    for source, (known, asked) in features.items():
        readouts[source] = _readout(_flat(known), np.tile(skill, len(known)), len(names), rng)
        p = _certainty(asked, readouts[source])  # (T, B, K)
        records += _over_time(source, "named", p.argmax(axis=2) == truth, seed)
    records += _over_time("past", "named", _nearest_past(rows, skill, seen) == truth, seed)
    records += _clustered("state", features["state"][1], truth, seed, rng)
    records += _clustered("row", features["row"][1], truth, seed, rng)
    records += _begun_late(memory, readouts["state"], seen, truth, seed)
    records += _switched(memory, readouts["state"], seen, truth, seed)
    return records, _example(memory, readouts["state"], seen, truth, features["state"][1])


def one_middle(seed: int, config: Config) -> list[Record]:
    """Two letters that begin differently, are one in the middle, and part again: is the beginning remembered?"""
    rng = np.random.default_rng([seed, 1])
    letter = repertoire(1, 2, rng)[0]
    first = replace(letter.strokes[0], turn=MIRRORED, length=4.0)
    letters = [Letter("a", (first, *letter.strokes[1:]))]
    letters.append(detoured(letters[0], "b", rng))
    train, tests = copybook(letters, 2 * config.writings, 2, rng), copybook(letters, 2 * config.writings, 2, rng)
    memory = ExpressionMemory.learned(train, config.hidden, rng, config.steps)
    (rows, skill), (seen, truth) = (_stacked(e, "ab") for e in (train, tests))
    records = []
    for source, (known, asked) in _features(memory, rows, seen).items():
        # A readout for each step, so that nothing hides behind what other steps need.
        right = []
        for k, a in zip(known, asked, strict=True):
            named = certainty(a, *_readout(k, skill, 2, rng, updates=200)).argmax(axis=1)
            right.append(named == truth)
        records += _over_time(source, "one middle", np.array(right), seed)
    return records


def _features(
    memory: ExpressionMemory, rows: Rows, seen: Rows
) -> dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """What a readout may see (T, B, C), of what was learned and of what is judged, for each source."""
    reader = memory.reader
    known, asked = (((x - reader.mean) / reader.spread).astype(np.float32) for x in (rows, seen))
    return {"state": (np.tanh(memory.hidden(rows)), np.tanh(memory.hidden(seen))), "row": (known, asked)}


def _stacked(episodes: Sequence[Episode], names: Sequence[str]) -> tuple[Rows, NDArray[np.intp]]:
    """(T, B, D) cut to the shortest, and the skill of each (B,)."""
    shortest = min(map(len, episodes))
    rows = np.stack([e.stream[:shortest] for e in episodes], axis=1).astype(np.float64)
    return rows, np.array([list(names).index(str(e.info["skill"])) for e in episodes])


def _flat(features: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.ascontiguousarray(features.reshape(-1, features.shape[2]))


def _readout(
    features: NDArray[np.float32], skill: NDArray[np.intp], count: int, rng: np.random.Generator, updates: int = 2000
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    return learn_readout(features.__getitem__, skill, count, rng, updates)


def _certainty(features: NDArray[np.float32], readout: tuple[Any, Any]) -> NDArray[np.float32]:
    return certainty(_flat(features), *readout).reshape(*features.shape[:2], -1)


def _over_time(source: str, how: str, right: NDArray[np.bool_], seed: int) -> list[Record]:
    shares = right.mean(axis=1)
    return [{"how": how, "source": source, "seed": seed, "step": t, "right": float(r)} for t, r in enumerate(shares)]


def _nearest_past(rows: Rows, skill: NDArray[np.intp], seen: Rows) -> NDArray[np.intp]:
    """(T, B) the skill whose mean demonstration has been nearest so far, over all steps read."""
    spread = rows.std(axis=(0, 1))
    means = np.stack([rows[:, skill == k].mean(axis=1) for k in range(skill.max() + 1)])  # (K, T, D)
    apart = np.sum(((seen[:, :, None] - means.transpose(1, 0, 2)[:, None]) / spread) ** 2, axis=3)  # (T, B, K)
    nearest: NDArray[np.intp] = np.cumsum(apart, axis=0).argmin(axis=2)
    return nearest


def _clustered(
    source: str, features: NDArray[np.float32], truth: NDArray[np.intp], seed: int, rng: np.random.Generator
) -> list[Record]:
    """How well as many clusters as there are skills, found at one step without labels, match the skills."""
    count, records = int(truth.max()) + 1, []
    for t in (t for t in TIMES if t < len(features)):
        spots = features[t].astype(np.float64)
        best: tuple[float, float] = (np.inf, 0.0)
        for _ in range(5):
            centres, found = kmeans2(spots, count, minit="++", seed=rng)
            table = np.zeros((count, count))
            np.add.at(table, (found, truth), 1)
            rows, columns = linear_sum_assignment(-table)
            scatter = float(np.sum((spots - centres[found]) ** 2))
            best = min(best, (scatter, float(table[rows, columns].sum() / len(truth))))
        records.append({"how": "clustered", "source": source, "seed": seed, "step": t, "right": best[1]})
    return records


def _begun_late(memory: ExpressionMemory, readout: Any, seen: Rows, truth: NDArray[np.intp], seed: int) -> list[Record]:
    """Cues that begin in mid-letter: the memory is asked after so many steps."""
    records = []
    for length in (1, 2, 5, 10, 20):
        right = []
        for start in range(5, len(seen) - 20, 5):
            state = np.tanh(memory.hidden(seen[start : start + length]))[-1:]
            right.append(_certainty(state, readout).argmax(axis=2)[0] == truth)
        records.append(
            {"how": "begun late", "source": "state", "seed": seed, "step": length, "right": float(np.mean(right))}
        )
    return records


def _switched(memory: ExpressionMemory, readout: Any, seen: Rows, truth: NDArray[np.intp], seed: int) -> list[Record]:
    """One letter up to ``SPLICE``, from there on another: the share that names the new one, since the switch."""
    other = np.roll(np.arange(len(truth)), len(truth) // (int(truth.max()) + 1))
    spliced = np.concatenate([seen[:SPLICE], seen[SPLICE:, other]])
    named = _certainty(np.tanh(memory.hidden(spliced)), readout).argmax(axis=2)
    return [
        {"how": "switched", "source": "state", "seed": seed, "step": k, "right": float((row == truth[other]).mean())}
        for k, row in enumerate(named[SPLICE:])
    ]


def _example(
    memory: ExpressionMemory, readout: Any, seen: Rows, truth: NDArray[np.intp], states: NDArray[np.float32]
) -> Example:
    centred = states - states.mean(axis=(0, 1))
    _, _, axes = np.linalg.svd(_flat(centred)[::3], full_matrices=False)
    plane = centred @ axes[:2].T  # (T, B, 2)
    twin = (int(truth.max()) + 1) // 2
    written = _certainty(states[:, truth == 0], readout).mean(axis=1)
    spliced = np.concatenate([seen[:SPLICE, truth == 0], seen[SPLICE:, truth == 1]])
    switch = _certainty(np.tanh(memory.hidden(spliced)), readout).mean(axis=1)
    few = np.concatenate([np.flatnonzero(truth == k)[:4] for k in range(int(truth.max()) + 1)])
    return Example(
        paths=seen[:, few, :2].transpose(1, 0, 2),
        plane=plane[:, few].transpose(1, 0, 2).astype(np.float64),
        skill=truth[few],
        certain=written[:, [0, twin]].astype(np.float64),
        switch=switch[:, [0, 1]].astype(np.float64),
    )


def run(config: Config) -> Findings:
    """Letters for every seed."""
    found = kit.each("learning letters", partial(one_seed, config=config), config.repetitions, config)
    records = [r for own, _ in found for r in own]
    return Findings(
        records, tables(records, len(set(config.skills))), drawn(records, found[0][1]), {"letter_steps": STEPS}
    )
