"""What the safety wrappers are given: reflexes by name, patience, and whether monitor and environment fit."""

from __future__ import annotations

import logging
from collections.abc import Callable
from copy import deepcopy
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np

from asm_gym.contact_limits import ContactLimits
from asm_gym.detection.adaptive import AdaptiveThreshold, RunningThreshold
from asm_gym.familiar_speed import FamiliarSpeed
from asm_gym.monitors import CalibratedMonitor, ExpectsActions, ExplainsItself, Monitor, NeuralASM, pretrained_for
from asm_gym.policies.base import Policy
from asm_gym.policies.reflexes import Comply, Graded, Hold, Recall, Retract, nearest_to_rest
from asm_gym.protocols import SensesWithinSteps
from asm_gym.spec import StreamSpec, control_period
from asm_gym.validation import check_number, shown
from asm_gym.wrappers.transitions import ReleaseRule

LOG = logging.getLogger("asm_gym.safety")

REFLEXES: dict[str, Callable[[gym.Env[Any, Any]], Policy]] = {
    "hold": Hold,
    "retract": Retract,
    "comply": Comply,
    "recall": Recall,
    "graded": Graded,
}
"""Reflexes by name: policies that act after an alarm."""
ON_ALARM = ("monitor", *REFLEXES, "terminate")
"""Names that ``on_alarm`` takes."""
OnAlarm = str | Policy | Callable[[gym.Env[Any, Any]], Policy]
"""What ``on_alarm`` takes."""


@runtime_checkable
class Watches(Protocol):
    """What the safety wrappers need of a monitor."""

    def initial_state(self, batch: int = 1) -> Any: ...

    def observe(self, state: Any, stream: Any) -> Any: ...


@runtime_checkable
class KnowsHealthyForces(Protocol):
    """A monitor whose calibration episodes have shown what healthy motion feels like."""

    healthy_: tuple[float, ...]
    """(N,) the most that it reached, of each number that an arm feels [N m], [N]; empty where nobody knows."""

    familiar_: FamiliarSpeed | None
    """How fast it went at each place; None where nobody knows."""


@runtime_checkable
class DoesWithFewerSenses(Protocol):
    """A monitor that can do without some of the channels it knows."""

    spec: StreamSpec

    def for_stream(self, spec: StreamSpec) -> Monitor:
        """The monitor for a stream that lacks some. Raises ValueError where it has others."""
        ...


def fitted_to(monitor: Monitor, watched: StreamSpec) -> Monitor:
    """The monitor itself where it reads such a stream, or else what it makes of itself with fewer senses, said aloud.

    Raises:
        ValueError: the stream has senses that it never met, by name.
        TypeError: it answers something else than a state and a surprise.
    """
    if isinstance(monitor, Watches) and not isinstance(monitor, CalibratedMonitor):
        check_answer(monitor)
    if not isinstance(monitor, DoesWithFewerSenses) or not monitor.spec.difference(watched):
        return monitor
    fewer = monitor.for_stream(watched)
    lacks = "; ".join(monitor.spec.difference(watched))
    gym.logger.warn(
        f"the monitor does without what this stream lacks ({lacks}); its threshold was set with all its senses: "
        "for_stream(spec).calibrate(episodes) sets it anew"
    )
    return fewer


def running(adaptive: AdaptiveThreshold | None, threshold: float) -> RunningThreshold | None:
    """The threshold that follows a policy, where it is to. Raises TypeError."""
    if adaptive is not None and not isinstance(adaptive, AdaptiveThreshold):
        raise TypeError(f"adaptive_threshold must be an AdaptiveThreshold, got {shown(adaptive)}")
    return None if adaptive is None else adaptive.start(threshold)


def fitted_parts(monitor: Monitor) -> tuple[Any, ...]:
    """What of a monitor ``fit`` replaces; compared by identity."""
    # Asked in every step: whether an object has what a protocol asks for takes longer than all of this.
    if isinstance(monitor, NeuralASM):
        return monitor, monitor.model.completion_, monitor.model.network_
    return monitor, getattr(monitor, "diagnosis_", None), None


