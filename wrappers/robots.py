"""What a guard has to know of the robots in an environment, or in many side by side."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorActionWrapper, VectorEnv, VectorWrapper
from numpy.typing import NDArray

from asm_gym.data.action_meaning import ACTIONS, DELTA, TARGET, TORQUE, UNKNOWN, VELOCITY, ActionMeaning, ActionMeans
from asm_gym.guard.checks import LOG
from asm_gym.guard.robots import Robots
from asm_gym.guard.severity import nothing_felt
from asm_gym.monitors import NeuralASM, pretrained_for
from asm_gym.policies.base import Policy
from asm_gym.policies.reflexes import Hold, changed_by, nearest_to_rest, no_rest, outside, resting_action
from asm_gym.spec import StreamSpec, control_period
from asm_gym.validation import check_number, short_repr
from asm_gym.wrappers.observation_map import ObservationMap

DELTAS = ("OSC_POSE", "JOINT_POSITION")  # controllers whose actions are changes, of pose or of joint angles

AnyEnv = gym.Env[Any, Any] | VectorEnv[Any, Any, Any]


class Members:
    """The environments of a vector environment, or a single one, which can be asked what they are."""

    def __init__(self, env: AnyEnv) -> None:
        self.many = isinstance(env, VectorEnv)
        self.count = askable(env).num_envs if isinstance(env, VectorEnv) else 1
        self._env: Any = env

    def ask(self, name: str) -> tuple[Any, ...] | None:
        """Return an attribute of each; None where one lacks it."""
        # Asked first, for a worker process in which an attribute is missing is ended by Gymnasium.
        there = self.call("has_wrapper_attr", name)
        return self.call("get_wrapper_attr", name) if all(there) else None

    def first(self, name: str, otherwise: Any = None) -> Any:
        """Return an attribute of the first."""
        return (self.ask(name) or (otherwise,))[0]

    def call(self, name: str, argument: Any) -> tuple[Any, ...]:
        """Return what a method of each returns."""
        if self.many:
            return tuple(self._env.unwrapped.call(name, argument))
        owner = self._env if hasattr(self._env, name) else self._env.unwrapped
        return (getattr(owner, name)(argument),)


def askable(envs: VectorEnv[Any, Any, Any]) -> Any:
    """Return a vector environment whose members can be asked what they are. Raises TypeError where they cannot."""
    inner: Any = envs.unwrapped
    if not (hasattr(inner, "call") and hasattr(inner, "set_attr")):
        raise TypeError(
            f"{inner} cannot be asked what its environments are: make it with SyncVectorEnv or AsyncVectorEnv"
        )
    return inner


def robots_of(
    env: AnyEnv, spec: StreamSpec, found: ActionMeaning | None = None, told: ActionMeans | None = None
) -> tuple[Robots, ObservationMap | None]:
    """Return the robots of an environment or a vector environment, and where their streams stand in observations.

    Args:
        found: what recorded episodes tell of the meaning of their actions.
        told: what the user says of it.

    Raises:
        TypeError: members of a vector environment cannot be asked what they are.
        ValueError: ``told`` does not fit the actions.
    """
    members, many = Members(env), isinstance(env, VectorEnv)
    actions: Any = env.single_action_space if isinstance(env, VectorEnv) else env.action_space
    observations = env.single_observation_space if isinstance(env, VectorEnv) else env.observation_space
    dt = float(members.first("dt") or control_period(env)) if many else control_period(env)  # type: ignore[arg-type]
    if not isinstance(actions, gym.spaces.Box):
        none = np.zeros(0, np.float32)
        return Robots(1, none, none, none, dt=dt), None
    first = members.first
    changed, holds_itself = _changed(env), members.ask("holding") is not None
    rest, refused, meaning = nearest_to_rest(actions), {}, None
    told = first("action_means") if told is None else told
    if found is not None and len(found.means) != rest.size:
        found = None
    given = None if told is None else ActionMeaning.told(told, rest.size, found)
    try:
        if not holds_itself:
            meaning = _meaning(env, given, found)
            if meaning is None or given is not None:
                rest = _resting_action(env, actions, changed, meaning)
    except ValueError as error:  # no action is known to rest
        refused["hold"], meaning = str(error), None
    grip = np.asarray(first("gripper_actions", ()), np.intp)
    if grip.size and grip.max() >= rest.size:  # a wrapper inside takes other numbers
        grip = grip[:0]
    has_stream, controller = members.ask("stream_spec") is not None, first("controller")
    for name in ("retract", "comply"):
        if controller not in DELTAS:
            refused[name] = (
                f"{name} needs an environment whose controller is {' or '.join(DELTAS)}, got {controller}: "
                "use hold with a safe_action of your own, or name any policy"
            )
        elif changed:
            refused[name] = changed
    if changed and has_stream:
        refused["recall"] = changed
    try:
        own = first("laid_out_space", None if many else env.unwrapped.observation_space)
        layout = first("observation_layout"), own
        places = ObservationMap(observations, spec, has_stream, *layout)
    except ValueError as error:
        places, refused["complete"] = None, str(error)
    felt, chains = first("felt_channels", ()), members.ask("hand_chains") or ()
    limits_contact = bool(felt) and members.ask("contact_limits") is not None
    efference = spec.motor if limits_contact and has_stream and not changed and len(spec.motor) == rest.size else None
    robots = Robots(
        count=members.count,
        low=np.float32(actions.low).ravel(),
        high=np.float32(actions.high).ravel(),
        rest=rest.ravel(),
        rests="hold" not in refused,
        meaning=meaning,
        brakes=holds_itself and members.ask("keeps_holding") is not None,
        grip=grip,
        dt=dt,
        chains=tuple(zip(*chains, strict=True)),
        felt_channels=felt,
        limits_contact=limits_contact,
        efference=efference,
        read=None if places is None else places.shown,
        turn=(lambda i, turns: members.call("action_for", turns)[i]) if controller in DELTAS else None,
        refused=refused,
    )
    return robots, places


def _changed(env: AnyEnv) -> str:
    """Return why no reflex can know what reaches the robots; empty where it can."""
    if not isinstance(env, VectorEnv):
        wrapper = changed_by(env)
        return "" if wrapper is None else outside(wrapper, "a reflex", "NeuralASMSafety")
    changed, layer = "", env
    while isinstance(layer, VectorWrapper):
        if isinstance(layer, VectorActionWrapper):
            changed = outside(layer, "a reflex", "VectorNeuralASMSafety")
        layer = layer.env
    return changed


def _meaning(env: AnyEnv, told: ActionMeaning | None, found: ActionMeaning | None) -> ActionMeaning | None:
    """Return what the actions mean by which a robot stays; None where a zero action makes it stay.

    Raises:
        ValueError: nothing tells what some of them mean, or they are torques.
    """
    meaning = found if told is None else told
    if meaning is None or UNKNOWN in meaning.means:
        unknown = (
            "" if meaning is None else f"numbers {', '.join(map(str, np.flatnonzero(_are(meaning, UNKNOWN))))} of "
        )
        raise ValueError(
            f"nothing tells what {unknown}the actions of {env.unwrapped} mean, so that no hold is known: say it by "
            'action_means="delta", "target" or "velocity", or one of them for each number; or use Hold(env, '
            'safe_action=...), another policy, on_alarm="terminate" or "monitor"'
        )
    if TORQUE in meaning.means:
        raise ValueError(
            f"actions of {env.unwrapped} are torques, and none of them makes an arm stay: use Hold(env, "
            'safe_action=...), another policy, on_alarm="terminate" or "monitor"'
        )
    if told is not None and found is not None and (wrong := _contradicted(told, found)):
        warnings.warn(f"action_means contradicts the recorded episodes: {wrong}", stacklevel=6)
    return None if told is not None and set(told.means) <= {DELTA, VELOCITY} else meaning


def _are(meaning: ActionMeaning, name: str) -> NDArray[np.bool_]:
    return np.array([own == name for own in meaning.means])


def _contradicted(told: ActionMeaning, found: ActionMeaning) -> str:
    """Return in which numbers of the action (A,) recorded episodes contradict what was told."""
    pairs = enumerate(zip(told.means, found.means, strict=True))
    both = ((k, own, was) for k, (own, was) in pairs if was in (TARGET, DELTA, VELOCITY) and TARGET in (own, was))
    return "; ".join(f"number {k} is told to be a {own}, and moves as a {was}" for k, own, was in both if own != was)


def found_in(monitor: Any) -> ActionMeaning | None:
    """Return what a monitor has found in the episodes that it was fitted on."""
    found = getattr(monitor, "about", {}).get(ACTIONS)
    return None if found is None else ActionMeaning.from_json(found)


def _resting_action(
    env: AnyEnv, actions: gym.spaces.Box, changed: str, meaning: ActionMeaning | None
) -> NDArray[np.float32]:
    """Return the action (A,) for which robots that do not hold by themselves stay; of targets it does not count.

    Raises:
        ValueError: there is none.
    """
    if not isinstance(env, VectorEnv) and meaning is None:
        return resting_action(env)
    rest = nearest_to_rest(actions)
    moved = rest.ravel() if meaning is None else rest.ravel()[~_are(meaning, TARGET)]
    if changed or np.any(moved):
        raise ValueError(changed or no_rest(actions))
    return rest


def felt_by(robots: Robots, infos: dict[str, Any], there: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
    """Return what environments say in ``info`` of what their arms felt in a step, of those that are ``there`` (n,)."""
    numbers = nothing_felt(robots.count, robots.felt_size)
    if "contact_load" not in infos:
        return numbers
    numbers[:, 0], numbers[:, 1] = infos["contact_load"], infos.get("contact_left_s", np.nan)
    if "contact_felt" in infos:
        numbers[:, 2:] = infos["contact_felt"]
    if there is not None:
        numbers[~there] = np.nan
    return numbers


def body_memory(env: AnyEnv, watched: StreamSpec) -> NeuralASM:
    """Return the shipped memory of the robot in ``env``, or in all its members. Raises ValueError where none fits."""
    memory = NeuralASM.pretrained(pretrained_for(watched, str(Members(env).first("controller", ""))))
    LOG.info("watching %s with %r", env.unwrapped, memory)
    return memory


def policy_for(on_alarm: Any, env: AnyEnv) -> Policy:
    """Return the user's own policy that acts during an alarm in ``env``, or in all its members.

    For a single environment, a class or a function makes one. Raises ValueError where it is no policy, or a reflex that
    was made for another environment, whose arm it would move.
    """
    made, many = on_alarm, isinstance(env, VectorEnv)
    takes = (
        "a name or one policy with a predict() that all environments share"
        if many
        else ("a name, have a predict(), or make such a policy")
    )
    try:
        if not many and callable(on_alarm) and (isinstance(on_alarm, type) or not hasattr(on_alarm, "predict")):
            made = on_alarm(env)
    except TypeError as error:
        raise ValueError(f"on_alarm must be {takes}, got {short_repr(on_alarm)}: {error}") from error
    if isinstance(made, type) or not callable(getattr(made, "predict", None)):
        raise ValueError(f"on_alarm must be {takes}, got {short_repr(made)}")
    name = type(made).__name__
    bound = isinstance(made, Hold) and not made.explicit  # to one environment
    if many and bound:
        raise ValueError(f"one {name} cannot act in several environments: give its name instead")
    if bound and isinstance(made, Hold) and made.env.unwrapped is not env.unwrapped:
        raise ValueError(
            f"this {name} was made for another environment, and would move that: give the class, on_alarm={name}, "
            "or a function of the environment that makes it"
        )
    policy: Policy = made
    return policy


def sensing_within_steps(env: gym.Env[Any, Any], rate: int) -> Any:
    """Return the environment underneath. Raises ValueError where its stream cannot run at ``rate`` [Hz]."""
    check_number("monitor_freq", rate, low=1, whole=True)
    inner: Any = env.unwrapped
    if not hasattr(inner, "stream_spec_at"):
        raise ValueError(f"monitor_freq needs an environment of asm_gym, which {inner} is not: leave it out")
    wrapper = env
    while isinstance(wrapper, gym.Wrapper):
        if isinstance(wrapper, gym.ActionWrapper) and rate > 1 / control_period(env):
            raise ValueError(
                f"{type(wrapper).__name__} changes actions, and a reflex within a step would pass it by: put it outside"
            )
        wrapper = wrapper.env
    return inner
