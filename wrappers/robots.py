"""What a guard has to know of the robots in an environment, or in many side by side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorActionWrapper, VectorEnv, VectorWrapper
from numpy.typing import NDArray

from asm_gym.guard.checks import LOG
from asm_gym.guard.robots import Robots
from asm_gym.guard.severity import nothing_felt
from asm_gym.monitors import NeuralASM, pretrained_for
from asm_gym.policies.base import Policy
from asm_gym.policies.reflexes import Hold, changed_by, nearest_to_rest, no_rest, outside, resting_action
from asm_gym.spec import StreamSpec, control_period
from asm_gym.validation import check_number, short_repr
from asm_gym.wrappers.observation_map import ObservationMap

DELTAS = ("OSC_POSE", "JOINT_POSITION")
"""Controllers whose actions are changes, of pose or of joint angles."""

Values = tuple[Any, ...] | None


def robots_of(env: gym.Env[Any, Any], spec: StreamSpec) -> tuple[Robots, ObservationMap | None]:
    """Return what is known of the robot in an environment, wrapped or not, and where its stream stands in what it
    observes; None where that is not known."""
    inner: Any = env.unwrapped
    if not isinstance(env.action_space, gym.spaces.Box):
        none = np.zeros(0, np.float32)
        return Robots(1, none, none, none, dt=control_period(env)), None

    def ask(name: str) -> Values:
        if name == "laid_out_space":
            return (getattr(inner, name, inner.observation_space),)
        if name == "stream_spec":
            return (env.get_wrapper_attr(name),) if env.has_wrapper_attr(name) else None
        return (getattr(inner, name),) if hasattr(inner, name) else None

    def call(name: str, argument: Any) -> tuple[Any, ...]:
        return (getattr(inner, name)(argument),)

    wrapper = changed_by(env)
    changed = "" if wrapper is None else outside(wrapper, "a reflex", "NeuralASMSafety")
    rest, refused = nearest_to_rest(env.action_space), {}
    if ask("holding") is None:
        try:
            rest = resting_action(env)
        except ValueError as error:  # no action is known to rest
            refused["hold"] = str(error)
    asked = _Asked(1, ask, call, env.observation_space, env.action_space, control_period(env))
    return _known(asked, spec, rest, changed, refused)


def robots_of_many(envs: VectorEnv[Any, Any, Any], spec: StreamSpec) -> tuple[Robots, ObservationMap | None]:
    """Return what is known of the robots in a vector environment, and where their streams stand in what they observe.

    Raises:
        TypeError: its members cannot be asked what they are.
    """
    members = askable(envs)

    def ask(name: str) -> Values:
        # Asked first, for a worker process in which an attribute is missing is ended by Gymnasium.
        there = all(members.call("has_wrapper_attr", name))
        return tuple(members.call("get_wrapper_attr", name)) if there else None

    space: Any = envs.single_action_space
    changed, wrapper = "", envs
    while isinstance(wrapper, VectorWrapper):
        if isinstance(wrapper, VectorActionWrapper):
            changed = outside(wrapper, "a reflex", "VectorNeuralASMSafety")
        wrapper = wrapper.env
    rest, refused = nearest_to_rest(space), {}
    if ask("holding") is None and (changed or np.any(rest)):
        refused["hold"] = changed or no_rest(space)
    dt = ask("dt")
    period = control_period(envs) if dt is None else float(dt[0])  # type: ignore[arg-type]
    asked = _Asked(envs.num_envs, ask, members.call, envs.single_observation_space, space, period)
    return _known(asked, spec, rest, changed, refused)


def askable(envs: VectorEnv[Any, Any, Any]) -> Any:
    """Return a vector environment whose members can be asked what they are. Raises TypeError where they cannot."""
    inner: Any = envs.unwrapped
    if not (hasattr(inner, "call") and hasattr(inner, "set_attr")):
        raise TypeError(
            f"{inner} cannot be asked what its environments are: make it with SyncVectorEnv or AsyncVectorEnv"
        )
    return inner


@dataclass(frozen=True)
class _Asked:
    """n environments that can be asked."""

    count: int
    ask: Callable[[str], Values]
    call: Callable[..., tuple[Any, ...]]
    observations: gym.spaces.Space[Any]
    actions: gym.spaces.Box
    dt: float


def _known(
    envs: _Asked, spec: StreamSpec, rest: NDArray[np.float32], changed: str, refused: dict[str, str]
) -> tuple[Robots, ObservationMap | None]:
    """Return what environments say of their robots.

    Args:
        rest: (A,) the action for which they stay.
        changed: why no reflex can know what reaches the robots; empty where it can.
        refused: the reflexes that they cannot do, and why; more are added.
    """
    ask, call = envs.ask, envs.call

    def first(name: str, otherwise: Any = None) -> Any:
        return (ask(name) or (otherwise,))[0]

    grip = np.asarray(first("gripper_actions", ()), np.intp)
    if grip.size and grip.max() >= rest.size:  # a wrapper inside takes other numbers
        grip = grip[:0]
    has_stream, controller = ask("stream_spec") is not None, first("controller")
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
        places = ObservationMap(
            envs.observations, spec, has_stream, first("observation_layout"), first("laid_out_space")
        )
    except ValueError as error:
        places, refused["complete"] = None, str(error)
    felt, chains = first("felt_channels", ()), ask("hand_chains") or ()
    robots = Robots(
        count=envs.count,
        low=np.float32(envs.actions.low).ravel(),
        high=np.float32(envs.actions.high).ravel(),
        rest=rest.ravel(),
        rests="hold" not in refused,
        brakes=ask("holding") is not None and ask("keeps_holding") is not None,
        grip=grip,
        dt=envs.dt,
        chains=tuple(zip(*chains, strict=True)),
        felt_channels=felt,
        limits_contact=bool(felt) and ask("contact_limits") is not None,
        read=None if places is None else places.shown,
        turn=(lambda i, turns: call("action_for", turns)[i]) if controller in DELTAS else None,
        refused=refused,
    )
    return robots, places


def felt_by(robots: Robots, infos: dict[str, Any], there: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
    """Return what environments say in ``info`` of what their arms felt within a step.

    Args:
        infos: of one environment, or of n with arrays whose first axis is n.
        there: (n,) whose information is there; of all where None.
    """
    numbers = nothing_felt(robots.count, robots.felt_size)
    if "contact_load" not in infos:
        return numbers
    numbers[:, 0], numbers[:, 1] = infos["contact_load"], infos.get("contact_left_s", np.nan)
    if "contact_felt" in infos:
        numbers[:, 2:] = infos["contact_felt"]
    if there is not None:
        numbers[~there] = np.nan
    return numbers


def body_memory(env: gym.Env[Any, Any] | VectorEnv[Any, Any, Any], watched: StreamSpec) -> NeuralASM:
    """Return the shipped memory of the robot in ``env``, or in all its members; which one it is goes to the log.

    Raises:
        ValueError: none fits; the message lists those that there are.
    """
    inner: Any = env.unwrapped
    if isinstance(env, VectorEnv):
        known = all(inner.call("has_wrapper_attr", "controller"))
        controller = inner.call("get_wrapper_attr", "controller")[0] if known else ""
    else:
        controller = getattr(inner, "controller", "")
    memory = NeuralASM.pretrained(pretrained_for(watched, str(controller)))
    LOG.info("watching %s with %r", inner, memory)
    return memory


def policy_for(on_alarm: Any, env: gym.Env[Any, Any] | VectorEnv[Any, Any, Any]) -> Policy:
    """Return the user's own policy that acts during an alarm in ``env``, or in all its members.

    Args:
        on_alarm: a policy; for a single environment also what makes one: a class such as ``BackOff``, or a function.

    Raises:
        ValueError: no policy, or a reflex that was made for another environment, whose arm it would move.
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
    """Return the environment underneath, once its stream can run at ``rate`` [Hz]; nothing is changed.

    Raises:
        ValueError: it cannot, or a wrapper inside changes actions, which a reflex within a step would pass by.
    """
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
