"""One policy's memory on another policy's episodes."""

import json

import numpy as np
import pytest

from asm_gym.episode import Episode, EpisodeLabel, save_episode
from asm_gym.scripts.cli import main
from asm_gym.spec import Channel, StreamSpec

SPEC = StreamSpec((Channel("external_torque_peak", 2, "N m", noise=0.1),), dt=0.05)
COUNTS = {"fit": 10, "calibration": 40, "nominal": 20}
ONSET = 30


def evaluation(folder, spread, seed):
    """What an evaluation leaves of a policy under which torques vary by ``spread``; the fault adds 100."""
    rng = np.random.default_rng(seed)
    seeds = iter(range(1000))

    def put(label, stream):
        quiet = {"faults": np.zeros(len(stream), bool), "contact_force": np.zeros(len(stream), np.float32)}
        episode = Episode.from_stream(stream, SPEC, success=True, label=label, **quiet)
        save_episode(folder / label.path, episode)

    for role, n in COUNTS.items():
        for seed in (next(seeds) for _ in range(n)):
            stream = rng.uniform(-spread, spread, (60, 2))
            put(EpisodeLabel("Lift", role, seed=seed), stream)
            if role == "nominal":
                struck = stream.copy()
                struck[ONSET:] += 100.0
                put(EpisodeLabel("Lift", "faulty", "push", "strong", seed, ONSET), struck)
    return str(folder)


def test_a_livelier_policy_alarms_until_the_memory_is_calibrated_on_it(tmp_path):
    calm, lively = evaluation(tmp_path / "calm", 1.0, 0), evaluation(tmp_path / "lively", 3.0, 1)
    how = ["--monitor", "external_torque_limit", "--out", str(tmp_path / "out")]
    assert main(["adopt", calm, lively, *how]) == 0
    rows = json.loads((tmp_path / "out" / "adopt.json").read_text())["rows"]
    assert [row[1] for row in rows] == ["1.000"] * 4
    assert all(row[2].startswith("100 %") for row in (rows[0], *rows[2:]))
    alarms = [int(row[3].split(" of ")[0]) for row in rows]
    assert alarms[1] == COUNTS["nominal"]
    assert max(alarms[0], *alarms[2:]) <= 4  # of 20, at a rate of 5 %
    assert "| re-calibrated on the watched | 1.000 |" in (tmp_path / "out" / "adopt.md").read_text()


@pytest.mark.parametrize(
    ("monitor", "message"), [("oracle", "unknown monitor 'oracle'"), ("force_limit", "holds no recordings")]
)
def test_what_cannot_be_compared_is_refused(monitor, message, tmp_path, capsys):
    assert main(["adopt", str(tmp_path), str(tmp_path), "--monitor", monitor, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
