"""Learning under a guard: vectors for learners, what is recorded, what is refused, and the study."""

import math

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorWrapper
from gymnasium.wrappers import RescaleAction
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from asm_gym.evaluation.statistics import Estimate
from asm_gym.exceptions import UnsupportedEnvironment
from asm_gym.guard.step_info import LazyInfo
from asm_gym.rollouts.executed_sac import ExecutedSAC
from asm_gym.rollouts.learner_vector import LearnerVector, of_each
from asm_gym.rollouts.learning_record import LearningRecord
from asm_gym.rollouts.priced_cost import Lagrangian, PricedCost
from asm_gym.rollouts.safety_callback import FIRST_STEPS, SafetyCallback
from asm_gym.scripts.reproduce import learning_safely, learning_tables
from asm_gym.wrappers import NeuralASMSafety, VectorNeuralASMSafety
from tests.fakes import CueMonitor, FadingMonitor, FakeEnv


def vector(*lengths):
    makes = [lambda length=length: FakeEnv(length=length) for length in lengths]
    return SyncVectorEnv(makes, autoreset_mode=AutoresetMode.DISABLED)


# ------------------------------------------------------------------ the learner's vector


def test_a_member_that_ended_begins_again_while_the_others_go_on():
    envs = LearnerVector(vector(2, 3))
    first = envs.reset()
    actions = np.zeros((2, 3), np.float32)
    ends = []
    for _ in range(6):
        observations, _, dones, infos = envs.step(actions)
        ends.append(dones.tolist())
        for n in np.flatnonzero(dones):
            assert infos[n]["TimeLimit.truncated"]
            np.testing.assert_array_equal(observations[n], first[n])
            assert (infos[n]["terminal_observation"] != observations[n]).any()
    assert [list(column) for column in zip(*ends, strict=True)] == [
        [False, True] * 3,
        [False, False, True] * 2,
    ]


def test_the_learner_meets_the_same_alarms_in_a_vector_as_in_single_environments():
    def single():
        return NeuralASMSafety(FakeEnv(length=8), FadingMonitor((2, 6)), on_alarm="monitor")

    together = VectorNeuralASMSafety(vector(8, 8), FadingMonitor((2, 6)), on_alarm="monitor")
    costs = []
    for envs in (DummyVecEnv([single, single]), LearnerVector(together)):
        callback = SafetyCallback()
        PPO("MlpPolicy", envs, n_steps=16, batch_size=16, seed=0).learn(32, callback)
        costs.append([episode["cost"] for episode in callback.ended])
    assert costs[0] == costs[1]
    assert len(costs[0]) == 4
    assert min(costs[0]) > 0


def test_what_the_guard_reports_is_made_only_when_it_is_read():
    reads = []

    def make():
        reads.append(1)
        return {"threshold": np.array([1.0, 2.0])}

    asm = LazyInfo(make)
    asm["slowed"] = np.array([0.0, 0.5])
    members = of_each({"asm": asm, "cost": np.array([0.0, 1.0])}, 2)
    assert members[1]["cost"] == 1.0
    assert members[1]["asm"]["slowed"] == 0.5
    assert not reads
    assert [member["asm"]["threshold"] for member in members] == [1.0, 2.0]


def test_another_autoreset_mode_is_refused():
    with pytest.raises(UnsupportedEnvironment, match="NEXT_STEP"):
        LearnerVector(SyncVectorEnv([FakeEnv]))


# ------------------------------------------------------------------ what is stored and refused


def test_sac_stores_what_the_guard_executed():
    guarded = NeuralASMSafety(FakeEnv(length=8), CueMonitor((2,)), on_alarm="hold")
    agent = ExecutedSAC("MlpPolicy", guarded, learning_starts=100, seed=0, buffer_size=64)
    agent.learn(8)
    held = (agent.replay_buffer.actions[:8, 0, :2] == 0).all(axis=1)  # the third is the grip
    assert held.any()
    assert not held.all()


def test_sac_learns_in_a_guarded_vector_with_scaled_observations():
    guarded = VectorNeuralASMSafety(vector(8, 8), FadingMonitor((2,)), on_alarm="hold")
    scaled = VecNormalize(LearnerVector(guarded), norm_reward=False)
    agent = ExecutedSAC("MlpPolicy", scaled, learning_starts=100, seed=0, buffer_size=64)
    agent.learn(16)
    held = (agent.replay_buffer.actions[:8, :, :2] == 0).all(axis=2)  # the third is the grip
    assert held.any()
    assert not held.all()


