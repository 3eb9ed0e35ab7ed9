"""What somebody who knows Gymnasium, Stable-Baselines3 or robosuite tries first."""

from __future__ import annotations

from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest

from asm_gym import Channel, NeuralASMSafety, StreamRecorder, StreamSpec, collect, make_monitor, register_task
from asm_gym.data.rows import RowReader
from asm_gym.detection import ModelOutput
from asm_gym.monitors import CalibratedMonitor, Surprise, load_monitor
from asm_gym.monitors.registry import MONITORS, register_monitor
from asm_gym.monitors.stream_model import StreamModel
from asm_gym.tasks import OWN
from tests.streams import sine_episodes, sine_spec

SPEC = StreamSpec((Channel("angle", 2, "rad"), Channel("current", 1, "A"), Channel("u", 1, group="action")), 0.05)


class Foreign:
    """A monitor that derives from nothing of ours, and answers what it was made with."""

    threshold = 1.0

    def __init__(self, spec, answer):
        self.spec, self.answer = spec, answer

    def initial_state(self, batch=1):
        return None

    def observe(self, state, stream):
        return self.answer(state, stream)


@pytest.fixture
def registries():
    kept = [(rows, dict(rows)) for rows in (MONITORS, OWN)]
    yield
    for rows, before in kept:
        rows.clear()
        rows.update(before)


def lines(*rows):
    return [row.numbers.tolist() for row, _ in RowReader(SPEC).rows(rows)]


def test_live_rows_with_units_behind_their_names_are_read_in_those_of_the_memory():
    header = "angle_0 [deg],angle_1 [deg],current [mA],u"
    assert lines(header, "180,90,500,1") == [pytest.approx([np.pi, np.pi / 2, 0.5, 1.0])]
    assert lines('{"angle [deg]": [180, 90], "current [mA]": 500, "u": 1}') == [
        pytest.approx([np.pi, np.pi / 2, 0.5, 1.0])
    ]
    by_label = '{"angle[0] [deg]": 180, "angle[1] [rad]": 1, "current": 0.5, "u": 1}'
    assert lines(by_label) == [pytest.approx([np.pi, 1.0, 0.5, 1.0])]
    with pytest.raises(ValueError, match=r"current is in V, and the memory reads A"):
        lines("angle_0,angle_1,current [V],u", "1,1,1,1")


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (lambda state, stream: np.zeros(1), "got ndarray"),
        (lambda state, stream: (state, np.zeros(1)), r"got \(state, ndarray\)"),
        (lambda state, stream: (state, 0.0, 1.0), "got a tuple of 3"),
    ],
)
def test_a_monitor_that_answers_something_else_than_a_surprise_is_refused_when_it_is_wrapped(answer, said):
    env = gym.make("Pendulum-v1")
    with pytest.raises(TypeError, match=said):
        NeuralASMSafety(env, Foreign(StreamRecorder(env).stream_spec, answer))


def test_a_monitor_that_answers_a_surprise_needs_no_base_class():
    env = gym.make("Pendulum-v1")
    spec = StreamRecorder(env).stream_spec
    quiet = Foreign(spec, lambda state, stream: (state, Surprise(np.zeros(len(stream)), np.zeros(stream.shape))))
    guarded = NeuralASMSafety(env, quiet)
    guarded.reset(seed=0)
    assert not guarded.step(np.zeros(1, np.float32))[-1]["asm"]["alarm"]


def test_an_environment_without_a_body_is_not_told_to_babble():
    with pytest.raises(ValueError, match="StreamRecorder") as said:
        NeuralASMSafety(gym.make("Pendulum-v1"))
    assert "babble" not in str(said.value)


class Count(NamedTuple):
    rows: np.ndarray  # (B,)


class Words(StreamModel):
    """Has learned words, which are no arrays."""

    kind = "words"

    def fit(self, episodes, rng, progress):
        self.learned_ = {"words": ["calm", "calmer"], "spread": 1.0}
        return self

    def state(self):
        return {"words": np.frombuffer(" ".join(self.learned_["words"]).encode(), np.uint8)}

    def restore(self, learned, skills=()):
        self.learned_ = {"words": learned["words"].astype(np.uint8).tobytes().decode().split(" "), "spread": 1.0}
        return self

    def start(self, batch, told=()):
        return Count(np.zeros(batch))

    def predict(self, state, rows):
        senses = rows[:, self.spec.sensory] / len(self.learned_["words"])
        return Count(state.rows + 1), ModelOutput(senses, np.zeros((len(rows), 0)))


