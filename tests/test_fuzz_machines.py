"""Calls in any order: a guard, a monitor, an environment and files, each against a model of what they promise.

``SOAK`` (an environment variable, 1 by default) multiplies how many runs each machine makes; ``make soak`` sets it.
"""

import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from asm_gym import faults
from asm_gym.checkpoint import read_checkpoint, write_checkpoint
from asm_gym.monitors import NeuralASM
from asm_gym.validation import as_float32
from asm_gym.wrappers import FaultInjection, NeuralASMSafety
from tests.fakes import CueMonitor, FakeEnv
from tests.streams import sine_episodes, sine_spec

FAULTS = {
    name: kind for name, kind in vars(faults).items() if isinstance(kind, type) and name != "Fault"
}

SOAK = int(os.environ.get("SOAK", "1"))


def runs(examples: int, steps: int) -> settings:
    """So many runs of so many calls; the same every time, and others in a soak."""
    return settings(
        max_examples=examples * SOAK,
        stateful_step_count=steps,
        deadline=None,
        derandomize=SOAK == 1,
        suppress_health_check=list(HealthCheck),
    )


numbers = st.one_of(st.floats(-3, 3), st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e39]))
actions = st.one_of(
    st.lists(st.floats(-1, 1), min_size=3, max_size=3),
    st.lists(numbers, min_size=3, max_size=3),
    st.sampled_from([None, "hold", 0.5, [], [0.0] * 4, [[0.0] * 3], object(), {}, [None] * 3]),
)


class Playing(FakeEnv):
    """Plays whatever rows it is told to, and may fail."""

    def __init__(self):
        super().__init__(length=12)
        self.next, self.fails = None, False

    def reset(self, *, seed=None, options=None):
        if self.fails:
            raise RuntimeError("no robot")
        return super().reset(seed=seed, options=options)

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        if self.fails:
            raise RuntimeError("the robot has gone")
        if isinstance(self.next, str):
            del info["stream"]
        elif self.next is not None:
            info["stream"] = as_float32(self.next)
        return observation, reward, terminated, truncated, info


class Guard(RuleBasedStateMachine):
    """The safety wrapper: whatever is sensed, asked for and called, only finite actions in the box reach the robot."""

    @initialize(
        on_alarm=st.sampled_from(["hold", "monitor", "terminate", "graded"]),
        release_after=st.integers(1, 5),
        max_override=st.one_of(st.none(), st.integers(1, 6)),
        cue=st.sets(st.integers(0, 12)),
    )
    def made(self, on_alarm, release_after, max_override, cue):
        self.robot = Playing()
        self.acts = on_alarm != "monitor"
        self.env = NeuralASMSafety(
            self.robot,
            CueMonitor(tuple(cue)),
            on_alarm,
            release_after=release_after,
            max_override=max_override,
        )
        self.running = False

    @rule(seed=st.one_of(st.none(), st.integers(0, 5)))
    def reset(self, seed):
        self.robot.fails, self.robot.next = False, None
        _, info = self.env.reset(seed=seed)
        self.running = True
        assert not info["asm"]["alarm"]
        assert info["cost"] == 0.0

    @rule()
    def reset_of_a_robot_that_is_off(self):
        self.robot.fails, self.running = True, False
        with pytest.raises(RuntimeError, match="no robot"):
            self.env.reset()

    @rule(row=st.one_of(st.none(), st.just("missing"), st.lists(numbers, min_size=5, max_size=5)))
    def senses(self, row):
        self.robot.next = row

    @rule(action=actions)
    def step(self, action):
        before = len(self.robot.actions) if self.running else 0
        try:
            _, _, terminated, truncated, info = self.env.step(action)
        except gym.error.ResetNeeded:
            assert not self.running
            return
        except (TypeError, ValueError):
            # A refused action has not been done; an episode that ran still does.
            assert not self.running or len(self.robot.actions) == before
            assert not (np.shape(action) == (3,) and np.asarray(action).dtype.kind == "f")
            return
        assert self.running
        self.running = not (terminated or truncated)
        asm = info["asm"]
        assert info["cost"] == float(asm["alarm"]) == float(info["asm_alarm"])
        assert asm["alarm"] == (asm["surprise"] > asm["threshold"] or asm["reason"] == "missing")
        assert not asm["failure"] or asm["alarm"]
        lost = isinstance(self.robot.next, str) or not np.isfinite(as_float32(action)).all()
        assert asm["alarm"] or asm["intervened"] or not lost
        if asm["intervened"]:
            assert self.acts or not np.isfinite(as_float32(action)).all()

    @precondition(lambda self: self.running)
    @rule()
    def robot_goes_away(self):
        self.robot.fails, self.running = True, False
        with pytest.raises(RuntimeError, match="has gone"):
            self.env.step(np.zeros(3, np.float32))

    @invariant()
    def what_reached_the_robot_was_an_action(self):
        for action in getattr(getattr(self, "robot", None), "actions", []):
            assert action.shape == (3,)
            assert np.isfinite(action).all()


