"""What asm-gym inspect says of a log whose clock, steps and noise are known."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.data.inspection import in_time, inspected
from asm_gym.data.selection import declared_by_all
from asm_gym.episode import Episode
from asm_gym.readings import resolution
from asm_gym.scripts.cli import main


def columns() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    t = np.arange(3000) / 100 + rng.normal(0, 1e-3, 3000)
    q = np.sin(np.arange(3000) / 100)
    kept = np.r_[0:1000, 1200:3000]
    made = {
        "Time (s)": t,
        "Num": np.arange(3000),
        "q_1 [rad]": np.round(q / 0.002) * 0.002,
        "current_1 [A]": q + 0.05 * rng.normal(size=3000),
        "fan": np.full(3000, 3.0),
        "target_1": q,
        "anomaly": np.zeros(3000),
    }
    made["current_1 [A]"][50:60] = np.nan
    return {name: values[kept] for name, values in made.items()}


def test_an_inspection_says_what_is_known_of_a_log():
    found = inspected("x", columns())
    channels = {c.name: c for c in found.channels}
    assert found.clock.rate == pytest.approx(100, rel=1e-3)
    assert found.clock.jitter == pytest.approx(0.1 * np.sqrt(2), rel=0.05)
    ((start, stop),) = found.clock.gaps
    assert stop - start == pytest.approx(2.01, abs=0.01)
    assert {c.name: c.role for c in found.channels} == {
        **{"Time": "clock", "Num": "counter", "q_1": "sense", "current_1": "sense", "fan": "sense"},
        **{"target_1": "command", "anomaly": "label"},
    }
    assert channels["q_1"].unit == "rad"
    assert channels["q_1"].resolution == pytest.approx(0.002, rel=1e-3)
    assert channels["current_1"].noise == pytest.approx(0.05, rel=0.1)
    assert channels["current_1"].resolution == 0.0
    assert channels["current_1"].missing == 10
    assert channels["fan"].constant
    assert "never moves" in channels["fan"].treatment()
    assert "healthy" in channels["q_1"].treatment()
    assert any("1 gaps in the clock, the longest 2.01 s" in line for line in found.remarks())


def test_what_forbids_reading_a_log_is_said():
    backwards = {"t": np.array([0.0, 1, 2, 0, 1]), "q": np.zeros(5)}
    assert inspected("x", backwards).remarks()[0].startswith("cannot be read: time must increase")
    assert "no clock: say --rate, rows a second" in inspected("x", {"q": np.arange(9.0)}).remarks()


@pytest.mark.parametrize("step", [0.001, 0.0625, 1.0])
def test_a_quantised_channel_shows_its_step_and_a_noisy_one_has_none(step):
    rng = np.random.default_rng(0)
    smooth = np.sin(np.arange(5000) / 200) * 20 * step + rng.normal(0, step, 5000)
    assert resolution(np.round(smooth / step) * step) == pytest.approx(step, rel=0.02)
    assert resolution((np.round(smooth / step) * step).astype(np.float32)) == pytest.approx(step, rel=0.02)
    assert resolution(smooth) == 0.0
    assert resolution(np.zeros(100)) == 0.0


def test_noise_is_declared_by_all_logs_and_not_by_the_first():
    def log(noise: float, seed: int) -> Episode:
        rows = np.random.default_rng(seed)
        return Episode.from_table({"q": np.sin(np.arange(900) / 50) + noise * rows.normal(size=900)}, rate=50.0)

    first = log(0.0, 0)
    others = [Episode.from_stream(log(0.1, n).stream, first.spec) for n in range(1, 5)]
    (spec,) = {e.spec for e in declared_by_all([first, *others])}
    assert first.spec.channels[0].noise < 1e-3
    assert spec.channels[0].noise == pytest.approx(0.1, rel=0.15)


def test_the_command_prints_a_table_and_draws_a_picture(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    rows = zip(*columns().values(), strict=True)
    text = "\n".join([";".join(columns()), *(";".join(map(str, row)) for row in rows)])
    (tmp_path / "arm.csv").write_text(text + "\n")
    assert main(["inspect", str(tmp_path / "arm.csv"), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "commanded, by its name: fit takes it so" in said
    assert "0.002" in said
    assert (tmp_path / "out" / "arm.png").read_bytes().startswith(b"\x89PNG")
    (tmp_path / "bad.csv").write_text("t,q\n1,2\n0,3\n")
    assert main(["inspect", str(tmp_path / "bad.csv"), "--out", str(tmp_path / "out")]) == 1
    assert "cannot be read: time must increase" in capsys.readouterr().out


def test_times_are_said_as_people_say_them():
    assert [in_time(s) for s in (0.5, 90, 300, 26320)] == ["0.5 s", "90 s", "5 min", "7.31 h"]


def test_logs_of_different_columns_are_one_line_each(tmp_path, capsys):
    for n, name in enumerate(("q_2", "q_3")):
        rows = np.random.default_rng(n).normal(size=(600, 2)).cumsum(axis=0)
        table = np.column_stack([np.arange(600) / 100, rows])
        np.savetxt(tmp_path / f"{n}.csv", table, "%.5f", ",", header=f"time,q_1,{name}", comments="")
    assert main(["inspect", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    assert "1.csv has other columns than 0.csv: q_2, q_3" in capsys.readouterr().out
    assert main(["fit", str(tmp_path), "--out", str(tmp_path / "m.asm")]) == 2
    said = capsys.readouterr()
    assert "1.csv: the memory reads channels that are not there: q[2]" in said.out + said.err
    assert not (tmp_path / "m.asm").exists()
