"""A corpus is split for good, goes on where it was left, and is not read when it is not what it was."""

from __future__ import annotations

import csv
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asm_gym.episode import EpisodeLabel, save_episode
from asm_gym.evaluation.corpus import MANIFEST, VERSION, Corpus, Entry
from asm_gym.monitors import MONITORS
from asm_gym.rollouts import corpus as module
from asm_gym.rollouts.corpus import PARTS, ROUNDS, Source, record_corpus, wanted
from asm_gym.rollouts.parallel import THIS_PROCESS
from asm_gym.rollouts.run_folder import unread
from asm_gym.scripts.corpus import contents
from asm_gym.scripts.evaluate import main as evaluate
from asm_gym.scripts.reproduce import main as reproduce
from asm_gym.scripts.reproduce import parts as parts_study
from tests.streams import sine_episodes
from tests.test_composition import Persistence

SOURCES = (Source("Lift", fit=2, calibration=1, nominal=4), Source("Stack", "stack_sac", nominal=2))


@pytest.fixture
def recorded(tmp_path, monkeypatch):
    """A corpus of sines, in two rounds; and which files were recorded, in order."""
    made = []

    def record(label, config, folder):
        made.append(label)
        episode = sine_episodes(1, label.seed % 1000)[0]
        return save_episode(folder / label.path, replace(episode, label=label, success=True))

    monkeypatch.setattr(module, "record", record)
    for number in range(2):
        record_corpus(tmp_path, SOURCES, number, 2, THIS_PROCESS, lambda done, total: None)
    return tmp_path, made


def test_rounds_part_the_test_episodes_and_the_first_has_what_is_learned_from():
    source = Source("Lift", fit=3, calibration=2, nominal=10)
    rounds = [[e.label for e in wanted(source, n)] for n in range(ROUNDS)]
    assert [len(r) for r in rounds] == [3 + 2 + 2, 2, 2, 2, 2]
    seeds = [label.seed for r in rounds for label in r]
    assert len(set(seeds)) == 15
    assert {label.role for r in rounds[1:] for label in r} == {"nominal"}


def test_it_has_what_was_asked_for():
    skills, hours = PARTS["skills"], PARTS["hours"]
    assert sum(s.nominal for s in skills) >= 2000
    horizons = {"Lift": 5.0, "Stack": 10.0, "Door": 10.0, "NutAssemblySquare": 17.5, "NutAssemblyRound": 17.5}
    each = ((s, s.fit + s.calibration + s.nominal) for s in (*skills, *hours))
    assert sum(count * horizons.get(s.task, 15.0) for s, count in each) / 3600 >= 20


def test_what_is_there_is_not_recorded_again(recorded, monkeypatch):
    folder, made = recorded
    monkeypatch.setattr("time.localtime", lambda *_: (2031, 5, 17, 12, 0, 0, 0, 1, 0))  # another day, the same bytes
    assert len(made) == len(set(made)) == 9
    lost = folder / Corpus.open(folder).entries[0].path
    lost.unlink()
    with pytest.raises(ValueError, match=r"cut off: 1 of 9 files are missing, such as scripted/episodes/Lift"):
        Corpus.open(folder)
    record_corpus(folder, SOURCES, 0, 2, THIS_PROCESS, lambda done, total: None)
    assert len(made) == 10
    Corpus.open(folder).episodes().check()


def test_episodes_are_chosen_by_role_policy_and_task_and_read_one_by_one(recorded):
    corpus = Corpus.open(recorded[0])
    assert len(corpus.episodes("nominal")) == 6
    assert [e.label.task for e in corpus.episodes(policies=("stack_sac",))] == ["Stack"] * 2
    chosen = corpus.episodes("fit", "calibration", tasks=("Lift",))
    assert len(chosen) == 3
    assert [e.label.role for e in chosen[1:]] == [entry.label.role for entry in chosen.entries[1:]]
    seconds = sum(e.seconds for e in corpus.entries)
    assert seconds == pytest.approx(sum(len(e) * e.spec.dt for e in corpus.episodes()))
    assert [row[0] for row in contents(corpus)] == ["Lift, scripted", "Stack, stack_sac"]


def test_one_bit_is_enough_to_be_refused(recorded):
    corpus = Corpus.open(recorded[0])
    path = corpus.folder / corpus.entries[3].path
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    corpus.episodes()[2]
    with pytest.raises(ValueError, match=f"{path.name} is damaged"):
        corpus.episodes()[3]


