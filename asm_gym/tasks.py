"""The robosuite tasks that are registered as Gymnasium environments, one row each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from asm_gym.extras import needed_for
from asm_gym.registries import Registry
from asm_gym.validation import check_choice, check_number, check_text

# arms that the tasks are tested with
ROBOTS = ("Panda", "Sawyer", "UR5e", "Kinova3", "IIWA", "Jaco")


@dataclass(frozen=True)
class TaskSpec:
    """One task."""

    name: str  # robosuite's; the Gymnasium id is ``asm_gym/<name>-v0``
    horizon: int  # control steps before an episode is truncated, at the default 20 Hz
    success: str  # meaning of ``info["success"]``
    arms: int = 1  # number of robots
    # of its objects, when robosuite loads the model; see ``asm_gym.envs.lift_cube``
    draws_shapes: bool = False

    @property
    def id(self) -> str:
        return f"asm_gym/{self.name}-v0"


ON_PEG = "its nut is around its peg, and the hand has let go of it"
IN_BIN = "its object is in its bin, and the hand has left it"

TABLE = (
    TaskSpec("Lift", 100, "the cube is more than 4 cm above the table", draws_shapes=True),
    TaskSpec("Stack", 200, "the red cube lies on the green one, and the hand has let go of it"),
    TaskSpec("Door", 200, "the door stands open by more than 0.3 rad"),
    TaskSpec("Wipe", 400, "every marker on the table is wiped off"),
    TaskSpec("ToolHang", 700, "the frame stands in its base and the tool hangs on it"),
    TaskSpec(
        "NutAssembly", 700, "both nuts are around their pegs, and the hand has let go of them"
    ),
    TaskSpec("NutAssemblySingle", 350, ON_PEG),
    TaskSpec("NutAssemblySquare", 350, ON_PEG),
    TaskSpec("NutAssemblyRound", 350, ON_PEG),
    TaskSpec("PickPlace", 1000, "all four objects are in their bins, and the hand has left them"),
    TaskSpec("PickPlaceSingle", 300, IN_BIN),
    TaskSpec("PickPlaceCan", 300, IN_BIN),
    TaskSpec("PickPlaceMilk", 300, IN_BIN),
    TaskSpec("PickPlaceBread", 300, IN_BIN),
    TaskSpec("PickPlaceCereal", 300, IN_BIN),
    TaskSpec("TwoArmLift", 200, "the pot is more than 10 cm above the table", arms=2),
    TaskSpec(
        "TwoArmPegInHole",
        300,
        "the peg is in the hole and aligned with it",
        arms=2,
        draws_shapes=True,
    ),
    TaskSpec(
        "TwoArmHandover",
        400,
        "the second arm alone holds the hammer by its handle, off the table",
        arms=2,
        draws_shapes=True,
    ),
    TaskSpec(
        "TwoArmTransport",
        700,
        "the payload is in the target bin and the trash in the trash bin",
        arms=2,
        draws_shapes=True,
    ),
)
TASKS = {task.name: task for task in TABLE}

# tasks of ``register_task``, by name
OWN: Registry[EnvSpec] = Registry("task", "asm_gym.tasks:OWN")


def register_task(
    name: str,
    make: Callable[..., gym.Env[Any, Any]] | type[Any] | str,
    horizon: int,
    **arguments: Any,
) -> None:
    """Register an environment as a task, in this process and its workers; raise ValueError if the name is taken.

    Args:
        name: the Gymnasium id is ``asm_gym/<name>-v0``.
        make: a class of environments with Box spaces, a function that makes one, or its ``module:name``. The
            sensors of a robosuite class become channels of the stream.
        horizon: control steps before an episode is truncated.
        arguments: of the environment: ``robots="Panda"``, ``controller_configs=…``.

    Example:
        >>> import gymnasium as gym
        >>> from asm_gym import register_task
        >>> register_task("Waving", "asm_gym.synthetic_arm:SyntheticArm", horizon=50)
        >>> gym.make("asm_gym/Waving-v0").spec.max_episode_steps
        50
    """
    if name in TASKS:
        raise ValueError(f"there is a task {name!r} already")
    check_number("horizon", horizon, low=1, whole=True)
    entry: Any = make
    if _is_of_robosuite(make):
        entry = "asm_gym.envs.user_environment:UserEnvironment"
        arguments = {"make": make} | arguments
    spec = EnvSpec(
        f"asm_gym/{name}-v0", entry_point=entry, max_episode_steps=horizon, kwargs=arguments
    )
    OWN.register(name, spec)
    gym.registry[spec.id] = spec


def _is_of_robosuite(make: object) -> bool:
    """Return whether it is a class of robosuite, or of the user's own, derived from one."""
    bases = getattr(make, "__mro__", ())
    return any(base.__module__.startswith("robosuite.") for base in bases)


def task(name: str) -> TaskSpec:
    """Return the row of a name or Gymnasium id. Raises ValueError, listing the tasks, where there is none."""
    short = check_text("task", name).removeprefix("asm_gym/").removesuffix("-v0")
    check_choice("task", short, (*TASKS, *OWN))
    return TASKS[short]


def env_id(name: str) -> str:
    """Return the Gymnasium id of a task or any environment. Raises ValueError or ImportError where it is unknown."""
    if name in OWN:
        gym.registry[OWN[name].id] = OWN[name]  # which a worker has not done yet
        return OWN[name].id
    try:
        env_spec(check_text("task", name))
    except gym.error.Error:
        return task(name).id
    return name


def env_spec(name: str) -> EnvSpec:
    """Return Gymnasium's entry of an id, ``module:id`` included."""
    module, colon, identifier = name.rpartition(":")
    if colon:
        with needed_for(name):
            import_module(module)
    return gym.spec(identifier)
