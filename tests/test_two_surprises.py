"""Body surprise and skill surprise: what no body does, and what no skill that was shown does."""

from functools import cache

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.episode import Episode
from asm_gym.monitors import NeuralASM, load_monitor
from asm_gym.monitors.skills import learn_skills, with_alarm_on
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.wrappers import NeuralASMSafety, VectorNeuralASMSafety
from tests.fakes import CueMonitor, FadingMonitor, FakeEnv

SPEC = StreamSpec(
    (
        Channel("position", 2, "m", 0.01),
        Channel("velocity", 2, "m/s", 0.01, "speed"),
        Channel("command", 2, group=MOTOR),
    ),
    0.05,
)
STEPS, LATE = 80, 40


def carried(seed, command=None, push=0.0):
    """A body whose velocity follows the command; the skill is to sway, unless ``command`` (T, 2) says otherwise."""
    rng = np.random.default_rng(seed)
    t, phase = np.arange(STEPS)[:, None], rng.uniform(0, 0.3, 2)
    u = 0.5 * np.sin(0.2 * t + phase) if command is None else command
    v = np.zeros((STEPS, 2))
    for n in range(1, STEPS):
        v[n] = 0.5 * v[n - 1] + 0.5 * u[n] + (push if n >= LATE else 0.0)
    x = np.cumsum(0.05 * v, axis=0) + 0.01 * rng.standard_normal((STEPS, 2))
    return Episode.from_stream(np.hstack([x, v + 0.01 * rng.standard_normal((STEPS, 2)), u]), SPEC)


def lost(seed):
    """The same body, of which a policy that is lost asks from a moment on what no skill does."""
    u = 0.5 * np.sin(0.2 * np.arange(STEPS)[:, None] + np.random.default_rng(seed).uniform(0, 0.3, 2))
    u[LATE:] = 0.5 * np.sign(u[LATE:])
    return carried(seed, u)


