"""What a Neural ASM learns beside its body: names of skills, and a body that wears."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asm_gym.data.episode import Episode
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.skills import name_skills
from tests.memories import SMALL, learned_bytes, sine_memory
from tests.streams import sine_episodes, sine_spec


@pytest.fixture(scope="module")
def asm() -> NeuralASM:
    return sine_memory()


def test_the_running_skill_is_told_by_name_and_changes_nothing_else(asm, tmp_path):
    def labelled(count, seed):
        made = []
        for n, e in enumerate(sine_episodes(count, seed=seed)):
            stream = e.stream.copy()
            stream[:, :4] += 2.0 * (n % 2)  # the second skill is elsewhere
            made.append(replace(e, stream=stream, info={"skill": ("near", "far")[n % 2]}))
        return made

    memory = NeuralASM(sine_spec(), **SMALL).fit(labelled(30, 0))
    before = memory.score(labelled(1, 1)[0]).value
    name_skills(memory, labelled(30, 0))
    np.testing.assert_array_equal(memory.score(labelled(1, 1)[0]).value, before)
    memory.save(tmp_path / "m.asm")
    memory = NeuralASM.load(tmp_path / "m.asm")
    right = []
    for e in labelled(20, 2):
        state = memory.initial_state()
        for row in e.stream[:20]:
            state, surprise = memory.observe(state, row[None])
        right.append(surprise.skill[0] == e.info["skill"])
    assert np.mean(right) > 0.95
    with pytest.raises(ValueError, match="does not say its skill"):
        name_skills(memory, sine_episodes(2))
    with pytest.raises(ValueError, match="two skills"):
        name_skills(memory, labelled(2, 0)[:1])


def worn(episode: Episode, share: float) -> Episode:
    """Episodes of a body whose first sense gives only ``share`` of what it gave."""
    stream = episode.stream.copy()
    stream[:, 0] *= share
    return replace(episode, stream=stream)


def live(memory: NeuralASM, episode: Episode, learn: bool) -> tuple[np.ndarray, int]:
    state, values, learned = memory.initial_state(), [], 0
    for row in episode.stream:
        before = state
        state, surprise = memory.observe(before, row[None])
        values.append(surprise.value[0])
        if learn:
            learned += int(memory.adapt(before, row[None], surprise)[0])
    return np.array(values), learned


def test_a_memory_that_learns_on_the_job_follows_a_body_that_wears(asm, tmp_path):
    asm.save(tmp_path / "new.asm")
    adapting = NeuralASM.load(tmp_path / "new.asm")
    for n, episode in enumerate(sine_episodes(120, seed=20)):
        live(adapting, worn(episode, 1.0 - 0.05 * n / 120), learn=True)
    old = [worn(e, 0.95) for e in sine_episodes(20, seed=21)]
    usual, followed = (np.median([s.value.max() for s in m.score_episodes(old)]) for m in (asm, adapting))
    assert followed < 0.4 * usual  # 1.3 and 7.6, of which 1.2 is there without wear
    adapting.save(tmp_path / "worn.asm")
    again = NeuralASM.load(tmp_path / "worn.asm")
    np.testing.assert_array_equal(again.score(old[0]).value, adapting.score(old[0]).value)


def test_what_is_surprising_is_never_learned(asm, tmp_path):
    asm.save(tmp_path / "a.asm")
    adapting = NeuralASM.load(tmp_path / "a.asm")
    state = adapting.initial_state()
    kept = learned_bytes(adapting)
    for t in range(10):
        row = np.full((1, asm.spec.size), 50.0 * (-1) ** t)
        before = state
        state, surprise = adapting.observe(before, row)
        assert not adapting.adapt(before, row, surprise).any()
    assert learned_bytes(adapting) == kept
    row[0, 0] = np.nan
    _, surprise = adapting.observe(state, row)
    assert not adapting.adapt(state, row, surprise).any()


def test_learning_on_the_job_refuses_what_makes_no_sense(asm):
    state = asm.initial_state()
    row = sine_episodes(1)[0].stream[:1]
    _, surprise = asm.observe(state, row)
    with pytest.raises(ValueError, match=r"rate must be a number in \(0, 1\], got 0"):
        asm.adapt(state, row, surprise, rate=0.0)
    fresh = NeuralASM(sine_spec(), **SMALL | {"epochs": 1}).fit(sine_episodes(4))
    state = fresh.initial_state()
    _, surprise = fresh.observe(state, row)
    with pytest.raises(RuntimeError, match="no threshold"):
        fresh.adapt(state, row, surprise)
