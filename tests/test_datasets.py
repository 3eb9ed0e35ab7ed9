"""Recording into Minari datasets, going on after a kill, and reading what others recorded."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage

from asm_gym import collect
from asm_gym.data.minari_datasets import read_dataset, write_dataset
from asm_gym.files import UNFINISHED
from asm_gym.monitors import NeuralASM, make_monitor
from asm_gym.policies import make_policy, rollout
from asm_gym.scripts.cli import main
from asm_gym.wrappers import NeuralASMSafety, StreamRecorder
from tests.fakes import CueMonitor, FakeEnv
from tests.streams import sine_episodes

ONE = ("--workers", "1", "--episodes")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What two collected episodes of Lift left behind."""
    out = tmp_path_factory.mktemp("collect")
    assert main(["collect", "Lift", *ONE, "2", "--seed", "5", "--out", str(out)]) == 0
    return out


def assert_same(a, b):
    for name in ("stream", "actions", "observations", "rewards", "faults"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), name)
    assert (a.success, a.seed, a.spec, a.info) == (b.success, b.seed, b.spec, b.info)


def test_a_dataset_gives_back_what_was_collected(folder):
    read = read_dataset(folder, env_id="asm_gym/Lift-v0")
    recorded = collect("asm_gym/Lift-v0", episodes=2, seed=5, workers=1)
    for a, b in zip(read, recorded, strict=True):
        assert_same(a, b)
    assert read[0].observations.shape[0] == len(read[0]) + 1 == 101
    assert read[0].success


