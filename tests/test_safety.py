"""The safety wrapper's contract, on an environment and a monitor that follow a script."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import given, settings
from hypothesis import strategies as st

from asm_gym.detection import AdaptiveThreshold
from asm_gym.guard.reflexes import GRADED, REFLEXES
from asm_gym.monitors import Surprise
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.wrappers import NeuralASMSafety, VectorNeuralASMSafety
from tests.fakes import SPEC, CueMonitor, FakeEnv

ACT = np.array([0.3, -0.2, 1.0], np.float32)


def run(env, steps, action=ACT):
    """The infos of ``steps`` steps, reset's first."""
    _, info = env.reset(seed=0)
    return [info, *(env.step(action)[4] for _ in range(steps))]


def test_monitor_reports_and_never_touches_the_action():
    env = NeuralASMSafety(FakeEnv(), CueMonitor([3, 4]), on_alarm="monitor")
    infos = run(env, 8)
    assert [i["asm"]["alarm"] for i in infos[1:]] == [False] * 3 + [True] * 2 + [False] * 3
    assert [i["cost"] for i in infos] == [0.0] * 4 + [1.0] * 2 + [0.0] * 3
    assert all(set(i["asm"]) == set(infos[0]["asm"]) for i in infos)
    assert all(set(i) == set(infos[0]) for i in infos)
    assert not any(i["asm"]["intervened"] for i in infos)
    assert all(np.array_equal(a, ACT) for a in env.unwrapped.actions)


def test_hold_acts_from_the_next_step_keeps_the_grip_and_hands_back_after_quiet():
    env = NeuralASMSafety(FakeEnv(), CueMonitor([2]), on_alarm="hold", release_after=3)
    infos = run(env, 9)
    held = [False, False, False, True, True, True, False, False, False]
    assert [i["asm"]["intervened"] for i in infos[1:]] == held
    rest = np.array([0, 0, 1.0], np.float32)  # the arm rests, the gripper stays closed
    for action, hold in zip(env.unwrapped.actions, held, strict=True):
        np.testing.assert_array_equal(action, rest if hold else ACT)


def test_an_alarm_during_the_override_starts_the_quiet_time_again():
    infos = run(
        NeuralASMSafety(FakeEnv(), CueMonitor([2, 4]), on_alarm="hold", release_after=3), 10
    )
    assert [i["asm"]["intervened"] for i in infos[1:]] == [False] * 3 + [True] * 5 + [False] * 2


def test_the_memory_sees_the_action_that_was_executed():
    monitor = CueMonitor([1])
    env = NeuralASMSafety(FakeEnv(), monitor, on_alarm="hold")
    infos = run(env, 4)
    for row, info, action in zip(monitor.rows, infos[1:], env.unwrapped.actions, strict=True):
        np.testing.assert_array_equal(row[SPEC.motor], action)
        np.testing.assert_array_equal(info["asm"]["executed_action"], action)


@pytest.mark.parametrize(("truncate", "expected"), [(False, (True, False)), (True, (False, True))])
def test_terminate_ends_the_episode_on_the_alarm(truncate, expected):
    env = NeuralASMSafety(FakeEnv(), CueMonitor([1]), on_alarm="terminate", truncate=truncate)
    env.reset()
    assert env.step(ACT)[2:4] == (False, False)
    assert env.step(ACT)[2:4] == expected
    with pytest.raises(gym.error.ResetNeeded):
        env.step(ACT)
    env.reset()
    assert env.step(ACT)[2:4] == (False, False)


def test_a_policy_of_the_users_takes_over_with_a_fresh_state():
    class Counter:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            count = 0 if state is None else state
            assert bool(episode_start[0]) is (count == 0)
            return np.full(3, 0.1 * count, np.float32), count + 1

    env = NeuralASMSafety(FakeEnv(), CueMonitor([0]), on_alarm=Counter(), release_after=3)
    run(env, 6)
    np.testing.assert_allclose(
        [a[0] for a in env.unwrapped.actions], [0.3, 0.0, 0.1, 0.2, 0.3, 0.3], atol=1e-6
    )


def test_attribution_names_every_number_and_adds_up_to_the_surprise():
    info = run(NeuralASMSafety(FakeEnv(), CueMonitor([0])), 1)[1]["asm"]
    assert list(info["attribution"]) == list(SPEC.labels)
    assert sum(info["attribution"].values()) == pytest.approx(info["surprise"]) == 10.0
    assert info["threshold"] == 1.0


