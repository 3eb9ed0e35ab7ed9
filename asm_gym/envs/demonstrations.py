"""Demonstrations in robosuite's and robomimic's HDF5 files: each state is put back into the simulator and sensed there.

Such a file holds, for each ``data/demo_<i>``, ``states`` (T, 1 + nq + nv) from before each of the ``actions`` (T, A),
and in the attributes of ``data`` the task and its arguments (Mandlekar et al. 2021, robomimic). Nothing is stepped, so
that a recording is read as it was made, whatever controller it was made with. What an environment senses of its hand
while it runs is one physics substep (2 ms) older than its joints; here both are of one moment.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.data.hdf5 import opened_hdf5
from asm_gym.envs.layout import Layout
from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.episode import Episode
from asm_gym.spec import MOTOR
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_number

GROUPS = ("joint", "hand", MOTOR)
"""Channel groups that a state determines. What motors and contacts do within a step is in no such file."""


LARGEST = 1e10
"""Beyond it MuJoCo itself takes a state for a bad one (mjMAXVAL)."""


class DemonstrationFile(NamedTuple):
    """What a file was recorded in.

    Attributes:
        task: a name in ``asm_gym.tasks.TASKS``.
        robots: one for each arm.
        control_freq: [Hz].
        demos: names of the demonstrations, in the order of their numbers.
    """

    task: str
    robots: tuple[str, ...]
    control_freq: int
    demos: tuple[str, ...]

    def make(self, sensor_noise: float = 1.0) -> gym.Env[Any, Any]:
        """The environment whose episodes the demonstrations become."""
        how: dict[str, Any] = {"control_freq": self.control_freq, "stream": GROUPS, "sensor_noise": sensor_noise}
        return gym.make(task_spec(self.task).id, robot=self.robots, **how)


def recorded_in(path: Path) -> DemonstrationFile:
    """Reads what a file says of itself.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged, holds no demonstration, or its task is none of ours.
    """
    with _open(path) as file:
        attributes = file["data"].attrs
        if "env_args" in attributes:  # robomimic
            about = json.loads(attributes["env_args"])
            name, kwargs = about["env_name"], about["env_kwargs"]
        else:
            name, kwargs = str(attributes["env"]), json.loads(attributes["env_info"])
        demos = sorted((n for n in file["data"] if re.fullmatch(r"demo_\d+", n)), key=lambda n: int(n[5:]))
    if not demos:
        raise ValueError(f"{path} holds no demonstration")
    control_freq = check_number(f"{path}: control_freq", kwargs.get("control_freq", 20), low=1, high=500)
    robots = kwargs.get("robots", "Panda")
    robots = (robots,) if isinstance(robots, str) else tuple(robots)
    return DemonstrationFile(task_spec(name).name, robots, int(control_freq), tuple(demos))


def replay(path: Path, recorded: DemonstrationFile, env: gym.Env[Any, Any], seed: int = 0) -> Iterator[Episode]:
    """The demonstrations as episodes, one step shorter than in the file, which has no state after the last action.

    Args:
        recorded: what the file was recorded in.
        env: made by it.
        seed: of the sensor noise.

    Raises:
        ValueError: states or actions of another size than the environment's.
    """
    inner: Any = env.unwrapped
    inner.reset(seed=seed)
    with _open(path) as file:
        for name in recorded.demos:
            demo = file["data"][name]
            states, actions = (_numbers(path, name, demo, what) for what in ("states", "actions"))
            rewards = _numbers(path, name, demo, "rewards").astype(np.float32) if "rewards" in demo else None
            _check(path, name, inner, states, actions, rewards)
            yield _episode(inner, name, states, actions.astype(np.float32), rewards, path)


def _episode(
    env: RobosuiteEnv,
    name: str,
    states: NDArray[np.float64],
    actions: NDArray[np.float32],
    rewards: NDArray[np.float32] | None,
    path: Path,
) -> Episode:
    layout = Layout(env.measured_spec, GROUPS, flat=True)
    before = np.concatenate([np.zeros_like(actions[:1]), actions[:-1]])
    rows, solved = zip(*(_sense(env, s, a) for s, a in zip(states, before, strict=True)), strict=True)
    T = len(actions) - 1
    return Episode(
        stream=np.stack([layout.stream(row) for row in rows[1:]]),
        spec=env.stream_spec,
        success=any(solved),
        actions=actions[:T],
        observations=np.stack([layout.observation(row, {}) for row in rows]),
        rewards=np.array(solved[1:], np.float32) if rewards is None else rewards[:T],
        faults=np.zeros(T, np.bool_),
        info={"terminated": False, "file": path.name, "demonstration": name},
    )


def _sense(
    env: RobosuiteEnv, state: NDArray[np.float64], action: NDArray[np.float32]
) -> tuple[NDArray[np.float64], bool]:
    """What the sensors read in ``state``, after ``action``, and whether the task is solved there."""
    simulator = env.robosuite_env.sim
    simulator.set_state_from_flattened(state)
    simulator.forward()
    env.simulation.begin_episode()  # samples the velocities, which are not in MuJoCo's state
    row = env.measure()
    row[env.measured_spec.motor] = action
    return row, bool(env.robosuite_env._check_success())


def _numbers(path: Path, name: str, demo: Any, what: str) -> NDArray[np.float64]:
    """An array of a demonstration. Raises ValueError for numbers that no simulation comes to."""
    found = np.array(demo[what])
    if found.dtype.kind not in "iuf":
        raise ValueError(f"{path}, {name}: {what} must be numbers, got {found.dtype}")
    found = found.astype(np.float64)
    wild = np.argwhere(~(np.abs(found) <= LARGEST))  # what is not a number is neither
    if len(wild):
        step = int(wild[0][0])
        value = f"{found[tuple(wild[0])]:g}"
        raise ValueError(f"{path}, {name}: {what} of step {step} must be finite and below {LARGEST:g}, got {value}")
    return found


def _check(
    path: Path,
    name: str,
    env: RobosuiteEnv,
    states: NDArray[np.float64],
    actions: NDArray[np.float64],
    rewards: NDArray[np.float32] | None,
) -> None:
    model = env.simulation.model
    size = 1 + model.nq + model.nv
    what = f"{path}, {name}"
    if states.ndim != 2 or states.shape[1] != size:
        raise ValueError(
            f"{what}: a state of {env.task.name} with {'+'.join(env.robots)} has {size} numbers, got {states.shape}; "
            "was it recorded with another robot, gripper or version?"
        )
    if actions.shape != (len(states), *(env.action_space.shape or ())):
        raise ValueError(
            f"{what}: {len(states)} states need actions of shape {env.action_space.shape}, got {actions.shape}"
        )
    if rewards is not None and rewards.shape != (len(states),):
        raise ValueError(f"{what}: {len(states)} states need as many rewards, got {rewards.shape}")
    if len(states) < 2:
        raise ValueError(f"{what}: two states at least are needed, got {len(states)}")


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    """An HDF5 file. Raises ValueError where what is looked for in it is not there."""
    try:
        with opened_hdf5(path) as file:
            yield file
    except FileNotFoundError:
        raise
    except (OSError, LookupError, TypeError, AttributeError, json.JSONDecodeError) as error:
        raise ValueError(
            f"{path} is damaged, or no file of robosuite's or robomimic's demonstrations: {error}"
        ) from error
