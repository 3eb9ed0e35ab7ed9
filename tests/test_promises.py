"""An override that is asked for happens: whatever fails is an alarm, with the reflex in charge and not the policy."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

import asm_gym  # noqa: F401
from asm_gym.policies.hold import Hold
from asm_gym.wrappers import NeuralASMSafety, VectorNeuralASMSafety
from tests.fakes import SPEC, CueMonitor, FadingMonitor, FakeEnv

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*which counts as an alarm", "ignore:.*is done instead"
)

ACT = np.array([0.3, -0.2, 1.0], np.float32)
HELD = np.array([0, 0, 1.0], np.float32)
LOST = np.full(3, np.nan, np.float32)


class Failing(CueMonitor):
    """From the row ``at`` on, it does what ``how`` says instead of judging."""

    def __init__(self, how, at=2):
        super().__init__()
        self.how, self.at, self.count = how, at, 0

    def observe(self, state, stream):
        state, surprise = super().observe(state, stream)
        self.count += 1
        return (state, surprise) if self.count <= self.at else (state, self.how(surprise))


def raising(surprise):
    raise RuntimeError("out of memory")


NONSENSE = {
    "raises": raising,
    "none": lambda s: None,
    "nan": lambda s: s._replace(value=np.array([np.nan])),
    "minus infinity": lambda s: s._replace(value=np.array([-np.inf])),
    "two values": lambda s: s._replace(value=np.zeros(2)),
    "no values": lambda s: s._replace(value=np.zeros(0)),
    "short attribution": lambda s: s._replace(attribution=np.zeros((1, 2))),
    "words": lambda s: s._replace(value=np.array(["calm"])),
}


@pytest.mark.parametrize("how", NONSENSE.values(), ids=NONSENSE)
def test_a_monitor_that_talks_nonsense_leaves_the_reflex_in_charge(how):
    env = NeuralASMSafety(FakeEnv(), Failing(how))
    env.reset()
    infos = [env.step(ACT)[4] for _ in range(12)]
    np.testing.assert_array_equal(env.unwrapped.actions[:3], [ACT] * 3)
    np.testing.assert_array_equal(env.unwrapped.actions[3:], [HELD] * 9)
    assert [i["asm"]["alarm"] for i in infos] == [False] * 2 + [True] * 10
    assert not infos[1]["asm"]["failure"]
    assert all(i["asm"]["failure"].startswith("monitor: ") for i in infos[2:])
    assert infos[-1]["asm"]["surprise"] == np.inf
    assert infos[-1]["asm_alarm"]
    assert infos[-1]["cost"] == 1.0


@pytest.mark.parametrize("ability", ["expected_action", "reset_evidence"])
def test_abilities_of_a_monitor_that_fail_do_not_end_the_guard(ability):
    class Able(CueMonitor):
        def expected_action(self, state):
            return fails("expected_action", np.zeros((1, 3), np.float32))

        def reset_evidence(self, state):
            return fails("reset_evidence", state)

    def fails(what, value):
        if what == ability:
            raise RuntimeError(what)
        return value

    env = NeuralASMSafety(FakeEnv(), Able([2]), on_alarm="recall")
    env.reset()
    infos = [env.step(ACT)[4] for _ in range(6)]
    assert ability in next(i["asm"]["failure"] for i in infos if i["asm"]["alarm"])
    assert infos[3]["asm_intervened"]


class Losing(gym.Wrapper):
    """Has no stream, or another thing in its place, in steps 2 and 3."""

    def __init__(self, env, instead=None):
        super().__init__(env)
        self.instead = instead

    def step(self, action):
        out = self.env.step(action)
        if self.unwrapped.t in (2, 3):
            del out[4]["stream"]
            if self.instead is not None:
                out[4]["stream"] = self.instead
        return out


@pytest.mark.parametrize("instead", [None, np.zeros(4, np.float32), "nothing", np.zeros((1, 5))])
def test_a_stream_that_is_missing_for_a_while_is_an_alarm_for_as_long(instead):
    env = NeuralASMSafety(Losing(FakeEnv(), instead), CueMonitor(), release_after=3)
    env.reset()
    infos = [env.step(ACT)[4] for _ in range(10)]
    assert [i["asm"]["alarm"] for i in infos] == [False] + [True] * 2 + [False] * 7
    assert [i["asm"]["intervened"] for i in infos] == [False] * 2 + [True] * 4 + [False] * 4
    assert infos[1]["asm"]["failure"].startswith("stream: ")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_policy_that_is_not_finite_is_relieved_in_that_very_step(bad):
    env = NeuralASMSafety(FakeEnv(), CueMonitor(), release_after=2)
    env.reset()
    infos = [env.step(a)[4] for a in (ACT, np.array([0.1, bad, 0.0]), ACT, ACT, ACT)]
    np.testing.assert_array_equal(env.unwrapped.actions, [ACT, HELD, HELD, HELD, ACT])
    assert [i["asm"]["transition"] for i in infos] == ["", "override", "", "release", ""]
    assert [i["asm"]["intervened"] for i in infos] == [False, True, True, True, False]
    assert [i["asm_alarm"] for i in infos] == [False, True, False, False, False]
    assert infos[1]["asm"]["failure"].startswith("policy: the action must be finite")


@pytest.mark.parametrize("on_alarm", ["monitor", "terminate"])
def test_without_a_reflex_too_an_action_that_is_not_finite_stays_out(on_alarm):
    env = NeuralASMSafety(FakeEnv(), CueMonitor(), on_alarm=on_alarm)
    env.reset()
    env.step(ACT)
    _, _, terminated, _, info = env.step(LOST)
    np.testing.assert_array_equal(env.unwrapped.actions, [ACT, HELD])
    assert info["asm_alarm"]
    assert "policy" in info["asm"]["failure"]
    assert terminated == (on_alarm == "terminate")
    if not terminated:
        env.step(ACT)
        np.testing.assert_array_equal(env.unwrapped.actions[-1], ACT)


@pytest.mark.parametrize("when", ["begin", "predict"])
def test_a_reflex_that_raises_is_replaced_by_staying(when):
    class Clumsy(Hold):
        def fails(self, what):
            if what == when:
                raise RuntimeError(what)

        def begin(self, executed):
            self.fails("begin")
            return super().begin(executed)

        def predict(self, *args, **more):
            self.fails("predict")
            return super().predict(*args, **more)

    env = FakeEnv()
    env = NeuralASMSafety(env, CueMonitor([1]), on_alarm=Clumsy(env))
    env.reset()
    with pytest.warns(UserWarning, match=f"reflex: .*{when}"):
        infos = [env.step(ACT)[4] for _ in range(4)]
    np.testing.assert_array_equal(env.unwrapped.actions, [ACT, ACT, HELD, HELD])
    assert when in infos[2]["asm"]["failure"]


@pytest.mark.parametrize("many", [False, True], ids=["one", "many"])
def test_a_step_after_a_reset_that_failed_is_refused(many):
    class Sleepy(FakeEnv):
        asleep = False

        def reset(self, **more):
            if self.asleep:
                raise RuntimeError("no power")
            return super().reset(**more)

    inner = Sleepy()
    env = NeuralASMSafety(inner, CueMonitor())
    if many:
        env = VectorNeuralASMSafety(SyncVectorEnv([lambda: inner]), FadingMonitor())
    env.reset()
    inner.asleep = True
    with pytest.raises(RuntimeError, match="no power"):
        env.reset()
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(env.action_space.shape, np.float32))
    inner.asleep = False
    env.reset()
    env.step(np.zeros(env.action_space.shape, np.float32))


# ---------------------------------------------------------------- many at once


def three(make=FakeEnv, wrap=lambda e: e):
    return SyncVectorEnv([lambda i=i: wrap(make(first=100 * i)) for i in range(3)])


def test_in_one_of_many_the_failure_is_its_own():
    class Odd(FadingMonitor):
        def observe(self, state, stream):
            state, surprise = super().observe(state, stream)
            value = np.where(stream[:, 0] == 102, np.nan, surprise.value)
            return state, surprise._replace(value=value)

    env = VectorNeuralASMSafety(three(), Odd(), release_after=2)
    env.reset()
    actions = np.tile(ACT, (3, 1))
    env.step(actions)
    infos = env.step(actions)[4]
    assert infos["asm_alarm"].tolist() == [False, True, False]
    assert [bool(f) for f in infos["asm"]["failure"]] == [False, True, False]
    broken = actions.copy()
    broken[2, 0] = np.inf
    infos = env.step(broken)[4]
    assert infos["asm_intervened"].tolist() == [False, True, True]
    assert infos["asm"]["failure"][2].startswith("policy: ")
    np.testing.assert_array_equal(infos["asm"]["executed_action"], [ACT, HELD, HELD])


# ---------------------------------------------------------------- wrappers inside


class Shifted(gym.ActionWrapper):
    def action(self, action):
        return action + 0.5


def test_where_no_environment_holds_itself_rest_is_found_or_refused():
    rescaled = gym.wrappers.RescaleAction(FakeEnv(), np.float32(0.0), np.float32(1.0))
    env = NeuralASMSafety(rescaled, CueMonitor([0], spec=SPEC))
    env.reset()
    for _ in range(2):
        env.step(np.ones(3, np.float32))
    np.testing.assert_allclose(env.unwrapped.actions, [[1, 1, 1], [0, 0, 1]], atol=1e-6)
    for changes in (Shifted, lambda e: gym.wrappers.StickyAction(e, 0.5)):
        with pytest.raises(ValueError, match=r"changes actions.*outside of NeuralASMSafety"):
            NeuralASMSafety(changes(FakeEnv()), CueMonitor())
    NeuralASMSafety(gym.wrappers.ClipAction(FakeEnv()), CueMonitor())


def test_an_environment_without_rest_asks_for_a_safe_action():
    env = FakeEnv()
    env.action_space = spaces.Box(0.5, 1.0, (3,), np.float32)
    with pytest.raises(ValueError, match="safe_action"):
        NeuralASMSafety(env, CueMonitor())
    NeuralASMSafety(env, CueMonitor(), on_alarm=Hold(env, safe_action=np.full(3, 0.6, np.float32)))
    NeuralASMSafety(env, CueMonitor(), on_alarm="monitor")