@settings(max_examples=30, deadline=None)
@given(cue=st.sets(st.integers(0, 19)), release=st.integers(1, 5))
def test_reset_forgets_everything_whatever_happened(cue, release):
    env = NeuralASMSafety(FakeEnv(), CueMonitor(cue), release_after=release)
    first, second = run(env, 20), run(env, 20)
    for a, b in zip(first, second, strict=True):
        assert a["cost"] == b["cost"]
        assert a["asm"]["intervened"] == b["asm"]["intervened"]


OTHER = StreamSpec(
    (Channel("position", 2, "m"), Channel("weight", 1), Channel("action", 3, group=MOTOR)), 0.05
)


@pytest.mark.parametrize(
    ("monitor", "options", "error", "message"),
    [
        ({}, {"on_alarm": "freeze"}, ValueError, r"'freeze'.*monitor, hold, retract.*terminate"),
        ({}, {"on_alarm": 3}, ValueError, "predict"),
        ({"spec": OTHER}, {}, ValueError, "weight"),
        ({"threshold": None}, {}, RuntimeError, "calibrate"),
        ({}, {"max_override": 0}, ValueError, "max_over"),
    ],
)
def test_what_makes_no_sense_is_refused(monitor, options, error, message):
    with pytest.raises(error, match=message):
        NeuralASMSafety(FakeEnv(), CueMonitor(**monitor), **options)


def test_discrete_actions_are_refused_and_so_is_a_step_before_reset():
    env = FakeEnv()
    with pytest.raises(gym.error.ResetNeeded):
        NeuralASMSafety(env, CueMonitor()).step(ACT)
    env.action_space = spaces.Discrete(3)
    with pytest.raises(TypeError, match="Box action space to act in"):
        NeuralASMSafety(env, CueMonitor())


@pytest.mark.parametrize(
    ("answer", "got"),
    [
        (lambda state, stream: np.zeros(1), r"got \(ndarray\)"),
        (lambda state, stream: (state, np.zeros(1)), r"got \(NoneType, ndarray\)"),
        (lambda state, stream: (state, 0.0, 1.0), r"got \(NoneType, float, float\)"),
    ],
)
def test_a_monitor_needs_no_base_class_and_must_answer_a_surprise(answer, got):
    class Foreign:
        threshold, spec = 1.0, SPEC
        observe = staticmethod(
            lambda state, rows: (state, Surprise(np.zeros(len(rows)), np.zeros(rows.shape)))
        )

        def initial_state(self, batch=1):
            return None

    assert not run(NeuralASMSafety(FakeEnv(), Foreign()), 1)[1]["asm"]["alarm"]
    Foreign.observe = staticmethod(answer)
    with pytest.raises(TypeError, match=got):
        NeuralASMSafety(FakeEnv(), Foreign())


def test_a_reflex_that_acts_too_long_gives_up_and_ends_the_episode():
    env = NeuralASMSafety(FakeEnv(), CueMonitor(range(2, 20)), on_alarm="hold", max_override=4)
    env.reset(seed=0)
    outs = [env.step(ACT) for _ in range(7)]
    assert [o[4]["asm"]["gave_up"] for o in outs] == [False] * 6 + [True]
    assert [o[2] for o in outs] == [False] * 6 + [True]
    with pytest.raises(gym.error.ResetNeeded):
        env.step(ACT)
    # a new episode has its own patience
    outs = [
        env.reset(seed=0),
        *(env.step(ACT) for _ in range(4)),
    ]
    assert not outs[-1][2]


def test_control_is_not_handed_back_before_surprise_is_well_below_the_threshold():
    class Lingering(CueMonitor):
        def observe(self, state, stream):
            state, surprise = super().observe(state, stream)
            value = {3: 0.9, 4: 0.9, 5: 0.5, 6: 0.5}.get(state - 1, surprise.value[0])
            return state, surprise._replace(value=np.array([value]))

    infos = run(NeuralASMSafety(FakeEnv(), Lingering([2]), on_alarm="hold", release_after=2), 9)
    assert [i["asm"]["intervened"] for i in infos[1:]] == [False] * 3 + [True] * 4 + [False] * 2


