"""The examination of a memory of a body: faults beside healthy twins, and what its card says of them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from asm_gym.detection import Blocks
from asm_gym.episode import EpisodeLabel
from asm_gym.evaluation.metrics import DetectionMetrics
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.evaluation.scoring import detectability_of, onset_row
from asm_gym.monitors import NeuralASM, Surprise
from asm_gym.rollouts.pretraining.exam import Alarms, Exam, Marks, at_rates, examine, usual_force
from tests.test_babble import ARM, lesson_of


def test_an_exam_pairs_every_fault_with_a_healthy_twin():
    labels = Exam("Lift", "scripted", known=False).labels(3, ["push", "slip"], seed=5)
    nominal = [n for n in labels if n.role == "nominal"]
    assert [n.seed for n in nominal] == [n.seed for n in Exam("Lift", "lift_sac", known=True).labels(3, [], 5)]
    faulty = [n for n in labels if n.role == "faulty"]
    assert [n.kind for n in faulty] == ["push", "push", "slip", "slip"]
    assert {n.seed for n in faulty} == {n.seed for n in nominal}
    assert all(n.onset is not None and n.onset >= 10 for n in faulty)


def test_pushes_are_tried_in_the_last_scenes_and_none_twice():
    labels = Exam("Lift", "scripted", known=False).labels(3, ["push"], seed=5, pushes=3)
    scenes = [n.seed for n in labels[:3]]
    assert [(n.kind, n.severity, n.seed) for n in labels[3:]] == [
        ("push", "medium", scenes[0]),
        ("push", "strong", scenes[1]),
        ("push", "medium", scenes[2]),
        ("push", "medium", scenes[1]),
    ]


def test_an_examination_is_told_at_each_rate_that_the_memory_can_promise():
    def trace(kind, severity, *surprise):
        onset = None if kind == "nominal" else 1
        return ScoredEpisode(kind, 0, 0.05, 4.0, np.array(surprise), onset, severity)

    healthy_ones = [trace("nominal", "", 1, 1, 3, 1), trace("nominal", "", 1, 1, 1, 1)]
    pushes = [trace("push", "medium", 0, 0, 5, 5), trace("push", "medium", 0, 0, 3, 5)]
    faults = [trace("slip", "strong", 0, 0, 0, 3)]
    metrics = DetectionMetrics("Lift", faults, healthy_ones, 1.0)
    marks = [Marks("Lift", healthy_ones, [], pushes, metrics)]
    memory = NeuralASM(ARM).with_threshold(4.0)
    memory.maxima_ = np.array([2.0] * 18 + [4.0])
    memory.blocks_ = Blocks(memory.maxima_, np.full(19, 0.001))
    told = at_rates(marks, memory, (10.0, 200.0))
    nothing = "0.0 (0.0 to 33199.9)"
    assert told == (
        f"In all: {nothing} faults, {nothing} knocks, {nothing} stops an hour in 0.00 healthy hours, 0 of 1 faults "
        "found, 1 of 2 pushes of 20 N noticed within 100 ms. At the threshold for 200 an hour, 2: 9000.0 (227.9 to "
        f"50144.8) faults, {nothing} knocks, {nothing} stops an hour in 0.00 healthy hours, 1 of 1 faults found, "
        "2 of 2 pushes of 20 N noticed within 100 ms."
    )


def test_knocks_and_stops_are_counted_apart_and_added_up():
    def trace(fault, knock, stop):
        rows = [np.repeat(value, 36) for value in (fault, knock, stop)]
        excused = {"knock": rows[1], "stop": rows[2]}
        return ScoredEpisode("nominal", 0, 1.0, 4.0, rows[0], excused=excused)

    many = (
        [trace(5.0, 150.0, 0.0)] + 2 * [trace(3.0, 90.0, 0.0)] + 3 * [trace(2.0, 0.0, 60.0)] + 94 * [trace(1.0, 0, 0)]
    )
    found = Alarms.of(many)
    assert [rate.k for rate in (*found, found.every)] == [1, 2, 3, 6]  # what is a fault is no knock beside it
    assert found.every.hours == pytest.approx(1.0)


def test_an_agent_that_crashes_in_most_of_its_episodes_does_not_say_what_is_usual():
    def nominal(seed, force, success=True):
        label = EpisodeLabel("Lift", "nominal", seed=seed)
        return replace(lesson_of([0, force, 0] * 20, [0] * 60), label=label, success=success)

    agents_own = [nominal(0, 9), nominal(1, 80), nominal(2, 90), nominal(3, 500, success=False)]
    assert usual_force(agents_own) == 80
    memory = SimpleNamespace(threshold=1.0, spec=ARM, score_episodes=lambda episodes: [quiet(e) for e in episodes])
    marks = examine(memory, "Lift", agents_own, 1.0, usual=10.0)
    assert [[t.seed for t in own] for own in (marks.solved, marks.failed)] == [[0, 1, 2], [3]]


def quiet(episode):
    """No surprise at all."""
    return Surprise(np.zeros(len(episode)), np.zeros_like(episode.stream))


@pytest.mark.parametrize("rows", [1, 5])
def test_a_fault_begins_in_the_row_of_its_step_where_a_step_has_several(rows):
    label = EpisodeLabel("Lift", "faulty", "push", "strong", seed=1, onset=12)
    jump = replace(lesson_of([0] * 40, [0] * (40 * rows), rows=rows), label=label)
    jump.stream[12 * rows :, 0] += 5.0
    twin = replace(lesson_of([0] * 40, [0] * (40 * rows), rows=rows), label=replace(label, role="nominal", onset=None))
    assert onset_row(jump) == 12 * rows
    assert onset_row(twin) is None
    assert onset_row(replace(jump, contact_force=np.zeros(0, np.float32))) == 12  # nobody says otherwise
    (seen,) = detectability_of([twin], [jump], window_s=0.05)
    assert seen.earliest == 0