def test_minari_finds_and_reads_the_dataset_by_its_name(folder, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    dataset = minari.load_dataset("asm_gym/lift-scripted-v0")
    assert dataset.total_episodes == 2
    assert dataset.env_spec.id == "asm_gym/Lift-v0"
    episode = dataset[0]
    assert episode.observations.shape == (101, 37)
    assert episode.truncations.tolist() == [False] * 99 + [True]
    assert not episode.terminations.any()
    assert dataset.storage.metadata["versions"]["robosuite"] == "1.5.2"


def test_collecting_touches_nothing_outside_its_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("MINARI_DATASETS_PATH", raising=False)
    before = dict(os.environ)
    episodes = sine_episodes(2)
    monkeypatch.chdir(tmp_path)
    write_dataset(Path("out"), "asm_gym/sines-v0", _observed(episodes), _Sines(), {})
    assert len(read_dataset("out")) == 2
    assert dict(os.environ) == before
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_killed_run_loses_only_what_was_running(tmp_path):
    command = [
        sys.executable,
        "-m",
        "asm_gym",
        "collect",
        "Lift",
        *ONE,
        "400",
        "--out",
        str(tmp_path),
    ]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while len(list((tmp_path / "episodes").glob("[0-9]*.npz"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    kept = sorted((tmp_path / "episodes").glob("[0-9]*.npz"))
    assert len(kept) >= 2
    stamps = {p.name: p.stat().st_mtime_ns for p in kept}
    more = len(kept) + 1
    assert main(["collect", "Lift", *ONE, str(more), "--out", str(tmp_path)]) == 0
    assert len(read_dataset(tmp_path)) == more
    assert all(
        (tmp_path / "episodes" / name).stat().st_mtime_ns == stamp for name, stamp in stamps.items()
    )
    assert not [p.name for p in tmp_path.rglob("*") if p.name.endswith(UNFINISHED)]


class _Sines(gym.Env):
    """As far as a dataset asks."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (12,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)


def _observed(episodes):
    """Episodes that have observations and actions too."""
    return [
        replace(
            e,
            observations=np.concatenate([e.stream[:1, :12], e.stream[:, :12]]),
            actions=e.stream[:, 12:],
            rewards=np.ones(len(e), np.float32),
            faults=np.zeros(len(e), bool),
        )
        for e in episodes
    ]


def foreign(path, env_id="Pusher-v5", episodes=3, infos=None, actions=7, changed=None):
    """A dataset that somebody else recorded, with Minari alone."""
    observations = gym.spaces.Box(-np.inf, np.inf, (23,), np.float64)
    path.mkdir(parents=True)
    spaces = {
        "observation_space": observations,
        "action_space": gym.spaces.Box(-2, 2, (actions,), np.float32),
    }
    storage = MinariStorage.new(path, **spaces, env_spec=gym.spec(env_id))
    rng = np.random.default_rng(0)
    columns = [
        {
            "seed": n,
            "observations": rng.normal(size=(11 + n, 23)),
            "actions": rng.normal(size=(10 + n, actions)).astype(np.float32),
            "rewards": rng.normal(size=10 + n),
            "terminations": np.zeros(10 + n, bool),
            "truncations": np.arange(10 + n) == 9 + n,
            "infos": infos,
        }
        for n in range(episodes)
    ]
    buffers = [EpisodeBuffer(**(c | (changed or {}))) for c in columns]
    storage.update_episodes(buffers)
    storage.update_metadata(
        {"dataset_id": "somebody/thing-v0", "minari_version": minari.__version__}
    )
    return buffers


def pendulum_monitor():
    """A monitor of the pendulum that alarms at nearly everything."""
    recorder = StreamRecorder(gym.make("Pendulum-v1", max_episode_steps=40))
    for seed in range(16):
        recorder.reset(seed=seed)
        for _ in range(40):
            recorder.step(recorder.action_space.sample())
    monitor = make_monitor("kalman", recorder.stream_spec).fit(recorder.episodes[:8])
    return monitor.calibrate(recorder.episodes[8:], 0.2).with_threshold(1e-3)


def test_minari_keeps_what_a_guard_reports(tmp_path):
    env = NeuralASMSafety(FakeEnv(), CueMonitor([3]), on_alarm="monitor")
    infos = [env.reset(seed=0)[1]]
    infos += [env.step(np.zeros(3, np.float32))[4] for _ in range(10)]
    columns = {name: [info[name] for info in infos] for name in infos[0]}
    foreign(tmp_path / "data", episodes=1, infos=columns)
    with h5py.File(tmp_path / "data" / "main_data.hdf5") as file:
        kept = file["episode_0/infos"]
        assert kept.keys() == infos[0].keys()
        np.testing.assert_array_equal(kept["asm_alarm"], [info["asm_alarm"] for info in infos])
        alarms = [json.loads(text)["alarm"] for text in kept["asm"]]
    assert alarms == [info["asm"]["alarm"] for info in infos]
    assert sum(alarms) == 1


def test_minaris_own_collector_records_a_guarded_environment(tmp_path, monkeypatch):
    pytest.importorskip("jax", reason="pip install 'minari[create]'")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    guarded = NeuralASMSafety(gym.make("Pendulum-v1"), pendulum_monitor(), on_alarm="monitor")
    collector = minari.DataCollector(guarded, record_infos=True)
    alarms = []
    collector.reset(seed=0)
    for _ in range(200):
        *_, truncated, info = collector.step(collector.action_space.sample())
        alarms.append(info["asm_alarm"])
    assert truncated
    dataset = collector.create_dataset("guarded/pendulum-v0", algorithm_name="sway")
    collector.close()
    episode = next(iter(dataset.iterate_episodes()))
    np.testing.assert_array_equal(episode.infos["asm_alarm"][1:], alarms)
    assert dataset.total_episodes == 1
    assert any(alarms)


def test_a_dataset_of_somebody_elses_environment_is_read_as_observation_and_action(tmp_path):
    buffers = foreign(tmp_path / "theirs")
    episodes = read_dataset(tmp_path / "theirs")
    env = StreamRecorder(gym.make("Pusher-v5"))
    for n, (episode, buffer) in enumerate(zip(episodes, buffers, strict=True)):
        expected = np.concatenate([buffer.observations[1:], buffer.actions], axis=1).astype(
            np.float32
        )
        np.testing.assert_array_equal(episode.stream, expected)
        assert episode.seed == n
        assert not episode.success
    # A memory that is fitted on it watches the environment itself.
    NeuralASM(episodes[0].spec, hidden_size=8, association_size=8, epochs=1).fit(episodes)
    episodes[0].spec.require(env.stream_spec, "the dataset")


def test_streams_that_run_faster_than_control_are_kept_whole(tmp_path):
    env = StreamRecorder(gym.make("asm_gym/Lift-v0", stream_freq=100, horizon=4))
    rollout(env, make_policy("sway", env, seed=0), 0)
    episode = env.finish()
    assert (len(episode.stream), len(episode.actions)) == (20, 4)
    write_dataset(tmp_path, "asm_gym/lift-v0", [episode], env, {})
    assert_same(read_dataset(tmp_path)[0], episode)
    with pytest.raises(
        ValueError, match="episode 0 needs an action, a reward and a flat observation"
    ):
        write_dataset(
            tmp_path, "asm_gym/lift-v0", [replace(episode, observations=np.zeros((0, 0)))], env, {}
        )
    env.close()


def test_what_cannot_be_read_is_refused_by_name(tmp_path, folder):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_dataset(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"asm_gym/Lift-v0, not in .asm_gym/Door-v0"):
        read_dataset(folder, env_id="asm_gym/Door-v0")
    foreign(tmp_path / "ours" / "data", env_id="asm_gym/Door-v0")
    with pytest.raises(ValueError, match="holds no streams"):
        read_dataset(tmp_path / "ours")
    foreign(tmp_path / "ours2" / "more" / "data")
    with pytest.raises(ValueError, match="several datasets"):
        read_dataset(tmp_path)
    broken = tmp_path / "ours2" / "more" / "data"
    whole = (broken / "main_data.hdf5").read_bytes()
    (broken / "main_data.hdf5").write_bytes(whole[: len(whole) // 3])
    with pytest.raises(ValueError, match="damaged"):
        read_dataset(broken)
    (broken / "metadata.json").write_text("{")
    with pytest.raises(ValueError, match="damaged"):
        read_dataset(broken)


def test_no_name_leads_out_of_the_root_and_nothing_of_others_is_removed(tmp_path):
    root, others = tmp_path / "root", tmp_path / "precious.txt"
    root.mkdir()
    others.write_text("kept")
    (root / "mine.txt").write_text("kept")
    (tmp_path / "elsewhere").mkdir()
    (root / "link").symlink_to(tmp_path / "elsewhere")
    episodes = _observed(sine_episodes(2))
    for name in (
        "..",
        "",
        ".",
        "/etc",
        "a/../..",
        "a//b",
        "~",
        "../root",
        "a/",
        None,
        3,
        "link",
        "link/a-v0",
    ):
        with pytest.raises(ValueError, match=r"dataset_id must be|is a link"):
            write_dataset(root, name, episodes, _Sines(), {})
    (root / "mine" / "data").mkdir(parents=True)
    (root / "mine" / "data" / "notes.txt").write_text("kept")
    with pytest.raises(ValueError, match=r"did not write .*notes\.txt"):
        write_dataset(root, "mine", episodes, _Sines(), {})
    with pytest.raises(ValueError, match=r"did not write .*mine\.txt"):
        write_dataset(root, "mine.txt", episodes, _Sines(), {})
    assert {
        f.read_text() for f in (others, root / "mine.txt", root / "mine" / "data" / "notes.txt")
    } == {"kept"}
    write_dataset(root, "ours", episodes, _Sines(), {})
    write_dataset(root, "ours", episodes[:1], _Sines(), {})
    assert len(read_dataset(root / "ours")) == 1
    assert sorted(p.name for p in root.iterdir()) == ["link", "mine", "mine.txt", "ours"]


def test_a_full_disk_is_a_line_that_names_the_file_and_nothing_is_lost(tmp_path, monkeypatch):
    write_dataset(tmp_path, "ours", _observed(sine_episodes(1)), _Sines(), {})
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=1000))
    with pytest.raises(OSError, match=r"No space left on device: '.*main_data\.hdf5'"):
        write_dataset(tmp_path, "ours", _observed(sine_episodes(2)), _Sines(), {})
    assert len(read_dataset(tmp_path)) == 1


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"rewards": np.array([0.0] * 9 + [np.nan])},
            "the reward of step 9 must be finite, got nan",
        ),
        ({"actions": np.zeros((20, 7), np.float32)}, "10 rewards need 10 actions, got 20"),
        ({"observations": np.zeros((10, 23))}, "10 rewards need 11 observations, got 10"),
    ],
)
def test_rewards_that_are_no_numbers_and_arrays_of_other_lengths_are_refused(
    changed, message, tmp_path
):
    foreign(tmp_path / "theirs", episodes=1, changed=changed)
    with pytest.raises(ValueError, match=message):
        read_dataset(tmp_path / "theirs")


def test_what_a_file_declares_must_be_in_it(tmp_path):
    foreign(tmp_path / "theirs", episodes=1)
    file = tmp_path / "theirs" / "main_data.hdf5"
    whole = file.read_bytes()

    def declare(**more):
        file.write_bytes(whole)
        with h5py.File(file, "a") as opened:
            del opened["episode_0/observations"]
            opened["episode_0"].create_dataset("observations", **more)

    declare(shape=(11, 23), dtype="f8")
    with pytest.raises(
        ValueError, match="observations declares 2024 bytes that were never written"
    ):
        read_dataset(tmp_path / "theirs")
    file.write_bytes(whole)
    with h5py.File(file, "a") as opened:
        del opened["episode_0/observations"]
        opened["episode_0/observations"] = h5py.ExternalLink("/etc/passwd", "/")
    with pytest.raises(ValueError, match="links are not followed"):
        read_dataset(tmp_path / "theirs")
