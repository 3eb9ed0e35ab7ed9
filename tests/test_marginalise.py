"""A memory for a stream that lacks channels: closed forms as oracle, and what it still notices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asm_gym.episode import Episode
from asm_gym.memory.marginalise import stand_in
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.adaptation import adapt, for_stream
from asm_gym.spec import Channel, StreamSpec
from asm_gym.wrappers import NeuralASMSafety
from tests.fakes import SPEC, FakeEnv
from tests.streams import frozen, sine_episodes

JOINT, HAND, WRIST = (Channel(n, 4, "rad", group=n) for n in ("joint", "hand", "wrist"))
COMMAND = Channel("command", 2, group="action")
WHOLE = StreamSpec((JOINT, HAND, WRIST, COMMAND), dt=0.05)
RATE = 0.1


@pytest.fixture(scope="module")
def memory() -> NeuralASM:
    episodes = sine_episodes(70, 0, WHOLE)
    made = NeuralASM(WHOLE, hidden_size=32, association_size=60, epochs=3).fit(episodes[:40])
    return made.calibrate(episodes[40:], RATE)


def without(episode: Episode, spec: StreamSpec) -> Episode:
    """The episode with the channels of ``spec`` alone, in its order."""
    columns = np.concatenate([np.arange(WHOLE.size)[WHOLE.slices[c.name]] for c in spec.channels])
    return replace(episode, stream=np.ascontiguousarray(episode.stream[:, columns]), spec=spec)


def alarms(memory: NeuralASM, episodes: list[Episode]) -> float:
    """Share of the episodes that raise one."""
    return float(np.mean([s.value.max() > memory.threshold for s in memory.score_episodes(episodes)]))


def test_what_stands_in_is_the_conditional_mean_of_a_gaussian():
    rng = np.random.default_rng(0)
    mixing, offset = rng.normal(size=(5, 5)), rng.normal(size=5)
    S = mixing @ mixing.T
    C = np.block([[S + np.outer(offset, offset), offset[:, None]], [offset[None], np.ones((1, 1))]])
    names = [("a", n) for n in range(5)] + [("one", 0)]
    left = [names[3], names[0], names[5]]  # in another order
    T = stand_in(C, names, left, frozenset())
    seen, lost = [3, 0], [1, 2, 4]
    x = rng.normal(size=2)
    mean = offset[lost] + S[np.ix_(lost, seen)] @ np.linalg.solve(S[np.ix_(seen, seen)], x - offset[seen])
    np.testing.assert_allclose(T[lost] @ [*x, 1.0], mean, rtol=2e-3, atol=2e-3)  # all but the penalty
    np.testing.assert_array_equal(T[[3, 0, 5]], np.eye(3))


def test_a_memory_that_lacks_nothing_is_the_same_in_any_order(memory):
    turned = StreamSpec((COMMAND, WRIST, JOINT, HAND), dt=0.05)
    episode = sine_episodes(1, 5, WHOLE)[0]
    whole, other = memory.score(episode), for_stream(memory, turned).score(without(episode, turned))
    np.testing.assert_allclose(other.value, whole.value, rtol=2e-3)
    assert for_stream(memory, turned).threshold == memory.threshold


@pytest.mark.parametrize("lacks", [("wrist",), ("command",), ("hand", "command")])
def test_what_is_left_is_watched_and_false_alarms_stay_few(memory, lacks):
    spec = StreamSpec(tuple(c for c in WHOLE.channels if c.name not in lacks), dt=0.05)
    fewer = for_stream(memory, spec)
    nominal = sine_episodes(60, 9, WHOLE)
    # Of 60 at 10 %, calibrated on 30: beyond 20 once in a hundred.
    assert alarms(fewer, [without(e, spec) for e in nominal]) <= 20 / 60
    stuck = [without(frozen(e, 1, 15), spec) for e in nominal[:20]]
    assert alarms(fewer, stuck) >= 0.9


def test_it_is_saved_calibrated_and_learns_on_the_job_as_any_other(memory, tmp_path):
    spec = StreamSpec((JOINT, WRIST), dt=0.05)
    before = {name: array.tobytes() for name, array in memory.learned_.items()}
    fewer = for_stream(memory, spec)
    assert {name: array.tobytes() for name, array in memory.learned_.items()} == before
    episodes = [without(e, spec) for e in sine_episodes(20, 3, WHOLE)]
    fewer.save(tmp_path / "fewer.asm")
    again = NeuralASM.load(tmp_path / "fewer.asm")
    np.testing.assert_array_equal(again.score(episodes[0]).value, fewer.score(episodes[0]).value)
    again.calibrate(episodes, 0.2)
    state = again.initial_state()
    for row in episodes[0].stream[:10]:
        before = state
        state, surprise = again.observe(state, row[None])
    assert adapt(again, before, episodes[0].stream[9:10], surprise).shape == (1,)
    with pytest.raises(ValueError, match="lost senses before"):
        for_stream(again, StreamSpec((JOINT,), dt=0.05))


def test_commands_of_another_controller_are_not_looked_at(memory):
    spec = StreamSpec((JOINT, HAND, WRIST, Channel("command", 5, group="action")), dt=0.05)
    fewer, rng = for_stream(memory, spec), np.random.default_rng(0)
    episode = sine_episodes(1, 4, WHOLE)[0]
    streams = [np.hstack([episode.stream[:, :12], rng.normal(size=(len(episode), 5))]) for _ in range(2)]
    first, second = (fewer.score(Episode.from_stream(s, spec)).value for s in streams)
    np.testing.assert_allclose(first, second, rtol=1e-5)


@pytest.mark.parametrize(
    ("channels", "named"),
    [
        ((JOINT, Channel("camera", 3)), "camera: new"),
        ((Channel("joint", 6, "rad", group="joint"), HAND), "joint: size 4 against 6"),
        ((Channel("joint", 4, "deg", group="joint"), HAND), "joint: unit rad against deg"),
    ],
)
def test_senses_that_it_never_met_are_refused_by_name(memory, channels, named):
    with pytest.raises(ValueError, match=named):
        for_stream(memory, StreamSpec((*channels, COMMAND), dt=0.05))


def test_another_rate_and_a_memory_that_has_learned_nothing_are_refused(memory):
    with pytest.raises(ValueError, match=r"0\.01"):
        for_stream(memory, StreamSpec((JOINT, COMMAND), dt=0.01))
    with pytest.raises(RuntimeError, match="fit"):
        for_stream(NeuralASM(WHOLE), StreamSpec((JOINT,), dt=0.05))


def test_the_wrapper_watches_with_what_is_there_and_says_what_is_not():
    spec = StreamSpec((*SPEC.channels, Channel("wrist", 2, group="wrist")), dt=SPEC.dt)
    rng = np.random.default_rng(0)
    episodes = [Episode.from_stream(np.cumsum(rng.normal(size=(40, spec.size)), axis=0), spec) for _ in range(20)]
    memory = NeuralASM(spec, hidden_size=8, association_size=16, epochs=1).fit(episodes).calibrate(episodes, 0.1)
    with pytest.warns(UserWarning, match="wrist: missing"):
        env = NeuralASMSafety(FakeEnv(), memory, on_alarm="monitor")
    assert env.monitor.spec == replace(SPEC, source=env.monitor.spec.source)
    env.reset()
    assert set(env.step(np.zeros(3, np.float32))[-1]["asm"]["attribution"]) == set(SPEC.labels)


def test_the_wrapper_refuses_senses_that_the_memory_never_met():
    spec = StreamSpec((Channel("elsewhere", 2), *SPEC.channels[1:]), dt=SPEC.dt)
    rng = np.random.default_rng(0)
    episodes = [Episode.from_stream(rng.normal(size=(40, spec.size)), spec) for _ in range(20)]
    memory = NeuralASM(spec, hidden_size=8, association_size=16, epochs=1).fit(episodes).calibrate(episodes, 0.1)
    with pytest.raises(ValueError, match="position: new"):
        NeuralASMSafety(FakeEnv(), memory)