def test_evidence_that_was_acted_on_is_not_counted_again():
    class Remembering(CueMonitor):
        def reset_evidence(self, state):
            forgotten.append(state)
            return state

    forgotten: list[int] = []
    run(NeuralASMSafety(FakeEnv(), Remembering([2, 4]), on_alarm="hold"), 8)
    assert forgotten == [3, 5]
    forgotten.clear()
    run(NeuralASMSafety(FakeEnv(), Remembering([2, 4]), on_alarm="monitor"), 8)
    assert not forgotten  # who only reports, reports all there is


class Broken:
    """A backup policy that fails in the way of ``how``."""

    def __init__(self, how):
        self.how = how

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        if self.how == "raises":
            raise RuntimeError("no plan")
        return {"nan": np.full(3, np.nan), "shape": np.ones(2)}[self.how], state


@pytest.mark.parametrize("how", ["raises", "nan", "shape"])
def test_where_a_backup_policy_fails_the_robot_holds_and_says_so(how):
    env = NeuralASMSafety(FakeEnv(), CueMonitor([2]), on_alarm=Broken(how), release_after=2)
    with pytest.warns(UserWarning, match="reflex: .*; the robot holds instead"):
        infos = run(env, 6)
    np.testing.assert_array_equal(env.unwrapped.actions[3], [0, 0, 1])  # the grip is kept
    assert [bool(i["asm"]["failure"]) for i in infos[4:6]] == [True, True]
    assert not infos[2]["asm"]["failure"]


def test_control_is_handed_back_on_trial_and_withheld_longer_after_each_that_fails(caplog):
    """Surprise stays over the threshold whatever is done: holds of 2, 4 and 8 steps, and then it gives up."""
    caplog.set_level("INFO", logger="asm_gym.safety")
    env = NeuralASMSafety(
        FakeEnv(length=60), CueMonitor(range(3, 60)), try_after=2, max_override=14
    )
    env.reset(seed=0)
    infos = []
    while not infos or not infos[-1]["asm"]["gave_up"]:
        infos.append(env.step(ACT)[4])
    acting = "".join("h" if i["asm"]["intervened"] else "p" for i in infos)
    assert acting == "pppp" + "hh" + "p" + "hhhh" + "p" + "hhhhhhhh"
    said = [i["asm"]["transition"] for i in infos if i["asm"]["transition"]]
    assert said == ["override", "trial", "override", "trial", "override", "give_up"]
    assert [r.message.split(":")[0] for r in caplog.records if r.name == "asm_gym.safety"] == said


def test_an_alarm_that_is_back_at_once_has_not_gone_and_ends_the_episode():
    """Quiet whenever the robot holds, and surprising again two steps after the policy goes on: a fault that lasts."""
    env = NeuralASMSafety(
        FakeEnv(length=60), CueMonitor([3, 7, 11, 15, 19]), release_after=2, max_override=6
    )
    env.reset(seed=0)
    infos = []
    while not infos or not infos[-1]["asm"]["gave_up"]:
        infos.append(env.step(ACT)[4])
    assert (
        "".join("h" if i["asm"]["intervened"] else "p" for i in infos) == "pppp" + "hhpp" * 3 + "h"
    )
    later = NeuralASMSafety(
        FakeEnv(length=60), CueMonitor([3, 9, 15, 21, 27]), release_after=2, max_override=6
    )
    assert not any(i["asm"]["gave_up"] for i in run(later, 40))


def test_recall_does_what_the_memory_expects_and_needs_one_that_expects():
    class Expecting(CueMonitor):
        def expected_action(self, state):
            return np.full((1, 3), 0.1 * state, np.float32)

    env = NeuralASMSafety(FakeEnv(), Expecting([2]), on_alarm="recall", release_after=2)
    run(env, 6)
    # as expected after the row that alarmed
    np.testing.assert_allclose(env.unwrapped.actions[3], 0.3, rtol=1e-6)
    np.testing.assert_allclose(env.unwrapped.actions[4], 0.4, rtol=1e-6)
    np.testing.assert_array_equal(env.unwrapped.actions[5], ACT)
    with pytest.raises(ValueError, match="CueMonitor does not"):
        NeuralASMSafety(FakeEnv(), CueMonitor(), on_alarm="recall")


def test_what_is_no_number_is_an_alarm():
    class Lost(CueMonitor):
        def observe(self, state, stream):
            state, surprise = super().observe(state, stream)
            return state, surprise._replace(value=np.array([np.nan]))

    with pytest.warns(UserWarning, match="its surprise is nan"):
        infos = run(NeuralASMSafety(FakeEnv(), Lost()), 3)
    assert [i["asm"]["alarm"] for i in infos[1:]] == [True] * 3
    assert infos[-1]["asm"]["intervened"]