def check_monitor(monitor: Monitor, watched: StreamSpec) -> float:
    """The monitor's threshold, once it can watch such a stream.

    Raises:
        ValueError: it is for another stream (the message names what differs), or would never alarm.
        RuntimeError: it is not calibrated.
    """
    if not isinstance(monitor, Watches):
        raise TypeError(f"monitor must have initial_state() and observe(), got {shown(monitor)}")
    monitor.spec.require(watched, "the monitor")
    return check_number("the monitor's threshold", monitor.threshold)


def check_answer(monitor: Monitor) -> None:
    """Raises TypeError where a monitor answers a row with something else than it should, which would alarm for ever."""
    try:
        tried = deepcopy(monitor)  # one that keeps count of its rows must not count this one
        answer: Any = tried.observe(tried.initial_state(1), np.zeros((1, monitor.spec.size), np.float32))
    except Exception as error:  # what fails is an alarm, and may be mended meanwhile
        LOG.warning("the monitor failed at a row of zeros: %r", error)
        return
    if not (isinstance(answer, tuple) and len(answer) == 2 and hasattr(answer[1], "attribution")):
        got = type(answer).__name__ if not isinstance(answer, tuple) else f"a tuple of {len(answer)}"
        got = f"(state, {type(answer[1]).__name__})" if isinstance(answer, tuple) and len(answer) == 2 else got
        raise TypeError(
            "observe(state, stream) must return (state, Surprise(value (B,), attribution (B, D))), of "
            f"asm_gym.monitors, got {got}"
        )


def names_causes(monitor: Monitor) -> bool:
    """Whether the monitor says what is wrong, and not only that something is."""
    return isinstance(monitor, ExplainsItself) and monitor.diagnosis_ is not None


def body_memory(env: gym.Env[Any, Any], watched: StreamSpec) -> NeuralASM:
    """The shipped memory of the body that ``env`` moves; which one it is goes to the log.

    Raises:
        ValueError: none fits; the message lists those that there are.
    """
    inner: Any = env.unwrapped
    memory = NeuralASM.pretrained(pretrained_for(watched, getattr(inner, "controller", "")))
    LOG.info("watching %s with %r", inner, memory)
    return memory


def make_reflex(on_alarm: OnAlarm, env: gym.Env[Any, Any]) -> Policy | None:
    """The policy that acts during an alarm in ``env``; None where none does.

    Args:
        on_alarm: a name, a policy, or what makes one for an environment: a class such as ``BackOff``, or a function.

    Raises:
        ValueError: an unknown name, no policy, or a reflex that was made for another environment, whose arm it would
            move.
    """
    if isinstance(on_alarm, str):
        if on_alarm not in ON_ALARM:
            raise ValueError(f"unknown on_alarm {shown(on_alarm)}; known: {', '.join(ON_ALARM)}, or any policy")
        return REFLEXES[on_alarm](env) if on_alarm in REFLEXES else None
    made: Any = on_alarm
    refused = f"on_alarm must be one of {', '.join(ON_ALARM)}, have a predict(), or make such a policy, got "
    if isinstance(on_alarm, type) or (callable(on_alarm) and not hasattr(on_alarm, "predict")):
        try:
            made = on_alarm(env)
        except TypeError as error:
            raise ValueError(f"{refused}{shown(on_alarm)}: {error}") from error
    if not callable(getattr(made, "predict", None)):
        raise ValueError(f"{refused}{shown(made)}")
    if isinstance(made, Hold) and not made.explicit and made.env.unwrapped is not env.unwrapped:
        name = type(made).__name__
        raise ValueError(
            f"this {name} was made for another environment, and would move that: give the class, on_alarm={name}, "
            "or a function of the environment that makes it"
        )
    policy: Policy = made
    return policy