def babbled(seed):
    """The same body under commands that follow one another at random: what any policy may ask of it."""
    rng = np.random.default_rng(seed)
    return carried(seed, np.repeat(rng.uniform(-0.6, 0.6, (STEPS // 4, 2)), 4, axis=0))


@cache
def memory():
    asm = NeuralASM(SPEC, hidden_size=8, association_size=32, epochs=2, habituates=False)
    asm.fit([babbled(1000 + s) for s in range(40)])
    return asm.calibrate([carried(100 + s) for s in range(40)], 0.05)


@cache
def alarming_on(which, asm=None):
    """The memory with skills, calibrated for alarms on this surprise."""
    return with_alarm_on(asm or both(), which).calibrate([carried(100 + s) for s in range(40)], 0.05)


def both():
    asm = learn_skills(with_alarm_on(memory(), "body"), [carried(s) for s in range(40)])
    return asm.calibrate([carried(100 + s) for s in range(40)], 0.05)


def test_listening_for_skills_changes_no_bit_of_what_alarms():
    episodes = [carried(200), lost(201)]
    for alone, beside in zip(memory().score_episodes(episodes), both().score_episodes(episodes), strict=True):
        np.testing.assert_array_equal(beside.value, alone.value)
        np.testing.assert_array_equal(beside.attribution, alone.attribution)
        np.testing.assert_array_equal(beside.of_body, alone.value)
        assert alone.of_skill is None
    assert both().threshold == memory().threshold
    assert both().alarm_on_ == "body"


def test_a_policy_that_is_lost_surprises_the_skill_and_not_the_body():
    """The body does as it is told: what is commanded is new, and what follows from it is not."""
    asm = alarming_on("skill")
    scores = asm.score_episodes([lost(300 + s) for s in range(20)])
    assert np.mean([s.value[LATE:].max() > asm.threshold for s in scores]) == 1.0
    assert np.mean([s.value[:LATE].max() > asm.threshold for s in scores]) <= 0.15
    assert np.mean([s.of_body.max() > both().threshold for s in scores]) <= 0.2


@pytest.mark.parametrize("which", ["skill", "either", "both"])
def test_each_choice_is_calibrated_and_its_shares_add_up(which):
    asm = alarming_on(which)
    fresh = asm.score_episodes([carried(500 + s) for s in range(200)])
    assert np.mean([s.value.max() > asm.threshold for s in fresh]) <= 0.12  # 5 % on average over calibrations
    for s in asm.score_episodes([carried(600), lost(601), carried(602, push=0.1)]):
        np.testing.assert_allclose(s.attribution.sum(axis=1), s.value)
        expected = {
            "skill": s.of_skill,
            "either": np.maximum(s.of_body, asm.skill_.weight * s.of_skill),
            "both": np.minimum(s.of_body, asm.skill_.weight * s.of_skill),
        }
        np.testing.assert_array_equal(s.value, expected[which])


def test_a_file_keeps_both_surprises_and_the_choice(tmp_path):
    asm = alarming_on("either")
    asm.save(tmp_path / "two.asm")
    loaded = load_monitor(tmp_path / "two.asm")
    assert (loaded.alarm_on_, loaded.threshold) == ("either", asm.threshold)
    episode = lost(700)
    for mine, theirs in zip(asm.score(episode), loaded.score(episode), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_a_number_that_is_not_finite_is_infinite_for_either_and_for_both():
    stream = carried(800).stream.copy()
    stream[10, 1] = np.nan
    for which in ("skill", "either", "both"):
        value = with_alarm_on(both(), which).score(Episode.from_stream(stream, SPEC)).value
        assert np.isinf(value[10])
        assert np.isfinite(value[11:]).all()


def test_skills_are_learned_first_and_forgotten_where_the_memory_learns_anew():
    with pytest.raises(RuntimeError, match="learn_skills"):
        with_alarm_on(memory(), "either")
    with pytest.raises(ValueError, match="body, skill, either, both"):
        with_alarm_on(both(), "neither")
    with pytest.raises(RuntimeError, match="calibrate"):
        _ = with_alarm_on(learn_skills(memory(), [carried(s) for s in range(5)]), "skill").threshold
    asm = alarming_on("either")
    threshold = asm.threshold
    with pytest.raises(ValueError, match="at least 19"):
        asm.calibrate([carried(100 + s) for s in range(5)], 0.05)
    assert asm.threshold == threshold
    with pytest.raises(ValueError, match="alarms on 'either'"):
        learn_skills(asm, [carried(s) for s in range(5)])
    asm.fit([carried(s) for s in range(3)])
    assert asm.alarm_on_ == "body"
    assert asm.skill_ is None
    assert both().skill_ is not None


class TwoCues(FadingMonitor):
    """Says 3 of the body and 7 of the skill."""

    def observe(self, state, stream):
        state, surprise = super().observe(state, stream)
        n = len(stream)
        return state, surprise._replace(of_body=np.full(n, 3.0), of_skill=np.full(n, 7.0))


def told(info):
    return tuple(np.ravel(info["asm"][name]).tolist() for name in ("surprise_body", "surprise_skill"))


def test_both_stand_in_info_and_a_monitor_of_one_says_which_it_lacks():
    env = NeuralASMSafety(FakeEnv(), TwoCues(), on_alarm="monitor")
    env.reset()
    assert told(env.step(env.action_space.sample())[-1]) == ([3.0], [7.0])
    env = NeuralASMSafety(FakeEnv(), CueMonitor(cue=[0]), on_alarm="monitor")
    _, first = env.reset()
    body, skill = told(env.step(env.action_space.sample())[-1])
    assert body == [10.0]
    assert np.isnan([*skill, first["asm"]["surprise_skill"]]).all()


def test_both_stand_in_the_infos_of_many_and_nothing_is_said_of_an_episode_that_begins():
    envs = gym.vector.SyncVectorEnv([lambda n=n: FakeEnv(length=n) for n in (2, 5)])
    envs = VectorNeuralASMSafety(envs, TwoCues(), on_alarm="monitor")
    envs.reset()
    said = [told(envs.step(envs.action_space.sample())[-1]) for _ in range(3)]
    assert said == [([3.0, 3.0], [7.0, 7.0]), ([3.0, 3.0], [7.0, 7.0]), ([0.0, 3.0], [0.0, 7.0])]
