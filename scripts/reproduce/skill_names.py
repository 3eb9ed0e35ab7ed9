"""Ways to name the skill that runs: a memory that was told names, random forests on the rows, and where the hand is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import partial
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from sklearn.ensemble import RandomForestClassifier

from asm_gym.episode import Episode
from asm_gym.memory.readout import KEPT, SMALLEST
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.model import running
from asm_gym.scripts.reproduce.skill_switch import Switch

ASIDE = 0.02
"""A Stack has parted from a Lift once the hand is so far to the side of where it closed [m]."""

TREES = 100

Right = NDArray[np.bool_]


class Named(NamedTuple):
    """In which steps one way of naming is right; (T,) for each episode, of a change those from it on.

    Where the hand is says nothing of an episode with one skill.
    """

    nominal: list[Right]
    switched: list[Right]


def by_memory(
    memory: NeuralASM, told: Sequence[Episode], nominal: Sequence[Episode], switches: Sequence[Switch]
) -> Named:
    """What a memory names that is told these skills; surprise and weights do not depend on it."""
    return _right([memory.name_skills(told).skills], nominal, switches)


def by_memory_shown(
    memory: NeuralASM, told: Sequence[Episode], nominal: Sequence[Episode], switches: Sequence[Switch]
) -> Named:
    """By a memory that was shown every other change too, but none of those that it is asked for."""
    shown = ([*told, *(s.episode for s in others)] for others in _others(switches))
    return _right([deepcopy(memory).name_skills(lessons).skills for lessons in shown], nominal, switches)


def by_forest(told: Sequence[Episode], nominal: Sequence[Episode], switches: Sequence[Switch], seed: int) -> Named:
    """The same by a random forest, whose moments add up as those of the memory do."""
    forest = _forest([(e.stream, running(e)) for e in told], seed)
    return _right([partial(_skills, forest)], nominal, switches)


def by_forest_shown(
    told: Sequence[Episode], nominal: Sequence[Episode], switches: Sequence[Switch], seed: int
) -> Named:
    """By forests that were shown every other change too, but none of those that they are asked for."""
    lessons = [(e.stream, running(e)) for e in told]
    shown = (lessons + [(s.episode.stream, s.skills) for s in others] for others in _others(switches))
    return _right([partial(_skills, _forest(each, seed)) for each in shown], nominal, switches)


def _others(switches: Sequence[Switch]) -> tuple[Sequence[Switch], Sequence[Switch]]:
    """What is shown to who is asked for the first, third, … change, and to who is asked for the rest."""
    return switches[1::2], switches[::2]


def _right(
    naming: Sequence[Callable[[NDArray[np.floating[Any]]], NDArray[np.str_]]],
    nominal: Sequence[Episode],
    switches: Sequence[Switch],
) -> Named:
    """Episodes asked in turn of each that names the rows (T,) of a stream (T, D)."""
    turn = cycle(naming)
    switched = [(name(s.episode.stream) == s.skills)[s.changed :] for s, name in zip(switches, turn, strict=False)]
    return Named([name(e.stream) == e.info["skill"] for e, name in zip(nominal, cycle(naming), strict=False)], switched)


def by_place(told: Sequence[Episode], switches: Sequence[Switch]) -> Named:
    """Whether the hand is nearer to where the new skill has been than to where the old one has."""
    hand = told[0].spec.slices["hand_position"]
    known = {str(e.info["skill"]) for e in told}
    places = {k: KDTree(np.concatenate([e.stream[:, hand] for e in told if e.info["skill"] == k])) for k in known}

    def nearer(s: Switch) -> Right:
        away = [places[str(s.skills[t])].query(s.episode.stream[s.changed :, hand])[0] for t in (0, -1)]
        return np.asarray(away[1] < away[0])

    return Named([], [nearer(s) for s in switches])


def _forest(lessons: Sequence[tuple[NDArray[np.float32], NDArray[np.str_]]], seed: int) -> RandomForestClassifier:
    """That has learned from streams (T, D) and the skills (T,) that ran."""
    forest = RandomForestClassifier(TREES, min_samples_leaf=5, class_weight="balanced", random_state=seed, n_jobs=1)
    streams, skills = zip(*lessons, strict=True)
    return forest.fit(np.concatenate(streams), np.concatenate(skills))


def _skills(forest: RandomForestClassifier, stream: NDArray[np.floating[Any]]) -> NDArray[np.str_]:
    """(T,) what it names, its moments adding up."""
    total, found = np.zeros(len(forest.classes_)), []
    for moment in np.log(forest.predict_proba(stream) + SMALLEST):
        total = KEPT * total + moment
        found.append(forest.classes_[total.argmax()])
    return np.array(found)


def partings(episodes: Sequence[Episode]) -> list[int | None]:
    """The step in which each Stack leaves for the side, and each Lift as long after its grasp; None for the others."""
    grasps = [_grasp(e) if e.info["skill"] in ("Lift", "Stack") else None for e in episodes]
    parted = {
        n: grasp + _aside(e, grasp)
        for n, (e, grasp) in enumerate(zip(episodes, grasps, strict=True))
        if grasp is not None and e.info["skill"] == "Stack"
    }
    usual = round(float(np.median([step - (grasps[n] or 0) for n, step in parted.items()])))
    return [parted.get(n, None if grasp is None else grasp + usual) for n, grasp in enumerate(grasps)]


def _grasp(episode: Episode) -> int:
    """The first step in which the gripper, the last number of the command, is to close."""
    return int(np.argmax(episode.stream[:, episode.spec.motor[-1]] > 0))


def _aside(episode: Episode, grasp: int) -> int:
    """Steps from the grasp until the hand is ``ASIDE`` from it, seen from above."""
    hand = episode.stream[grasp:, episode.spec.slices["hand_position"]][:, :2]
    return int(np.argmax(np.linalg.norm(hand - hand[0], axis=1) > ASIDE))