@pytest.fixture
def pushed(tmp_path, monkeypatch):
    """A corpus of sines, in some of which a push is plain to see."""
    entries = wanted(Source("Lift", fit=6, calibration=24, nominal=8), 0, 1)
    seeds = [e.label.seed for e in entries if e.label.role == "nominal"][:4]
    entries += [Entry("scripted", EpisodeLabel("Lift", "faulty", "push", "strong", s, 20)) for s in seeds]

    def record(label, config, folder):
        (episode,) = sine_episodes(1, label.seed % 1000, steps=(60, 60))
        stream = episode.stream.copy()
        stream[20 if label.role == "faulty" else 60 :, :12] += 3.0
        made = replace(episode, stream=stream, faults=np.arange(60) >= (label.onset or 60), label=label, success=True)
        return save_episode(folder / label.path, made)

    monkeypatch.setattr(module, "record", record)
    monkeypatch.setattr(module, "wanted", lambda *_: entries)
    record_corpus(tmp_path / "corpus", SOURCES[:1], 0, 1, THIS_PROCESS, lambda done, total: None)
    return tmp_path / "corpus"


def test_parts_of_the_memory_are_judged_by_it(pushed, tmp_path):
    asked = ["--corpus", str(pushed), "--ways", "learned traces", "local traces", "linear", "--seeds", "2", "--quick"]
    assert reproduce(["parts", *asked, "--workers", "1", "--out", str(tmp_path / "out")]) == 0
    rows = list(csv.DictReader((tmp_path / "out/parts.csv").open()))
    alone = ["temporal network alone", "association alone", "all, one precision everywhere"]
    parts = ["all", *alone, "association alone, one precision everywhere", "all, local", "no hidden units"]
    assert [(r["part"], r["seed"]) for r in rows] == [(part, seed) for seed in "01" for part in parts]
    assert all(float(r["auroc"]) > 0.9 for r in rows)  # a push of three metres is plain to every part
    with pytest.raises(ValueError, match="learned traces, transported traces"):
        parts_study.Config(corpus=pushed, ways=("none",))


@pytest.fixture
def asked(pushed, tmp_path):
    """How it is judged, without the monitors."""
    common = ["--workers", "1", "--false-alarm-rate", "0.05", "--out", str(tmp_path / "out")]
    return ["--corpus", str(pushed), *common]


class Peeking(Persistence):
    """Learns from what it should be judged on."""

    kind = "peeking"

    def fit(self, readings, rng, progress):
        for path in Path(os.environ["PEEKED_AT"]).rglob("*.npz"):
            np.load(path).close()
        return super().fit(readings, rng, progress)


def test_a_monitor_that_reads_the_recordings_by_itself_is_refused_in_a_line(asked, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PEEKED_AT", str(tmp_path / "corpus"))
    monkeypatch.setattr("asm_gym.monitors.registry.MONITORS", dict(MONITORS))
    assert evaluate([*asked, "--monitors", "tests.test_corpus:Peeking"]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "a monitor opened" in said
    assert "it may learn from what fit and calibrate are given alone" in said


def test_monitors_are_judged_by_it_and_have_cards(asked, tmp_path):
    assert evaluate([*asked, "--monitors", "kalman+evidence", "window_pca"]) == 0
    card = json.loads((tmp_path / "out/cards/kalman+evidence.json").read_text())
    assert (card["faults"], card["nominal"], card["auroc"][0], card["aucpdt"]) == (4, 8, 1.0, 0.0)
    assert card["found"]["0.05"] == [1.0, 1.0, 1.0]
    text = (tmp_path / "out/results.md").read_text()
    assert "within chance" in text
    assert "|  | in calibration | 0 of 24 |" in text
    assert not (tmp_path / "corpus/scripted/monitors").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text[:-20], "is damaged or cut off"),
        (lambda text: text.replace(f'"version": {VERSION}', '"version": 99'), "version 99 of the corpus.*reads 2"),
        (lambda text: json.dumps({"version": VERSION}), "is damaged or cut off: 'files'"),
    ],
)
def test_a_manifest_that_is_not_ours_is_refused_in_a_line(recorded, change, message, capsys):
    folder = recorded[0]
    path = folder / MANIFEST
    path.write_text(change(path.read_text()))
    with pytest.raises(ValueError, match=message):
        Corpus.open(folder)
    assert evaluate(["--corpus", str(folder), "--out", str(folder / "out")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_folder_without_a_corpus_says_what_records_one(tmp_path, capsys):
    assert evaluate(["--corpus", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "asm-gym corpus" in capsys.readouterr().err


def test_nothing_that_is_watched_is_opened_by_whoever_learns(recorded):
    folder = recorded[0] / "scripted"
    path = next(folder.rglob("*.npz"))
    with unread(folder, "a monitor"), pytest.raises(PermissionError, match=r"a monitor opened .*npz"):
        np.load(path)
    np.load(path).close()