def make_rule(
    reflex: Policy | None,
    env: gym.Env[Any, Any],
    release_after: int,
    release_below: float,
    max_override: int | None,
    try_after: int | None,
) -> ReleaseRule:
    """When control is handed back, in control steps; ``Graded`` has limits of its own where none are given."""
    if not isinstance(reflex, Graded):
        return ReleaseRule(release_after, release_below, max_override, try_after)
    dt = control_period(env)

    def steps(seconds: float) -> int:
        return max(1, round(seconds / dt))

    return ReleaseRule(
        release_after,
        release_below,
        steps(reflex.GIVE_UP_AFTER_S) if max_override is None else max_override,
        steps(reflex.TRY_AFTER_S) if try_after is None else try_after,
        strikes=reflex.STRIKES,
        impulse=reflex.IMPULSE,
        go_on=steps(reflex.GO_ON_S),
    )


def familiar_to(monitor: Monitor, limits: ContactLimits | None) -> FamiliarSpeed | None:
    """How fast a hand has gone at each place, where ``limits`` ask for that; None where they do not.

    Raises:
        ValueError: they do, and the monitor does not know.
    """
    if limits is None or not limits.by_place:
        return None
    known = monitor.familiar_ if isinstance(monitor, KnowsHealthyForces) else None
    if known is None:
        raise ValueError(
            "by_place needs a monitor that knows how fast the hand healthily goes where: "
            "calibrate it on episodes whose stream holds hand_position and hand_velocity"
        )
    return known


def limits_of(contact_limits: ContactLimits | str | None, monitor: Monitor) -> ContactLimits | None:
    """The limits themselves, or those that the memory's healthy range makes of the usual ones.

    Raises:
        ValueError: neither.
    """
    if contact_limits is None or isinstance(contact_limits, ContactLimits):
        return contact_limits
    if not isinstance(contact_limits, str) or contact_limits != "memory":
        raise ValueError(f'contact_limits must be ContactLimits, "memory" or None, got {shown(contact_limits)}')
    return ContactLimits(healthy=monitor.healthy_ if isinstance(monitor, KnowsHealthyForces) else ())


def make_fallback(env: gym.Env[Any, Any]) -> Hold:
    """What acts where nobody else can: staying, or what comes nearest to no action."""
    try:
        return Hold(env)
    except ValueError:  # no action is known to rest, and a reflex that needs one has refused already
        space: Any = env.action_space
        return Hold(env, safe_action=nearest_to_rest(space))


def check_expectation(reflex: Policy | None, monitor: Monitor) -> bool:
    """Whether the reflex has to be told what the memory expects to be commanded.

    Raises:
        ValueError: it has, and the monitor expects nothing.
    """
    recalls = isinstance(reflex, Recall)
    if recalls and not (isinstance(monitor, ExpectsActions) and monitor.spec.motor.size):
        raise ValueError(f"recall needs a memory that expects actions, and {type(monitor).__name__} does not")
    return recalls


def check_rate(env: gym.Env[Any, Any], rate: int) -> SensesWithinSteps:
    """The environment underneath, once its stream can run at ``rate`` [Hz]; nothing is changed.

    Raises:
        ValueError: it cannot, or a wrapper inside changes actions, which a reflex within a step would pass by.
    """
    check_number("monitor_freq", rate, low=1, whole=True)
    inner = env.unwrapped
    if not isinstance(inner, SensesWithinSteps):
        raise ValueError(f"monitor_freq needs an environment of asm_gym, which {inner} is not: leave it out")
    wrapper = env
    while isinstance(wrapper, gym.Wrapper):
        if isinstance(wrapper, gym.ActionWrapper) and rate > 1 / control_period(env):
            raise ValueError(
                f"{type(wrapper).__name__} changes actions, and a reflex within a step would pass it by: put it outside"
            )
        wrapper = wrapper.env
    return inner
