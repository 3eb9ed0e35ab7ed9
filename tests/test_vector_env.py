"""The vector on threads equals Gymnasium's vector of one thread, and ends its threads."""

import threading

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RecordVideo

from asm_gym import FaultInjection, StreamRecorder
from asm_gym.envs.vector import ThreadedVectorEnv
from asm_gym.faults import Push
from asm_gym.graphics import rendering_backend
from tests.fakes import FakeEnv


class Talking(FakeEnv):
    """Says all kinds of things, some of them only in some steps, and on which threads it lived."""

    def __init__(self, length, first):
        super().__init__(length, first=first)
        self.lived_on = {threading.get_ident()}

    def _out(self, action):
        observation, info = super()._out(action)
        info |= {"step": self.t, "load": np.float64(self.first + self.t), "names": ("a",) * self.t}
        info |= {"nested": {"load": 0.5 * self.t, "row": observation}}
        if self.t == self.first % 5:
            info |= {"rare": self.t, "row": np.arange(3)}
        return observation, info

    def step(self, action):
        self.lived_on |= {threading.get_ident()}
        if action[0] > 0.9 and self.first == 2:
            raise RuntimeError("out of order")
        return super().step(action)

    def render(self):
        self.lived_on |= {threading.get_ident()}
        return super().render()


def members(n=5):
    return [lambda i=i: Talking(length=4 + i % 3, first=i) for i in range(n)]


def play(envs, steps, masked):
    seen = [envs.reset(seed=3)]
    for t in range(steps):
        *outcome, info = envs.step(np.full((envs.num_envs, 3), 0.1 * (t % 7), np.float32))
        seen.append((outcome, info))
        ended = outcome[2] | outcome[3]
        if masked and ended.any():
            seen.append(envs.reset(options={"reset_mask": ended}))
    return seen


@pytest.mark.parametrize("threads", [1, 2, 3, 8])
@pytest.mark.parametrize("mode", AutoresetMode)
def test_it_gives_what_gymnasiums_vector_gives(mode, threads):
    ours = ThreadedVectorEnv(members(), threads=threads, autoreset_mode=mode)
    theirs = SyncVectorEnv(members(), autoreset_mode=mode)
    masked = mode == AutoresetMode.DISABLED
    mine, wanted = play(ours, 15, masked), play(theirs, 15, masked)
    for one, other in zip(mine, wanted, strict=True):
        assert data_equivalence(list(one), list(other))
    assert ours.metadata["autoreset_mode"] is mode
    ours.close()


def test_what_was_handed_out_stays_as_it_was():
    envs = ThreadedVectorEnv(members(), threads=2)
    observation = envs.reset(seed=0)[0]
    *outcome, info = envs.step(np.zeros((5, 3), np.float32))
    kept = [
        observation.copy(),
        *(part.copy() for part in outcome),
        info["stream"].copy(),
        info["_stream"].copy(),
    ]
    envs.step(np.ones((5, 3), np.float32) * 0.5)
    assert data_equivalence(kept, [observation, *outcome, info["stream"], info["_stream"]])
    envs.close()


def test_a_member_lives_on_one_thread_which_ends_with_the_vector():
    before = set(threading.enumerate())
    envs = ThreadedVectorEnv(members(6), threads=3)
    envs.reset()
    for _ in range(3):
        envs.step(np.zeros((6, 3), np.float32))
        envs.render()
    main = threading.get_ident()
    lived = [
        threads - {main} if i > 1 else threads
        for i, threads in enumerate(envs.get_attr("lived_on"))
    ]
    assert all(len(threads) == 1 for threads in lived)
    assert len(set.union(*lived)) == 3
    envs.close()
    envs.close()
    assert set(threading.enumerate()) == before


def test_an_error_of_a_member_reaches_the_caller_once_the_others_are_done():
    envs = ThreadedVectorEnv(members(), threads=3)
    envs.reset()
    with pytest.raises(RuntimeError, match="out of order"):
        envs.step(np.ones((5, 3), np.float32))
    assert envs.get_attr("t")[4] == 1
    envs.close()
    with pytest.raises(ValueError, match="threads must be"):
        ThreadedVectorEnv(members(), threads=0)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"seed": [1, 2]}, ValueError),
        ({"options": {"reset_mask": np.ones(2, bool)}}, ValueError),
        ({"options": {"reset_mask": np.arange(5) > 3}}, gym.error.ResetNeeded),
    ],
)
def test_a_reset_that_does_not_fit_is_refused(options, error):
    with pytest.raises(error):
        ThreadedVectorEnv(members()).reset(**options)


def test_robots_on_threads_move_as_each_alone():
    def wrapped():
        env = gym.make("asm_gym/Lift-v0", horizon=8, stream_freq=100)
        return StreamRecorder(
            FaultInjection(env, [Push(body="robot0_link5", newtons=20.0, onset=2)])
        )

    envs = {n: ThreadedVectorEnv([wrapped] * 3, threads=n) for n in (1, 3)}
    actions = np.random.default_rng(0).uniform(-1, 1, (12, 3, 7)).astype(np.float32)
    played = {n: [many.reset(seed=0), *map(many.step, actions)] for n, many in envs.items()}
    assert data_equivalence(played[1], played[3])
    for one, other in zip(*(many.get_attr("episodes") for many in envs.values()), strict=True):
        np.testing.assert_array_equal(one[0].stream, other[0].stream)
        assert one[0].faults.any()
    for many in envs.values():
        many.close()


@pytest.mark.skipif(rendering_backend() is None, reason="this machine has no OpenGL to render with")
def test_members_are_filmed_each_on_its_thread(tmp_path):
    pytest.importorskip("moviepy")  # which wants another Pillow than everything else

    def filmed(i):
        return RecordVideo(
            gym.make("asm_gym/Lift-v0", horizon=2, render_mode="rgb_array"), str(tmp_path / str(i))
        )

    envs = ThreadedVectorEnv([lambda i=i: filmed(i) for i in range(2)], threads=2)
    envs.reset(seed=0)
    for _ in range(3):
        envs.step(np.zeros((2, 7), np.float32))
    assert all(picture.any() for picture in envs.render())
    envs.close()
    assert all(list((tmp_path / str(i)).glob("*.mp4")) for i in range(2))
