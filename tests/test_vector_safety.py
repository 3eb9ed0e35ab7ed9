"""Many environments under one monitor equal as many guarded ones."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from asm_gym import collect
from asm_gym.envs.vector import ThreadedVectorEnv
from asm_gym.guard.observer import choose
from asm_gym.monitors import NeuralASM
from asm_gym.policies.hold import Hold
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.wrappers import NeuralASMSafety, VectorNeuralASMSafety
from tests.fakes import SPEC, FadingMonitor, FakeEnv

LENGTHS = (9, 7, 12)
CUE = (2, 3, 103, 104, 105, 106, 107, 208)
OPTIONS = [
    {"on_alarm": "monitor"},
    {"on_alarm": "hold", "release_after": 2},
    {"on_alarm": "terminate"},
    {"on_alarm": "terminate", "truncate": True},
    {"on_alarm": "hold", "max_override": 2},
    {"on_alarm": "hold", "try_after": 1, "max_override": 3},
]


class Counter:
    """Acts with the number of steps it has acted."""

    def __str__(self):
        return "counter"

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        count = 0 if state is None else state
        return np.full(3, 0.1 * count + 0.001 * observation[0], np.float32), count + 1


class Broken:
    """Fails in the first environment, and acts in the others."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        if observation[0] < 100:
            raise RuntimeError("out of order")
        return np.full(3, 0.5, np.float32), state


def fakes(wrap, own_stream=True):
    def make(i):
        return lambda: wrap(FakeEnv(LENGTHS[i], own_stream, first=100 * i))

    return [make(i) for i in range(len(LENGTHS))]


def monitor(own_stream=True):
    env = FakeEnv()
    spec = (
        SPEC
        if own_stream
        else StreamSpec.from_spaces(env.observation_space, env.action_space, dt=0.05)
    )
    return FadingMonitor(CUE, spec=spec)


def both(options, own_stream=True, many=SyncVectorEnv):
    """One wrapper around all environments, and a wrapper around each."""
    bare = many(fakes(lambda e: e, own_stream))
    wrapped = fakes(lambda e: NeuralASMSafety(e, monitor(own_stream), **options), own_stream)
    return VectorNeuralASMSafety(bare, monitor(own_stream), **options), SyncVectorEnv(wrapped)


def assert_same_report(ours, theirs, present, stepped):
    for name in (
        "surprise",
        "threshold",
        "alarm",
        "intervened",
        "gave_up",
        "transition",
        "failure",
    ):
        np.testing.assert_array_equal(
            ours["asm"][name][present], theirs["asm"][name][present], name
        )
    for label, shares in theirs["asm"]["attribution"].items():
        if not label.startswith("_"):
            np.testing.assert_array_equal(
                ours["asm"]["attribution"][label][present], shares[present]
            )
    for name in ("cost", "cost_sum", "asm_steps"):
        np.testing.assert_array_equal(ours[name][present], theirs[name][present], name)
    executed = np.array([list(a) for a in theirs["asm"]["executed_action"][stepped]], np.float32)
    np.testing.assert_array_equal(
        ours["asm"]["executed_action"][stepped].reshape(executed.shape), executed
    )


def assert_equal_step_by_step(ours, theirs, steps):
    everyone = np.ones(ours.num_envs, bool)
    a, b = ours.reset(seed=0), theirs.reset(seed=0)
    np.testing.assert_array_equal(a[0], b[0])
    assert_same_report(a[1], b[1], everyone, ~everyone)
    begun, seen = ~everyone, []
    for t in range(steps):
        actions = np.full((ours.num_envs, 3), 0.01 * t, np.float32)
        a, b = ours.step(actions), theirs.step(actions)
        for mine, other in zip(a[:4], b[:4], strict=True):
            np.testing.assert_array_equal(mine, other)
        ended = a[2] | a[3]
        assert_same_report(a[4], b[4], everyone, ~begun)
        np.testing.assert_array_equal(a[4]["success"], b[4]["success"])
        begun = ended
        seen.append((a[4]["asm"]["intervened"].any(), ended.any()))
    return np.array(seen).any(axis=0)


@pytest.mark.parametrize(
    "options", [*OPTIONS, {"on_alarm": Counter()}], ids=lambda o: "-".join(map(str, o.values()))
)
def test_one_wrapper_around_many_equals_many_wrappers(options):
    acted, ended = assert_equal_step_by_step(*both(options), steps=40)
    assert ended
    assert acted == (options["on_alarm"] not in ("monitor", "terminate"))


@pytest.mark.filterwarnings("ignore:.*the robot holds instead")
def test_where_a_reflex_fails_only_that_environment_holds():
    ours, theirs = both({"on_alarm": Broken()})
    assert_equal_step_by_step(ours, theirs, steps=25)
    ours.reset()
    for _ in range(4):
        asm = ours.step(np.full((3, 3), 0.2, np.float32))[4]["asm"]
    assert asm["failure"].tolist() == ["reflex: RuntimeError('out of order')", "", ""]
    np.testing.assert_allclose(
        asm["executed_action"], [[0, 0, 0.2], [0.5] * 3, [0.2] * 3], rtol=1e-6
    )


def test_environments_without_a_stream_are_watched_through_their_spaces():
    assert_equal_step_by_step(
        *both({"on_alarm": "hold", "release_after": 2}, own_stream=False), steps=30
    )


@pytest.mark.parametrize("many", [AsyncVectorEnv, ThreadedVectorEnv])
def test_members_in_processes_and_on_threads_are_watched_alike(many):
    ours, theirs = both({"on_alarm": "hold", "max_override": 2}, many=many)
    assert_equal_step_by_step(ours, theirs, steps=25)
    ours.close()


