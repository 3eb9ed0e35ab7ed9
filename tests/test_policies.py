"""Experts, reflexes and policies by name."""

import numpy as np
import pytest

from asm_gym.policies import make_policy, rollout
from asm_gym.policies.hold import Hold
from asm_gym.policies.scripted.expert import Style
from tests.fakes import FakeEnv


def test_one_seed_gives_one_course_and_another_seed_another(lift):
    observation, _ = lift.reset(seed=0)

    def actions(seed):
        policy, state = make_policy("scripted", lift, seed=seed), None
        made = []
        for _ in range(5):
            action, state = policy.predict(observation, state)
            made.append(action)
        return np.array(made)

    np.testing.assert_array_equal(actions(1), actions(1))
    assert not np.array_equal(actions(1), actions(2))


def test_hold_rests_and_keeps_the_grip():
    env = FakeEnv()
    hold = Hold(env)
    state = hold.begin(np.array([0.5, 0.5, -0.7], np.float32))
    action, state = hold.predict(None, state)
    np.testing.assert_allclose(action, [0, 0, -0.7])
    np.testing.assert_allclose(hold.predict(None, state)[0], [0, 0, -0.7])


def test_hold_takes_the_users_safe_action_as_it_is():
    hold = Hold(FakeEnv(), safe_action=np.array([0.1, 0.2, 0.3]))
    action, _ = hold.predict(None, hold.begin(np.ones(3, np.float32)))
    np.testing.assert_allclose(action, [0.1, 0.2, 0.3], rtol=1e-6)
    with pytest.raises(ValueError, match="safe_action"):
        Hold(FakeEnv(), safe_action=np.array([2.0, 0, 0]))


def test_what_cannot_be_made_is_refused_with_what_exists(lift):
    with pytest.raises(ValueError, match=r"'teleop'.*scripted, hold"):
        make_policy("teleop", lift)
    with pytest.raises(ValueError, match="no scripted expert"):
        make_policy("scripted", FakeEnv())
    for bad in ({"noise": -1}, {"speed": 0}):
        with pytest.raises(ValueError, match="must be"):
            Style(**bad)


class Overridden(FakeEnv):
    """Says that another acted in steps 3 to 6."""

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, info | {"overridden": 3 <= self.t <= 6}


class Counting:
    """Its state is how often it has acted."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        state = 0 if episode_start[0] else state
        self.state = state + 1
        return np.zeros(3, np.float32), self.state


def test_a_policy_resumes_where_it_was_left_when_another_has_acted():
    policy, seen = Counting(), []
    rollout(Overridden(length=9), policy, on_step=lambda info: seen.append(policy.state))
    assert seen == [1, 2, 3, 3, 3, 3, 3, 4, 5]
