"""Memories that come with the package: found by name and by the body they know, and refused where they do not fit."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.monitors import NeuralASM, pretrained, pretrained_for
from asm_gym.policies import make_policy, rollout
from asm_gym.wrappers import NeuralASMSafety, VectorNeuralASMSafety
from tests.fakes import FakeEnv
from tests.rates import failures
from tests.streams import sine_episodes, sine_spec

SIZES = {"hidden_size": 4, "association_size": 4, "epochs": 1}


@pytest.fixture
def shelf(tmp_path, monkeypatch):
    """A room with one memory, of a body called sines under the controller SWING."""
    memory = (
        NeuralASM(sine_spec(), **SIZES)
        .fit(sine_episodes(4))
        .calibrate(sine_episodes(4, seed=1), 0.5)
    )
    memory.about = {"name": "sines", "controller": "SWING"}
    memory.save(tmp_path / "sines.asm")
    monkeypatch.setattr("asm_gym.monitors.shipped.SHIPPED_FOLDER", tmp_path)
    return memory


def test_a_shipped_memory_is_loaded_by_name_with_its_threshold_and_what_is_known_of_it(shelf):
    assert list(pretrained()) == ["sines"]
    memory = NeuralASM.pretrained("sines")
    assert memory.threshold == shelf.threshold
    assert memory.about == {"name": "sines", "controller": "SWING"}
    assert repr(memory) == f"<NeuralASM 'sines', sines at 20 Hz, threshold {shelf.threshold:.4g}>"
    with pytest.raises(
        ValueError,
        match=r"unknown pretrained memory 'cosines'; known: sines; did you mean 'sines'\?",
    ):
        NeuralASM.pretrained("cosines")


@pytest.mark.parametrize(
    ("spec", "controller", "why"),
    [
        (replace(sine_spec(), source="cosines"), "SWING", "robot: sines against cosines"),
        (sine_spec(), "SLIDE", "controller: SWING against SLIDE"),
        (replace(sine_spec(), dt=0.01), "SWING", "dt: 0.05 s against 0.01 s"),
        (
            replace(sine_spec(sensory=11), source="sines"),
            "SWING",
            "joint_position: size 12 against 11",
        ),
    ],
)
def test_another_body_is_refused_with_what_there_is_and_what_to_do(shelf, spec, controller, why):
    with pytest.raises(ValueError, match="no shipped memory fits") as refused:
        pretrained_for(spec, controller)
    assert f"sines: {why}" in str(refused.value)
    made = f"asm-gym babble --robot {spec.source}" + (
        " --stream-freq 100 for" if spec.dt == 0.01 else " for"
    )
    assert made in str(refused.value)


def test_the_wrapper_without_a_monitor_says_what_there_is_where_none_fits(shelf):
    with pytest.raises(
        ValueError, match=r"no shipped memory fits this stream of an unnamed body at 20 Hz"
    ):
        NeuralASMSafety(FakeEnv())


@pytest.mark.parametrize("name", list(pretrained()))
def test_every_shipped_memory_is_what_its_name_says(name):
    memory = NeuralASM.pretrained(name)
    assert memory.about["name"] == name
    assert memory.threshold > 0
    assert pretrained_for(memory.spec, memory.about["controller"]) == name
    assert pretrained()[name].stat().st_size < 8e6


def test_an_environment_of_the_panda_is_watched_by_the_memory_of_its_body():
    env = NeuralASMSafety(gym.make("asm_gym/Lift-v0"))
    envs = VectorNeuralASMSafety(gym.make_vec("asm_gym/Lift-v0", 1, vectorization_mode="sync"))
    assert env.monitor.about["name"] == envs.monitor.about["name"] == "panda"
    assert env.threshold == envs.threshold == NeuralASM.pretrained("panda").threshold
    _, at_reset = env.reset(seed=0)
    after_a_step = env.step(np.zeros(7, np.float32))[4]
    assert {name: np.shape(value) for name, value in at_reset.items()} == {
        name: np.shape(value) for name, value in after_a_step.items()
    }
    env.close()
    envs.close()


@pytest.mark.floats
@pytest.mark.parametrize("robot", ["Panda", "Sawyer", "IIWA"])
@pytest.mark.parametrize("stream_freq", [None, 100])
def test_each_arm_and_rate_has_a_memory_of_its_own_and_a_healthy_episode_is_quiet(
    robot, stream_freq
):
    env = NeuralASMSafety(
        gym.make("asm_gym/Lift-v0", robot=robot, stream_freq=stream_freq), on_alarm="monitor"
    )
    name = robot.lower() + ("_100hz" if stream_freq else "")
    assert env.monitor.about["name"] == name
    assert env.threshold == NeuralASM.pretrained(name).threshold

    def trial(seed: int) -> str:
        infos = []
        solved = rollout(env, make_policy("scripted", env, seed=seed), seed, infos.append)
        assert len(infos[0]["asm"]["surprises"]) == (5 if stream_freq else 1)
        quiet = max(max(info["asm"]["surprises"]) for info in infos) < env.threshold
        return "" if solved and quiet else f"solved: {solved}, quiet: {quiet}"

    assert not failures(trial, range(4, 14), 0.95, first=1)
    env.close()