@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("many", [False, True])
def test_actions_changed_outside_the_guard_are_refused(many, scaled):
    if many:
        rescaled = gym.wrappers.vector.RescaleAction(
            VectorNeuralASMSafety(vector(8, 8), FadingMonitor((2,)), on_alarm="monitor"), -2.0, 2.0
        )
        envs = LearnerVector(rescaled)
    else:
        guarded = NeuralASMSafety(FakeEnv(length=8), CueMonitor((2,)), on_alarm="hold")
        envs = RescaleAction(guarded, -2.0, 2.0)
    if scaled:
        if not many:
            single = envs
            envs = DummyVecEnv([lambda: single])
        envs = VecNormalize(envs)
    with pytest.raises(UnsupportedEnvironment, match="RescaleAction outside the guard"):
        ExecutedSAC("MlpPolicy", envs)


class Scales(gym.Wrapper):
    """Takes other actions than the guard, and is no ActionWrapper."""

    def __init__(self, env, largest, share):
        super().__init__(env)
        self.action_space = gym.spaces.Box(-largest, largest, env.action_space.shape, np.float32)
        self._share = np.float32(share)

    def step(self, action):
        return self.env.step(self._share * action)


class LeavesOut(Scales):
    def __init__(self, env):
        super().__init__(env, 1.0, 1.0)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def step(self, action):
        return self.env.step(np.append(action, np.float32(0.0)))


def guarded_fake(cue=(2,)):
    return NeuralASMSafety(FakeEnv(length=8), CueMonitor(cue), on_alarm="hold")


def scaled_fake():
    return Scales(guarded_fake(), largest=10.0, share=0.1)


@pytest.mark.parametrize("outside", [scaled_fake, lambda: LeavesOut(guarded_fake())])
def test_another_action_space_outside_the_guard_is_refused(outside):
    with pytest.raises(UnsupportedEnvironment, match="outside the guard"):
        ExecutedSAC("MlpPolicy", outside())


def test_another_action_space_in_another_process_is_refused():
    envs = SubprocVecEnv([scaled_fake], start_method="spawn")
    try:
        with pytest.raises(UnsupportedEnvironment, match="outside the guard"):
            ExecutedSAC("MlpPolicy", envs)
    finally:
        envs.close()


def test_an_environment_without_a_guard_in_another_process_is_learned_in():
    envs = SubprocVecEnv([FakeEnv], start_method="spawn")
    try:
        agent = ExecutedSAC("MlpPolicy", envs, learning_starts=10, seed=0, buffer_size=64)
        assert agent.learn(8).replay_buffer.size() == 8
    finally:
        envs.close()


def test_actions_changed_within_their_space_are_refused_when_they_are_met():
    agent = ExecutedSAC("MlpPolicy", Scales(guarded_fake(()), largest=1.0, share=0.5), seed=0)
    with pytest.raises(UnsupportedEnvironment, match="outside the guard"):
        agent.learn(8)


def test_ppo_learns_from_its_own_actions_where_a_wrapper_rescales_them():
    guarded = NeuralASMSafety(FakeEnv(length=8), CueMonitor((2,)), on_alarm="monitor")
    chosen = []
    executed = []

    def keep(local, _):
        chosen.append(local["clipped_actions"][0])
        executed.append(local["infos"][0]["asm"]["executed_action"])
        return True

    agent = PPO("MlpPolicy", RescaleAction(guarded, -2.0, 2.0), n_steps=8, batch_size=8, seed=0)
    agent.learn(8, keep)
    np.testing.assert_allclose(np.array(chosen) / 2, executed, rtol=1e-5)
    learned_from = agent.rollout_buffer.actions.reshape(8, -1)
    np.testing.assert_allclose(np.clip(learned_from, -2, 2), chosen)


class HidesEnds(gym.Wrapper):
    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            observation, _ = self.env.reset()
        return observation, reward, False, False, info


@pytest.mark.parametrize("cue", [(2,), ()])
def test_a_wrapper_that_hides_ends_is_named_with_alarms_and_without(cue):
    hidden = HidesEnds(NeuralASMSafety(FakeEnv(length=8), CueMonitor(cue), on_alarm="monitor"))
    agent = PPO("MlpPolicy", hidden, n_steps=32, batch_size=32)
    with pytest.raises(ValueError, match="hides that the episode ended"):
        agent.learn(32, SafetyCallback())


