"""A report that is put together when it is read: a dict in every way, right whenever that is."""

import copy
import json
import operator
import pickle

import numpy as np
import pytest

from asm_gym.wrappers.lazily import Lazily

WHOLE = {"a": 1, "b": [2], "c": {"d": 3.0}, "e": 5}
READS = {
    "in": lambda d: "b" in d and "z" not in d,
    "len": lambda d: len(d) == len(WHOLE),
    "dict": lambda d: dict(d) == WHOLE,
    "star": lambda d: {**d} == WHOLE,
    "list": lambda d: list(d) == list(WHOLE),
    "reversed": lambda d: list(reversed(d)) == list(reversed(WHOLE)),
    "keys": lambda d: list(d.keys()) == list(WHOLE),
    "values": lambda d: list(d.values()) == list(WHOLE.values()),
    "items": lambda d: list(d.items()) == list(WHOLE.items()),
    "get": lambda d: d.get("b") == [2] and d.get("z", 7) == 7,
    "or": lambda d: d | {"z": 1} == {**WHOLE, "z": 1},
    "ror": lambda d: {"z": 1} | d == {**WHOLE, "z": 1},
    "equal": lambda d: operator.eq(WHOLE, d) and operator.eq(d, WHOLE) and not operator.ne(d, WHOLE),
    "repr": lambda d: repr(d) == repr(WHOLE),
    "json": lambda d: json.loads(json.dumps(d)) == WHOLE,
    "pickle": lambda d: pickle.loads(pickle.dumps(d)) == WHOLE,
    "copy": lambda d: d.copy() == WHOLE and copy.copy(d) == WHOLE and copy.deepcopy(d) == WHOLE,
    "pop": lambda d: d.pop("b") == [2] and "b" not in d,
    "setdefault": lambda d: d.setdefault("b", 0) == [2],
}


def made(calls):
    def later():
        calls.append(1)
        return dict(WHOLE, e=4)

    return Lazily({"a": 1}, later)


@pytest.mark.parametrize("read", READS.values(), ids=READS)
def test_it_reads_as_the_dict_that_it_will_be(read):
    calls = []
    report = made(calls)
    report.update(e=5)
    assert report["a"] == 1
    assert not calls  # what is known costs nothing
    assert read(report)
    assert len(calls) == 1


def test_what_is_not_there_is_a_key_error_and_what_was_written_stays():
    report = made([])
    report["b"] = "mine"
    with pytest.raises(KeyError, match="z"):
        report["z"]
    assert report["b"] == "mine"
    del report["c"]
    assert dict(report) == {"a": 1, "b": "mine", "e": 4}


def test_reports_of_steps_are_right_when_they_are_read_later():
    gym = pytest.importorskip("gymnasium")
    from asm_gym import NeuralASM, NeuralASMSafety
    from asm_gym.episode import Episode
    from asm_gym.spec import StreamSpec

    env = gym.make("Pendulum-v1")
    spec = StreamSpec.from_spaces(env.observation_space, env.action_space, 0.05)
    rng = np.random.default_rng(0)
    episodes = [Episode.from_stream(rng.normal(size=(60, spec.size)).cumsum(0), spec) for _ in range(12)]
    memory = NeuralASM(spec, hidden_size=8, association_size=8, epochs=1).fit(episodes[:6]).calibrate(episodes[6:], 0.5)

    def run(info, read):
        guarded = NeuralASMSafety(gym.make("Pendulum-v1"), memory, "monitor", on_overrun="ignore", info=info)
        guarded.reset(seed=0)
        infos = []
        for _ in range(20):
            infos.append(guarded.step(np.ones(1, np.float32))[-1])
            if read:
                dict(infos[-1]["asm"])
        return infos

    soon, late, flat = run("full", True), run("full", False), run("flat", False)
    for a, b, c in zip(soon, late, flat, strict=True):
        one, other = dict(a["asm"]), dict(b["asm"])
        assert one.pop("latency_us") > 0
        assert other.pop("latency_us") > 0
        np.testing.assert_equal(one, other)
        assert "asm" not in c
        names = "asm_surprise", "asm_alarm", "asm_intervened", "cost", "cost_sum"
        assert [a[n] for n in names] == [c[n] for n in names]
    assert len({i["asm_surprise"] for i in late}) > 10  # each has its own
    with pytest.raises(ValueError, match="info"):
        run("none", False)