def test_a_reflex_takes_over_within_a_control_step():
    env = gym.make("asm_gym/Lift-v0", horizon=20, stream_freq=100)
    spec = env.unwrapped.stream_spec
    action = np.array([0.4, 0, 0, 0, 0, 0, 1], np.float32)
    # Rows 0 to 4 are those of the first step; the third of the second step alarms.
    env = NeuralASMSafety(env, CueMonitor([7], spec=spec), release_after=2)
    env.reset(seed=0)
    first, second = env.step(action)[4], env.step(action)[4]
    assert first["asm"]["surprises"].shape == (5,)
    assert not first["asm"]["intervened"]
    commanded = second["streams"][:, spec.slices["action"]]
    np.testing.assert_allclose(commanded[:, 0], [0.4, 0.4, 0.4, 0, 0])
    np.testing.assert_allclose(commanded[:, 6], 1)
    assert second["asm"]["intervened"]
    assert second["asm"]["alarm"]
    np.testing.assert_array_equal(second["asm"]["executed_action"], [0, 0, 0, 0, 0, 0, 1])
    assert np.argmax(second["asm"]["surprises"]) == 2
    rows = [env.step(action)[4] for _ in range(3)]
    # two control steps of quiet
    assert [r["asm"]["intervened"] for r in rows] == [
        True,
        True,
        False,
    ]
    assert not env.unwrapped.row_hooks
    env.close()


def test_rates_that_do_not_fit_are_refused(lift):
    fast = gym.make("asm_gym/Lift-v0", stream_freq=100)
    with pytest.raises(ValueError, match=r"dt: 0\.05 s against 0\.01 s"):
        NeuralASMSafety(fast, CueMonitor(spec=lift.unwrapped.stream_spec))
    with pytest.raises(ValueError, match="RescaleAction changes actions"):
        NeuralASMSafety(
            gym.wrappers.RescaleAction(fast, -2.0, 2.0), CueMonitor(spec=fast.unwrapped.stream_spec)
        )
    fast.close()


class Foreseeing(CueMonitor):
    """Expects no action, which ``recall`` then commands."""

    def expected_action(self, state):
        return np.zeros((1, 7), np.float32)


@pytest.mark.parametrize("name", [*REFLEXES, GRADED])
def test_every_reflex_acts_in_the_step_after_an_alarm_by_an_action_of_its_own(name, lift):
    env = NeuralASMSafety(
        lift, Foreseeing([3], lift.unwrapped.stream_spec), on_alarm=name, contact_limits=None
    )
    env.reset(seed=0)
    wanted = np.full(7, 0.75, np.float32)
    said = [env.step(wanted)[4]["asm"] for _ in range(5)]
    assert [s["alarm"] for s in said] == [False, False, False, True, False]
    assert [s["intervened"] for s in said] == [False, False, False, False, True]
    assert all((s["executed_action"] == wanted).all() for s in said[:4])
    assert not (said[4]["executed_action"] == wanted).all()
    assert env.action_space.contains(np.asarray(said[4]["executed_action"], np.float32))


# ------------------------------------------------------------------ a threshold that follows the policy


HOW = AdaptiveThreshold(rate=0.1, step=0.5, ceiling=20.0)


class ScriptedMonitor(CueMonitor):
    """Says ``values`` of the steps of an episode; the threshold is 1."""

    def __init__(self, values):
        super().__init__()
        self.values = values

    def observe(self, state, stream):
        value = np.full(len(stream), self.values.get(state, 0.5))
        return state + 1, Surprise(value, np.zeros((len(stream), self.spec.size)))


def episode(env, steps=20):
    _, info = env.reset()
    for _ in range(steps):
        *_, info = env.step(np.zeros(3, np.float32))
    return info["asm"]


def test_a_false_alarm_raises_the_threshold_of_the_next_episode_and_not_of_its_own():
    env = NeuralASMSafety(
        FakeEnv(), ScriptedMonitor({5: 2.0}), on_alarm="monitor", adaptive_threshold=HOW
    )
    first, second = episode(env), episode(env)
    assert first["threshold"] == 1.0
    assert np.isnan(first["level"])
    assert first["ceiling"] == 20.0
    assert second["threshold"] == pytest.approx(np.exp(0.45))
    assert second["level"] == 1.0
    assert env.threshold == second["threshold"]