@pytest.mark.parametrize(("cue", "warns"), [(range(8), True), ((2,), False)])
def test_a_memory_that_alarms_in_most_first_steps_is_named(cue, warns, recwarn):
    guarded = NeuralASMSafety(FakeEnv(length=8), CueMonitor(tuple(cue)), on_alarm="monitor")
    agent = PPO("MlpPolicy", guarded, n_steps=FIRST_STEPS, batch_size=250, n_epochs=1)
    agent.learn(FIRST_STEPS, SafetyCallback())
    assert warns == any("first 1000 steps" in str(each.message) for each in recwarn)


def test_a_memory_whose_few_alarms_stop_the_agent_in_most_first_steps_is_named(recwarn):
    env = FakeEnv(length=8)
    guarded = NeuralASMSafety(env, CueMonitor((1,)), on_alarm="hold", release_after=10)
    agent = PPO("MlpPolicy", guarded, n_steps=FIRST_STEPS, batch_size=250, n_epochs=1)
    callback = SafetyCallback()
    agent.learn(FIRST_STEPS, callback)
    assert np.mean([episode["cost"] for episode in callback.ended]) < 4
    assert any("first 1000 steps" in str(each.message) for each in recwarn)


# ------------------------------------------------------------------ records


class Scripted(VectorWrapper):
    """Reports contact as it is told."""

    def __init__(self, env, forces):
        super().__init__(env)
        self.forces = iter(forces)

    def step(self, actions):
        observations, _, terminated, truncated, infos = self.env.step(actions)
        force = np.array(next(self.forces), float)
        infos["contact_force"] = force
        infos["contact_impulse"] = np.maximum(force - 40.0, 0.0) / 500
        infos["success"] = force > 500
        infos["joint_stops"] = np.array([1, 0])
        infos["self_contacts"] = np.array([0, 2])
        return observations, np.ones(2), terminated, truncated, infos


def test_a_record_adds_up_each_episode():
    forces = [(30, 300), (290, 300), (281, 0), (0, 600)]
    record = LearningRecord(Scripted(vector(4, 2), forces))
    record.reset(seed=0)
    for n in range(4):
        *_, terminated, truncated, _ = record.step(np.zeros((2, 3), np.float32))
        ended = terminated | truncated
        if ended.any() and n < 3:
            record.reset(options={"reset_mask": ended})
    frame = pd.DataFrame(record.episodes)
    assert frame.member.tolist() == [1, 0, 1]
    assert frame.step.tolist() == [4, 8, 8]
    assert frame.length.tolist() == [2, 4, 2]
    assert frame.blows.tolist() == [1, 1, 1]  # steps that follow each other are one contact
    assert frame.peak.tolist() == [300, 290, 600]
    assert frame.success.tolist() == [0, 0, 1]
    assert frame.slowed.isna().all()  # no guard tells
    assert frame.joint_stops.tolist() == [0, 4, 0]
    assert frame.self_contacts.tolist() == [4, 0, 4]
    harm = [2 * 260, 250 + 241, 560]
    np.testing.assert_allclose(frame.harm, np.array(harm) / 500)


class CostlyVector(DummyVecEnv):
    def step_wait(self):
        observations, rewards, dones, infos = super().step_wait()
        for info in infos:
            info["cost"] = 1.0
        return observations, rewards, dones, infos


def test_a_price_follows_its_limit_and_lowers_the_reward():
    plain = CostlyVector([lambda: FakeEnv(length=4)])
    plain.reset()
    reward = plain.step(np.zeros((1, 3), np.float32))[1]
    priced = PricedCost(CostlyVector([lambda: FakeEnv(length=4)]), price=0.5)
    priced.reset()
    np.testing.assert_allclose(priced.step(np.zeros((1, 3), np.float32))[1], reward - 0.5)

    priced.price = 0.0
    priced.costs.clear()
    agent = PPO("MlpPolicy", priced, n_steps=8, batch_size=8)
    agent.learn(24, Lagrangian(priced, limit=0.25, rate=0.1))
    assert priced.price == pytest.approx(3 * 0.1 * 0.75)


# ------------------------------------------------------------------ the study


def result(way, seed, harm, rewards, task="Reach"):
    count = len(rewards)
    episodes = {
        "step": [100 * (n + 1) for n in range(count)],
        "member": [0] * count,
        "length": [100] * count,
        "reward": rewards,
        "success": [0.0] * (count - 1) + [1.0],
        "harm": [harm / count] * count,
        "peak": [300.0] * count,
        "blows": [1] * count,
        "overridden": [10] * count,
        "slowed": [50] * count,
        "cost": [5] * count,
        "joint_stops": [0] * count,
        "self_contacts": [1] * count,
    }
    return {
        "robot": "Panda",
        "task": task,
        "algorithm": "PPO",
        "way": way,
        "seed": seed,
        "period": 0.05,
        "processor_seconds": 20.0,
        "steps": 100 * count,
        "learning": episodes,
        "trained": {"alone": episodes, "default": episodes},
    }


