"""Members that step on threads, against Gymnasium's own, which step one after another."""

import threading
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import asm_gym  # noqa: F401
from asm_gym.envs.threaded_vector import ThreadVectorEnv
from asm_gym.graphics import rendering_backend


class Countdown(gym.Env):
    """Ends after as many steps as its seed has; a number above 1 breaks it."""

    observation_space = gym.spaces.Box(0, 100, (1,), np.float32)
    action_space = gym.spaces.Box(-9, 9, (1,), np.float32)
    together = None

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = seed or 3
        return np.array([self.left], np.float32), {"thread": threading.get_ident()}

    def step(self, action):
        if self.together is not None:
            self.together.wait()
        if action[0] > 1:
            raise RuntimeError("broken")
        self.left -= 1
        info = {"thread": threading.get_ident()}
        return np.array([self.left], np.float32), float(action[0]), self.left == 0, False, info

    def close(self):
        self.closed_on = threading.get_ident()


def course(envs, steps, seed):
    """All that is returned, infos included, as bytes."""
    shown = [envs.reset(seed=seed)]
    for actions in np.random.default_rng(0).uniform(-1, 1, (steps, *envs.action_space.shape)).astype(np.float32):
        shown.append(envs.step(actions))
        if envs.autoreset_mode is AutoresetMode.DISABLED and envs._autoreset_envs.any():
            shown.append(envs.reset(options={"reset_mask": envs._autoreset_envs.copy()}))
    return [text(entry) for entry in shown]


def text(value):
    if isinstance(value, dict):
        return {key: text(entry) for key, entry in value.items() if key not in ("thread", "_thread")}
    if isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.dtype == object):
        return [text(entry) for entry in value]
    return value.tobytes() if isinstance(value, np.ndarray) else value


@pytest.mark.parametrize("mode", AutoresetMode)
def test_threads_return_what_gymnasium_returns(mode):
    expected = course(SyncVectorEnv([Countdown] * 3, autoreset_mode=mode), 12, [2, 5, 3])
    envs = ThreadVectorEnv([Countdown] * 3, autoreset_mode=mode)
    assert course(envs, 12, [2, 5, 3]) == expected
    envs.close()


def test_robots_on_threads_move_as_they_do_one_after_another():
    make = [partial(gym.make, "asm_gym/Lift-v0", horizon=6)] * 2
    one, other = SyncVectorEnv(make), ThreadVectorEnv(make)
    expected = course(one, 9, 4)
    assert course(other, 9, 4) == expected
    assert len({str(entry) for entry in expected}) == len(expected)
    one.close()
    other.close()


def test_members_step_at_the_same_time_each_on_its_own_thread():
    envs = ThreadVectorEnv([Countdown] * 3)
    before = envs.reset(seed=[9, 9, 9])[1]["thread"]
    # Nobody passes before all have come: one after another they would wait for ever.
    barrier = threading.Barrier(3, timeout=20)
    for env in envs.envs:
        env.unwrapped.together = barrier
    after = envs.step(np.zeros((3, 1), np.float32))[4]["thread"]
    np.testing.assert_array_equal(before, after)
    assert len({*after, threading.get_ident()}) == 4
    bare = [env.unwrapped for env in envs.envs]
    envs.close()
    assert [env.closed_on for env in bare] == list(after)
    assert not {*after} & {thread.ident for thread in threading.enumerate()}
    envs.close()


def test_a_member_that_raises_leaves_none_under_way():
    envs = ThreadVectorEnv([Countdown] * 3)
    envs.reset(seed=[9, 9, 9])
    with pytest.raises(RuntimeError, match="broken"):
        envs.step(np.array([[2], [0], [0]], np.float32))
    assert [env.unwrapped.left for env in envs.envs] == [9, 8, 8]
    assert envs.step(np.zeros((3, 1), np.float32))[0].ravel().tolist() == [8, 7, 7]
    with pytest.raises(ValueError, match="3 environments need as many actions, got 2"):
        envs.step(np.zeros((2, 1), np.float32))
    assert [env.unwrapped.left for env in envs.envs] == [8, 7, 7]
    envs.close()


@pytest.mark.skipif(rendering_backend() is None, reason="this machine has no OpenGL to render with")
def test_pictures_on_threads_are_those_taken_one_after_another():
    """Each from a context of its own thread, of the shape that was drawn last."""
    options = {"render_mode": "rgb_array", "render_size": (48, 48)}
    make = [partial(gym.make, "asm_gym/Lift-v0", **options)] * 2
    one, other = SyncVectorEnv(make), ThreadVectorEnv(make)
    other.reset(seed=7)
    other.render()
    assert course(other, 2, 4) == course(one, 2, 4)
    shown = other.render()
    np.testing.assert_array_equal(shown, one.render())
    assert (shown[0] != shown[1]).any()
    one.close()
    other.close()
