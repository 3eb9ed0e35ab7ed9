"""From ten episodes, each of another skill, the memory is no worse than what is linear alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asm_gym.episode import Episode
from asm_gym.evaluation.statistics import auroc
from asm_gym.monitors import NeuralASM, make_monitor
from asm_gym.spec import MOTOR, Channel, StreamSpec

SKILLS, STEPS, ONSET, WINDOW = 10, 60, 30, 20
GROUPS, EACH, HIDDEN, MOTORS = 4, 6, 8, 3
NOISE, OFFSET = 0.02, 0.2

SPEC = StreamSpec(
    (
        *(Channel(f"sense_{g}", EACH, noise=NOISE, group=f"group_{g}") for g in range(GROUPS)),
        Channel("action", MOTORS, group=MOTOR),
    ),
    dt=0.05,
)


def episode(seed: int) -> Episode:
    """A body of eight numbers that is driven and seen through noise, in one of its skills; a group is not linear."""
    body, skill, rng = (np.random.default_rng(s) for s in (5, [seed % SKILLS, 5], [seed, 3]))
    orthogonal, _ = np.linalg.qr(body.normal(size=(HIDDEN, HIDDEN)))
    driven, seen = 0.5 * body.normal(size=(HIDDEN, MOTORS)), 0.5 * body.normal(size=(GROUPS * EACH, HIDDEN))
    speed, wide, middle = skill.uniform(0.05, 0.3, MOTORS), skill.normal(size=MOTORS), skill.normal(size=MOTORS)
    phase, x, rows = rng.normal(0, 0.5, MOTORS), rng.normal(size=HIDDEN), []
    for t in range(STEPS):
        u = middle + wide * np.sin(speed * t + phase) + 0.05 * rng.normal(size=MOTORS)
        x = 0.9 * orthogonal @ x + driven @ u + NOISE * rng.normal(size=HIDDEN)
        senses = seen @ x
        senses[EACH : 2 * EACH] += 0.3 * np.maximum(senses[EACH : 2 * EACH], 0.0)
        rows.append(np.concatenate([senses + NOISE * rng.normal(size=len(senses)), u]))
    return Episode.from_stream(np.array(rows), SPEC)


def offset(episode: Episode, column: int) -> Episode:
    stream = episode.stream.copy()
    stream[ONSET:, column] += OFFSET
    return replace(episode, stream=stream)


@pytest.fixture(scope="module")
def nominal() -> list[Episode]:
    return [episode(2000 + n) for n in range(200)]


def told_apart(name: str, nominal: list[Episode], **settings: int) -> float:
    """AUROC of an offset in any one sense, over the same steps."""
    monitor = make_monitor(name, SPEC, **settings).fit([episode(n) for n in range(10)])
    rng = np.random.default_rng(0)
    faulty = [offset(e, int(rng.integers(GROUPS * EACH))) for e in nominal]
    surprised, calm = (
        [s.value[ONSET : ONSET + WINDOW].max() for s in monitor.score_episodes(made)] for made in (faulty, nominal)
    )
    return auroc(surprised, calm)


def test_a_memory_of_ten_episodes_is_no_worse_than_ridge_and_near_the_filter_of_linear_systems(nominal):
    ours = told_apart("neural_asm", nominal, epochs=10)
    assert ours >= told_apart("association_linear+evidence", nominal) - 0.01
    assert ours >= told_apart("kalman+evidence", nominal) - 0.03  # these streams are linear but for one group in four


def test_of_so_few_rows_nothing_is_excused_and_no_unit_is_believed():
    fitted = NeuralASM(SPEC, association_size=40, epochs=1).fit([episode(n) for n in range(10)])
    assert not fitted.learned_["U"].any()
    assert not fitted.learned_["context_quantile"].any()
