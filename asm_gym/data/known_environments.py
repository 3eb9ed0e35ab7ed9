"""What actions mean in environments of other packages, by the ids under which Gymnasium knows them.

Read in the packages' sources: gymnasium-robotics 1.4.2, panda-gym 3.0.7, Meta-World 3.1.1, dm_control 1.0.50 (through
Shimmy).
"""

from __future__ import annotations

import re
from typing import NamedTuple

from asm_gym.data.action_meaning import DELTA, KEPT, TARGET, TORQUE, VELOCITY


class KnownActions(NamedTuple):
    """What the numbers of an action mean in environments whose ids fit a pattern."""

    pattern: str  # of the whole id
    means: tuple[str, ...]  # of each number; the last one of all further numbers
    source: str  # where the package says so


KNOWN_ACTIONS = (
    KnownActions(
        r"Fetch(Reach|Push|Slide|PickAndPlace).*",
        (DELTA,),
        "gymnasium_robotics/envs/fetch: displacements of the hand and of the fingers",
    ),
    KnownActions(
        r"FrankaKitchen.*",
        (VELOCITY,),
        "gymnasium_robotics/envs/franka_kitchen/franka_env.py, _ctrl_velocity_limits",
    ),
    KnownActions(
        r"AdroitHand.*",
        (TARGET,),
        "gymnasium_robotics/envs/adroit_hand: absolute angles of the joints",
    ),
    KnownActions(
        r"Hand(Reach|Manipulate).*",
        (TARGET,),
        "gymnasium_robotics/envs/shadow_dexterous_hand/hand_env.py, absolute control",
    ),
    KnownActions(
        r"(Point|Ant)Maze.*",
        (TORQUE,),
        "gymnasium_robotics/envs/maze: forces on the ball, torques of the legs",
    ),
    KnownActions(
        r"Panda(Reach|Push|Slide|PickAndPlace|Stack|Flip)(Joints)?(Dense)?-v\d+",
        (DELTA,),
        "panda_gym/envs/robots/panda.py, set_action: displacements of hand or joints, and fingers",
    ),
    KnownActions(
        r"Meta-World/.*",
        (DELTA, DELTA, DELTA, KEPT),
        "metaworld/sawyer_xyz_env.py, step: displacements of the hand; the effort of the fingers",
    ),
    KnownActions(
        r"dm_control/(reach|lift|place|reassemble|stack)_.*",
        (VELOCITY,),
        "dm_control/entities/manipulators/kinova: velocity actuators of arm and hand",
    ),
    KnownActions(
        r"dm_control/(manipulator|stacker|reacher|finger)-.*",
        (TORQUE,),
        "dm_control/suite/manipulator.xml and others: motors",
    ),
)


def known_means(env_id: str, size: int) -> tuple[str, ...] | None:
    """Return what the ``size`` numbers of an action mean in an environment; None where it is not known.

    Args:
        env_id: Gymnasium's id, with or without the module that registers it.
        size: A, how many numbers an action has.
    """
    name = env_id.rsplit(":", 1)[-1]
    for known in KNOWN_ACTIONS:
        if re.fullmatch(known.pattern, name):
            means = known.means + (known.means[-1],) * size
            return means[:size]
    return None
