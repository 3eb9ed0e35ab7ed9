"""A corpus is split for good, continues where it was left, and is refused where it was changed."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest

from asm_gym.rollouts import detection_corpus as module
from asm_gym.rollouts.detection_corpus import (
    CLAIM,
    ROUNDS,
    VERSION,
    Corpus,
    Source,
    record_corpus,
    skill_files,
    trials,
)
from asm_gym.rollouts.trial import faulty_trial
from asm_gym.scripts.evaluate import main as evaluate
from tests.streams import sine_episodes

SOURCES = (Source("Lift", fit=2, calibration=1, nominal=4), Source("Stack", "stack_sac", nominal=2))


def record_round(folder, number, rounds=2, sources=SOURCES):
    folder.mkdir(exist_ok=True)
    (folder / CLAIM).write_text(json.dumps({"corpus": VERSION}))
    record_corpus(folder, sources, number, rounds, 1, lambda done, total: None)


@pytest.fixture
def recorded(tmp_path, monkeypatch):
    """A corpus of sines, in two rounds; and which episodes were recorded, in order."""
    made = []

    def record(trial, config):
        made.append(trial)
        return replace(sine_episodes(1, trial.seed % 1000)[0], label=trial.label, success=True)

    monkeypatch.setattr(sys.modules["asm_gym.rollouts.run_trials"], "record_stream", record)
    for number in range(2):
        record_round(tmp_path, number)
    return tmp_path, made


def test_rounds_share_the_test_episodes_and_the_first_has_what_is_learned_from():
    rounds = [trials(Source("Lift", fit=3, calibration=2, nominal=10), n) for n in range(ROUNDS)]
    assert [len(r) for r in rounds] == [3 + 2 + 2, 2, 2, 2, 2]
    assert len({trial.seed for r in rounds for trial in r}) == 15
    assert {trial.role for r in rounds[1:] for trial in r} == {"nominal"}


def test_what_is_there_is_not_recorded_again(recorded):
    folder, made = recorded
    assert len(made) == len(set(made)) == 9
    (folder / Corpus.open(folder).files.index[0]).unlink()
    assert len(Corpus.open(folder).episodes()) == 8
    record_round(folder, 0)
    assert len(made) == 10
    assert len(Corpus.open(folder).episodes()) == 9


def test_episodes_are_chosen_by_role_policy_and_task_and_checked(recorded):
    corpus = Corpus.open(recorded[0])
    assert len(corpus.episodes("nominal")) == 6
    assert [e.label.task for e in corpus.episodes(policies=("stack_sac",))] == ["Stack"] * 2
    assert {e.label.role for e in corpus.episodes("fit", "calibration", tasks=("Lift",))} == {
        "fit",
        "calibration",
    }
    labels = [e.label for e in corpus.episodes()]
    assert corpus.files[["task", "role", "kind", "severity"]].to_numpy().tolist() == [
        [label.task, label.role, label.kind, label.severity] for label in labels
    ]


def test_one_changed_bit_is_refused(recorded):
    corpus = Corpus.open(recorded[0])
    path = corpus.folder / corpus.files.index[3]
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert corpus.episodes("fit")
    with pytest.raises(ValueError, match=path.name):
        corpus.episodes()


def test_a_corpus_of_another_version_is_refused_in_a_line(recorded, capsys):
    folder = recorded[0]
    (folder / CLAIM).write_text(json.dumps({"corpus": 99}))
    with pytest.raises(ValueError, match=f"version 99 .* reads {VERSION}"):
        Corpus.open(folder)
    assert evaluate(["--corpus", str(folder), "--out", str(folder / "out")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_folder_without_a_corpus_names_the_command_that_records_one(tmp_path, capsys):
    assert evaluate(["--corpus", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "asm-gym corpus" in capsys.readouterr().err


@pytest.fixture
def pushed(tmp_path, monkeypatch):
    """A corpus of sines, in some of which a push is plain to see."""
    wanted = trials(Source("Lift", fit=6, calibration=24, nominal=8), 0, 1)
    seeds = [t.seed for t in wanted if t.role == "nominal"][:4]
    wanted += [faulty_trial("asm_gym/Lift-v0", "push", "strong", s, 100) for s in seeds]
    wanted = [replace(t, onset=20) if t.role == "faulty" else t for t in wanted]

    def record(trial, config):
        (episode,) = sine_episodes(1, trial.seed, steps=(60, 60))
        stream, onset = episode.stream.copy(), trial.onset or 60
        stream[onset:, :12] += 3.0
        return replace(
            episode, stream=stream, faults=np.arange(60) >= onset, label=trial.label, success=True
        )

    monkeypatch.setattr(sys.modules["asm_gym.rollouts.run_trials"], "record_stream", record)
    monkeypatch.setattr(module, "trials", lambda *_: wanted)
    record_round(tmp_path / "corpus", 0, 1, SOURCES[:1])
    return tmp_path / "corpus"


def test_monitors_are_judged_by_a_corpus(pushed, tmp_path):
    asked = [
        "--corpus",
        str(pushed),
        "--workers",
        "1",
        "--false-alarm-rate",
        "0.05",
        "--out",
        str(tmp_path / "out"),
    ]
    assert evaluate([*asked, "--monitors", "kalman+evidence", "association_linear"]) == 0
    text = (tmp_path / "out/results.md").read_text()
    assert re.search(r"\| kalman\+evidence \| 1.000 \(1.000–1.000\) \|.* 100 % \(100–100\)", text)
    assert "within chance" in text
    assert not (pushed / "scripted/monitors").exists()


def test_fewer_episodes_to_learn_from_leave_all_others_as_they_are(pushed):
    roles = [file.parent.name for file in skill_files(pushed, fit=2)]
    assert [roles.count(role) for role in ("fit", "calibration", "nominal", "faulty")] == [
        2,
        24,
        8,
        4,
    ]


def test_only_the_tasks_that_are_asked_for_are_judged(pushed):
    asked = skill_files(pushed, tasks=("Lift",))
    assert asked == [file for file in skill_files(pushed) if "Lift" in file.parts]
    assert not skill_files(pushed, tasks=("Door",))
    with pytest.raises(ValueError, match="Lift"):
        skill_files(pushed, tasks=("Lfit",))
