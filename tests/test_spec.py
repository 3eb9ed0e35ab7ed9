"""The stream's layout, episodes that hold one, and their files."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from asm_gym.control_period import PeriodWarning, control_period
from asm_gym.data.episode import Episode, EpisodeLabel, load_episode, save_episode
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.wrappers.recording import StreamRecorder

SPEC = StreamSpec(
    (
        Channel("joint_position", 2, "rad", 0.1, "joint"),
        Channel("force", 1, "N", 0.5, "wrench"),
        Channel("action", 2, group=MOTOR),
    ),
    dt=0.05,
    source="test",
)


def test_every_number_has_a_name_and_a_place():
    assert SPEC.size == 5
    assert SPEC.labels == (
        "joint_position[0]",
        "joint_position[1]",
        "force",
        "action[0]",
        "action[1]",
    )
    assert SPEC.slices == {
        "joint_position": slice(0, 2),
        "force": slice(2, 3),
        "action": slice(3, 5),
    }
    assert SPEC.sensory.tolist() == [0, 1, 2]
    assert SPEC.motor.tolist() == [3, 4]
    assert SPEC.noise.tolist() == [0.1, 0.1, 0.5, 0, 0]


channels = st.builds(
    Channel,
    name=st.text(min_size=1, max_size=8),
    size=st.integers(1, 4),
    unit=st.sampled_from(["1", "N m", "rad"]),
    noise=st.floats(0, 10),
    resolution=st.floats(0, 10),
    group=st.sampled_from(["joint", "wrench"]),
)


@given(st.lists(channels, min_size=1, max_size=5, unique_by=lambda c: c.name), st.floats(1e-3, 10))
def test_a_spec_survives_json(chosen, dt):
    spec = StreamSpec(tuple(chosen), dt)
    assert StreamSpec.from_json(spec.to_json()) == spec
    assert spec.difference(StreamSpec.from_json(spec.to_json())) == []


@pytest.mark.parametrize(
    ("other", "says"),
    [
        ((SPEC.channels[0], SPEC.channels[2]), "force: missing"),
        ((*SPEC.channels, Channel("smell", 1)), "smell: new"),
        (
            (Channel("joint_position", 3, "rad", group="joint"), *SPEC.channels[1:]),
            "size 2 against 3",
        ),
        (
            (Channel("joint_position", 2, "deg", group="joint"), *SPEC.channels[1:]),
            "unit rad against deg",
        ),
        ((SPEC.channels[1], SPEC.channels[0], SPEC.channels[2]), "order"),
    ],
)
def test_specs_that_differ_say_in_what(other, says):
    assert any(says in line for line in SPEC.difference(StreamSpec(other, 0.05)))
    with pytest.raises(ValueError, match="the memory does not fit"):
        SPEC.require(StreamSpec(other, 0.05), "the memory")


def test_another_rate_is_a_difference_and_another_source_or_noise_is_not():
    assert SPEC.difference(StreamSpec(SPEC.channels, 0.01)) == ["dt: 0.05 s against 0.01 s"]
    quiet = tuple(Channel(c.name, c.size, c.unit, 0.0, c.group) for c in SPEC.channels)
    assert SPEC.difference(StreamSpec(quiet, 0.05, "another robot")) == []


def test_keys_of_nested_spaces_are_all_in_the_name():
    box = spaces.Box(-1, 1, (2,))
    nested = spaces.Dict({"observation": spaces.Dict({"q": box}), "q": box})
    spec = StreamSpec.from_spaces(nested, spaces.Box(-1, 1, (2,)), dt=0.1)
    assert [channel.name for channel in spec.channels] == ["observation.q", "q", "action"]


def test_the_spec_of_plain_spaces_is_observation_then_action():
    box = spaces.Box(-1, 1, (2, 3), np.float32)
    spec = StreamSpec.from_spaces(box, spaces.Box(-1, 1, (2,)), dt=0.1)
    assert [(c.name, c.size) for c in spec.channels] == [("observation", 6), ("action", 2)]


@pytest.mark.parametrize(
    "make",
    [
        lambda: Channel("x", 0),
        lambda: Channel("x", 1, noise=-1.0),
        lambda: Channel("x", 1, resolution=-1.0),
        lambda: Channel("x", 1, resolution=float("nan")),
        lambda: Channel("x", 2, elements=("a",)),
        lambda: Channel("q", 2, "rad", stops=((0.0, 1.0),)),
        lambda: StreamSpec((Channel("x", 1), Channel("x", 2)), 0.1),
        lambda: StreamSpec((Channel("a", 1, group=MOTOR),), 0.1),
        lambda: StreamSpec((Channel("x", 1),), 0.0),
        lambda: Episode.from_stream(np.zeros(5), SPEC),
        lambda: Episode.from_stream(np.zeros((3, 4)), SPEC),
    ],
)
def test_what_makes_no_sense_is_refused(make):
    with pytest.raises(ValueError, match=r"got|must|needs|names|but"):
        make()


def test_an_episode_from_a_recorded_stream_is_float32_and_as_long():
    episode = Episode.from_stream(np.ones((7, 5)), SPEC, success=True)
    assert len(episode) == 7
    assert episode.stream.dtype == np.float32
    assert episode.success


@pytest.mark.parametrize(
    "stops", [1, np.inf, ((0.0,),), ((1.0, 0.0),), ((0.0, np.nan),), [(0.0, 1.0)], "ab"]
)
def test_what_is_no_pair_of_stops_is_refused(stops):
    with pytest.raises(TypeError, match="channel 'q': stops must be a tuple of pairs"):
        Channel("q", 1, "rad", stops=stops)


X = (np.arange(30, dtype=np.float32) / 8).reshape(6, 5)
EPISODE = Episode(
    X,
    SPEC,
    success=True,
    seed=7,
    actions=X[:, 2:],
    observations=np.vstack([X[:1, :2], X[:, :2]]),
    rewards=np.ones(6, np.float32),
    faults=np.arange(6) >= 2,
    contact_force=np.arange(6, dtype=np.float32),
    label=EpisodeLabel(
        "Lift", "faulty", "push", "mild", 7, onset=2, affected_channels=frozenset({"force"})
    ),
    info={"terminated": False},
)


@pytest.mark.parametrize("episode", [EPISODE, replace(EPISODE, label=None), Episode(X, SPEC)])
def test_what_was_saved_is_loaded(episode, tmp_path):
    loaded = load_episode(save_episode(tmp_path / "deep" / "one.npz", episode))
    for name in ("stream", "actions", "observations", "rewards", "faults", "contact_force"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(episode, name), name)
    for name in ("success", "seed", "spec", "label", "info"):
        assert getattr(loaded, name) == getattr(episode, name)
    if episode.label is not None:
        assert loaded.label.affected_channels == episode.label.affected_channels


def test_a_label_names_a_file_and_an_episode_without_one_says_so():
    assert EPISODE.labelled.path == Path("episodes/Lift/faulty/push-mild-7.npz")
    with pytest.raises(ValueError, match="has no label"):
        Episode(X, SPEC).labelled  # noqa: B018 (a property that raises)


def test_a_damaged_file_is_named(tmp_path):
    whole = save_episode(tmp_path / "new.npz", EPISODE).read_bytes()
    path = tmp_path / "one.npz"
    for damaged in (
        whole[: len(whole) // 2],
        b"",
        whole[:200] + bytes(b ^ 255 for b in whole[200:250]) + whole[250:],
    ):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"one\.npz is damaged"):
            load_episode(path)
    with pytest.raises(FileNotFoundError):
        load_episode(tmp_path / "none.npz")


def test_the_control_period_is_what_an_environment_says_of_time_and_never_silently_its_videos():
    def env(**said):
        kind = type("Foreign", (gym.Env,), {"metadata": {"render_fps": 10}} | said)
        return gym.Wrapper(kind())

    model = SimpleNamespace(opt=SimpleNamespace(timestep=0.002))
    for said, dt in (
        ({"dt": 0.05}, 0.05),
        ({"tau": 0.02}, 0.02),
        ({"control_timestep": lambda self: 0.04}, 0.04),
        ({"frame_skip": 5, "model": model}, 0.01),
        ({"config": {"policy_frequency": 5}}, 0.2),
        ({"control_freq": 20}, 0.05),
    ):
        assert control_period(env(**said)) == pytest.approx(dt)

    def step(self, action):
        self.time += 0.2
        return 0.0, 0.0, False, False, {}

    own = {
        "time": 3.0,
        "step": step,
        "reset": lambda self, **_: None,
        "action_space": gym.spaces.Discrete(2),
    }
    clocked = env(**own)
    assert control_period(clocked) == pytest.approx(0.2)  # by its own clock, in a copy
    assert clocked.unwrapped.time == 3.0
    with pytest.warns(PeriodWarning, match="Foreign does not state its control period: 0.1 s"):
        assert control_period(env()) == pytest.approx(0.1)
    assert control_period(env(metadata={})) == 1.0


def test_an_environment_whose_step_returns_six_values_is_refused_with_the_wrapper_that_mends_it():
    space = gym.spaces.Box(-1, 1, (2,), np.float32)
    zeros = np.zeros(2, np.float32)
    said = {"observation_space": space, "action_space": space, "dt": 0.1}
    said |= {
        "reset": lambda self, **_: (zeros, {}),
        "step": lambda self, a: (zeros, 0.0, 1.0, False, False, {}),
    }
    recorder = StreamRecorder(type("Six", (gym.Env,), said)())
    recorder.reset()
    with pytest.raises(
        TypeError, match=r"step of Six returns 6 values.*SafetyGymnasium2Gymnasium\(env\)"
    ):
        recorder.step(zeros)
