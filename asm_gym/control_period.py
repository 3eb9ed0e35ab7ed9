"""The control period of any environment: simulated time from one action to the next.

    dt = clock after a step - clock before it    [s]

The step is one of the outermost environment: a wrapper that repeats actions makes it longer.
"""

from __future__ import annotations

import math
import random
import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from copy import deepcopy
from inspect import getattr_static
from numbers import Real
from operator import attrgetter
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper

# Where simulators keep their clock [s]: MuJoCo, dm_control, robosuite, Gymnasium-Robotics.
SIMULATOR_CLOCKS = (
    "data.time",
    "physics.data.time",
    "_env.physics.data.time",
    "sim.data.time",
    "robot_env.data.time",
    "simulation.data.time",
    "robosuite_env.sim.data.time",
)
# What environments call a clock of their own [s].
OWN_CLOCKS = (
    "time",
    "sim_time",
    "simulation_time",
    "elapsed_time",
    "t",
)
ALL_CLOCKS = (*SIMULATOR_CLOCKS, *OWN_CLOCKS)
# What wrappers call how often they repeat an action.
REPEAT_NAMES = (
    "_skip",
    "skip",
    "repeat",
    "action_repeat",
    "frame_skip",
)
TOLERANCE = 0.01  # relative: periods that are closer are the same


class PeriodWarning(UserWarning):
    """The control period was guessed, or is another one than was declared."""


def control_period(env: gym.Env[Any, Any] | VectorEnv[Any, Any, Any]) -> float:
    """Return the control period of an environment, or of a member of a vector environment [s].

    A simulator's clock is measured over two steps of a copy, unless the environment renders or has
    a stream of its own. Otherwise the environment declares the period, by ``dt``, ``tau``,
    ``control_timestep``, ``frame_skip`` and the model's ``timestep``, or a frequency of control; a
    wrapper that says how often it repeats actions multiplies it. Without either a clock of the
    environment's own is measured, or the rate of its videos is taken, with a ``PeriodWarning``.

    Returns:
        The period; 1 if nothing is known.
    """
    if isinstance(env, VectorEnv):
        return _period_of_member(env)
    if env.has_wrapper_attr("stream_spec"):
        return _period_of_stream(env)
    declared = repeats_of(env) * declared_period(env)
    # A declared period is tried on simulators only: a copy of another environment may move a robot.
    clocks: Sequence[str] = ALL_CLOCKS
    if declared:
        clocks = SIMULATOR_CLOCKS
    measured = _measured_in_copy(env, clocks)
    if measured and not _same(measured, declared):
        return measured
    return declared or _video_period(env)


def declared_period(env: Any) -> float:
    """Return the control period that the innermost environment declares [s]; 0 without one."""
    bare = env.unwrapped
    for name in ("dt", "tau", "control_timestep"):
        declared = getattr(bare, name, None)
        if callable(declared):
            declared = declared()
        if period := _positive(declared):
            return period

    options = getattr(getattr(bare, "model", None), "opt", None)
    timestep = _positive(getattr(options, "timestep", None))
    if period := _positive(getattr(bare, "frame_skip", None)) * timestep:
        return period

    config = getattr(bare, "config", None)
    if not isinstance(config, dict):
        config = {}
    for name in ("control_freq", "policy_frequency", "control_frequency"):
        if rate := _positive(config.get(name) or getattr(bare, name, None)):
            return 1.0 / rate
    return 0.0


def repeats_of(env: Any) -> int:
    """Return how many steps of the innermost environment one step takes, as its wrappers say."""
    repeats = 1
    for layer in layers(env):
        for name in REPEAT_NAMES:
            # Static: a wrapper may forward the names of the environment inside.
            value = getattr_static(layer, name, None)
            if isinstance(value, int | np.integer) and value > 1:
                repeats *= int(value)
                break
    return repeats


def layers(env: Any) -> Iterator[Any]:
    """Yield the wrappers around an environment, or around many, the outermost first."""
    while isinstance(env, gym.Wrapper | VectorWrapper):
        yield env
        env = env.env