def test_harm_is_compared_with_that_of_the_same_seed():
    results = [
        result("alone", 0, 100.0, [1.0] * 10),
        result("alone", 1, 300.0, [1.0] * 10),
        result("default", 0, 1.0, [1.0] * 10),
        result("default", 1, 9.0, [1.0] * 10),
    ]
    found = learning_tables.findings(results, [])
    rows = [dict(zip(found.tables[0].headings, row, strict=True)) for row in found.tables[0].rows]
    default = next(row for row in rows if row["way"] == "default")
    shares = Estimate.of_mean([1.0, 3.0])
    assert default["% of alone"] == shares.text(2)
    assert default["overridden [%]"].startswith("10.0")
    # 10 episodes of 100 steps of 0.05 s
    assert found.records[2]["harm_hour"] == pytest.approx(1.0 / (50 / 3600))
    assert found.figure is not None


def test_a_reward_counts_as_reached_in_the_mean_of_many_episodes():
    rewards = [0.0] * 20 + [10.0] * 20
    episodes = pd.DataFrame(result("alone", 0, 0.0, rewards)["learning"])
    # 5 in the mean after 10 of the second kind
    assert learning_tables.steps_to_target(episodes, 5.0) == 3000
    assert math.isnan(learning_tables.steps_to_target(episodes, 11.0))


def test_an_interval_of_a_mean_is_students():
    estimate = Estimate.of_mean([1.0, 2.0, 6.0])
    half = 4.302652729911275 * math.sqrt(7.0) / math.sqrt(3.0)
    np.testing.assert_allclose(estimate, (3.0, 3.0 - half, 3.0 + half))
    assert Estimate.of_mean([2.0]).text() == "2.0"


def test_small_actions_move_the_hand_less_and_the_fingers_as_before():
    found = learning_safely.smaller(0.5, np.ones((2, 7), np.float32))
    assert found.tolist() == [[0.5] * 6 + [1.0]] * 2


def test_every_run_of_the_study_has_a_file_of_its_own():
    wanted = learning_safely.runs(learning_safely.Config())
    names = {run.file_name for run in wanted}
    assert len(names) == len(wanted) == 5 * 4 * (6 + 4)
    assert [run.seed for run in wanted] == sorted(run.seed for run in wanted)


def test_an_algorithm_that_cannot_learn_in_a_way_has_no_run_and_none_at_all_is_refused():
    config = learning_safely.Config(algorithms=("PPO", "SAC"), ways=("executed action",))
    assert {run.algorithm for run in learning_safely.runs(config)} == {"SAC"}
    config = learning_safely.Config(algorithms=("PPO",), ways=("executed action",))
    with pytest.raises(ValueError, match="executed action"):
        learning_safely.runs(config)


def test_ways_are_compared_with_learning_alone_in_pairs_of_seeds():
    cell = {"robot": "Panda", "task": "Lift", "algorithm": "PPO"}
    rewards = {("alone", 0): 1.0, ("alone", 1): 5.0, ("default", 1): 8.0, ("default", 2): 9.0}
    runs = [
        cell | {"way": way, "seed": seed} | dict.fromkeys(learning_tables.DIFFERENCES, reward)
        for (way, seed), reward in rewards.items()
    ]
    table = learning_tables.difference_table(pd.DataFrame(runs))
    (cells,) = table.rows
    row = dict(zip(table.headings, cells, strict=True))
    assert (row["way"], row["seeds"], row["reward, last fifth"]) == ("default", "1", "3.0")


def test_a_way_to_learn_looks_the_same_in_every_panel_and_the_legend_names_it_once():
    runs = (("Door", "default"), ("Lift", "alone"), ("Lift", "default"))
    points = [
        {
            "task": task,
            "algorithm": "PPO",
            "way": way,
            "step": step,
            "seed": 0,
            "reward": 1.0,
            "success": 0.0,
            "harm": 2.0,
        }
        for task, way in runs
        for step in (10, 20)
    ]
    fig = learning_tables.curves_figure(points)
    (legend,) = fig.legends
    assert [text.get_text() for text in legend.get_texts()] == ["default guard", "alone"]
    colours = {
        line.get_color()
        for ax in fig.axes
        for line in ax.lines
        if line.get_label() == "default guard"
    }
    assert len(colours) == 1
