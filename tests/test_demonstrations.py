"""Robosuite's and robomimic's demonstrations: sensed from their states, imported as a dataset, refused by name."""

import json

import gymnasium as gym
import h5py
import numpy as np
import pytest

from asm_gym.data.datasets import read_dataset
from asm_gym.envs.demonstrations import recorded_in, replay
from asm_gym.policies import make_policy, rollout
from asm_gym.scripts.cli import main
from asm_gym.wrappers import StreamRecorder


@pytest.fixture(scope="module")
def demonstrated(tmp_path_factory):
    """Two short episodes of Lift, as an HDF5 file of each format, and what was sensed while they were recorded."""
    env = gym.make("asm_gym/Lift-v0", sensor_noise=0.0, horizon=12)
    inner = env.unwrapped
    folder, demos, episodes = tmp_path_factory.mktemp("demos"), [], []
    for seed in (3, 4):
        states = []

        class Keeping(gym.Wrapper):
            def step(self, action, kept=states):
                kept.append(inner.robosuite_env.sim.get_state().flatten())
                return self.env.step(action)

        recorder = StreamRecorder(Keeping(env))
        rollout(recorder, make_policy("scripted", env, seed=seed), seed)
        episodes.append(recorder.finish())
        demos.append((np.array(states), episodes[-1].actions))
    kwargs = {"robots": ["Panda"], "control_freq": 20}
    for name in ("robosuite", "robomimic"):
        with h5py.File(folder / f"{name}.hdf5", "w") as file:
            data = file.create_group("data")
            if name == "robosuite":
                data.attrs["env"], data.attrs["env_info"] = "Lift", json.dumps(kwargs)
            else:
                data.attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": kwargs})
            for n, (states, actions) in enumerate(demos, 9):  # demo_9 comes before demo_10
                group = data.create_group(f"demo_{n}")
                group["states"], group["actions"] = states, actions
    env.close()
    return folder, episodes


@pytest.mark.parametrize("name", ["robosuite", "robomimic"])
def test_replayed_states_read_as_they_did_when_they_were_recorded(demonstrated, name):
    folder, episodes = demonstrated
    file = folder / f"{name}.hdf5"
    recorded = recorded_in(file)
    env = recorded.make(sensor_noise=0.0)
    replayed = list(replay(file, recorded, env))
    env.close()
    for mine, original in zip(replayed, episodes, strict=True):
        T = len(original) - 1
        assert len(mine) == T
        was = {n: original.stream[:T, w] for n, w in original.spec.slices.items()}
        now = {n: mine.stream[:, w] for n, w in mine.spec.slices.items()}
        assert list(now) == [n for n in was if n.startswith(("joint", "hand", "action"))]
        for channel in ("joint_position", "joint_velocity", "action"):
            np.testing.assert_allclose(now[channel], was[channel], atol=1e-6, err_msg=channel)
        # While an environment runs, the hand is where it was 2 ms before its joints came to where they are.
        np.testing.assert_allclose(now["hand_position"], was["hand_position"] + 2e-3 * was["hand_velocity"], atol=1e-5)
        np.testing.assert_allclose(now["hand_orientation"], was["hand_orientation"], atol=2e-3)
        np.testing.assert_allclose(now["hand_velocity"], was["hand_velocity"], atol=1e-2)
        np.testing.assert_array_equal(mine.actions, original.actions[:T])
        np.testing.assert_allclose(mine.observations, original.observations[:-1], atol=5e-2)
        assert np.abs(mine.observations - original.observations[:-1]).mean() < 1e-3


def test_imported_demonstrations_are_a_dataset(demonstrated, tmp_path):
    folder, _ = demonstrated
    assert main(["import", str(folder / "robomimic.hdf5"), "--out", str(tmp_path)]) == 0
    episodes = read_dataset(tmp_path, env_id="asm_gym/Lift-v0")
    assert [len(e) for e in episodes] == [11, 11]
    assert [e.info["demonstration"] for e in episodes] == ["demo_9", "demo_10"]
    env = gym.make("asm_gym/Lift-v0", stream=("joint", "hand", "action"))
    episodes[0].spec.require(env.unwrapped.stream_spec, "the dataset")
    env.close()


def test_files_that_do_not_fit_are_refused_by_name(demonstrated, tmp_path, capsys):
    folder, _ = demonstrated
    whole = (folder / "robosuite.hdf5").read_bytes()

    def edited(edit):
        path = tmp_path / "edited.hdf5"
        path.write_bytes(whole)
        with h5py.File(path, "a") as file:
            edit(file["data"])
        return path

    def drop_a_column(data):
        states = data["demo_9/states"][:, 1:]
        del data["demo_9/states"]
        data["demo_9/states"] = states

    def set_to(value, what):
        def edit(data):
            numbers = data[f"demo_9/{what}"][:].astype(np.float64)
            numbers[5, 2] = value
            del data[f"demo_9/{what}"]
            data[f"demo_9/{what}"] = numbers

        return edit

    for edit, message in (
        (lambda data: data.attrs.__setitem__("env", "Juggle"), "Juggle"),
        (lambda data: data.attrs.__delitem__("env"), "no file of robosuite"),
        (drop_a_column, "has 32 numbers"),
        (set_to(np.nan, "states"), "states of step 5 must be finite and below 1e+10, got nan"),
        (set_to(1e300, "states"), "states of step 5 must be finite and below 1e+10, got 1e+300"),
        (set_to(1e300, "actions"), "actions of step 5 must be finite and below 1e+10, got 1e+300"),
        (lambda data: data["demo_9"].create_dataset("rewards", data=np.full(12, np.nan)), "rewards of step 0 must be"),
        (lambda data: data["demo_9"].create_dataset("rewards", data=np.zeros(3)), "need as many rewards"),
    ):
        assert main(["import", str(edited(edit)), "--out", str(tmp_path / "out")]) == 2
        assert message in capsys.readouterr().err
    (tmp_path / "half.hdf5").write_bytes(whole[:500])
    assert main(["import", str(tmp_path / "half.hdf5"), "--out", str(tmp_path / "out")]) == 2
    assert "damaged" in capsys.readouterr().err
    assert main(["import", str(tmp_path / "none.hdf5"), "--out", str(tmp_path / "out")]) == 2
    assert "none.hdf5" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
