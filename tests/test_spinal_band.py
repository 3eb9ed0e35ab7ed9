"""What a memory expects an arm to feel: it knows the task, keeps its promise, and refuses what it cannot do."""

import json
from functools import partial

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.envs.threaded_vector import ThreadVectorEnv
from asm_gym.episode import Episode
from asm_gym.faults import Push
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.contact_band import UNJUDGED, ContactBand, FeltEpisode
from asm_gym.rollouts.substeps import felt_episodes
from asm_gym.spec import Channel, StreamSpec
from asm_gym.wrappers import FaultInjection, NeuralASMSafety

SPEC = StreamSpec(
    (
        Channel("joint_position", 2, "rad", 1e-3, "joint"),
        Channel("external_torque", 2, "N m", 0.1, "torque"),
        Channel("wrist_force", 3, "N", 0.1, "wrench"),
        Channel("action", 2, group="action"),
    ),
    dt=0.05,
)
STEPS, SUBSTEPS = 30, 5
CONTACT = 8.0
"""[N] on the first axis of the wrist, while the second action says that something is held."""


def felt_episode(rng, begins=None):
    """Moves about, then grasps at a time that the command tells."""
    begins = int(rng.integers(8, 20)) if begins is None else begins
    held = np.arange(STEPS) >= begins
    action = np.stack([np.sin(0.3 * np.arange(STEPS) + rng.uniform(0, 6)), held], axis=1)
    felt = rng.normal(scale=0.05, size=(STEPS, SUBSTEPS, 5))
    felt[:, :, 0] += 0.5 * action[:, None, 0]
    felt[:, :, 2] += CONTACT * held[:, None] * (1 + 0.1 * rng.normal(size=(STEPS, SUBSTEPS)))
    senses = np.hstack([np.cumsum(0.05 * action, axis=0), felt.mean(axis=1)])
    stream = np.hstack([senses + rng.normal(scale=1e-3, size=senses.shape), action]).astype(np.float32)
    return FeltEpisode(stream, felt)


@pytest.fixture(scope="module")
def nominal():
    rng = np.random.default_rng(0)
    return [felt_episode(rng) for _ in range(160)]


@pytest.fixture(scope="module")
def memory(nominal):
    episodes = [Episode.from_stream(e.stream, SPEC) for e in nominal[:12]]
    return NeuralASM(SPEC, hidden_size=8, association_size=20, epochs=1).fit(episodes)


@pytest.fixture(scope="module")
def band(memory, nominal):
    return ContactBand(memory).fit(nominal[12:60]).calibrate(nominal[60:], 0.05)


def bands(band, episode):
    """The band of each step of an episode; None where there is none."""
    state, found = band.memory.initial_state(1), []
    for row in episode.stream:
        found.append(band.expect(state.model, row[SPEC.motor]))
        state, _ = band.memory.observe(state, row[None].astype(np.float64))
    return found


def leaves(band, episode):
    found = bands(band, episode)
    return any(b is not None and (b.times(f) > 1).any() for b, f in zip(found, episode.felt, strict=True))


def test_no_more_of_fresh_nominal_episodes_leave_it_than_calibration_allows(band):
    rng = np.random.default_rng(1)
    left = sum(leaves(band, felt_episode(rng)) for _ in range(60))
    assert left <= 60 * band.promise.at_most + 3  # 3: a binomial's own spread


def test_a_grasp_is_inside_and_the_same_force_in_free_motion_is_not(band):
    episode = felt_episode(np.random.default_rng(2), begins=15)
    found = bands(band, episode)
    assert found[0] is None  # nothing is known yet to expect from
    held, free = found[20], found[10]
    force = np.array([[0.0, 0.0, CONTACT, 0.0, 0.0]])
    assert held.times(force)[2] <= 1
    assert free.times(force)[2] > 1
    assert held.times(0 * force)[2] > 1  # what was grasped is gone


def test_what_is_not_a_number_is_outside(band):
    found = bands(band, felt_episode(np.random.default_rng(3)))[5]
    assert found.times(np.full((1, 5), np.nan)).min() == np.inf


def test_its_file_holds_all_of_it_and_its_export_the_thresholds(band, memory, tmp_path):
    band.save(tmp_path / "arm.band")
    again = ContactBand.load(tmp_path / "arm.band", memory)
    episode = felt_episode(np.random.default_rng(4))
    for one, other in zip(bands(band, episode)[2:], bands(again, episode)[2:], strict=True):
        np.testing.assert_array_equal(one, other)
    assert again.promise == band.promise
    band.export(tmp_path / "thresholds.json")
    said = json.loads((tmp_path / "thresholds.json").read_text())
    assert said["number"] == [*(f"external_torque[{i}]" for i in range(2)), *(f"wrist_force[{i}]" for i in range(3))]
    half = [(b.high - b.low) / 2 for b in bands(band, episode)[2:]]
    assert (np.array(said["least"]) <= np.min(half, axis=0) + 1e-12).all()
    assert (np.array(said["most"]) >= np.max(half, axis=0) - 1e-12).all()
    with pytest.raises(ValueError, match="does not fit"):
        ContactBand.load(tmp_path / "arm.band", NeuralASM.pretrained("panda"))


