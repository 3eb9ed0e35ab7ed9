"""What a watch and a guard show in Rerun: written to a recording, opened again, and compared with what was judged."""

from __future__ import annotations

import io
import json
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.data.episode import Episode
from asm_gym.monitors import NeuralASM, make_monitor
from asm_gym.rollouts.run_trials import collect
from asm_gym.scripts.cli import main
from asm_gym.wrappers import NeuralASMSafety
from asm_gym.wrappers.live_view import LiveView, RerunView
from tests.needs import needs
from tests.test_acknowledgement import SHIFT, SHIFTED, SPEC, lines, motion, shifted
from tests.test_core import NOTHING_ELSE
from tests.wheel import ROOT


@pytest.fixture(scope="module")
def asm() -> NeuralASM:
    episodes = [Episode.from_stream(motion(seed), SPEC) for seed in range(60)]
    made = NeuralASM(SPEC, hidden_size=16, association_size=16, epochs=4).fit(episodes[:20])
    made.calibrate(episodes[20:], false_alarm_rate=0.05)
    return made.with_threshold(4 * made.threshold)


def column(path, entity, kind="Scalars:scalars"):
    """(T, n) what a recording holds of an entity, row by row."""
    chunk = needs("rerun.chunk")
    chunks = chunk.RrdReader(path).stream().to_chunks()
    of_entity = (c.to_record_batch() for c in chunks if c.entity_path == f"/{entity}")
    return [
        row for batch in of_entity if kind in batch.schema.names for row in batch[kind].to_pylist()
    ]


def test_a_watch_shows_surprise_channels_state_and_alarms(asm, tmp_path, monkeypatch, capsys):
    needs("rerun")
    asm.save(tmp_path / "x.asm")
    stream = shifted(400)
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(lines(stream))))
    path = tmp_path / "made" / "watch.rrd"
    command = ["watch", "-", "--monitor", str(tmp_path / "x.asm"), "--out", str(tmp_path)]
    assert main([*command, "--rerun", str(path)]) == 1
    surprise = np.ravel(column(path, "surprise"))
    assert len(surprise) == len(stream)
    assert surprise[: SHIFTED - 1].max() < 1 < surprise[SHIFTED:].max()
    np.testing.assert_allclose(column(path, "sensed/q"), stream[:, :2], rtol=1e-6)
    sensed = np.ravel(column(path, "sensed/sum"))
    assert np.ravel(column(path, "sensed/cmd")).shape == (len(stream),)
    expected = np.ravel(column(path, "expected/sum"))
    assert np.nanmin(np.abs(expected - (sensed[-1] - SHIFT))) < 0.15
    states = [row[0] for row in column(path, "state", "StateChange:state")]
    assert states[:2] == ["policy", "alarm"]
    (said,) = column(path, "alarms", "TextLog:text")
    assert said[0] in capsys.readouterr().out
    (worst,) = column(path, "worst", "TextDocument:text")[SHIFTED + 1]
    assert worst.splitlines()[2].startswith("| sum | ")


class Rendered(gym.Wrapper):
    """An environment that draws one picture."""

    render_mode = "rgb_array"

    def render(self):
        return np.zeros((24, 32, 3), np.uint8)


def test_a_guarded_environment_shows_its_rows_alarms_and_frames(tmp_path):
    needs("rerun")
    episodes = collect("asm_gym/SyntheticArm-v0", policy="sway", episodes=24, seed=0)
    monitor = make_monitor("kalman", episodes[0].spec).fit(episodes[:12])
    monitor.calibrate(episodes[12:], 0.2)
    path = tmp_path / "guard.rrd"
    guarded = NeuralASMSafety(
        Rendered(gym.make("asm_gym/SyntheticArm-v0")), monitor.with_threshold(1e-6), "hold"
    )
    env = RerunView(guarded, str(path))
    env.reset(seed=0)
    rows = []
    strengths = []
    for _ in range(20):
        info = env.step(env.action_space.sample())[-1]
        rows.append(guarded.newest_row.copy())
        strengths.append(info["asm"]["surprise"] / info["asm"]["threshold"])
    env.close()
    first = episodes[0].spec.channels[0].name
    part = episodes[0].spec.slices[first]
    np.testing.assert_allclose(column(path, f"sensed/{first}"), np.array(rows)[:, part], rtol=1e-6)
    np.testing.assert_allclose(np.ravel(column(path, "surprise")), np.minimum(strengths, 1000))
    assert column(path, "state", "StateChange:state")[-1][0] == info["asm"]["state"] == "reflex"
    assert "thresholds" in column(path, "alarms", "TextLog:text")[0][0]
    assert column(path, "camera", "EncodedImage:blob")


def test_a_viewer_that_fails_ends_the_view_and_not_the_watch(asm, tmp_path, capsys):
    needs("rerun")
    view = LiveView(asm, str(tmp_path / "x.rrd"))
    numbers = np.zeros(SPEC.size)
    view.show_row(0.0, numbers, np.arange(99.0), 0.5, "policy")  # too many shares
    view.show_row(0.1, numbers, numbers, 0.5, "policy")
    view.show_text(0.1, "an alarm")
    view.close()
    assert "the live view ends" in capsys.readouterr().err


@pytest.mark.parametrize("show", ["show_text", "show_frame"])
def test_an_alarm_or_a_frame_that_cannot_be_shown_ends_the_view_alone(asm, tmp_path, capsys, show):
    needs("rerun")
    view = LiveView(asm, str(tmp_path / "x.rrd"))
    broken = {"show_text": (None, object()), "show_frame": (object(),)}
    getattr(view, show)(*broken[show])
    view.show_row(0.1, np.zeros(SPEC.size), np.zeros(SPEC.size), 0.5, "policy")
    view.close()
    assert capsys.readouterr().err.count("the live view ends") == 1


@pytest.mark.parametrize(
    ("where", "message"), [("viewer", "FILE.rrd"), ("x.rrd", "rerun: pip install 'asm-gym[rerun]'")]
)
def test_where_a_view_goes_is_checked_and_the_extra_that_it_lacks_is_named(
    where,
    message,
    asm,
    tmp_path,
):
    asm.save(tmp_path / "x.asm")
    code = NOTHING_ELSE.replace("ABSENT", "{'rerun'}")
    code += "from asm_gym.scripts.cli import main; sys.exit(main())"
    command = [
        "watch",
        "-",
        "--monitor",
        str(tmp_path / "x.asm"),
        "--out",
        str(tmp_path),
        "--rerun",
        where,
    ]
    done = subprocess.run(
        [sys.executable, "-c", code, *command],
        input=json.dumps([0.0] * SPEC.size),
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
    )
    assert done.returncode == 2
    assert message in done.stderr
