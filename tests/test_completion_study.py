"""Rivals of completion: a Kalman filter that is exact where the world is linear, and when the last value is better."""

import numpy as np

from asm_gym.scaling import StreamScaler
from asm_gym.scripts.reproduce.completion import _worse_from, by_kalman, by_last_value, by_memory, main
from asm_gym.spec import MOTOR, Channel, StreamSpec
from tests.test_completion import MEMORY, SENSES, SPEC, STREAMS, arm


def test_the_kalman_filter_follows_a_linear_world():
    spec = StreamSpec((Channel("place", 2), Channel("action", 1, group=MOTOR)), 0.05)
    rng = np.random.default_rng(0)

    def episode():
        x, rows = np.zeros(2), []
        for _ in range(150):
            u = rng.standard_normal()
            x = np.array([[0.9, 0.2], [-0.2, 0.9]]) @ x + np.array([0.0, 0.5]) * u
            rows.append([*x, u])
        return np.array(rows)

    streams = [episode() for _ in range(10)]
    complete, fresh = by_kalman(StreamScaler.fit(spec, streams), streams), episode()
    found = complete(fresh, np.array([True, False, False]), 50)
    np.testing.assert_allclose(found[50:, 0], fresh[50:, 0], atol=0.05)


def test_the_memory_is_nearer_than_the_last_value_on_a_bent_arm():
    missing, fresh = np.zeros(SPEC.size, bool), arm(120, 77).astype(float)
    missing[0] = True
    errors = [
        np.sqrt(np.mean((way(fresh, missing, 40)[40:, 0] - fresh[40:, 0]) ** 2))
        for way in (by_memory(MEMORY), by_kalman(SENSES, [s.astype(float) for s in STREAMS]), by_last_value)
    ]
    assert errors[0] < errors[1] < errors[2]


def test_when_the_last_value_is_better_for_good():
    two, one = np.full(4, 2.0), np.ones(4)
    assert _worse_from(two, one) == 0
    assert _worse_from(one, two) is None
    assert _worse_from(np.array([0.0, 0, 3, 0]), one) == 2
    assert _worse_from(np.array([3.0, 0, 0, 0]), 2 * one) is None


def test_a_run_without_recordings_is_refused(tmp_path, capsys):
    assert main(["--run", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "run asm-gym evaluate first" in capsys.readouterr().err.replace("\n", " ")
