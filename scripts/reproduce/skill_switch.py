"""Episodes in which one skill follows another: the arm sorts a can and a milk carton, one after the other."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.episode import Episode, load_episode, save_episode
from asm_gym.monitors.model import running
from asm_gym.policies.scripted.pick_place import PickPlaceExpert
from asm_gym.rollouts.staging import environment
from asm_gym.scripts.reproduce import kit
from asm_gym.spec import StreamSpec
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
        episode = load_episode(path)
        spec.require(episode.spec, str(path))
        return cls(episode, running(episode), int(episode.info["changed"]))


def record_switch(path: Path) -> Path:
    """Records the episode whose seed is the file's name, unless it is there; where a seed fails others follow."""
    seed = int(path.stem)
    for attempt in range(20 if not path.is_file() else 0):
        found = _sort_both(seed + 10_000 * attempt)
        if found is None:
            continue
        save_episode(path, found)
        break
    if not path.is_file():
        raise RuntimeError(f"none of 20 attempts sorted both things with seed {seed}")
    return path


def switches(config: kit.Config, count: int, kind: str = "switches", first: int = 0) -> list[Path]:
    """So many of them in the folder of a study, recorded where they are not there yet; ``first`` is added to seeds."""
    wanted = [config.out / kind / f"{config.seed + first + n}.npz" for n in range(count)]
    return kit.each("changing skills", record_switch, wanted, config)


def _sort_both(seed: int) -> Episode | None:
    """The episode of ``seed``, with its two skills and the step of the change; None where a thing is not sorted."""
    env = StreamRecorder(environment("asm_gym/PickPlace-v0", (("horizon", HORIZON),)))
    simulator: Any = env.unwrapped.robosuite_env  # type: ignore[attr-defined]
    expert = PickPlaceExpert(env, seed=seed, things=tuple(NAMES))
    observation, _ = env.reset(seed=seed)
    state, rest = None, 0
    skills: list[str] = []
    forces: list[float] = []
    start = np.ones(1, np.bool_)
    for _ in range(HORIZON):
        action, state = expert.predict(observation, state, start)
        start = np.zeros(1, np.bool_)
        if state.task is None:
            break
        observation, *_, info = env.step(action)
        skills.append(NAMES[state.task.name])
        forces.append(info["contact_force"])
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
    changes = [t for t, (a, b) in enumerate(pairwise(skills), 1) if a != b]
    if len(changes) != 1 or not rest:
        return None
    told = {"skills": [skills[0], skills[-1]], "changed": changes[0]}
    return replace(episode, contact_force=np.asarray(forces, np.float32), info={**episode.info, **told})
