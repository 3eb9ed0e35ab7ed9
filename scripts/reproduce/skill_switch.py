"""Episodes in which one skill follows another: the arm sorts a can and a milk carton, one after the other."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.episodes import Episode
from asm_gym.policies.scripted.pick_place import PickPlaceExpert
from asm_gym.rollouts.parallel import environment
from asm_gym.stream import StreamSpec
from asm_gym.wrappers import StreamRecorder

NAMES = {"Can": "PickPlaceCan", "Milk": "PickPlaceMilk"}
"""Objects, and the skills of sorting them."""

HORIZON = 500
REST_S = 1.0
"""How long an episode goes on after both things are sorted [s]."""


@dataclass(frozen=True, eq=False)
class Switch:
    """An episode with a change of skill.

    Args:
        episode: its stream.
        skills: (T,) which skill ran.
        changed: the first step of the second one.
    """

    episode: Episode
    skills: NDArray[np.str_]
    changed: int

    @classmethod
    def read(cls, path: Path, spec: StreamSpec) -> Self:
        """What ``record_switch`` wrote."""
        with np.load(path, allow_pickle=False) as arrays:
            skills = arrays["skills"]
            return cls(Episode.from_stream(arrays["stream"], spec), skills, int(np.argmax(skills != skills[0])))


def record_switch(path: Path) -> Path:
    """Records the episode whose seed is the file's name, unless it is there; where a seed fails others follow."""
    seed = int(path.stem)
    for attempt in range(20 if not path.is_file() else 0):
        found = _sort_both(seed + 10_000 * attempt)
        if found is None:
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_name(f".{path.name}.unfinished.npz")
        np.savez_compressed(unfinished, stream=found[0].stream, skills=found[1])
        unfinished.replace(path)
        break
    if not path.is_file():
        raise RuntimeError(f"none of 20 attempts sorted both things with seed {seed}")
    return path


def _sort_both(seed: int) -> tuple[Episode, NDArray[np.str_]] | None:
    """The episode of ``seed`` and the skill of each step; None where either thing is not sorted."""
    env = StreamRecorder(environment("asm_gym/PickPlace-v0", (("horizon", HORIZON),)))
    simulator: Any = env.unwrapped.robosuite_env  # type: ignore[attr-defined]
    expert = PickPlaceExpert(env, seed=seed, things=tuple(NAMES))
    observation, _ = env.reset(seed=seed)
    state, skills, rest = None, [], 0
    start = np.ones(1, np.bool_)
    for _ in range(HORIZON):
        action, state = expert.predict(observation, state, start)
        start = np.zeros(1, np.bool_)
        if state.errand is None:
            break
        observation, *_ = env.step(action)
        skills.append(NAMES[state.errand.name])
        simulator = env.unwrapped.robosuite_env  # type: ignore[attr-defined]
        left = any(
            simulator.not_in_bin(expert.pose(observation, thing.name)[0], i)
            for i, thing in enumerate(simulator.objects)
            if thing.name in NAMES
        )
        rest = 0 if left else rest + 1
        if rest > round(REST_S / env.stream_spec.dt):
            break
    episode = env.finish()
    changes = sum(a != b for a, b in pairwise(skills))
    return (episode, np.array(skills)) if changes == 1 and rest else None