def test_a_model_that_learned_no_arrays_is_saved_by_its_own_state(tmp_path, registries):
    register_monitor("words", Words)
    episodes = sine_episodes(30)
    monitor = make_monitor("words", sine_spec()).fit(episodes[:10]).calibrate(episodes[10:], false_alarm_rate=0.1)
    monitor.save(tmp_path / "words.asm")
    loaded = load_monitor(tmp_path / "words.asm")
    assert isinstance(loaded, CalibratedMonitor)
    assert loaded.model.learned_["words"] == ["calm", "calmer"]
    np.testing.assert_array_equal(loaded.score(episodes[0]).value, monitor.score(episodes[0]).value)


def test_an_argument_of_robosuite_is_refused_by_name():
    with pytest.raises(TypeError, match=r"asm_gym/Lift-v0 takes robot=, got robots='Panda'"):
        gym.make("asm_gym/Lift-v0", robots="Panda")
    with pytest.raises(ValueError, match="makes Lift, got task='Door'"):
        gym.make("asm_gym/Lift-v0", task="Door")


def own_class():
    from robosuite.environments.manipulation.lift import Lift

    class Pour(Lift):
        """A class of one's own."""

    return Pour


def test_robosuites_own_gym_wrapper_is_recorded():
    from robosuite.wrappers import GymWrapper

    options = {"has_renderer": False, "has_offscreen_renderer": False, "use_camera_obs": False, "control_freq": 10}
    recorder = StreamRecorder(GymWrapper(own_class()(robots="Panda", **options)))
    recorder.reset(seed=0)
    for _ in range(3):
        recorder.step(recorder.action_space.sample())
    episode = recorder.finish()
    assert episode.spec.dt == pytest.approx(0.1)
    assert len(episode) == 3


def test_a_class_of_robosuite_becomes_a_task_with_named_channels(registries):
    register_task("Decant", own_class(), horizon=6, robots="Sawyer", control_freq=10)
    first, again = (collect("asm_gym/Decant-v0", "hold", episodes=1, seed=3, workers=1)[0] for _ in range(2))
    np.testing.assert_array_equal(first.stream, again.stream)
    units = {c.name: c.unit for c in first.spec.channels}
    assert (first.spec.source, first.spec.dt, len(first)) == ("Sawyer", 0.1, 6)
    assert (units["robot0_joint_pos"], units["robot0_joint_vel"], units["robot0_joint_pos_cos"]) == (
        "rad",
        "rad/s",
        "1",
    )
    assert "cube_pos" not in units


def test_a_callback_finds_out_the_control_period():
    sb3 = pytest.importorskip("stable_baselines3")
    from asm_gym.rollouts.safety_callback import SafetyCallback

    env = gym.make("asm_gym/SyntheticArm-v0", horizon=20)
    spec = StreamRecorder(env).stream_spec
    alarmed = Foreign(spec, lambda state, stream: (state, Surprise(np.full(len(stream), 2.0), np.zeros(stream.shape))))
    callback = SafetyCallback()
    guarded = NeuralASMSafety(env, alarmed, on_alarm="hold")
    sb3.PPO("MlpPolicy", guarded, n_steps=20, batch_size=20).learn(20, callback=callback)
    assert callback.ended[0].override_s == pytest.approx(19 * spec.dt)


def test_what_a_notebook_shows_is_a_line():
    episode = sine_episodes(1)[0]
    assert len(repr(episode)) < 200
    assert "rows of" in repr(episode)
    assert len(repr(episode.spec)) < 400
    assert repr(Surprise(np.arange(5.0), np.ones((5, 3)))) == "<Surprise of 5: last 4, largest 4>"
    assert len(repr(Surprise(np.zeros(0), np.zeros((0, 3))))) < 40


def test_each_label_has_its_unit():
    assert dict(zip(SPEC.labels, SPEC.units, strict=True)) == {
        "angle[0]": "rad",
        "angle[1]": "rad",
        "current": "A",
        "u": "1",
    }