TestGuard = Guard.TestCase
TestGuard.settings = runs(40, 30)
# the wrapper says whom it does not believe
quiet = pytest.mark.filterwarnings("ignore::UserWarning")
TestGuard.pytestmark = [quiet]


def fitted() -> NeuralASM:
    episodes = sine_episodes(24, spec=sine_spec(4, 1))
    asm = NeuralASM(episodes[0].spec, hidden_size=8, association_size=16, epochs=1)
    return asm.fit(episodes[:14]).calibrate(episodes[14:], 0.1)


class Watching(RuleBasedStateMachine):
    """A memory: it forgets nothing it has learned and learns nothing while it watches; what is odd is never calm."""

    asm: NeuralASM

    @initialize(batch=st.integers(1, 3))
    def made(self, batch):
        cls = type(self)
        if not hasattr(cls, "asm"):
            cls.asm = fitted()
            cls.bytes = _saved(cls.asm)
        self.batch, self.mine = batch, cls.asm
        self.state = self.mine.initial_state(batch)

    @rule(data=st.data())
    def observe(self, data):
        row = st.lists(numbers, min_size=self.mine.spec.size, max_size=self.mine.spec.size)
        rows = np.array(data.draw(st.lists(row, min_size=self.batch, max_size=self.batch)))
        kept = rows.copy()
        state, surprise = self.mine.observe(self.state, rows)
        again = self.mine.observe(self.state, rows)[1]
        np.testing.assert_array_equal(surprise.value, again.value)  # a state is a value
        np.testing.assert_array_equal(rows, kept)
        finite = np.isfinite(rows).all(axis=1)
        assert not np.isnan(surprise.value).any()
        assert (surprise.value >= 0.0).all()
        assert np.isinf(surprise.value[~finite]).all()
        assert np.isfinite(surprise.value[finite]).all()
        np.testing.assert_allclose(surprise.attribution.sum(axis=1)[finite], surprise.value[finite])
        self.state = state

    @rule()
    def forget(self):
        self.state = self.mine.reset_evidence(self.state)

    @rule()
    def saved_and_loaded(self):
        with tempfile.TemporaryDirectory() as folder:
            self.mine.save(Path(folder) / "x.asm")
            self.mine = NeuralASM.load(Path(folder) / "x.asm")

    @invariant()
    def nothing_was_learned(self):
        if hasattr(self, "mine"):
            assert _saved(self.mine) == type(self).bytes


def _saved(asm: NeuralASM) -> bytes:
    return b"".join(np.ascontiguousarray(a).tobytes() for _, a in sorted(asm.learned_.items()))


TestWatching = Watching.TestCase
TestWatching.settings = runs(25, 20)


