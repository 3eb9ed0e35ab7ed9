"""Experts, reflexes and policies by name."""

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.policies import make_policy, rollout
from asm_gym.policies.reflexes import Comply, Hold, Retract
from asm_gym.policies.scripted.base import Style
from tests.fakes import FakeEnv
from tests.rates import failures


def test_the_expert_reads_dict_observations_too():
    env = gym.make("asm_gym/Lift-v0", observation="dict")

    def trial(seed: int) -> str:
        return "" if rollout(env, make_policy("scripted", env, seed=seed), seed) else "not solved"

    assert not failures(trial, range(10), 0.98, first=1)
    env.close()


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


def test_deterministic_leaves_out_the_noise(lift):
    observation, _ = lift.reset(seed=0)
    quiet = make_policy("scripted", lift, seed=1, style=Style(noise=0.0))
    noisy = make_policy("scripted", lift, seed=1, style=Style(noise=0.5))
    state = noisy.predict(observation)[1]
    np.testing.assert_array_equal(
        noisy.predict(observation, state, deterministic=True)[0],
        quiet.predict(observation, quiet.predict(observation)[1])[0],
    )


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


def test_what_cannot_be_made_is_refused_with_what_exists(lift, tmp_path):
    with pytest.raises(ValueError, match=r"'teleop'.*scripted, hold"):
        make_policy("teleop", lift)
    with pytest.raises(ValueError, match="no scripted expert"):
        make_policy("scripted", FakeEnv())
    with pytest.raises(FileNotFoundError, match="none_sac"):
        make_policy(str(tmp_path / "none_sac.zip"), lift)
    (tmp_path / "agent.zip").touch()
    with pytest.raises(ValueError, match=r"agent\.zip is not an agent"):
        make_policy(str(tmp_path / "agent.zip"), lift)
    for bad in ({"noise": -1}, {"speed": 0}):
        with pytest.raises(ValueError, match="must be"):
            Style(**bad)


def test_retract_undoes_the_last_actions_newest_first_and_then_stays(lift):
    retract = Retract(lift, steps=2)
    retract.reset()
    for x in (0.1, 0.2, 0.3):
        retract.feel(np.zeros(3), np.full(7, x, np.float32), acting=False)
    retract.feel(np.zeros(3), np.full(7, 0.9, np.float32), acting=True)  # its own doing is not undone
    state, moves = retract.begin(np.full(7, 0.3, np.float32)), []
    for _ in range(3):
        action, state = retract.predict(None, state)
        assert action[6] == np.float32(0.3)  # the grip is kept
        moves.append(float(action[0]))
    np.testing.assert_allclose(moves, [-0.3, -0.2, 0.0], rtol=1e-6)


@pytest.mark.parametrize("controller", ["OSC_POSE", "JOINT_POSITION"])
def test_comply_moves_the_joints_the_way_they_are_pressed(controller):
    env = gym.make("asm_gym/Lift-v0", controller=controller).unwrapped
    env.reset(seed=0)
    comply = Comply(env, compliance=2.0, tolerated=1.0)
    row = np.zeros(env.stream_spec.size)
    at = env.stream_spec.slices["external_torque"].start
    row[at + 3] = 3.0
    comply.feel(row, np.zeros(7), acting=False)
    assert comply.load.tolist() == [0, 0, 0, 2.0, 0, 0, 0]
    before = env.simulation.data.qpos[:7].copy()
    for _ in range(5):
        action, _ = comply.predict(None, comply.begin(np.zeros(env.action_space.shape, np.float32)))
        env.step(action)
    moved = env.simulation.data.qpos[:7] - before
    # Under OSC_POSE other joints help to move the hand as the pressed one would.
    assert moved[3] > 0.01
    if controller == "JOINT_POSITION":
        assert np.abs(np.delete(moved, 3)).max() < 0.3 * moved[3]
    env.close()


def test_what_is_always_carried_is_not_yielded_to(lift):
    comply = Comply(lift)
    row = np.zeros(lift.get_wrapper_attr("stream_spec").size)
    row[lift.get_wrapper_attr("stream_spec").slices["external_torque"]] = 5.0
    for _ in range(100):
        comply.feel(row, np.zeros(7), acting=False)
    assert not comply.load.any()


def test_reflexes_that_need_changes_refuse_other_actions():
    for reflex in (Retract, Comply):
        with pytest.raises(ValueError, match=r"OSC_POSE or JOINT_POSITION.*safe_action"):
            reflex(FakeEnv())
    env = gym.make("asm_gym/Lift-v0", stream=("joint", "hand"))
    with pytest.raises(ValueError, match="external_torque"):
        Comply(env)
    env.close()


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
