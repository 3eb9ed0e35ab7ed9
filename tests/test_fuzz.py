"""Hostile arguments end in one of two ways: they are fine, or refused by an error that names argument or value."""

import copy
import dataclasses
import pickle

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from asm_gym import faults
from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.wrappers import NeuralASMSafety, StreamRecorder, VectorNeuralASMSafety
from tests.fakes import CueMonitor, FadingMonitor, FakeEnv

FAULTS = {
    name: kind for name, kind in vars(faults).items() if isinstance(kind, type) and name != "Fault"
}

quickly = settings(
    max_examples=15, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True
)

NUMBERS = (
    0,
    1,
    -1,
    3,
    10**9,
    -(10**9),
    10**400,
    0.5,
    1e-320,
    1e300,
    -1e300,
    np.nan,
    np.inf,
    -np.inf,
    1j,
)
TEXTS = ("", "hold", "no such thing", "\x00", "\ud800", "x" * 10_000, b"robot0_link5")
SEQUENCES = (
    (),
    [],
    (0, 0, 0),
    (0.0, 1.0, 0.0),
    (np.nan, 0, 0),
    (1e300, 1e300, 1e300),
    ("a", "b", "c"),
    [[1], [2, 3]],
)
ARRAYS = (
    np.zeros(3),
    np.full(3, np.nan),
    np.zeros((2, 2)),
    np.array(None),
    np.float64(0.5),
    np.int64(2),
    np.bool_(True),
)
NASTY = (
    None,
    True,
    False,
    *NUMBERS,
    *TEXTS,
    *SEQUENCES,
    *ARRAYS,
    {},
    set(),
    object(),
    int,
    lambda: None,
)
nasty = st.sampled_from(range(len(NASTY))).map(NASTY.__getitem__)


def assert_fine_or_refused(make, arguments):
    """What ``make`` returns, or None where it refuses in words of its own."""
    try:
        return make(**arguments)
    except (ValueError, TypeError) as error:
        said = str(error)
        words = [name.removesuffix("s") for name in arguments]
        shown = [repr(value)[:20] for value in arguments.values()]
        assert any(w in said or w.replace("_", " ") in said for w in words) or any(
            s in said for s in shown
        ), said
        return None


@quickly
@given(data=st.data())
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_described_well_or_refused(name, data):
    field = data.draw(st.sampled_from([f.name for f in dataclasses.fields(FAULTS[name])]))
    fault = assert_fine_or_refused(FAULTS[name], {field: data.draw(nasty)})
    if fault is not None:
        fault.rng().random()


WRAPPERS = {
    "safety": (lambda **more: NeuralASMSafety(FakeEnv(), **({"monitor": CueMonitor()} | more)), (
        "monitor", "on_alarm", "release_after", "max_override", "try_after", "truncate",
        "contact_limits", "responses",
    )),
    "many": (lambda **more: VectorNeuralASMSafety(
        gym.vector.SyncVectorEnv([FakeEnv]), **({"monitor": FadingMonitor()} | more)
    ), ("monitor", "on_alarm", "release_after", "max_override", "try_after", "truncate")),
}  # fmt: skip


@settings(quickly, max_examples=80)
@given(data=st.data())
@pytest.mark.parametrize(("make", "names"), WRAPPERS.values(), ids=WRAPPERS)
def test_a_wrapper_is_made_or_refused(make, names, data):
    name = data.draw(st.sampled_from(names))
    env = assert_fine_or_refused(make, {name: data.draw(nasty)})
    if env is not None and name != "on_alarm":
        env.reset(seed=0)
        env.step(np.zeros(env.action_space.shape, np.float32))


# Those that are checked before a simulator is made, which takes seconds.
EARLY = (
    "task",
    "robot",
    "render_mode",
    "observation",
    "render_size",
    "control_freq",
    "horizon",
    "stream",
    "stream_freq",
    "sensor_noise",
    "terminate_on_success",
    "controller",
    "reward_shaping",
    "camera",
)


@settings(quickly, max_examples=300)
@given(data=st.data())
def test_an_environment_is_made_or_refused(data):
    name = data.draw(st.sampled_from(EARLY))

    def checked(**arguments):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                "asm_gym.envs.robosuite_backend.import_robosuite", lambda: pytest.fail("made")
            )
            try:
                return RobosuiteEnv(**arguments)
            except pytest.fail.Exception:
                return None  # every argument that is looked at before was fine

    assert_fine_or_refused(checked, {name: data.draw(nasty)})


@pytest.mark.parametrize("how", [copy.deepcopy, pickle.dumps], ids=["copied", "pickled"])
@pytest.mark.parametrize("wrap", [lambda e: e.unwrapped, StreamRecorder], ids=["bare", "wrapped"])
def test_an_environment_is_neither_copied_nor_pickled_and_says_what_to_do(lift, how, wrap):
    with pytest.raises(TypeError, match=r"cannot be (copied|pickled).*gym\.make"):
        how(wrap(lift))
