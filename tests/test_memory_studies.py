"""Studies of the memory: their instruments against oracles, and the direction of each claim on small data."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from asm_gym import NeuralASM
from asm_gym.memory.traces import Weights, direct_synapses, initial_weights
from asm_gym.scripts.reproduce import speed_accuracy
from asm_gym.scripts.reproduce.expression import (
    Backpropagated,
    ExpressionMemory,
    mean_demonstrations,
    recalled,
)
from asm_gym.scripts.reproduce.handwriting import (
    DT,
    NOISE,
    STEPS,
    copybook,
    repertoire,
    written,
)
from asm_gym.scripts.reproduce.local_learning import COMPARED, cosine, exact, local
from asm_gym.scripts.reproduce.recurrent import Batch
from asm_gym.scripts.reproduce.two_links import (
    COMMAND,
    CUE,
    ENCODERS,
    EVENT,
    HAND,
    PUSH,
    SPEC,
    MemoryDriver,
    closed_loop,
    demonstrations,
    hand,
    joints,
)
from asm_gym.scripts.reproduce.two_links import DT as ARM_DT


def test_the_pen_goes_where_its_commands_take_it_at_any_speed():
    letter = repertoire(1, np.random.default_rng(0))[0]
    episode = written(letter, np.random.default_rng(1))
    noise = episode.stream[:, :2] - np.cumsum(episode.stream[:, 2:], axis=0) * DT
    assert noise.std() == pytest.approx(NOISE, rel=0.2)
    slow, fast = (written(letter, np.random.default_rng(1), speed, wobble=0.0) for speed in (1.0, 2.0))
    assert len(fast) == len(slow) / 2
    np.testing.assert_allclose(fast.stream[:, :2], slow.stream[1::2, :2], atol=6 * NOISE)


def letters_of(count: int, each: int = 6) -> tuple[list, list]:
    rng = np.random.default_rng(0)
    letters = repertoire(count, rng)
    return copybook(letters, each, rng), copybook(letters, 3, rng)


def test_the_recurrent_rival_offline_reads_its_own_predictions():
    train, tests = letters_of(2)
    model = Backpropagated.learned(train, 16, np.random.default_rng(0), updates=5)
    streams = np.stack([e.stream for e in tests], axis=1).astype(np.float64)
    offline, row = model.express(streams, 20), np.arange(STEPS)[:, None, None]
    np.testing.assert_allclose(offline[:20], model.express(streams, STEPS)[:20], atol=1e-5)
    np.testing.assert_array_equal(offline, model.express(np.where(row < 20, streams, 9.0), 20))


def test_the_memory_recalls_each_letter_from_its_cue():
    train, tests = letters_of(2, each=8)
    memory = ExpressionMemory.learned(train, 32, np.random.default_rng(0), 4000)
    error, right = recalled(memory, tests, mean_demonstrations(train), 20)
    streams = np.stack([e.stream for e in tests], axis=1)
    still = np.linalg.norm(streams[20:, :, :2] - streams[19, :, :2], axis=2).mean()
    assert right >= 5 / 6
    assert error < 0.5 * still


def test_traces_need_no_inference_and_a_settling_state_does():
    config = speed_accuracy.Config(skills=2, hidden=32, writings=4, steps=2000, iterations=(1, 5, 30, 100))
    found = {}
    for dynamics in ("traces", "settling"):
        rng = np.random.default_rng(0)
        records = speed_accuracy.by_iterations(repertoire(2, rng), config, rng, dynamics)
        found[dynamics] = {(r["iterations"], r["shorter"]): r["next_cm"] for r in records}
    assert len(set(found["traces"].values())) == 1  # to the bit: nothing is inferred
    settling = [found["settling"][at] for at in ((1, 20), (5, 20), (30, 20), (100, 1))]
    assert all(later < sooner for sooner, later in itertools.pairwise(settling))
    assert settling[0] > 1.3 * settling[-1]


def small_batch(steps: int) -> tuple[Weights, Batch]:
    rng = np.random.default_rng(0)
    senses, commands = (rng.normal(size=(steps, 4, n)).astype(np.float32) for n in (5, 3))
    weights = initial_weights(7, 5, 2, rng)
    weights.W_F[:] = rng.normal(size=weights.W_F.shape)
    weights.W_D[:] = 0.1 * rng.normal(size=weights.W_D.shape) * direct_synapses(5, 2)
    return weights, Batch(senses, commands)


def test_the_differentiated_network_is_the_memory_and_its_gradient_that_of_finite_differences():
    weights, batch = small_batch(14)
    read, alone = (local(weights, batch, 8, alone, pi_z=1.0) for alone in (False, True))
    gradient = {target: exact(weights, batch, 8, target, pi_z=1.0) for target in ("energy", "error", "alone")}
    assert gradient["energy"].energy == pytest.approx(read.energy, rel=1e-4)
    assert gradient["error"].error == pytest.approx(read.error, rel=1e-4)
    assert gradient["alone"].error == pytest.approx(alone.error, rel=1e-4)
    for name, index in (("W_C", (2, 3)), ("W_F", (1, 4)), ("W_D", (0, 2)), ("W_D", (6, 5))):
        for target in ("error", "alone"):
            ends = []
            for step in (0.01, -0.01):
                moved = getattr(weights, name).copy()
                moved[index] += step
                ends.append(local(weights._replace(**{name: moved}), batch, 8, target == "alone", 1.0).error)
            slope = (ends[0] - ends[1]) / 0.02
            assert -gradient[target].arrays[name][index] == pytest.approx(slope, rel=0.05, abs=0.02)


def test_the_local_change_is_the_gradient_of_the_energy_and_of_the_error_for_a_firm_prior():
    weights, batch = small_batch(6)
    ours, theirs = local(weights, batch, 400, pi_z=1.0), exact(weights, batch, 400, "energy", 1.0)
    for name in COMPARED:
        np.testing.assert_allclose(ours.arrays[name], theirs.arrays[name], atol=1e-3)
    weights, batch = small_batch(20)
    angles = []
    for pi_z in (1.0, 100.0):
        angles.append(cosine(local(weights, batch, 50, pi_z=pi_z), exact(weights, batch, 50, "error", pi_z)))
        alone = local(weights, batch, 50, alone=True, pi_z=pi_z), exact(weights, batch, 50, "alone", pi_z)
        assert 0.2 < cosine(*alone) < 0.999  # the way back through time is left out
    assert 0.5 < angles[0] < angles[1]
    assert angles[1] > 0.999


@pytest.fixture(scope="module")
def arm():
    rng = np.random.default_rng(0)
    two = repertoire(2, rng)
    return demonstrations(two, 12, rng), demonstrations(two, 4, rng)


def test_the_arm_is_where_its_joints_and_its_commands_say(arm):
    for e in arm[1]:
        rows = e.stream.astype(np.float64)
        assert np.abs(hand(rows[:, ENCODERS]) - rows[:, HAND]).max() < 0.25  # the noise of both
        moved = rows[0, ENCODERS] + ARM_DT * np.cumsum(rows[1:, COMMAND], axis=0)
        assert np.abs(moved - rows[1:, ENCODERS]).max() < 0.01
        np.testing.assert_allclose(hand(joints(rows[:, HAND])), rows[:, HAND], atol=1e-9)


class Replay:
    """Commands what was commanded in the demonstrations."""

    def __init__(self, cues):
        self.cues, self.t, self.attribution = cues, 0, np.zeros(cues.shape[1:])

    def command(self):
        return self.cues[self.t][:, COMMAND]

    def read(self, rows):
        self.t, self.last = self.t + 1, rows
        return np.zeros(len(rows))


def test_replayed_commands_write_the_letter_unless_something_happens(arm):
    cues = np.stack([e.stream for e in arm[1]], axis=1).astype(np.float64)
    drivers = {way: Replay(cues) for way in ("left alone", "pushed", "stuck")}
    paths = {way: closed_loop(driver, cues, way, 0).path for way, driver in drivers.items()}
    assert np.linalg.norm(paths["left alone"] - cues[:, :, HAND], axis=2).max() < 0.3
    np.testing.assert_array_equal(paths["pushed"][:EVENT], paths["left alone"][:EVENT])
    moved = np.abs(joints(paths["pushed"][EVENT + 2 :]) - joints(paths["left alone"][EVENT + 2 :]))
    np.testing.assert_allclose(moved, PUSH, atol=1e-6)
    np.testing.assert_allclose(drivers["stuck"].last[:, 0], joints(cues[EVENT - 1, :, HAND])[:, 0], atol=0.02)


def test_a_memory_writes_its_letters_and_is_surprised_by_a_push(arm):
    asm = NeuralASM(SPEC, 32, 32, epochs=400, free_running_probability=0.6).fit(arm[0]).calibrate(arm[0], 0.1)
    cues = np.stack([e.stream for e in arm[1]], axis=1).astype(np.float64)
    energy = asm.model.free_energy(arm[1])
    alone, pushed = (
        closed_loop(MemoryDriver(asm, 8), cues, way, 0, energy, asm.threshold) for way in ("left alone", "pushed")
    )
    truth = cues[CUE:, :, HAND]
    off = np.linalg.norm(alone.path[CUE:] - truth, axis=2).mean()
    assert off < 0.5 * np.linalg.norm(truth - truth[0], axis=2).mean()
    assert (pushed.alarm < EVENT + 10).all()
    for what in ("surprise", "energy"):
        nominal, found = (getattr(c, what)[EVENT : EVENT + 5].max(axis=0) for c in (alone, pushed))
        assert found.min() > nominal.max()
