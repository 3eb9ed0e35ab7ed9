"""Knock, stop and fault: told apart by senses alone, each with what is done about it, and none of them hidden."""

import gymnasium as gym
import numpy as np
import pytest

from asm_gym import Episode, NeuralASM
from asm_gym.detection.alarm_rule import EVENTS
from asm_gym.detection.benign_events import (
    EXCUSED,
    FADING,
    FASTEST_JOINT,
    KNOCKED_S,
    NEAR_STOP,
    SLIPPED,
    BenignEvents,
)
from asm_gym.detection.detector import GAINS
from asm_gym.monitors import Surprise
from asm_gym.spec import StreamSpec
from asm_gym.wrappers import NeuralASMSafety
from tests.fakes import FadingMonitor, FakeEnv
from tests.streams import EVENTFUL_ARM as ARM
from tests.streams import UNEVENTFUL


def excused(rows, spec=ARM):
    events = BenignEvents(spec)
    state, found = events.start(1), []
    for row in rows:
        state, judged = events.step(state, np.asarray(row, np.float64)[None])
        found.append((EVENTS[judged["excuse"][0]], judged["divisor"][0]))
    return found


def changed(column, value):
    row = UNEVENTFUL.copy()
    row[column] = value
    return row


@pytest.mark.parametrize(
    ("row", "event", "divisor"),
    [
        (UNEVENTFUL, "", 1.0),
        (changed(6, -50.1), "knock", EXCUSED),
        (changed(6, -49.9), "", 1.0),
        (changed(6, np.nan), "", 1.0),
        (changed(0, 0.98), "stop", EXCUSED),
        (changed(0, 0.96), "", 1.0),
        (changed(0, 1.09), "stop", EXCUSED),
        (changed(0, 1.11), "", 1.0),
        (changed(0, np.nan), "", 1.0),
        (changed(9, 0.011), "", SLIPPED),
        (changed(9, 0.009), "", 1.0),
    ],
)
def test_what_the_senses_say_of_a_row(row, event, divisor):
    assert excused([row]) == [(event, divisor)]


def test_a_joint_that_was_seen_on_its_way_is_at_its_stop_and_one_that_jumps_there_is_not():
    on_its_way = 1.0 - NEAR_STOP - 0.9 * FASTEST_JOINT * ARM.dt
    # at 20 Hz a joint of 5 rad/s gets from there to its stop in a row
    path = [
        0.5,
        on_its_way,
        0.98,
        1.05,
        0.98,
    ]
    assert [event for event, _ in excused([changed(0, q) for q in path])] == [
        "",
        "",
        "stop",
        "stop",
        "stop",
    ]
    for far in (0.5, -1.5, 1.2):  # across its range, or from past either stop
        assert {
            event for event, _ in excused([changed(0, far), changed(0, 0.98), changed(0, 0.99)])
        } == {""}
    # nobody saw it
    assert excused([changed(0, 0.5), changed(0, np.nan), changed(0, 0.98)])[-1] == (
        "stop",
        EXCUSED,
    )
    other = changed(0, 0.98)
    other[1] = -1.98
    assert excused([changed(1, -1.9), other])[-1] == ("stop", EXCUSED)  # each joint by itself


def test_a_knock_is_felt_for_a_second_at_any_rate_and_fades_as_what_it_has_left_in_the_slowest_evidence():
    for dt in (0.05, 0.01):
        spec = StreamSpec(ARM.channels, dt)
        found = excused([changed(5, 80.0)] + [UNEVENTFUL] * 200, spec)
        second = round(KNOCKED_S / dt)
        assert found[:second] == [("knock", EXCUSED)] * second
        fading = np.array([by for _, by in found[second:]])
        assert [event for event, _ in found[second:]] == ["knock"] * FADING + [""] * (
            201 - second - FADING
        )
        left = EXCUSED * (1 - min(GAINS)) ** (2 * np.arange(1, len(fading) + 1))  # of evidence
        assert (np.diff(fading) <= 0).all()
        np.testing.assert_allclose(fading, np.maximum(left, 1.0))


def test_an_excused_surprise_is_divided():
    events = BenignEvents(ARM)
    _, judged = events.step(events.start(1), changed(5, 80.0)[None])
    kind, divisor = judged["excuse"], judged["divisor"]
    value, shares = np.array([60.0]), np.array([[20.0, 40.0]])
    left = Surprise(value / divisor, shares / divisor, raw=value, excuse=kind)
    assert left.value == pytest.approx(60.0 / EXCUSED)


def wild(count, knocks=False, seed=0, spec=ARM):
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        x = 0.02 * rng.normal(size=(80, spec.size)).cumsum(0) + UNEVENTFUL
        x[:, 2:5] -= 55.0
        x[:, 8:] = 0.002 * rng.normal(size=(80, 2))
        if knocks:
            x[40, 5:8] += 100.0
        found.append(Episode.from_stream(x, spec))
    return found


