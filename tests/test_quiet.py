"""Rows in which nothing happens are judged in one compiled call: as all others are, to the last bit."""

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.addresses import flags1, floats1, floats2, table
from asm_gym.compilation import compiled
from asm_gym.faults import make_fault
from asm_gym.monitors import NeuralASM
from asm_gym.wrappers import FaultInjection, NeuralASMSafety
from asm_gym.wrappers.quiet import QuietRow, QuietRows
from tests.streams import sine_episodes, sine_spec

pytestmark = pytest.mark.filterwarnings("ignore:.*which counts as an alarm", "ignore:.*another is done instead")


def plain(said):
    """What can be compared, without how long it took."""
    if isinstance(said, dict):
        return {name: plain(said[name]) for name in said if name != "latency_us"}
    if isinstance(said, np.ndarray):
        return said.dtype.str, said.shape, said.tobytes()
    return repr(said)


def told(env, steps, actions):
    """What comes of each step, as it is read after the next one, and how many rows were quiet."""
    _, info = env.reset(seed=3)
    found, quiet = [info], 0
    for t in range(steps):
        observation, reward, terminated, truncated, info = env.step(actions[t])
        quiet += sum(isinstance(row, QuietRow) for row in env._rows)
        found.append({"observation": observation, "reward": reward, **info, "asm": info["asm"]})
        if terminated or truncated:
            break
    return [plain({**said, "asm": dict(said["asm"])}) for said in found], quiet


def both(make, actions, monkeypatch):
    """With and without the compiled call."""
    with_it = told(make(), len(actions), actions)
    monkeypatch.setattr(QuietRows, "of", lambda monitor, guard: None)
    without = told(make(), len(actions), actions)
    assert without[1] == 0
    for t, (one, other) in enumerate(zip(*(found for found, _ in (with_it, without)), strict=True)):
        assert one == other, t
    return with_it[1], len(with_it[0]) - 1


def jerks(steps, size, seed=0, every=7):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1, 1, (steps // every + 1, size)), every, axis=0)[:steps].astype(np.float32)


@pytest.mark.parametrize(
    ("fault", "reflex"), [("", None), ("", "hold"), ("", "monitor"), ("", "retract"), ("frozen_encoder", None)]
)
def test_a_guarded_episode_is_the_same_to_the_last_bit(fault, reflex, monkeypatch):
    panda = NeuralASM.pretrained("panda")

    def make():
        env = gym.make("asm_gym/Lift-v0", disable_env_checker=True)
        env = FaultInjection(env, [make_fault(fault, onset=12)]) if fault else env
        return NeuralASMSafety(env, panda, reflex, on_overrun="ignore")

    quiet, steps = both(make, jerks(50, 7), monkeypatch)
    assert 5 < quiet < steps  # some are quiet, and some are not


@pytest.mark.parametrize("share", [100.0, 0.25])
def test_rows_within_control_steps_are_the_same_too(share, monkeypatch):
    fast = NeuralASM.pretrained("panda_100hz")
    fast = fast.with_threshold(share * fast.threshold)

    def make():
        env = gym.make("asm_gym/Lift-v0", disable_env_checker=True)
        return NeuralASMSafety(env, fast, monitor_freq=100, on_overrun="ignore")

    assert both(make, jerks(15, 7), monkeypatch)[0] > 5


class Replayed(gym.Env):
    """Plays a recorded stream back, of which some rows are spoilt."""

    metadata = {"render_fps": 20}  # noqa: RUF012

    def __init__(self, spec, rows):
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (len(spec.sensory),), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (len(spec.motor),), np.float32)
        self.stream_spec, self.rows = spec, rows

    def _out(self):
        row = self.rows[self.t].copy()
        return row[self.stream_spec.sensory], {"stream": row}

    def reset(self, *, seed=None, options=None):
        self.t = 0
        return self._out()

    def step(self, action):
        self.t += 1
        observation, info = self._out()
        return observation, 0.0, False, self.t == len(self.rows) - 1, info


@pytest.fixture(scope="module")
def memory():
    small = NeuralASM(sine_spec(), hidden_size=8, association_size=8, epochs=1, excuses=True)
    return small.fit(sine_episodes(8)).calibrate(sine_episodes(20, seed=1), 0.1)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("reflex", ["monitor", "terminate", "hold"])
