"""What a Neural ASM learns beside its body: names of skills, and a body that wears."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asm_gym.monitors import NeuralASM
from asm_gym.monitors.memory_skills import name_skills
from tests.memories import SMALL, sine_memory
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
    with pytest.raises(ValueError, match="at least two"):
        name_skills(memory, labelled(2, 0)[:1])