def test_what_was_never_calibrated_is_refused(memory, nominal, tmp_path):
    band = ContactBand(memory)
    with pytest.raises(RuntimeError, match="learned nothing"):
        band.calibrate(nominal[:30], 0.05)
    band.fit(nominal[:8])
    for asked in (
        lambda: band.expect(memory.initial_state(1).model, np.zeros(2)),
        lambda: band.save(tmp_path / "x"),
        lambda: band.export(tmp_path / "x"),
        lambda: band.promise,
    ):
        with pytest.raises(RuntimeError, match="never calibrated"):
            asked()
    with pytest.raises(ValueError, match="needs at least 99"):
        band.calibrate(nominal[:30], 0.01)


def test_what_is_sent_down_is_what_was_calibrated_whatever_was_sent_before(memory, nominal):
    band = ContactBand(memory).fit(nominal[:8]).calibrate(nominal[8:30], 0.05)
    other = ContactBand(memory).fit(nominal[8:16]).calibrate(nominal[16:38], 0.05)
    x = band._read(0, nominal[0])[0][:5]
    for _ in range(2):
        for each, scale in ((band, band.scale_), (band, 2.0), (other, other.scale_)):
            middle, half = each._at(x, scale)
            sent = [each._sent_down(scale).at(row) for row in x]
            np.testing.assert_allclose([m for m, _ in sent], middle, rtol=1e-9)
            np.testing.assert_allclose([h for _, h in sent], half, rtol=1e-9)
        other.learned_ = {**other.learned_, "middle": 2 * other.learned_["middle"]}


@pytest.mark.parametrize("gone", ["external_torque", "wrist_force"])
def test_a_memory_that_expects_no_torque_or_no_force_is_refused(nominal, gone):
    spec = StreamSpec(tuple(c for c in SPEC.channels if c.name != gone), 0.05)
    keep = [i for i, label in enumerate(SPEC.labels) if not label.startswith(gone)]
    memory = NeuralASM(spec, hidden_size=8, association_size=20, epochs=1)
    memory.fit([Episode.from_stream(e.stream[:, keep], spec) for e in nominal[:4]])
    with pytest.raises(ValueError, match="expects external_torque and wrist_force"):
        ContactBand(memory)


@pytest.mark.parametrize("what", ["few", "short", "wide", "nan"])
def test_episodes_that_cannot_be_learned_from_are_refused(memory, nominal, what):
    stream, felt = nominal[0]
    bad = {
        "few": [nominal[0]] * 3,
        "short": [FeltEpisode(stream[:2], felt[:2])] * 4,
        "wide": [FeltEpisode(stream, felt[:, :, :4])] * 4,
        "nan": [FeltEpisode(stream, np.full_like(felt, np.nan))] * 4,
    }
    with pytest.raises(ValueError, match=r"four|should have|not finite"):
        ContactBand(memory).fit(bad[what])


class Sways:
    """A policy that moves the hand to and fro."""

    def __init__(self, env):
        self.step = 0

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        step = 0 if state is None else state
        action = np.zeros(7, np.float32)
        action[:3], action[-1] = 0.3 * np.sin(0.4 * step + np.arange(3)), -1.0
        return action, step + 1


@pytest.fixture(scope="module")
def swaying():
    """An environment, a memory of the arm that never alarms, and a band for swaying in the air."""
    env = gym.make("asm_gym/Lift-v0", horizon=100)
    memory = NeuralASM.pretrained("panda").with_threshold(1e9)
    felt = felt_episodes(env, range(36), Sways, steps=20)
    yield env, memory, ContactBand(memory).fit(felt[:16]).calibrate(felt[16:], 0.05)
    env.close()


def sway(env, seed, steps=20):
    env.reset(seed=seed)
    policy, state, infos = Sways(env), None, []
    for _ in range(steps):
        action, state = policy.predict(None, state)
        infos.append(env.step(action)[-1]["asm"])
    return infos


