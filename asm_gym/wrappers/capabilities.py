"""What a guard asks of an environment that it does not know, all of it in ``robots_of``.

Each attribute belongs to the environment, or to a wrapper inside the guard. The members of a
vector environment are of one kind; they have a capability if all of them have its attribute.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.data.action_meaning import ActionMeaning, ActionMeans
from asm_gym.data.known_environments import known_means
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.detection.kinematics import Chain
from asm_gym.guard.robot_facts import RobotFacts, TurningAction
from asm_gym.policies.hold import Staying, gripper_columns, nearest_to_zero, staying, why_changed
from asm_gym.spec import Channel, StreamSpec
from asm_gym.wrappers.env_attributes import AnyEnv, EnvAttributes
from asm_gym.wrappers.observation_map import ObservationMap, ObservationPart, parts_of

# Controllers whose actions are changes, of pose or of joint angles.
DELTAS = ("OSC_POSE", "JOINT_POSITION")


def robots_of(
    env: AnyEnv,
    spec: StreamSpec,
    dt: float,
    recorded: ActionMeaning | None = None,
    action_means: ActionMeans | None = None,
) -> tuple[RobotFacts, ObservationMap | None]:
    """Return the facts of an environment's robots, and where their streams are observed.

    Args:
        env: an environment, or a vector environment.
        spec: of the streams.
        dt: control period [s].
        recorded: what recorded episodes show of the meaning of their actions.
        action_means: what the user says of it.

    Raises:
        TypeError: members of a vector environment cannot be asked for attributes.
        ValueError: ``action_means`` does not fit the actions.
    """
    attributes = EnvAttributes(env)
    space = attributes.action_space
    if not isinstance(space, gym.spaces.Box):
        no_action = np.zeros(0, np.float32)
        facts = RobotFacts(count=1, low=no_action, high=no_action, rest=no_action, dt=dt)
        return facts, None

    resting = resting_of(attributes, space, recorded, action_means)
    refused = refused_reflexes(attributes, resting)
    observation_map = None
    observed = None
    try:
        observation_map = observation_map_of(attributes, spec)
        observed = observation_map.observed
    except ValueError as error:
        refused["complete"] = str(error)

    size = resting.action.size
    facts = RobotFacts(
        count=attributes.count,
        low=np.float32(space.low).ravel(),
        high=np.float32(space.high).ravel(),
        rest=resting.action.ravel(),
        meaning=resting.meaning,
        brakes=can_brake(attributes),
        grip=gripper_columns(attributes.first("gripper_actions", ()), size),
        dt=dt,
        task=getattr(attributes.first("task"), "name", ""),
        chains=hand_chains(attributes),
        felt_channels=felt_channels(attributes),
        contact_limits=attributes.first("usual_contact_limits") or ContactLimits(),
        limits_contact=limits_contact(attributes),
        observed=observed,
        turning_action=turning_action(attributes),
        efference=efference_columns(attributes, spec, size),
        refused=refused,
    )
    return facts, observation_map


def controller_of(attributes: EnvAttributes) -> str:
    """Return the name of the arms' controller: ``controller``; empty without it."""
    return str(attributes.first("controller", ""))


def has_stream(attributes: EnvAttributes) -> bool:
    """Return whether there is a stream: ``stream_spec``.

    Without it, observation and action are the stream.
    """
    return attributes.has("stream_spec")


def can_brake(attributes: EnvAttributes) -> bool:
    """Return whether robots can be braked beneath their controllers: ``HoldsItself``.

    They stay in all steps that a wrapper makes of one. Without ``holding`` and
    ``keeps_holding``, an action has to make them stay.
    """
    return attributes.has("holding") and attributes.has("keeps_holding")


def resting_of(
    attributes: EnvAttributes,
    space: gym.spaces.Box,
    recorded: ActionMeaning | None,
    action_means: ActionMeans | None,
) -> Staying:
    """Return which actions make the robots stay.

    Robots with the attribute ``holding`` stay whatever the action is.

    Args:
        attributes: of the environment.
        space: the action space of one robot.
        recorded: what recorded episodes show of the meaning of actions, if nobody declares it.
        action_means: what the user declares; by default ``action_means`` of the environment.

    Raises:
        ValueError: ``action_means`` does not fit the actions.
    """
    zero = nearest_to_zero(space)
    if recorded is not None and len(recorded.means) != zero.size:
        recorded = None
    declared = declared_meaning(attributes, zero.size, recorded, action_means)
    if attributes.has("holding"):
        return Staying(zero)
    try:
        return staying(attributes.env, space, declared, recorded)
    except ValueError as error:
        return Staying(zero, refused=str(error))


