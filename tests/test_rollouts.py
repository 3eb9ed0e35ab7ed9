"""Episodes of any policy in any environment, folders of runs, and progress: the same episodes whoever records them."""

import io
import subprocess
import sys
import threading
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console
from stable_baselines3 import SAC

from asm_gym import collect
from asm_gym.data.episode import Episode, EpisodeLabel
from asm_gym.evaluation.scoring import HEALTHY_ROLES, Recordings
from asm_gym.rollouts import progress
from asm_gym.rollouts.run_folder import claimed, make_missing
from asm_gym.rollouts.run_trials import environment
from asm_gym.scripts.cli import main
from tests.fakes import FakeEnv
from tests.streams import sine_episodes

PENDULUM = "Pendulum-v1"


class Damp:
    """Torque against the velocity; keeps nothing. The class is a factory, too."""

    def __init__(self, env=None):
        pass

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.array([-2.0 * observation[2]], np.float32).clip(-2, 2), state


def streams(**how):
    return [e.stream for e in collect(PENDULUM, episodes=3, seed=4, **how)]


def test_an_object_and_a_factory_give_the_same_episodes_with_any_number_of_workers():
    expected = streams(policy=Damp(), workers=1)
    # where info has no stream, observation and action are it
    assert expected[0].shape == (
        200,
        3 + 1,
    )
    for policy in (Damp(), Damp, lambda env: Damp()):
        for workers in (1, 2):
            for a, b in zip(expected, streams(policy=policy, workers=workers), strict=True):
                np.testing.assert_array_equal(a, b)


def test_an_agent_that_draws_is_seeded_anew_for_every_episode():
    agent = SAC("MlpPolicy", PENDULUM, seed=0, buffer_size=10)
    agent.env = None
    one, two = streams(policy=agent, workers=1), streams(policy=agent, workers=2)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one[0], one[1])


def test_a_policy_that_cannot_be_sent_or_that_does_not_exist_is_refused():
    policy = Damp()
    policy.lock = threading.Lock()
    with pytest.raises(TypeError, match=r"cannot be sent.*factory"):
        streams(policy=policy, workers=2)
    with pytest.raises(ValueError, match="no scripted expert"):
        streams(workers=1)


def test_an_environment_that_only_this_process_registered_is_known_to_the_workers():
    gym.register("tests/Fake-v0", entry_point=lambda **kwargs: FakeEnv(length=4, own_stream=False))
    try:
        episodes = collect("tests/Fake-v0", policy="hold", episodes=2, workers=2)
    finally:
        del gym.registry["tests/Fake-v0"]
    assert [len(e) for e in episodes] == [4, 4]


def test_arguments_of_the_environment_may_be_lists_dictionaries_and_arrays():
    made, sizes, lengths = [], {"length": [3]}, []

    def make(sizes, **kwargs):
        made.append(FakeEnv(length=sizes["length"][0]))
        return made[-1]

    gym.register("tests/Any-v0", entry_point=make)
    try:
        for sizes["length"][0] in (3, 3, 5):  # the caller's own list changes
            episodes = collect("tests/Any-v0", policy="hold", episodes=2, workers=1, sizes=sizes)
            lengths.append([len(e) for e in episodes])
        before = len(made)
        for scale in (np.ones(2), np.ones(2)):
            environment("tests/Any-v0", (("sizes", sizes), ("scale", scale)))
    finally:
        del gym.registry["tests/Any-v0"]
    assert lengths == [[3, 3], [3, 3], [5, 5]]
    assert (before, len(made)) == (2, 3)  # one environment for equal arguments


# ------------------------------------------------------------------ folders of runs