def test_a_push_in_free_motion_is_an_alarm_within_ten_milliseconds_and_the_reflex_goes_on(swaying):
    env, memory, band = swaying
    quiet = sway(NeuralASMSafety(env, memory, on_alarm="hold", band=band), 100)
    assert not any(i["alarm"] for i in quiet)
    assert all(np.isnan(i["severity"]["left_s"]) for i in quiet)
    pushed = FaultInjection(env, [Push(body="robot0_link5", newtons=20.0, onset=10, duration=4)])
    infos = sway(NeuralASMSafety(pushed, memory, on_alarm="hold", band=band), 100)
    assert [i["alarm"] for i in infos[:11]] == [False] * 10 + [True]
    assert infos[10]["severity"]["left_s"] <= 0.01
    assert infos[10]["transition"] == "override"
    assert infos[11]["intervened"]
    worst = max(infos[10]["attribution"], key=infos[10]["attribution"].get)
    assert worst.startswith(("external_torque", "wrist_force"))
    assert sum(infos[10]["attribution"].values()) == pytest.approx(infos[10]["surprise"])
    watched = sway(NeuralASMSafety(pushed, memory, on_alarm="monitor", band=band), 100)
    assert watched[10]["severity"]["left_s"] <= 0.01
    assert not any(i["intervened"] for i in watched)
    pushed.undo_faults()


def test_no_band_is_sent_while_a_reflex_acts_and_in_the_first_steps_after_it(swaying, monkeypatch):
    env, memory, band = swaying
    sent, step = [], 0
    expect = env.unwrapped.expect
    monkeypatch.setattr(env.unwrapped, "expect", lambda *a: (sent.append(step), expect(*a)))
    pushed = FaultInjection(env, [Push(body="robot0_link5", newtons=20.0, onset=6, duration=2)])
    guarded = NeuralASMSafety(pushed, memory, on_alarm="hold", band=band, release_after=4)
    guarded.reset(seed=100)
    policy, state, acted = Sways(env), None, []
    for step in range(16):  # noqa: B007 (what is sent says in which step)
        action, state = policy.predict(None, state)
        acted.append(guarded.step(action)[-1]["asm"]["intervened"])
    pushed.undo_faults()
    back = acted.index(True) + 4
    assert acted[:16] == [7 <= t < back for t in range(16)]
    assert sent == [*range(UNJUDGED, 7), *range(back + UNJUDGED, 16)]


def test_side_by_side_each_member_has_its_own_band(swaying):
    _, memory, band = swaying

    def made(newtons):
        push = Push(body="robot0_link5", newtons=newtons, onset=10, duration=4)
        return NeuralASMSafety(FaultInjection(gym.make("asm_gym/Lift-v0"), [push]), memory, "hold", band=band)

    envs = ThreadVectorEnv([partial(made, newtons) for newtons in (0.1, 20.0)])
    envs.reset(seed=100)
    policy, state, left = Sways(None), None, []
    for _ in range(12):
        action, state = policy.predict(None, state)
        infos = envs.step(np.stack([action, action]))[-1]
        left.append(infos["asm"]["severity"]["left_s"])
    envs.close()
    left = np.array(left)
    assert np.isnan(left[:10]).all()
    assert left[10, 1] <= 0.01


class Replay(gym.Env):
    """A log of another arm, played back."""

    observation_space = gym.spaces.Box(-1, 1, (1,))
    action_space = gym.spaces.Box(-1, 1, (7,))

    def __init__(self, spec, rows):
        self.stream_spec, self.rows, self.dt = spec, rows, spec.dt

    def reset(self, *, seed=None, options=None):
        self.at = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        row = self.rows[self.at]
        self.at += 1
        return np.zeros(1, np.float32), 0.0, False, False, {"stream": row}


def test_where_nothing_is_felt_within_steps_it_is_compared_once_a_step_and_said(swaying):
    env, memory, band = swaying
    (episode,) = felt_episodes(env, [200], Sways, steps=20)
    rows = episode.stream.copy()
    rows[12, memory.spec.slices["external_torque"].start] += 60.0
    with pytest.warns(UserWarning, match="compared once a step"):
        guarded = NeuralASMSafety(Replay(memory.spec, rows), memory, on_alarm="hold", band=band)
    infos = sway(guarded, 200, 14)
    assert [i["alarm"] for i in infos[:13]] == [False] * 12 + [True]
    assert infos[12]["severity"]["left_s"] == pytest.approx(0.05)


def test_a_band_that_does_not_fit_is_refused(swaying, memory, nominal):
    env, known, band = swaying
    with pytest.raises(TypeError, match="ContactBand"):
        NeuralASMSafety(env, known, band=0.5)
    with pytest.raises(RuntimeError, match="never calibrated"):
        NeuralASMSafety(env, known, band=ContactBand(known))
    with pytest.raises(ValueError, match="another memory"):
        NeuralASMSafety(env, NeuralASM.pretrained("panda").with_threshold(1e9), band=band)
    fast = StreamSpec(SPEC.channels, 0.01)
    quick = NeuralASM(fast, hidden_size=8, association_size=20, epochs=1)
    quick.fit([Episode.from_stream(e.stream, fast) for e in nominal[:4]])
    with pytest.raises(ValueError, match="100 rows a second"):
        ContactBand(quick)
