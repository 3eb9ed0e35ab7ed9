"""What a guard has to know of the robots in an environment, or in many side by side."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cached_property
from typing import Any
from uuid import uuid4

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from asm_gym.data.action_meaning import ACTIONS, MEANINGS, TARGET, ActionMeaning, ActionMeans
from asm_gym.guard.engine import Engine
from asm_gym.guard.observer import LOG, Fitted, check_answer, check_monitor, diagnosis_of
from asm_gym.guard.options import GuardOptions
from asm_gym.guard.robots import Robots
from asm_gym.guard.severity import nothing_felt
from asm_gym.monitors import Monitor, NeuralASM, pretrained_for
from asm_gym.policies.base import Policy
from asm_gym.policies.reflexes import Hold, changed_by, nearest_to_rest, no_rest, outside, resting_action
from asm_gym.spec import StreamSpec, control_period
from asm_gym.stream_source import layers
from asm_gym.validation import as_float32, short_repr

DELTAS = ("OSC_POSE", "JOINT_POSITION")  # controllers whose actions are changes, of pose or of joint angles

COUNTS = "episode_returns"  # attribute of wrappers that count episodes, Gymnasium's and Stable-Baselines3's

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


def as_action(space: gym.spaces.Space[Any] | None, action: Any) -> Any:
    """Return an action, or several, in the type of their space: whole numbers where a Box holds these."""
    whole = isinstance(space, gym.spaces.Box) and space.dtype.kind in "iu"
    return np.rint(action).astype(space.dtype) if whole and space is not None else action


def refuse_counts(env: AnyEnv, guard: str, on_alarm: object) -> None:
    """Raise ValueError if a wrapper inside counts episodes: it would miss those that the guard ends, or its numbers."""
    ends = not (isinstance(on_alarm, str) and on_alarm == "monitor")
    for layer in layers(env):
        own = vars(layer).get("info_keywords", ())  # of Stable-Baselines3's Monitor
        if COUNTS in vars(layer) and (ends or any(key.startswith(("asm", "cost")) for key in own)):
            name, usual = type(layer).__name__, "make_vec_env(lambda: NeuralASMSafety(gym.make(ID), monitor))"
            raise ValueError(
                f"{name} inside the guard would miss the episodes that the guard ends, and what it reports: put it "
                f"outside, as in {name}({guard}(env, monitor)); with Stable-Baselines3, {usual}"
            )
    if isinstance(env, VectorEnv) and ends and any(Members(env).call("has_wrapper_attr", COUNTS)):
        raise ValueError(
            "wrappers of the members that count episodes would miss those that the guard ends: use "
            f"gymnasium.wrappers.vector.RecordEpisodeStatistics({guard}(envs, monitor))"
        )


def askable(envs: VectorEnv[Any, Any, Any]) -> Any:
    """Return a vector environment whose members can be asked what they are. Raises TypeError where they cannot."""
    inner: Any = envs.unwrapped
    if not (hasattr(inner, "call") and hasattr(inner, "set_attr")):
        raise TypeError(
            f"the environments in {inner} cannot be inspected: make it with SyncVectorEnv or AsyncVectorEnv"
        )
    return inner


class ObservationMap:
    """Where the numbers of a stream stand in an observation of this space.

    ``layout`` are the parts of the observation in order, by the names of channels, and their sizes; ``own`` is the
    space of that layout. Without a stream of its own, observation and action are the stream. Raises ValueError where
    the environment does not say where they stand, or a wrapper inside has changed the observation.
    """

    def __init__(
        self,
        space: gym.spaces.Space[Any],
        spec: StreamSpec,
        has_stream: bool,
        layout: dict[str, int] | None = None,
        own: gym.spaces.Space[Any] | None = None,
    ) -> None:
        self._space, senses = space, len(spec.sensory)
        if not has_stream and isinstance(space, gym.spaces.Box):
            self._places = [("", spec.sensory, np.arange(senses))]
        elif not has_stream or layout is None:
            raise ValueError("the environment does not say where its stream stands in its observation")
        elif own is not None and space != own:
            raise ValueError(f"a wrapper inside has changed the observation, which was {own}")
        else:
            self._places = _laid_out(layout, spec, space)
        self.shown = np.zeros(spec.size, bool)
        """(D,) which columns stand in the observation; a policy that sees nothing else cannot read the others."""
        for _, columns, _ in self._places:
            self.shown[columns] = True

    def repaired(self, observation: Any, row: NDArray[np.float32], missing: NDArray[np.bool_]) -> Any:
        """Return the observation with the numbers of ``row`` (D,) where they are ``missing`` (D,)."""
        for part, columns, entries in self._places:
            wrong = missing[columns]
            if not wrong.any():
                continue
            array = np.array(observation[part] if part else observation)
            array.reshape(-1)[entries[wrong]] = row[columns[wrong]]
            box = self._space[part] if isinstance(self._space, gym.spaces.Dict) else self._space
            if isinstance(box, gym.spaces.Box):
                array = np.clip(array, box.low, box.high).astype(box.dtype)
            observation = {**observation, part: array} if part else array
        return observation


def _laid_out(
    layout: dict[str, int], spec: StreamSpec, space: gym.spaces.Space[Any]
) -> list[tuple[str, NDArray[np.intp], NDArray[np.intp]]]:
    """Return part, columns and entries of each channel in a flat observation, its ``state``, or a dict of arrays."""
    named = isinstance(space, gym.spaces.Dict) and "state" not in space.spaces
    flat = "state" if isinstance(space, gym.spaces.Dict) else ""
    found, start = [], 0
    for name, size in layout.items():
        if name in spec.slices:
            columns = np.arange(spec.size)[spec.slices[name]]
            found.append((name if named else flat, columns, np.arange(size) + (0 if named else start)))
        start += size
    return found


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
            rest, meaning = _staying(env, actions, changed, given, found)
    except ValueError as error:
        refused["hold"] = str(error)
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
        task=getattr(first("task"), "name", ""),
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
    wrapper, guard = changed_by(env), "VectorNeuralASMSafety" if isinstance(env, VectorEnv) else "NeuralASMSafety"
    return "" if wrapper is None else outside(wrapper, "a reflex", guard)


def _staying(
    env: AnyEnv, actions: gym.spaces.Box, changed: str, told: ActionMeaning | None, found: ActionMeaning | None
) -> tuple[NDArray[np.float32], ActionMeaning | None]:
    """Return (A,) the action for which robots that do not hold by themselves stay, and what their actions mean.

    The meaning is None where that action makes them stay everywhere; else its targets do not count.

    Raises:
        ValueError: nothing tells what some of them mean, or they are torques, or a wrapper changes them.
    """
    rest, meaning = nearest_to_rest(actions), told or found or ActionMeaning.unknown(actions.shape)
    meaning.check_stays(env.unwrapped)
    if told is None:
        return rest, meaning
    pairs = [] if found is None else enumerate(zip(told.means, found.means, strict=True))
    wrong = [(k, was) for k, (own, was) in pairs if own != was and TARGET in (own, was) and was in MEANINGS[:3]]
    if wrong:
        said = "; ".join(f"number {k} moves as a {was}" for k, was in wrong)
        warnings.warn(f"action_means contradicts the recorded episodes: {said}", stacklevel=6)
    if TARGET not in told.means and not isinstance(env, VectorEnv):
        return resting_action(env), None
    if changed or np.any(rest.ravel()[np.array(told.means) != TARGET]):
        raise ValueError(changed or no_rest(actions))
    return rest, told if TARGET in told.means else None


def sensed_row(row: Callable[[], Any], size: int) -> tuple[NDArray[np.float32], str]:
    """Return the row (D,) that is read, or NaN and what failed."""
    try:
        found = as_float32(row())
        if found.shape != (size,):
            raise ValueError(f"a row has the shape {(size,)}, got {found.shape}")
    except Exception as error:
        return np.full(size, np.nan, np.float32), f"stream: {error!r}"
    return found, ""


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
    takes = "one policy with a predict() that all environments share" if many else "have a predict(), or make a policy"
    try:
        if not many and callable(on_alarm) and (isinstance(on_alarm, type) or not hasattr(on_alarm, "predict")):
            made = on_alarm(env)
        if isinstance(made, type) or not callable(getattr(made, "predict", None)):
            raise TypeError("it has no predict()")
    except TypeError as error:
        raise ValueError(f"on_alarm must be a name, or {takes}, got {short_repr(made)}: {error}") from error
    name = type(made).__name__
    bound = isinstance(made, Hold) and not made.explicit  # to one environment
    if many and bound:
        raise ValueError(f"one {name} cannot act in several environments: give its name instead")
    if bound and isinstance(made, Hold) and made.env.unwrapped is not env.unwrapped:
        raise ValueError(
            f"this {name} was made for another environment, and would move that: give the class, on_alarm={name}, "
            "or a function of the environment that makes it"
        )
    return made


class Guarding:
    """What a guard of one environment has in common with a guard of many."""

    env: Any
    _options: GuardOptions
    _spec: StreamSpec  # of the streams that are watched
    _rows_per_step = 1

    @cached_property
    def _name(self) -> str:
        """Its name among all guards around one environment."""
        return uuid4().hex

    def _watch_with(self, monitor: Monitor) -> None:
        """Take up a monitor, and all that depends on it."""
        refuse_counts(self.env, type(self).__name__, self._options.on_alarm)
        check_answer(monitor)
        check_monitor(monitor, self._spec, str(Members(self.env).first("controller", "")))
        found = getattr(monitor, "about", {}).get(ACTIONS)
        meaning = None if found is None else ActionMeaning.from_json(found)
        self._robots, self._places = robots_of(self.env, monitor.spec, meaning, self._options.action_means)
        chosen = self._options.reaction(diagnosis_of(monitor) is not None)
        policies = [] if isinstance(chosen, str) else [policy_for(chosen, self.env)] * self._robots.count
        self._engine = Engine(self._robots, monitor, self._options, policies, self._rows_per_step)
        self._next = monitor

    def _limit_contact(self, anew: bool = False) -> None:
        """Tell the environments their contact limits, where they have changed; new episodes have forgotten them."""
        limits = self._engine.limits
        if self._robots.limits_contact and (anew or limits is not self._limits):
            told = [(self._name, own) for own in limits]
            if isinstance(self.env, VectorEnv):
                askable(self.env).set_attr("limits_of_guard", told)
            else:
                self.env.unwrapped.limits_of_guard = told[0]
        self._limits: tuple[Any, ...] = limits

    def _watch_with_next(self) -> None:
        """Take over the monitor that was assigned, or was fitted or calibrated since."""
        if Fitted.of(self._next, self._spec).differs(self._engine.fitted):
            LOG.info("the monitor was changed, fitted or calibrated since: it is taken over as it is now")
            self._watch_with(self._next)

    @property
    def latency(self) -> float:
        """How long the monitor took for the last rows [s]."""
        return self._engine.latency

    @property
    def monitor(self) -> Monitor:
        """The monitor in use; one that is assigned, or was fitted or calibrated since, takes over at the next reset."""
        return self._engine.fitted.monitor

    @monitor.setter
    def monitor(self, monitor: Monitor) -> None:
        check_monitor(monitor, self._spec, str(Members(self.env).first("controller", "")))
        self._next = monitor
