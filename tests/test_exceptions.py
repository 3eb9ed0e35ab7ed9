"""Exceptions that can be caught: each is a ValueError, tells its facts, and survives the way between processes."""

from __future__ import annotations

import pickle

import gymnasium as gym
import numpy as np
import pytest

import asm_gym
from asm_gym import Channel, NeuralASM, StreamSpec
from asm_gym.checkpoint import read_checkpoint
from asm_gym.detection.conformal import check_hours, conformal_threshold
from asm_gym.exceptions import (
    AsmGymError,
    DamagedFile,
    LimitsLacking,
    NotEnoughEpisodes,
    NotFitted,
    SpecMismatch,
    UnsupportedEnvironment,
)
from asm_gym.policies.hold import Hold

SPEC = StreamSpec((Channel("position", 2), Channel("command", 2, group="action")), dt=0.05)


def test_a_stream_with_other_channels_is_a_spec_mismatch():
    other = StreamSpec((Channel("position", 3), Channel("command", 2, group="action")), dt=0.05)
    with pytest.raises(SpecMismatch) as refused:
        SPEC.require(other, "the monitor")
    assert refused.value.whose == "the monitor"
    assert refused.value.differences == ["position: size 2 against 3"]
    assert "position: size 2 against 3" in str(refused.value)


def test_a_monitor_that_has_not_learned_is_not_fitted():
    monitor = NeuralASM(SPEC)
    with pytest.raises(NotFitted, match="call fit"):
        monitor.initial_state()
    with pytest.raises(NotFitted, match="call fit"):  # calibrate would refuse it
        _ = monitor.threshold


def test_too_few_episodes_or_hours_say_how_many_are_needed():
    with pytest.raises(NotEnoughEpisodes) as refused:
        conformal_threshold(np.arange(5.0), rate=0.05)
    assert refused.value.needed == "19 nominal episodes"
    assert refused.value.got == "5"
    with pytest.raises(NotEnoughEpisodes, match=r"at least 1 hours .*, got 0\.25: record"):
        check_hours(1.0, hours=0.25)


def test_an_environment_without_a_known_rest_is_unsupported():
    with pytest.raises(UnsupportedEnvironment) as refused:
        Hold(gym.make("Pendulum-v1"))
    assert "safe_action" in refused.value.advice


def test_what_is_no_checkpoint_is_a_damaged_file(tmp_path):
    path = tmp_path / "memory.asm"
    path.write_bytes(b"no zip")
    with pytest.raises(DamagedFile) as refused:
        read_checkpoint(path, "neural_asm")
    assert refused.value.what == str(path)
    with pytest.raises(DamagedFile):
        StreamSpec.from_json("{}")


@pytest.mark.parametrize(
    "error",
    [
        SpecMismatch("the monitor", ["dt: 1 s against 2 s"], "Fit another."),
        NotFitted("this monitor", "has no threshold", "calibrate(episodes)"),
        NotEnoughEpisodes("a rate of 0.05 needs", "19 episodes", "5", "record more"),
        UnsupportedEnvironment("it changes actions", "put it outside"),
        LimitsLacking("franka", "torques", ("force",), ("wrist_force",)),
        DamagedFile("memory.asm", "it is empty"),
    ],
)
def test_exceptions_are_value_errors_and_keep_their_message_between_processes(error):
    assert isinstance(error, AsmGymError)
    assert isinstance(error, ValueError)
    assert isinstance(error, RuntimeError) == isinstance(error, NotFitted)
    copied = pickle.loads(pickle.dumps(error))
    assert type(copied) is type(error)
    assert str(copied) == str(error)
    assert vars(copied) == vars(error)
    assert getattr(asm_gym, type(error).__name__) is type(error)
