"""Environments that are not robosuite's: their streams, faults in them, and what of them cannot be watched."""

from __future__ import annotations

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import NormalizeObservation

from asm_gym import collect, register_task
from asm_gym.data.known_environments import known_means
from asm_gym.data.minari_datasets import read_dataset
from asm_gym.faults import (
    ActionDelay,
    ActionScale,
    Bias,
    Delay,
    Dropout,
    Freeze,
    Noise,
    Push,
    Scale,
)
from asm_gym.faults.foreign_faults import KINDS, FaultyInterface, faults_anywhere, sigmas
from asm_gym.faults.suite import SEVERITIES
from asm_gym.policies import make_policy
from asm_gym.scripts.cli import main
from asm_gym.spec import MOTOR, Channel, StreamSpec, flat, flat_rows
from asm_gym.tasks import OWN
from asm_gym.wrappers import FaultInjection, NeuralASMSafety, StreamRecorder, VectorNeuralASMSafety
from asm_gym.wrappers.capabilities import missing_meaning
from tests.fakes import CueMonitor, FakeEnv
from tests.needs import needs

ONSET, STEPS = 5, 12
ARM = "asm_gym/SyntheticArm-v0"


class Both(gym.Env):
    """Observes a dict within a dict; is told one of three things."""

    observation_space = spaces.Dict(
        {
            "wheel": spaces.Box(-9, 9, (2,), np.float64),
            "lamp": spaces.Discrete(3),
            "gps": spaces.Dict({"x": spaces.Box(-9, 9, (), np.float32)}),
        }
    )
    action_space = spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.observe(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.t += 1
        return self.observe(), 0.0, False, self.t >= 6, {}

    def observe(self):
        return {
            "wheel": np.array([self.t, -self.t]),
            "lamp": self.t % 3,
            "gps": {"x": np.float32(0.5 * self.t)},
        }


def test_a_dict_observation_has_a_channel_for_each_key():
    spec = StreamSpec.from_spaces(Both.observation_space, Both.action_space, 0.1)
    sizes = {c.name: c.size for c in spec.channels}
    assert sizes == {"wheel": 2, "lamp": 3, "gps.x": 1, "action": 3}
    rng_space = Both.observation_space
    rng_space.seed(0)
    samples = [rng_space.sample() for _ in range(4)]
    rows = np.array([flat(rng_space, s) for s in samples], np.float32)
    wheel = spec.slices["wheel"]
    np.testing.assert_allclose(rows[:, wheel], [s["wheel"] for s in samples], rtol=1e-6)
    np.testing.assert_array_equal(
        rows[:, spec.slices["lamp"]].argmax(axis=1), [s["lamp"] for s in samples]
    )
    columns = {k: [s[k] for s in samples] for k in ("wheel", "lamp")} | {
        "gps": {"x": [s["gps"]["x"] for s in samples]}
    }
    np.testing.assert_array_equal(flat_rows(rng_space, columns, 4), rows)


def test_discrete_actions_are_recorded_watched_and_never_taken_over():
    recorder = StreamRecorder(Both())
    recorder.reset(seed=0)
    for action in (2, 0, 1, 1, 0, 2):
        recorder.step(action)
    (episode,) = recorder.episodes
    assert episode.success  # nobody said that it was not
    np.testing.assert_array_equal(episode.stream[:, -3:].argmax(axis=1), [2, 0, 1, 1, 0, 2])
    assert episode.observations.shape == (7, 6)
    env = NeuralASMSafety(Both(), CueMonitor([2], recorder.stream_spec), on_alarm="monitor")
    env.reset(seed=0)
    infos = [env.step(1)[4] for _ in range(4)]
    assert [bool(i["asm_alarm"]) for i in infos] == [False, False, True, False]
    assert infos[2]["asm"]["executed_action"] == 1
    ended = NeuralASMSafety(Both(), CueMonitor([0], recorder.stream_spec), on_alarm="terminate")
    ended.reset(seed=0)
    assert ended.step(0)[2]
    with pytest.raises(TypeError, match=r"needs a Box action space.*on_alarm=\"monitor\""):
        NeuralASMSafety(Both(), CueMonitor([2], recorder.stream_spec))


class Renamed(FakeEnv):
    """An environment that does not say what its actions mean."""

    def __init__(self, env_id):
        super().__init__()
        self.action_means = None
        self.spec = SimpleNamespace(id=env_id)


@pytest.mark.parametrize(
    ("env_id", "means"),
    [
        ("FetchReachDense-v4", ("delta",) * 3),
        ("FrankaKitchen-v1", ("velocity",) * 3),
        ("panda_gym:PandaReachJoints-v3", ("delta",) * 3),
        ("Meta-World/MT1", ("delta",) * 3),
        ("HandReach-v2", ("target",) * 3),
        ("dm_control/manipulator-bring_ball-v0", ("torque",) * 3),
        ("Pendulum-v1", None),
    ],
)
def test_actions_of_known_environments_need_no_declaration(env_id, means):
    assert known_means(env_id, 3) == means
    env = Renamed(env_id)
    assert (missing_meaning(env) == "") == (means is not None)
    refused = means is None or "torque" in means
    if refused:
        with pytest.raises(ValueError, match="action_means"):
            NeuralASMSafety(env, CueMonitor([1]), on_alarm="hold")
    else:
        NeuralASMSafety(env, CueMonitor([1]), on_alarm="hold").reset(seed=0)


def test_a_kept_number_of_a_known_action_stays_as_it_was_executed():
    assert known_means("Meta-World/MT1", 4) == ("delta", "delta", "delta", "kept")


def test_collect_asks_for_the_meaning_of_actions_that_are_not_known():
    with pytest.warns(UserWarning, match="action_means"):
        collect("Pendulum-v1", "sway", episodes=1, workers=1)


def test_spaces_that_are_no_numbers_cannot_be_a_stream():
    graph = spaces.Sequence(spaces.Discrete(2))
    with pytest.raises(TypeError, match="observation space must be numbers"):
        StreamSpec.from_spaces(graph, spaces.Discrete(2))


def test_a_wrapper_that_changes_with_what_it_has_seen_belongs_outside():
    inside = NormalizeObservation(FakeEnv(own_stream=False))
    monitor = CueMonitor(
        spec=StreamSpec((Channel("observation", 2), Channel("action", 3, group=MOTOR)), 0.05)
    )
    for watch in (StreamRecorder, lambda env: NeuralASMSafety(env, monitor)):
        with pytest.raises(
            ValueError, match=r"NormalizeObservation\(NeuralASMSafety\(env, monitor\)\)"
        ):
            watch(inside)
    inside.update_running_mean = False
    NeuralASMSafety(inside, monitor)
    NormalizeObservation(NeuralASMSafety(FakeEnv(own_stream=False), monitor))
    StreamRecorder(NormalizeObservation(FakeEnv()))  # whose stream it cannot reach


def course(faults=(), seed=3, make=lambda: gym.make(ARM, horizon=STEPS)):
    """(T, D) the stream of an arm that sways, and what was said to be active."""
    env = StreamRecorder(FaultInjection(make(), faults))
    policy = make_policy("sway", env, seed=seed)
    env.reset(seed=seed)
    active = []
    for _ in range(STEPS):
        *_, info = env.step(policy.predict(np.zeros(21))[0])
        active.append(info["fault"])
    return env.finish().stream, active


VELOCITY = {"channel": "joint_velocity", "element": 2, "onset": ONSET}
AT = 9
"""Where that is in a row."""


@pytest.mark.parametrize(
    ("fault", "oracle"),
    [
        (Bias(**VELOCITY, amount=0.5), lambda x: x[ONSET:] + 0.5),
        (Scale(**VELOCITY, factor=1.5), lambda x: x[ONSET:] * 1.5),
        (Freeze(**VELOCITY), lambda x: np.full(STEPS - ONSET, x[ONSET - 1])),
        (
            Freeze(**VELOCITY, duration=2),
            lambda x: np.concatenate([np.full(2, x[ONSET - 1]), x[ONSET + 2 :]]),
        ),
        (Dropout(**VELOCITY, probability=1.0), lambda x: np.zeros(STEPS - ONSET)),
        (Delay(**VELOCITY, steps=1), lambda x: x[ONSET - 1 : -1]),
    ],
    ids=lambda f: getattr(f, "name", ""),
)
def test_a_sense_reads_what_its_fault_makes_of_it_and_no_other_changes(fault, oracle):
    (healthy, none), (broken, active) = course(), course([fault])
    np.testing.assert_array_equal(broken[:ONSET], healthy[:ONSET])
    np.testing.assert_allclose(broken[ONSET:, AT], oracle(healthy[:, AT]), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(np.delete(broken, AT, axis=1), np.delete(healthy, AT, axis=1))
    assert [bool(a) for a in active] == [fault.active(t) for t in range(STEPS)]
    assert not any(none)


def test_a_motor_does_what_its_fault_makes_of_a_command_and_the_stream_keeps_the_command():
    done = []

    class Kept(gym.ActionWrapper):
        def action(self, action):
            done.append(action)
            return action

    def make():
        return Kept(gym.make(ARM, horizon=STEPS))

    course(make=make)
    told, done = done, []
    stream, _ = course([ActionScale(factor=0.5, onset=ONSET)], make=make)
    np.testing.assert_allclose(done[ONSET:], 0.5 * np.array(told[ONSET:]), rtol=1e-6)
    np.testing.assert_array_equal(done[:ONSET], told[:ONSET])
    np.testing.assert_allclose(stream[:, 21:], told, rtol=1e-6)
    done = []
    course([ActionDelay(steps=2, onset=2)], make=make)
    np.testing.assert_allclose(done[4:], told[2:-2], rtol=1e-6)


def test_faults_end_with_the_episode_and_wrappers_add_up():
    env = FaultInjection(gym.make(ARM), [Bias(**VELOCITY | {"onset": 0}, amount=1.0)])
    env = FaultInjection(env, [Bias(**VELOCITY | {"onset": 0}, amount=2.0)])
    rest = np.zeros(7, np.float32)
    for _ in range(2):
        first = env.reset(seed=0)[0]
        assert abs(first[AT]) < 0.1
        observation, *_, info = env.step(rest)
        assert info["fault"] == ("Bias", "Bias")
        assert observation[AT] == pytest.approx(3.0, abs=0.1)
        assert info["stream"][AT] == observation[AT]
        assert observation.dtype == np.float32


class Named(gym.ObservationWrapper):
    """As a dict."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Dict({"sensed": env.observation_space})

    def observation(self, observation):
        return {"sensed": observation}


def named():
    return Named(FakeEnv(length=5, own_stream=False))


@pytest.mark.parametrize(
    ("env", "fault", "error", "message"),
    [
        (lambda: gym.make(ARM), Push(), ValueError, "Push needs a robosuite environment"),
        (
            lambda: gym.make(ARM),
            Bias(channel="smell"),
            ValueError,
            "unknown channel 'smell'; known: joint_position",
        ),
        (
            lambda: gym.make(ARM),
            Bias(element=7),
            ValueError,
            r"element of joint_position must be .*\[0, 6\], got 7",
        ),
        (
            lambda: gym.make("Pendulum-v1"),
            Noise(channel="observation", element=0, onset=200),
            ValueError,
            "horizon of 200",
        ),
        (Both, ActionScale(), TypeError, "faults need Box spaces"),
    ],
)
def test_a_fault_that_an_environment_cannot_have_is_refused(env, fault, error, message):
    with pytest.raises(error, match=message):
        FaultInjection(env(), [fault])


def test_a_stream_that_is_not_the_observation_is_refused():
    class Other(FakeEnv):
        def _out(self, action):
            observation, info = super()._out(action)
            return observation + 1, info

    env = FaultInjection(Other(), [Bias(channel="position", element=0)])
    with pytest.raises(ValueError, match="does not hold its observation"):
        env.reset(seed=0)


def test_every_kind_strikes_a_sense_that_moves_and_a_twin_shows_it():
    interface = FaultyInterface(gym.make(ARM))
    healthy, _ = course()
    sigma = sigmas(interface, [healthy[:, :21]])
    np.testing.assert_array_equal(sigma[:7], 1e-4)  # its declared noise
    sigma[1:] = 0.0  # as if all others stood still
    for kind in KINDS:
        for severity in SEVERITIES:
            faults = faults_anywhere(kind, interface, sigma, severity, ONSET, seed=1)
            broken, _ = course(faults)
            np.testing.assert_array_equal(broken[:ONSET], healthy[:ONSET])
            struck = {label for fault in faults for label in fault.labels(interface)}
            assert "joint_position[0]" in struck
            if severity == "strong":
                assert not np.array_equal(broken, healthy), kind
    with pytest.raises(ValueError, match="no sensor reading of this environment changes"):
        faults_anywhere("frozen_sense", interface, 0 * sigma, "strong", ONSET, seed=1)


def test_what_a_dict_environment_did_is_a_dataset_and_comes_back(tmp_path):
    needs("minari")
    gym.register("tests/Named-v0", entry_point="tests.test_elsewhere:named")
    try:
        options = ["--policy", "sway", "--episodes", "3", "--workers", "1", "--out", str(tmp_path)]
        assert main(["collect", "tests/Named-v0", *options]) == 0
        episodes = collect("tests/Named-v0", "sway", 3, workers=1)
    finally:
        del gym.registry["tests/Named-v0"]
    read = read_dataset(tmp_path)
    assert read[0].spec.labels == ("sensed[0]", "sensed[1]", "action[0]", "action[1]", "action[2]")
    for there, here in zip(read, episodes, strict=True):
        np.testing.assert_array_equal(there.stream, here.stream)


EVALUATE = [
    *(
        "--fit-episodes",
        "8",
        "--calibration-episodes",
        "19",
        "--nominal-episodes",
        "4",
        "--faulty-episodes",
        "3",
    ),
    *("--false-alarm-rate", "0.05", "--severities", "strong", "--workers", "1"),
    *("--monitors", "kalman+evidence", "association_values"),
    "asm_gym.monitors.baselines.friction_rule:FrictionRule",  # needs torques, which no Gymnasium arm senses
    *("--faults", "frozen_sense", "lost_rows", "action_scale"),
]


def test_any_environment_can_be_evaluated(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    assert (
        main(
            [
                "evaluate",
                "--tasks",
                "Pusher-v5",
                "--policy",
                "sway",
                "--steps",
                "40",
                *EVALUATE,
                "--out",
                str(tmp_path / "run"),
            ]
        )
        == 0
    )
    said = " ".join(capsys.readouterr().out.split())
    assert "FrictionRule is left out" in said
    for row in (
        "ideal observer",
        "kalman+evidence",
        "frozen sense strong",
        "lost rows strong",
        "action scale strong",
    ):
        assert row in said
    table = (tmp_path / "run" / "results.md").read_text()
    assert "| frozen sense strong | 1.00 / 100 % | 1.00 / 100 % |" in table


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--tasks", "Pusher-v5", "Lift"], "name one environment at a time"),
        (["--tasks", "Lift", "--steps", "20"], "leave --steps out"),
        (["--tasks", "Pusher-v6"], "unknown task 'Pusher-v6'"),
        (["--tasks", "nowhere_at_all:Pusher-v5"], "nowhere_at_all"),
        (["--tasks", "Pusher-v5", "--faults", "push"], "unknown kind of fault 'push'"),
        (["--tasks", "CartPole-v1"], "no scripted expert"),
        (["--tasks", "CartPole-v1", "--policy", "sway"], "finite Box"),
    ],
)
def test_an_evaluation_that_makes_no_sense_is_refused(arguments, message, tmp_path, capsys):
    assert main(["evaluate", *arguments, "--quick", "--out", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err


def test_environments_side_by_side_must_sense_boxes():
    envs = gym.vector.SyncVectorEnv([lambda: Named(FakeEnv(own_stream=False))] * 2)
    monitor = CueMonitor()
    with pytest.raises(TypeError, match="FlattenObservation"):
        VectorNeuralASMSafety(envs, monitor)


@pytest.mark.parametrize(
    ("package", "env_id", "policy"),
    [
        ("gymnasium_robotics", "gymnasium_robotics:FetchReach-v4", "sway"),
        ("shimmy", "shimmy:dm_control/cartpole-balance-v0", "sway"),
    ],
)
def test_environments_of_others_give_streams_whose_senses_can_be_struck(package, env_id, policy):
    needs(package)
    needs("dm_control" if package == "shimmy" else package)
    env = gym.make(env_id, max_episode_steps=20)
    (episode,) = collect(env_id, policy, 1, workers=1, max_episode_steps=20)
    assert episode.stream.shape == (20, episode.spec.size)
    assert np.isfinite(episode.stream).all()
    channel = episode.spec.channels[0]
    struck = StreamRecorder(
        FaultInjection(env, [Bias(channel=channel.name, element=0, amount=9.0, onset=2)])
    )
    acting = make_policy(policy, struck, seed=0)
    observation, _ = struck.reset(seed=0)
    for _ in range(3):
        observation, *_ = struck.step(acting.predict(observation)[0])
    stream = struck.finish().stream
    assert stream[2, 0] - stream[1, 0] > 8


def test_an_environment_without_a_body_is_not_told_to_babble():
    with pytest.raises(ValueError, match="StreamRecorder") as said:
        NeuralASMSafety(gym.make("Pendulum-v1"))
    assert "babble" not in str(said.value)


def test_an_argument_of_robosuite_is_refused_by_name():
    with pytest.raises(TypeError, match="named by robot="):
        gym.make("asm_gym/Lift-v0", robots="Panda")


def own_class():
    from robosuite.environments.manipulation.lift import Lift

    class Pour(Lift):
        """A class of one's own."""

    return Pour


def test_robosuites_own_gym_wrapper_is_recorded():
    from robosuite.wrappers import GymWrapper

    from asm_gym.envs.robosuite_backend import import_robosuite

    import_robosuite()
    options = {
        "has_renderer": False,
        "has_offscreen_renderer": False,
        "use_camera_obs": False,
        "control_freq": 10,
    }
    recorder = StreamRecorder(GymWrapper(own_class()(robots="Panda", **options)))
    recorder.reset(seed=0)
    for _ in range(3):
        recorder.step(recorder.action_space.sample())
    episode = recorder.finish()
    assert episode.spec.dt == pytest.approx(0.1)
    assert len(episode) == 3


def test_a_class_of_robosuite_becomes_a_task_with_named_channels():
    register_task("Decant", own_class(), horizon=6, robots="Sawyer", control_freq=10)
    first, again = (
        collect("asm_gym/Decant-v0", "hold", episodes=1, seed=3, workers=1)[0] for _ in range(2)
    )
    np.testing.assert_array_equal(first.stream, again.stream)
    units = {c.name: c.unit for c in first.spec.channels}
    assert (first.spec.source, first.spec.dt, len(first)) == ("Sawyer", 0.1, 6)
    assert (
        units["robot0_joint_pos"],
        units["robot0_joint_vel"],
        units["robot0_joint_pos_cos"],
    ) == (
        "rad",
        "rad/s",
        "1",
    )
    assert "cube_pos" not in units
    del OWN["Decant"], gym.registry["asm_gym/Decant-v0"]