def test_knocks_set_no_threshold_of_faults_and_the_choice_is_saved(tmp_path):
    plain, told = (
        NeuralASM(ARM, hidden_size=8, association_size=8, epochs=1, excuses=e)
        for e in (False, True)
    )
    for memory in (plain, told):
        memory.fit(wild(20)).calibrate(wild(40, knocks=True, seed=1), false_alarms_per_hour=60.0)
    assert told.threshold < plain.threshold / 3
    knocked = told.score(wild(1, knocks=True, seed=2)[0])
    assert knocked.raw[40] > told.threshold
    assert knocked.excuse[40] == EVENTS.index("knock")
    assert (knocked.value <= told.threshold).all()
    told.save(tmp_path / "told.asm")
    loaded = NeuralASM.load(tmp_path / "told.asm")
    assert loaded.excuses
    assert loaded.spec.channels[0].stops == ARM.channels[0].stops
    np.testing.assert_array_equal(
        loaded.score(wild(1, knocks=True, seed=2)[0]).value, knocked.value
    )


class Eventful(FadingMonitor):
    """What it senses of ``cue`` surprises it by 2 (threshold 1), and is excused by what ``kind`` says."""

    kind = "knock"

    def observe(self, state, stream):
        surprised = np.isin(stream[:, 0], list(self.cue))
        raw = np.where(surprised, 2.0, 0.1)
        excuse = np.where(surprised, EVENTS.index(self.kind), 0).astype(np.int8)
        value = np.where(excuse > 0, raw / EXCUSED, raw)
        shares = np.zeros((len(stream), self.spec.size))
        shares[:, 0] = value
        return state._replace(steps=state.steps + 1), Surprise(
            value, shares, raw=raw, excuse=excuse
        )


def lived(env, steps=15):
    env.reset(seed=0)
    said = []
    for _ in range(steps):
        *_, ended, _, info = env.step(np.array([0.5, -0.5, 1.0], np.float32))
        said.append(
            (
                info["asm"]["event"],
                bool(info["asm_alarm"]),
                info["asm"]["state"],
                float(info["cost"]),
            )
        )
        if ended:
            break
    return said


def eventful(kind, cue=(5,)):
    monitor = Eventful(list(cue))
    monitor.kind = kind
    return monitor


def test_a_knock_is_braked_a_stop_only_counted_and_a_fault_acted_on():
    rows = lived(NeuralASMSafety(FakeEnv(), eventful("knock"), "hold", release_after=3))
    assert rows[4] == ("knock", True, "reflex", 1.0)
    assert [r[2] for r in rows[5:9]] == ["reflex", "reflex", "trial", "trial"]
    rows = lived(NeuralASMSafety(FakeEnv(), eventful("stop"), "hold"))
    assert rows[4] == ("stop", False, "policy", 0.0)
    rows = lived(NeuralASMSafety(FakeEnv(), eventful(""), "terminate"))
    assert rows[4][:2] == ("fault", True)
    assert len(rows) == 5
    rows = lived(NeuralASMSafety(FakeEnv(), eventful("knock"), "terminate"))
    assert len(rows) == 15


class Losing(FakeEnv):
    """Loses a number in the fifth row."""

    def _out(self, action):
        observation, info = super()._out(action)
        info["stream"][1] = np.nan if info["stream"][0] == 5 else info["stream"][1]
        return observation, info


@pytest.mark.parametrize("reaction", ["terminate", "hold", "graded"])
def test_a_knock_hides_no_number_that_is_missing(reaction):
    said = lived(NeuralASMSafety(Losing(), eventful("knock"), reaction, release_after=3))
    assert said[4][:2] == ("fault", True)
    assert "fault" in {event for event, *_ in said}
    if reaction == "terminate":
        assert len(said) == 5
    else:
        assert said[4][2] == "reflex"


def test_a_knock_that_presses_too_hard_is_held_by_the_limits_all_the_same():
    """The hand is driven down on the table under a memory that excuses whatever it feels."""

    class Deaf(FadingMonitor):
        def observe(self, state, stream):
            kind = np.full(len(stream), EVENTS.index("knock"), np.int8)
            nothing = np.zeros((len(stream), self.spec.size))
            return state, Surprise(
                np.zeros(len(stream)), nothing, raw=np.full(len(stream), 9.0), excuse=kind
            )

    lift = gym.make("asm_gym/Lift-v0")
    guarded = NeuralASMSafety(lift, Deaf([], spec=lift.unwrapped.stream_spec), "hold")
    guarded.reset(seed=0)
    down = np.array([0, 0, -1.0, 0, 0, 0, -1.0], np.float32)
    said = []
    for _ in range(60):
        *_, terminated, truncated, info = guarded.step(down)
        said.append(info["asm"])
        if terminated or truncated:
            break
    assert said[0]["event"] == "knock"
    assert all(s["intervened"] for s in said[1:])  # braked from the first on
    assert max(s["severity"]["speed"] for s in said) < 0.19
    lift.close()