def stream_provider(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """Return the outermost wrapper that defines a stream, or else the innermost environment."""
    for layer in layers(env):
        if getattr_static(layer, "stream_spec", None) is not None:
            return layer
    return env.unwrapped


class PeriodCheck:
    """Compare the control period with the clock in the first step that ends no episode.

    Args:
        env: the outermost environment; None if it cannot be asked.
        period: the expected control period [s].
    """

    def __init__(self, env: gym.Env[Any, Any] | None, period: float) -> None:
        self.period = period
        """The control period [s], as measured once it was."""
        self._env = env
        self._pending = env is not None
        self._clock = ""
        self._before = math.nan

    def begin(self) -> None:
        """Read the clock before a step."""
        if self._pending:
            self._clock = _clock_of(self._env, ALL_CLOCKS)
            self._before = _read(self._env, self._clock)

    def end(self, ended: bool) -> None:
        """Read the clock after a step; correct ``period`` if that took another time.

        Args:
            ended: the step ended an episode, so that a wrapper may have repeated less often.
        """
        if not self._pending or ended:
            return
        self._pending = False
        elapsed = _elapsed(self._before, _read(self._env, self._clock))
        if elapsed and not _same(elapsed, self.period) and self._is_simulated(elapsed):
            self.period = elapsed

    def _is_simulated(self, elapsed: float) -> bool:
        """Return whether a clock shows simulated time, and no time of day or number of steps."""
        if self._clock in SIMULATOR_CLOCKS or not declared_period(self._env):
            return True
        return not elapsed.is_integer() and whole_multiple(elapsed, self.period, 1e-6) > 1


def whole_multiple(longer: float, shorter: float, tolerance: float = TOLERANCE) -> int:
    """Return how many times ``shorter`` makes ``longer``; 0 if that is no whole number."""
    multiple = longer / shorter
    if math.isclose(multiple, round(multiple), rel_tol=tolerance):
        return round(multiple)
    return 0


def _period_of_member(envs: VectorEnv[Any, Any, Any]) -> float:
    """Return the control period of the first member [s]."""
    inner: Any = envs.unwrapped
    if hasattr(inner, "envs"):
        return control_period(inner.envs[0])
    if hasattr(inner, "env_fns"):
        # Those in worker processes cannot be measured: one more is made, as Gymnasium does.
        with closing(inner.env_fns[0]()) as member:
            return control_period(member)
    return declared_period(envs) or _video_period(envs)


def _period_of_stream(env: gym.Env[Any, Any]) -> float:
    """Return the control period of an environment whose stream says how long a row takes [s]."""
    row = env.get_wrapper_attr("stream_spec").dt
    provider = stream_provider(env)
    rows = max(1, round(declared_period(provider) / row))
    return rows * row * repeats_of(env) / repeats_of(provider)


def _measured_in_copy(env: Any, clocks: Sequence[str]) -> float:
    """Return how long each of two steps of a copy takes [s]; 0 if they differ, or nothing tells.

    An environment that renders is not copied: the copy would open a window or write a video.
    """
    clock = _clock_of(env, clocks)
    if not clock or getattr(env, "render_mode", None) is not None:
        return 0.0
    times = []
    with suppress(Exception), _undisturbed():  # a copy of somebody's environment may raise anything
        copied = deepcopy(env)
        copied.reset(seed=0)
        action = _some_action(copied.action_space)
        times.append(_read(copied, clock))
        for _ in range(2):
            _, _, terminated, truncated, _ = copied.step(action)
            if terminated or truncated:
                return 0.0
            times.append(_read(copied, clock))
        copied.unwrapped.close()  # wrappers may share files with the original
    if len(times) < 3:
        return 0.0
    first = _elapsed(times[0], times[1])
    second = _elapsed(times[1], times[2])
    if math.isclose(first, second, rel_tol=1e-6):
        return first
    return 0.0


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Keep the state of the global random generators, and hide warnings."""
    python_state = random.getstate()
    numpy_state = np.random.get_state()  # noqa: NPY002 (environments of others may use it)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        random.setstate(python_state)
        np.random.set_state(numpy_state)  # noqa: NPY002


def _some_action(space: gym.Space[Any]) -> Any:
    """Return the action nearest to zero; of another space than Box, always the same sample."""
    if isinstance(space, gym.spaces.Box):
        return np.clip(np.zeros(space.shape, space.dtype), space.low, space.high)
    space.seed(0)
    return space.sample()


def _clock_of(env: Any, clocks: Sequence[str]) -> str:
    """Return the attribute that is the clock of the innermost environment; empty without one."""
    for clock in clocks:
        if not math.isnan(_read(env, clock)):
            return clock
    return ""


def _read(env: Any, clock: str) -> float:
    """Return the time that a clock shows [s]; NaN if the environment has no such clock."""
    with suppress(Exception):  # an environment's own properties may raise anything
        time = attrgetter(clock)(env.unwrapped)
        if isinstance(time, float | np.floating):
            return float(time)
    return math.nan


def _elapsed(before: float, after: float) -> float:
    """Return the time in between without rounding errors [s]; 0 if unknown or not positive."""
    return _positive(float(f"{after - before:.9g}"))


def _video_period(env: Any) -> float:
    """Return the control period by the rate of videos [s], with a warning; 1 without videos."""
    rate = _positive((env.metadata or {}).get("render_fps"))
    if not rate:
        return 1.0
    period = repeats_of(env) / rate
    warnings.warn(
        f"{type(env.unwrapped).__name__} does not state its control period: {period:g} s is taken "
        "from its render_fps; if that is wrong, give it an attribute dt [s]",
        PeriodWarning,
        stacklevel=3,
    )
    return period


def _same(period: float, other: float) -> bool:
    return math.isclose(period, other, rel_tol=TOLERANCE)


def _positive(value: Any) -> float:
    """Return a number that is positive and finite; 0 for anything else."""
    if isinstance(value, Real) and value is not True and 0 < float(value) < math.inf:
        return float(value)
    return 0.0