def test_rows_that_are_spoilt_are_judged_as_they_are_without(memory, reflex, seed, monkeypatch):
    rng = np.random.default_rng(seed)
    (episode,) = sine_episodes(1, seed=50 + seed, steps=(55, 55))
    rows, actions = episode.stream.copy(), np.zeros((54, 2), np.float32)
    for t in rng.choice(np.arange(10, 50), 4, replace=False):
        rows[t, rng.integers(12)] += rng.choice([np.nan, np.inf, 0.3, 20.0])
    actions[rng.integers(20, 50)] = np.nan
    quiet, steps = both(
        lambda: NeuralASMSafety(Replayed(sine_spec(), rows), memory, reflex, on_overrun="ignore"), actions, monkeypatch
    )
    assert 0 < quiet <= steps


def test_a_quiet_row_that_is_late_is_an_alarm_too(memory, monkeypatch):
    (episode,) = sine_episodes(1, seed=50, steps=(55, 55))
    calm = memory.with_threshold(1e6)
    env = NeuralASMSafety(Replayed(sine_spec(), episode.stream), calm, "monitor", on_overrun="alarm")
    env.reset(seed=0)
    said = [env.step(np.zeros(2, np.float32))[4]["asm"]["alarm"] for _ in range(3)]
    clock = iter(np.arange(0.0, 100.0))
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    said += [env.step(np.zeros(2, np.float32))[4]["asm"]["alarm"] for _ in range(2)]
    assert said == [False, False, False, True, True]


@pytest.mark.parametrize("rows", [np.zeros(13, np.float32), np.zeros(14), np.zeros((1, 14), np.float32)])
def test_a_row_that_is_none_is_left_to_who_says_so(memory, rows):
    (episode,) = sine_episodes(1, seed=50, steps=(55, 55))
    env = NeuralASMSafety(Replayed(sine_spec(), episode.stream), memory.with_threshold(1e6), "monitor")
    env.reset(seed=0)
    assert env._quiet.judge(episode.stream[0], None, 1e6) is not None
    assert env._quiet.judge(rows, None, 1e6) is None


def test_a_memory_that_is_calibrated_while_it_watches_is_taken_over_at_the_next_reset(memory):
    (episode,) = sine_episodes(1, seed=50, steps=(55, 55))
    mine = memory.with_threshold(1e6)
    env = NeuralASMSafety(Replayed(sine_spec(), episode.stream), mine, "monitor", on_overrun="ignore")
    env.reset(seed=0)
    assert not env.step(np.zeros(2, np.float32))[4]["asm_alarm"]
    mine.fit(sine_episodes(8, seed=2))
    said = env.step(np.zeros(2, np.float32))[4]["asm"]
    assert said["alarm"]
    assert "it was fitted while it watched" in said["failure"]


def test_a_row_is_read_in_one_call_as_it_is_with_faults_of_sensors():
    def rows(faults):
        env = gym.make("asm_gym/Lift-v0", disable_env_checker=True, stream_freq=100)
        _, info = env.reset(seed=5)
        env.unwrapped.corruptions += faults
        found = [info["stream"][None], *(env.step(action)[4]["streams"] for action in jerks(12, 7))]
        return np.concatenate(found), env.unwrapped.measured

    for one, other in zip(rows([]), rows([lambda row: None]), strict=True):
        np.testing.assert_array_equal(one, other)


def test_arrays_are_found_by_where_they_lie():
    numbers, flags = np.arange(6.0).reshape(2, 3), np.array([True, False])
    t = table((7, numbers, flags, numbers[0]))
    assert t[0, 0] == 7
    np.testing.assert_array_equal(_added_up(t), 2 * numbers + 1.0)
    numbers[0, 0] = 5.0
    assert _added_up(t)[0, 0] == 11.0
    with pytest.raises(ValueError, match=r"an array of shape \(3, 2\) does not lie in one piece"):
        table((numbers.T,))


@compiled
def _added_up(t):
    """Twice the second array, and a number of the last where a flag of the third says so."""
    flags = flags1(t, 2)
    return 2 * floats2(t, 1) + (floats1(t, 3)[1] if flags[0] and not flags[1] else 0.0)
