"""Collecting and the demo, end to end on the real simulator with few episodes."""

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from asm_gym import collect
from asm_gym.faults import FrozenEncoder, Push
from asm_gym.rollouts.run_trials import watch
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.scripts import command, demo
from asm_gym.scripts.cli import main
from asm_gym.version import __version__

LIFT = "asm_gym/Lift-v0"
TINY = {
    "fit_episodes": 6,
    "calibration_episodes": 19,
    "nominal_episodes": 2,
    "faulty_episodes": 1,
    "epochs": 3,
}


def tiny(out: Path) -> None:
    """Little of the demo."""
    demo.demonstrate(demo.Args(**TINY, workers=2, out=out), Console())


CONDITIONS = "nominal", "frozen encoder", "push", "weak joint", "collision"


def test_collected_episodes_do_not_depend_on_the_number_of_workers():
    one, two = (collect(LIFT, episodes=2, seed=5, workers=n, horizon=15) for n in (1, 2))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.stream, b.stream)
        np.testing.assert_array_equal(a.observations, b.observations)
    assert one[0].stream.shape == (15, one[0].spec.size)
    assert one[0].observations.shape[0] == 16
    assert one[0].actions.shape == (15, 7)
    assert one[0].seed == episode_seeds(5, 2)[0]
    assert not set(episode_seeds(0, 200)) & set(episode_seeds(0, 200, stage=1))
    with pytest.raises(ValueError, match=r"episodes.*0"):
        collect(LIFT, episodes=0)
    assert not np.array_equal(one[0].stream, one[1].stream)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What a tiny demo writes."""
    out = tmp_path_factory.mktemp("demo")
    tiny(out)
    return out


def test_the_demo_writes_everything_it_promises(folder):
    written = {p.name for p in folder.iterdir()}
    assert written == {"report.html", "lift.asm"}
    report = (folder / "report.html").read_text()
    assert f"asm-gym {__version__}" in report
    assert all(f"<th>{condition}</th>" in report for condition in CONDITIONS)
    assert "<dt>robosuite</dt><dd>1.5.2</dd>" in report


def test_a_hard_push_raises_an_alarm_even_in_a_memory_that_has_learned_little(folder):
    push = Push(newtons=100.0, onset=10, duration=10)
    trace = watch(
        Trial(LIFT, 4, "push", faults=(push,), acting="terminate"),
        RolloutConfig(),
        folder / "lift.asm",
    )
    assert trace.detected_after is not None
    assert trace.detected_after <= 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--workers", "0"], "workers"),
        (["asm_gym/Juggle-v0"], "Juggle"),
        (["Lfit"], "did you mean 'Lift'?"),
    ],
)
def test_a_bad_argument_is_refused_before_anything_is_written(arguments, message, tmp_path, capsys):
    assert main(["demo", *arguments, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_quick_keeps_the_calibration_that_the_rate_needs():
    args = command.parse("demo", demo.Args, ["--quick"])
    assert args.calibration_episodes == 20
    assert args.faulty_episodes < demo.Args().faulty_episodes
    with pytest.raises(ValueError, match="calibration_episodes must be at least 19, got 18"):
        demo.Args(calibration_episodes=18)


def test_a_fault_of_one_trial_does_not_reach_into_the_next(folder):
    def trace(condition, faults):
        return watch(Trial(LIFT, 9, condition, faults=faults), RolloutConfig(), folder / "lift.asm")

    before = trace("nominal", ())
    faulty = trace("frozen", (FrozenEncoder(onset=10),))
    after = trace("nominal", ())
    assert not np.array_equal(before.surprise, faulty.surprise)
    np.testing.assert_array_equal(before.surprise, after.surprise)