class World(RuleBasedStateMachine):
    """A robosuite environment: resets are exact whatever ran before, and faults leave nothing behind."""

    env: gym.Env
    first: dict

    @initialize()
    def made(self):
        cls = type(self)
        if not hasattr(cls, "env"):
            cls.env, cls.first = gym.make("asm_gym/Stack-v0", horizon=6), {}
        self.inner, self.outer, self.running = cls.env.unwrapped, cls.env, None
        with suppress(
            ValueError
        ):  # the example before may have left it in the middle of an episode
            self.inner.reset(options={"noise": 1})

    @rule(seed=st.integers(0, 2))
    def reset(self, seed):
        row = self.outer.reset(seed=seed)[1]["stream"]
        if self.outer is self.env:
            np.testing.assert_array_equal(type(self).first.setdefault(seed, row), row)
        self.running = seed

    @rule(
        options=st.sampled_from(
            [{"qpos_noise": -1}, {"noise": 1}, {"qpos_noise": None}, 3, [("qpos_noise", 0)]]
        )
    )
    def reset_that_makes_no_sense(self, options):
        with pytest.raises(ValueError, match=r"qpos_noise|option"):
            self.outer.unwrapped.reset(options=options)
        self.running = None

    @rule(
        action=st.one_of(st.lists(numbers, min_size=7, max_size=7), st.lists(numbers, max_size=3))
    )
    def step(self, action):
        action = as_float32(action)
        if action.shape != (7,) or not np.isfinite(action).all():
            with pytest.raises(ValueError, match=r"finite|shape"):
                self.outer.unwrapped.step(action)
            return
        if self.running is None:
            with pytest.raises(gym.error.ResetNeeded):
                self.outer.step(action)
            return
        _, reward, terminated, truncated, info = self.outer.step(action)
        assert info["unstable"] or np.isfinite(info["stream"]).all()
        assert np.isfinite(reward)
        if terminated or truncated:
            self.running = None

    @precondition(lambda self: self.running is None)
    @rule(
        kinds=st.lists(st.sampled_from(sorted(FAULTS)), min_size=1, max_size=2),
        onset=st.integers(0, 3),
    )
    def faults(self, kinds, onset):
        self.mended()
        with suppress(ValueError):  # nothing here to act on
            self.outer = FaultInjection(self.env, [FAULTS[k](onset=onset) for k in kinds])

    @precondition(lambda self: self.running is None)
    @rule()
    def mended(self):
        if self.outer is not self.env:
            self.outer.undo_faults()
            self.outer = self.env
        assert not len(self.inner.edits)
        assert not [*self.inner.corruptions, *self.inner.deliveries, *self.inner.substep_hooks]

    def teardown(self):
        if hasattr(self, "outer"):
            self.running = None
            self.mended()


TestWorld = World.TestCase
TestWorld.settings = runs(8, 20)
TestWorld.pytestmark = [pytest.mark.filterwarnings("ignore")]

arrays = st.builds(
    lambda shape, kind, seed: np.random.default_rng(seed).normal(size=shape).astype(kind),
    st.lists(st.integers(0, 4), max_size=3).map(tuple),
    st.sampled_from(["f4", "f8", "i8", "u1", "?"]),
    st.integers(0, 9),
)


class Archive(RuleBasedStateMachine):
    """A checkpoint: what is read is what was written last, bit by bit, or is refused in words."""

    def __init__(self):
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        self.path = self.folder / "x.asm"
        self.held, self.damaged = None, False

    @rule(
        held=st.dictionaries(st.sampled_from(["W", "b", "deep/er", "x y"]), arrays, max_size=3),
        number=st.floats(),
    )
    def write(self, held, number):
        try:
            write_checkpoint(self.path, "test", {"number": number}, held)
        except ValueError:
            assert not np.isfinite(number)
            return
        self.held, self.damaged = held | {"": number}, False

    @precondition(lambda self: self.held is not None and not self.damaged)
    @rule(data=st.data())
    def damage(self, data):
        whole = self.path.read_bytes()
        at = data.draw(st.integers(0, len(whole) - 1))
        how = data.draw(st.sampled_from(["flip", "cut", "repeat", "zeros"]))
        flipped = (
            whole[:at] + bytes([whole[at] ^ (1 << data.draw(st.integers(0, 7)))]) + whole[at + 1 :]
        )
        made = {
            "flip": flipped,
            "cut": whole[:at],
            "repeat": whole + whole[at:],
            "zeros": whole[:at] + b"\0" * 64,
        }
        self.path.write_bytes(made[how])
        self.damaged = made[how] != whole

    @rule(kind=st.sampled_from(["test", "other"]))
    def read(self, kind):
        if self.held is None or kind != "test":
            with pytest.raises(
                FileNotFoundError if self.held is None else ValueError, match=r"x\.asm"
            ):
                read_checkpoint(self.path, kind)
            return
        try:
            found = read_checkpoint(self.path, kind)
        except ValueError as refused:
            assert self.damaged
            assert str(self.path) in str(refused)  # noqa: PT017
            return
        # Damage may hit what a zip keeps twice, or nobody reads: then nothing else is read than what was written.
        assert found.header["number"] == self.held[""]
        assert {n: a.tobytes() for n, a in found.arrays.items()} == {
            n: a.tobytes() for n, a in self.held.items() if n
        }

    @invariant()
    def nothing_is_left_lying_about(self):
        assert [p.name for p in self.folder.iterdir()] in ([], ["x.asm"])

    def teardown(self):
        shutil.rmtree(self.folder)


TestArchive = Archive.TestCase
TestArchive.settings = runs(60, 20)