def test_only_the_masked_environments_begin_anew():
    env = VectorNeuralASMSafety(
        SyncVectorEnv(fakes(lambda e: e), autoreset_mode=AutoresetMode.DISABLED), monitor()
    )
    env.reset(seed=0)
    for _ in range(4):
        infos = env.step(np.zeros((3, 3), np.float32))[4]
    assert infos["asm"]["intervened"].tolist() == [True, True, False]
    options = {"reset_mask": np.array([True, False, False])}
    infos = env.reset(options=options)[1]
    assert infos["_asm"].tolist() == [True, False, False]
    assert "reset_mask" in options
    infos = env.step(np.zeros((3, 3), np.float32))[4]
    assert infos["asm"]["intervened"].tolist() == [False, True, False]
    for _ in range(2):
        ended = env.step(np.zeros((3, 3), np.float32))[3]
    assert ended.tolist() == [False, True, False]
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((3, 3), np.float32))


def test_one_observe_serves_all_environments():
    calls = []

    class Counting(FadingMonitor):
        def observe(self, state, stream):
            calls.append(stream.shape)
            return super().observe(state, stream)

    env = VectorNeuralASMSafety(SyncVectorEnv(fakes(lambda e: e)), Counting(CUE))
    calls.clear()  # the row that it was tried with
    env.reset()
    for _ in range(12):
        env.step(np.zeros((3, 3), np.float32))
    assert calls == [(3, SPEC.size)] * 12


def test_actions_of_a_wrong_shape_are_refused_and_end_no_episode():
    many = VectorNeuralASMSafety(SyncVectorEnv(fakes(lambda e: e)), monitor())
    many.reset(seed=0)
    for wrong in (np.zeros(3), np.zeros((3, 4)), np.zeros((2, 3))):
        with pytest.raises(ValueError, match="actions have the shape"):
            many.step(wrong)
    *_, terminated, truncated, _ = many.step(np.zeros((3, 3), np.float32))
    assert not (terminated | truncated).any()


def test_what_makes_no_sense_is_refused(lift):
    many = SyncVectorEnv(fakes(lambda e: e))
    other = StreamSpec(
        (Channel("position", 2, "m"), Channel("weight", 1), Channel("action", 3, group=MOTOR)), 0.05
    )
    with pytest.raises(ValueError, match="weight"):
        VectorNeuralASMSafety(many, FadingMonitor(spec=other))
    with pytest.raises(ValueError, match=r"freeze.*hold"):
        VectorNeuralASMSafety(many, monitor(), on_alarm="freeze")
    with pytest.raises(ValueError, match="give its name"):
        VectorNeuralASMSafety(many, monitor(), on_alarm=Hold(lift))
    # has no memory
    VectorNeuralASMSafety(many, monitor(), on_alarm=Hold(FakeEnv(), safe_action=np.full(3, 0.5)))
    with pytest.raises(ValueError, match="release_after"):
        VectorNeuralASMSafety(many, monitor(), release_after=0)
    with pytest.raises(ValueError, match="DISABLED, got SAME_STEP"):
        VectorNeuralASMSafety(
            SyncVectorEnv(fakes(lambda e: e), autoreset_mode=AutoresetMode.SAME_STEP), monitor()
        )
    with pytest.raises(TypeError, match="VectorEnv"):
        VectorNeuralASMSafety(FakeEnv(), monitor())
    with pytest.raises(gym.error.ResetNeeded):
        VectorNeuralASMSafety(many, monitor()).step(np.zeros((3, 3), np.float32))
    with pytest.raises(TypeError, match="first axis"):
        choose(np.ones(2, bool), 0, 0)
    with pytest.raises(TypeError, match="Box"):
        VectorNeuralASMSafety(gym.make_vec("CartPole-v1", 2), monitor())


def test_robots_side_by_side_are_watched_as_each_alone():
    settings, on_alarm = {"horizon": 15}, "comply"
    episodes = collect("asm_gym/Lift-v0", episodes=4, seed=3, workers=1, **settings)
    asm = NeuralASM(episodes[0].spec, hidden_size=16, association_size=40, epochs=2).fit(
        episodes[:3]
    )
    asm = asm.with_threshold(0.5 * asm.score(episodes[3]).value.max())
    many = gym.make_vec("asm_gym/Lift-v0", num_envs=2, threads=2, **settings)
    many = VectorNeuralASMSafety(many, asm, on_alarm=on_alarm, release_after=2)
    alone = [
        NeuralASMSafety(gym.make("asm_gym/Lift-v0", **settings), asm, on_alarm, release_after=2)
        for _ in range(2)
    ]
    rng = np.random.default_rng(0)
    many.reset(seed=5)
    for i, env in enumerate(alone):
        env.reset(seed=5 + i)
    intervened = 0
    for t in range(36):
        actions = rng.uniform(-1, 1, (2, 7)).astype(np.float32)
        infos = many.step(actions)[4]["asm"]
        for i, env in enumerate(alone):
            if t % 16 == 15:
                env.reset()
                assert infos["surprise"][i] == 0.0
                continue
            info = env.step(actions[i])[4]["asm"]
            assert infos["surprise"][i] == pytest.approx(info["surprise"], rel=1e-4)
            assert infos["intervened"][i] == info["intervened"]
            np.testing.assert_allclose(
                infos["executed_action"][i], info["executed_action"], atol=1e-5
            )
            intervened += info["intervened"]
    assert intervened
    many.close()
