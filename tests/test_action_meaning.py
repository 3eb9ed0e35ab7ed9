"""What an action means is found in how the state moves, and a robot that is held stays where it is."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.data.action_identification import identify_meaning
from asm_gym.data.action_meaning import ACTIONS, ActionMeaning
from asm_gym.monitors import Surprise
from asm_gym.policies.hold import Hold
from asm_gym.wrappers import NeuralASMSafety, StreamRecorder, VectorNeuralASMSafety

JOINTS, STEPS = 3, 150


class Arm(gym.Env):
    """Joints [rad] whose actions mean what ``means`` says, each a name of how it moves; senses are noisy."""

    def __init__(self, means, noise=1e-3, lag=1.0, unit=1.0, rates=True, **more):
        self.means, self.noise, self.lag, self.unit, self.rates, self.more = (
            means,
            noise,
            lag,
            unit,
            rates,
            more,
        )
        size = JOINTS * (2 if rates else 1)
        self.observation_space = gym.spaces.Box(-1e3, 1e3, (size,), np.float32)
        self.action_space = gym.spaces.Box(-400, 400, (JOINTS,), np.float32)
        self.dt = 0.02

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.q, self.v, self.t = np.array([0.3, 1.2, -1.5]), np.zeros(JOINTS), 0
        return self.observe(), {}

    def observe(self):
        sensed = self.q + self.noise * self.np_random.normal(size=JOINTS)
        sensed = np.r_[sensed, self.v / self.dt] if self.rates else sensed
        return sensed.astype(np.float32)

    def step(self, action):
        for j, (how, u) in enumerate(
            zip(self.means, np.asarray(action, float) / self.unit, strict=True)
        ):
            if how == "target":
                self.v[j] = np.clip(self.lag * (u - self.q[j]), -0.06, 0.06)
            elif how in ("delta", "velocity"):
                self.v[j] = np.clip(u * (self.dt if how == "velocity" else 1.0), -0.06, 0.06)
            else:
                self.v[j] = 0.98 * self.v[j] + 1e-3 * u
            self.q[j] += self.v[j]
        self.t += 1
        return self.observe(), 0.0, False, self.t >= STEPS, {}


def wave(t, phase):
    return 0.3 * np.sin(0.06 * t + phase)


def speed(t, phase):
    return 0.3 * 0.06 * np.cos(0.06 * t + phase)


def policy(means, t, phase, dt=0.02, unit=1.0):
    """An action that sways each joint, in what its numbers mean."""
    made = {
        "target": np.array([0.3, 1.2, -1.5]) + wave(t, phase),
        "delta": np.full(JOINTS, speed(t, phase)),
        "velocity": np.full(JOINTS, speed(t, phase) / dt),
        "torque": 1.5 * np.cos(0.2 * t + phase) * np.ones(JOINTS),
    }
    return (unit * np.array([made[how][j] for j, how in enumerate(means)])).astype(np.float32)


def recorded(env, episodes=20):
    recorder = StreamRecorder(env)
    for seed in range(episodes):
        recorder.reset(seed=seed)
        phase = np.random.default_rng(seed).uniform(0, 6, JOINTS)
        for t in range(STEPS):
            recorder.step(policy(env.means, t, phase if seed % 2 else phase[:1], unit=env.unit))
    return recorder.episodes


SAME = ("target",) * JOINTS
CASES = {
    "targets": Arm(SAME),
    "targets that lag": Arm(SAME, lag=0.2),
    "targets in degrees": Arm(SAME, unit=180 / np.pi),
    "targets, exact": Arm(SAME, noise=0.0),
    "targets without rates": Arm(SAME, rates=False),
    "deltas": Arm(("delta",) * JOINTS),
    "deltas without rates": Arm(("delta",) * JOINTS, rates=False),
    "velocities": Arm(("velocity",) * JOINTS),
    "torques": Arm(("torque",) * JOINTS),
    "a mixture": Arm(("target", "target", "velocity")),
}
LIKE = {"velocity": ("velocity", "delta"), "delta": ("velocity", "delta")}


@pytest.mark.parametrize("case", CASES)
def test_recorded_episodes_tell_what_actions_mean(case):
    env = CASES[case]
    found = identify_meaning(recorded(env))
    assert all(f in LIKE.get(m, (m,)) for f, m in zip(found.means, env.means, strict=True)), found
    for j, means in enumerate(env.means):
        if means == "target":
            assert (found.senses[j], found.slopes[j], found.offsets[j]) == (
                j,
                pytest.approx(env.unit),
                0.0,
            )
    assert ActionMeaning.from_json(found.to_json()) == found


class Surprised:
    """A monitor that alarms from a row on, and knows what its episodes told of actions."""

    def __init__(self, spec, at, found=None):
        self.spec, self.at, self.threshold = spec, at, 1.0
        self.about = {} if found is None else {ACTIONS: found.to_json()}

    def initial_state(self, batch=1):
        return np.zeros(batch, np.int64)

    def observe(self, state, rows):
        shares = np.zeros((len(rows), self.spec.size))
        shares[:, 0] = 10.0 * (state >= self.at)
        return state + 1, Surprise(shares.sum(axis=1), shares)


def guarded(env, means=None, on_alarm="hold", at=40):
    recorder = StreamRecorder(env)
    found = None if means else identify_meaning(recorded(env))
    return NeuralASMSafety(
        env, Surprised(recorder.stream_spec, at, found), on_alarm, action_means=means
    )


def travel(env, means, rows=30, at=40):
    """How far the joints move in a hold [rad], and in as many rows before it."""
    env.reset(seed=5)
    inner, places = env.unwrapped, []
    for t in range(at + 1 + rows):
        *_, info = env.step(policy(means, t, np.arange(3.0), unit=inner.unit))
        places.append(inner.q.copy())
        assert bool(info["asm_intervened"]) == (t > at)
        assert not info["asm"]["failure"]
    before, held = np.array(places[at - rows : at]), np.array(places[at:])
    return float(np.ptp(held, axis=0).max()), float(np.ptp(before, axis=0).max())


FOUND = [(name, False) for name in CASES if name != "torques"]
TOLD = [(name, True) for name in ("targets", "deltas", "velocities", "a mixture")]


@pytest.mark.parametrize(("case", "told"), FOUND + TOLD)
def test_a_held_arm_stays_where_it_is_whatever_its_actions_mean(case, told):
    env = CASES[case]
    held, before = travel(guarded(env, env.means if told else None), env.means)
    assert held < 0.03
    assert before > 0.1


@pytest.mark.parametrize("lie", [1.0, -0.4, -99999.0, np.nan])
@pytest.mark.parametrize("many", [False, True])
@pytest.mark.parametrize("case", ["targets", "targets that lag", "targets in degrees", "a mixture"])
def test_a_held_arm_stays_though_the_sense_of_its_place_lies(case, many, lie):
    class Lying(Arm):
        def observe(self):
            sensed = super().observe()
            sensed[0] += lie if self.t > 40 else 0.0
            return sensed

    like = CASES[case]
    found, means, arms = identify_meaning(recorded(like)), like.means, []

    def make():
        arms.append(Lying(means, lag=like.lag, unit=like.unit))
        return arms[-1]

    if many:
        made = gym.vector.SyncVectorEnv([make, make])
        env = VectorNeuralASMSafety(
            made, Surprised(StreamRecorder(make()).stream_spec, 40, found), "hold"
        )
    else:
        env = NeuralASMSafety(
            make(), Surprised(StreamRecorder(make()).stream_spec, 40, found), "hold"
        )
    env.reset(seed=5)
    places = []
    for t in range(70):
        action = policy(means, t, np.arange(3.0), unit=like.unit)
        env.step(np.stack([action, action]) if many else action)
        places.append(arms[0].q.copy())
    assert np.ptp(places[41:], axis=0).max() < 0.05
    assert np.ptp(places[10:41], axis=0).max() > 0.1


@pytest.mark.parametrize("reflex", ["retract", "comply"])
def test_a_reflex_that_would_move_a_target_arm_is_refused_by_name(reflex):
    with pytest.raises(ValueError, match=f"{reflex} needs an environment whose controller"):
        guarded(Arm(SAME), on_alarm=reflex)


def test_a_hold_is_refused_where_nothing_tells_what_actions_mean_and_the_option_is_named():
    env = Arm(SAME)
    spec = StreamRecorder(env).stream_spec
    for on_alarm in (None, "hold", "graded"):
        with pytest.raises(ValueError, match="action_means"):
            NeuralASMSafety(env, Surprised(spec, 5), on_alarm)
    with pytest.raises(ValueError, match="action_means"):
        Hold(env)
    for told in ("torque", ("target", "target", "torque")):
        with pytest.raises(ValueError, match="torques"):
            NeuralASMSafety(env, Surprised(spec, 5), "hold", action_means=told)
    for told, message in (("position", "unknown action_means"), (("target",), "3 of them")):
        with pytest.raises(ValueError, match=message):
            NeuralASMSafety(env, Surprised(spec, 5), "hold", action_means=told)
    for on_alarm in ("monitor", "terminate", Hold(env, safe_action=np.zeros(3))):
        NeuralASMSafety(env, Surprised(spec, 5), on_alarm)
    with pytest.raises(ValueError, match="torques"):
        guarded(CASES["torques"])
    with pytest.warns(UserWarning, match="contradicts the recorded episodes: number 0"):
        NeuralASMSafety(
            env,
            Surprised(spec, 5, identify_meaning(recorded(env))),
            "hold",
            action_means="velocity",
        )


def test_an_environment_may_say_what_its_actions_mean():
    env = Arm(SAME)
    env.action_means = "target"
    held, _ = travel(
        NeuralASMSafety(env, Surprised(StreamRecorder(env).stream_spec, 40), "hold"), SAME
    )
    assert held < 0.03


@pytest.mark.filterwarnings("ignore:policy. the action must be finite")
def test_a_target_arm_whose_policy_fails_at_once_stays_where_it_is():
    env = guarded(Arm(SAME))
    env.reset(seed=1)
    for _ in range(5):
        env.step(np.full(JOINTS, np.nan, np.float32))
    np.testing.assert_allclose(env.unwrapped.q, [0.3, 1.2, -1.5], atol=0.01)