def test_without_adapt_nothing_moves_and_nothing_is_added():
    env = NeuralASMSafety(FakeEnv(), ScriptedMonitor({5: 2.0}), on_alarm="monitor")
    assert episode(env)["threshold"] == episode(env)["threshold"] == 1.0
    assert not {"level", "ceiling"} & episode(env).keys()


def test_what_goes_on_while_the_reflex_acts_is_no_drift():
    passing, lasting = {5: 2.0}, dict.fromkeys(range(5, 20), 2.0)
    for values, moved in ((passing, True), (lasting, False)):
        env = NeuralASMSafety(
            FakeEnv(), ScriptedMonitor(values), release_after=3, adaptive_threshold=HOW
        )
        episode(env)
        assert (episode(env)["threshold"] > 1.0) is moved


def test_surprise_of_the_reflex_itself_is_not_the_policys():
    env = NeuralASMSafety(
        FakeEnv(), ScriptedMonitor({5: 2.0, 6: 1000.0}), release_after=3, adaptive_threshold=HOW
    )
    episode(env)
    # by the 2; 1000 is above the ceiling
    assert episode(env)["threshold"] == pytest.approx(np.exp(0.45))


def test_a_confirmed_alarm_and_one_above_the_ceiling_teach_nothing():
    env = NeuralASMSafety(
        FakeEnv(), ScriptedMonitor({5: 2.0}), on_alarm="monitor", adaptive_threshold=HOW
    )
    episode(env)
    env.confirm_alarm()
    assert episode(env)["threshold"] == 1.0
    assert episode(env)["threshold"] > 1.0  # the confirmation was of one episode
    env = NeuralASMSafety(
        FakeEnv(), ScriptedMonitor({5: 20.5}), on_alarm="monitor", adaptive_threshold=HOW
    )
    for _ in range(5):
        last = episode(env)
    assert last["threshold"] == 1.0


def test_many_environments_share_a_threshold_and_keep_it_to_the_end_of_their_episodes():
    class Monitor(ScriptedMonitor):
        def initial_state(self, batch=1):
            return np.zeros(batch, np.int64)

        def observe(self, state, stream):
            value = np.array([self.values.get(int(s), 0.5) for s in state])
            return state + 1, Surprise(value, np.zeros((len(stream), self.spec.size)))

    lengths = (6, 10)
    made = SyncVectorEnv(
        [lambda n=n: FakeEnv(n) for n in lengths], autoreset_mode=AutoresetMode.NEXT_STEP
    )
    env = VectorNeuralASMSafety(made, Monitor({3: 2.0}), on_alarm="monitor", adaptive_threshold=HOW)
    env.reset()
    thresholds = []
    for _ in range(24):
        *_, infos = env.step(np.zeros((2, 3), np.float32))
        thresholds.append(infos["asm"]["threshold"])
    thresholds = np.array(thresholds)
    np.testing.assert_allclose(thresholds[0], [1.0, 1.0])
    once = np.exp(0.45)
    # the first has begun anew, the second is under way
    np.testing.assert_allclose(thresholds[7], [once, 1.0])
    np.testing.assert_allclose(thresholds[12], [once, once**2])
    assert infos["asm"]["level"].shape == infos["asm"]["ceiling"].shape == (2,)
    np.testing.assert_allclose(env.threshold, thresholds[-1])


@pytest.mark.parametrize("on_alarm", ["monitor", "hold"])
def test_a_policy_so_strange_that_most_of_its_steps_alarm_is_named_once_with_what_to_do(on_alarm):
    strange = ScriptedMonitor(
        dict.fromkeys(range(0, 4000, 2), 2.0) | dict.fromkeys(range(0, 4000, 3), 2.0)
    )
    env = NeuralASMSafety(FakeEnv(8000), strange, on_alarm=on_alarm, release_after=1)
    with pytest.warns(
        UserWarning, match=r"of the first 200 rows under this policy alarm: .* warm_start=True"
    ) as said:
        episode(env, 4000)
    assert len(said) == 1


def test_a_fault_that_passes_makes_no_policy_strange():
    passing = ScriptedMonitor(dict.fromkeys(range(20, 110), 2.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        episode(NeuralASMSafety(FakeEnv(400), passing, on_alarm="monitor"), 300)