HOLD = """
import sys, time
from pathlib import Path
from asm_gym.rollouts.run_folder import claimed

with claimed(Path(sys.argv[1]), "run.json", {}):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that works in the folder."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()


def test_a_second_command_is_refused_until_the_first_ends_even_if_it_is_killed(
    holder, tmp_path, capsys
):
    with pytest.raises(BlockingIOError, match="in use"), claimed(tmp_path, "run.json", {}):
        pass
    assert main(["collect", PENDULUM, "--policy", "sway", "--out", str(tmp_path)]) == 2
    assert "in use" in capsys.readouterr().err
    holder.kill()
    holder.wait()
    with pytest.raises(ZeroDivisionError), claimed(tmp_path, "run.json", {}):
        raise ZeroDivisionError
    with claimed(tmp_path, "run.json", {}):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["run.json"]


def test_a_run_continues_with_its_settings_and_is_refused_with_others(tmp_path):
    for _ in range(2):
        with claimed(tmp_path, "run.json", {"seed": 1, "task": "Lift"}):
            pass
    with (
        pytest.raises(ValueError, match="seed: 1 there, 2 here"),
        claimed(tmp_path, "run.json", {"seed": 2}),
    ):
        pass


def test_only_what_is_missing_is_made(tmp_path):
    def make(n):
        (tmp_path / str(n)).write_text("new")
        return tmp_path / str(n)

    (tmp_path / "1").write_text("old")
    seen = []
    made = make_missing(
        make,
        [0, 1, 2],
        lambda n: tmp_path / str(n),
        1,
        lambda done, total: seen.append((done, total)),
    )
    assert [p.read_text() for p in made] == ["new", "old", "new"]
    assert seen == [(1, 3), (2, 3), (3, 3)]


def recording(role: str, seed: int, force: float, success: bool = True) -> Episode:
    made = sine_episodes(1)[0]
    kind = {"kind": "push", "severity": "mild", "onset": 5} if role == "faulty" else {}
    forces = np.full(len(made), force, np.float32)
    return replace(
        made,
        success=success,
        label=EpisodeLabel("Lift", role, seed=seed, **kind),
        contact_force=forces,
    )


def test_episodes_that_fail_or_crash_by_themselves_are_not_normal():
    nominal = [
        recording(role, seed, 10.0)
        for seed, role in enumerate(["fit", "fit", "calibration", "nominal"])
    ]
    crash, failure = recording("nominal", 7, 21.0), recording("fit", 8, 90.0, success=False)
    faulty = [recording("faulty", seed, 300.0) for seed in (3, 7)]
    found = Recordings.of([*nominal, crash, failure, *faulty])
    assert found.left_out == (1, 1)
    assert [e.labelled.seed for e in found.roles["faulty"]] == [3]
    assert [e.labelled.seed for role in HEALTHY_ROLES for e in found.roles[role]] == [0, 1, 2, 3]
    assert [e.labelled.seed for e in found.twins] == [3, 7]
    unfelt = [
        replace(recording(role, 0, 1.0), contact_force=np.zeros(0, np.float32))
        for role in HEALTHY_ROLES
    ]
    assert Recordings.of(unfelt).left_out == (0, 0)


# ------------------------------------------------------------------ progress


def test_progress_goes_to_standard_error_so_that_results_can_be_piped(capsys):
    with progress.stage("recording") as tell:
        tell(12, 12)
    shown = capsys.readouterr()
    assert not shown.out
    assert "recording: 12 of 12, done in" in shown.err


def test_in_a_pipe_progress_is_a_line_now_and_then_and_in_a_terminal_a_bar(monkeypatch):
    monkeypatch.setattr(progress, "EVERY_S", 0.0)
    out, seconds = io.StringIO(), {}
    with progress.stage("recording [all]", seconds, Console(file=out)) as tell:
        tell(3, 12)
        tell(12, 12)
    assert out.getvalue().splitlines() == [
        "recording [all]: 3 of 12, 0 s",
        "recording [all]: 12 of 12, 0 s",
        "recording [all]: 12 of 12, done in 0 s",
    ]
    assert set(seconds) == {"recording [all]"}
    out = io.StringIO()
    with progress.stage(
        "recording", console=Console(file=out, force_terminal=True, width=80)
    ) as tell:
        tell(3, 12)
    assert "12/12" in out.getvalue()
