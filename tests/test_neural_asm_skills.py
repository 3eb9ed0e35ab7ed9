"""The names of skills that a Neural ASM tells, from episodes of one and from such as change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asm_gym.episode import Episode
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.skills import name_skills, named_skills
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
    with pytest.raises(ValueError, match="two skills"):
        name_skills(memory, labelled(2, 0)[:1])


def changing(count: int, seed: int, back: bool = False) -> list[Episode]:
    """Episodes of a skill near by, of one far away, and of both, whose second half, where it goes, is nowhere else.

    Args:
        back: the second skill of a change is reached from the other side.
    """
    made = []
    for n, e in enumerate(sine_episodes(count, seed=seed)):
        stream, half = e.stream.copy(), len(e) // 2
        if n % 3 == 1:
            stream[:, :4] += 2.0
        if n % 3 == 2:
            stream[half:, :4] += -2.0 if back else 2.0
        told = [{"skill": "near"}, {"skill": "far"}, {"skills": ["near", "far"], "changed": half}][n % 3]
        made.append(replace(e, stream=stream, info=told))
    return made


def test_names_that_were_learned_from_changes_follow_one_that_single_skills_do_not_show():
    shown, asked = changing(30, 0, back=True), changing(30, 1, back=True)[2::3]
    memory = NeuralASM(sine_spec(), **SMALL).fit(shown)

    def right() -> float:
        return float(np.mean([np.mean(named_skills(memory, e.stream)[len(e) // 2 + 20 :] == "far") for e in asked]))

    name_skills(memory, [e for e in shown if "skill" in e.info])
    alone = right()
    name_skills(memory, shown)
    assert memory.skills_ == ("far", "near")
    assert right() > 0.95 > alone + 0.3


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({"skills": ["a", "b"]}, "episode 1 names 2 skills, and says of 0 where they begin"),
        ({"skills": ["a", "b"], "changed": [3, 9]}, "names 2 skills, and says of 2"),
        ({"skills": ["a", "b", "a"], "changed": [9, 3]}, "cannot begin at 0, 9, 3"),
        ({"skills": ["a", "b"], "changed": 10**6}, "rows, in which skills cannot begin at 0, 1000000"),
        ({"skills": ["a", "b"], "changed": 0}, r"info\['changed'\] must be a whole number .*, got 0"),
        ({"skills": ["a", "b"], "changed": 2.5}, r"info\['changed'\] must be a whole number .*, got 2.5"),
        ({"skills": ["a", "b"], "changed": None}, r"info\['changed'\] must be a whole number .*, got None"),
        ({"skills": "ab", "changed": 3}, "must name its skills in order"),
        ({"skills": ["a", ""], "changed": 3}, "must name its skills in order"),
    ],
)
def test_changes_that_cannot_be_are_refused(asm, info, message):
    first, second = sine_episodes(2)
    with pytest.raises(ValueError, match=message):
        name_skills(asm, [replace(first, info={"skill": "a"}), replace(second, info=info)])