def declared_meaning(
    attributes: EnvAttributes,
    size: int,
    recorded: ActionMeaning | None,
    action_means: ActionMeans | None,
) -> ActionMeaning | None:
    """Return what actions mean: ``action_means``, or what is known of the environment's id; None without either.

    Args:
        attributes: of the environment.
        size: A, how many numbers an action has.
        recorded: what recorded episodes show, which tells the senses of targets.
        action_means: what the user declares, instead of the attribute.

    Raises:
        ValueError: an unknown meaning, or another number of them.
    """
    if action_means is None:
        action_means = attributes.first("action_means")
    if action_means is not None:
        return ActionMeaning.declared(action_means, size, recorded)

    spec = attributes.first("spec")
    known = known_means(getattr(spec, "id", ""), size)
    if known is None:
        return None
    return replace(recorded or ActionMeaning.unknown((size,)), means=known)


def missing_meaning(env: gym.Env[Any, Any]) -> str:
    """Return that nothing tells what the actions of an environment mean, and how to say it; empty where it is known.

    Recorded episodes may show it, but random or still ones do not.
    """
    attributes = EnvAttributes(env)
    space = attributes.action_space
    if not isinstance(space, gym.spaces.Box) or attributes.has("holding"):
        return ""
    size = int(np.prod(space.shape))
    if declared_meaning(attributes, size, None, None) is not None:
        return ""
    return (
        f"what the actions of {env.unwrapped} mean is not known, so hold may be refused: "
        'set its attribute action_means, or NeuralASMSafety(..., action_means=...), to "delta", '
        '"target", "velocity" or "torque", one for all numbers or one for each'
    )


def hand_chains(attributes: EnvAttributes) -> tuple[tuple[Chain, ...], ...]:
    """Return the kinematics by arm, then by environment: ``hand_chains``; none without it."""
    by_environment = attributes.ask("hand_chains")
    return tuple(zip(*by_environment, strict=True))


def felt_channels(attributes: EnvAttributes) -> tuple[Channel, ...]:
    """Return what the arms feel in physics substeps: ``felt_channels``; nothing without it."""
    return attributes.first("felt_channels", ())


def limits_contact(attributes: EnvAttributes) -> bool:
    """Return whether each physics substep compares what is felt with ``contact_limits``.

    Without that attribute, or ``felt_channels``, nothing reacts within a control step.
    """
    return bool(felt_channels(attributes)) and attributes.has("contact_limits")


def efference_columns(
    attributes: EnvAttributes,
    spec: StreamSpec,
    size: int,
) -> NDArray[np.intp] | None:
    """Return the columns of the stream with the executed action, if contact limits may slow it.

    Returns:
        (A,) columns of the stream's action; None where a wrapper inside changes actions, or
        actions have another ``size``.
    """
    if not (limits_contact(attributes) and has_stream(attributes)):
        return None
    if why_changed(attributes.env, "a reflex") or len(spec.motor) != size:
        return None
    return spec.motor


def turning_action(attributes: EnvAttributes) -> TurningAction:
    """Return the action that turns the joints of a robot: the method ``action_for``, of deltas."""
    return lambda robot, turns: attributes.call("action_for", turns)[robot]


def refused_reflexes(attributes: EnvAttributes, resting: Staying) -> dict[str, str]:
    """Return why robots cannot do a reflex, by its name.

    Hold needs a brake, or an action that makes the robots stay. Retract and comply need actions
    that are changes, by the controller's name. No wrapper inside may change actions.
    """
    refused = {}
    changed = why_changed(attributes.env, "a reflex")
    if changed:
        refused = {"retract": changed, "comply": changed}
        if has_stream(attributes):
            refused["recall"] = changed

    controller = controller_of(attributes)
    if controller not in DELTAS:
        for name in ("retract", "comply"):
            refused[name] = (
                f"{name} needs an environment whose controller is {' or '.join(DELTAS)}, "
                f"got {controller or None}: "
                "use hold with a safe_action of your own, or name any policy"
            )
    if resting.refused:
        refused["hold"] = resting.refused
    return refused


def observation_map_of(attributes: EnvAttributes, spec: StreamSpec) -> ObservationMap:
    """Return where the stream stands in observations.

    The attribute ``observation_layout`` has the sizes of the observation's channels in order, by
    name, and ``laid_out_space`` the space of that layout.

    Raises:
        ValueError: there is no layout, or a wrapper inside has changed the observation.
    """
    space = attributes.observation_space
    if not has_stream(attributes) and isinstance(space, gym.spaces.Box):
        whole = ObservationPart("", space, spec.sensory, np.arange(len(spec.sensory)))
        return ObservationMap([whole], spec.size)

    layout = attributes.first("observation_layout")
    if not has_stream(attributes) or layout is None:
        raise ValueError("the environment does not say where its stream stands in its observation")
    innermost_space = None
    if not attributes.is_vector:
        innermost_space = attributes.env.unwrapped.observation_space
    own_space = attributes.first("laid_out_space", innermost_space)
    if own_space is not None and space != own_space:
        raise ValueError(f"a wrapper inside has changed the observation, which was {own_space}")
    return ObservationMap(parts_of(layout, spec, space), spec.size)
