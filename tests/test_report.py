"""The report and its figures, read back from the files and the figures' own artists."""

from __future__ import annotations

import dataclasses
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

from asm_gym.evaluation import figures
from asm_gym.evaluation.detection_tables import CONDITION_COLUMNS, headline
from asm_gym.evaluation.metrics import by_condition, false_alarms
from asm_gym.evaluation.report_page import write_report
from asm_gym.evaluation.scored_episode import InterventionOutcome, ScoredEpisode
from asm_gym.evaluation.tables import Table, tabulate


def a_trace(condition: str, seed: int, acting: str = "policy alone") -> ScoredEpisode:
    """60 steps of 0.05 s; faults begin at step 20 and are detected, or not, as chance has it."""
    rng = np.random.default_rng([seed, len(condition)])
    surprise = rng.gamma(3.0, 2.0, 60)
    fault = np.zeros(60, np.bool_)
    if condition != "nominal":
        fault[20:40] = True
        surprise[20 + rng.integers(8) : 40] += 30 * rng.random()
    attribution = rng.dirichlet(np.ones(20), 60) * surprise[:, None]
    channels = tuple(f"joint_position[{i}]" for i in range(20))
    onset, outcome = 20 if fault.any() else None, InterventionOutcome(True, 10 * rng.random())
    kept = {"attribution": attribution, "channels": channels, "fault": fault}
    made = ScoredEpisode(
        condition, seed, 0.05, 20.0, surprise, onset, acting=acting, outcome=outcome, **kept
    )
    return made.attributed(attribution, channels)


@pytest.fixture(scope="module")
def traces() -> list[ScoredEpisode]:
    names = ("nominal", "push", "weak joint")
    return [a_trace(c, s, a) for c in names for s in range(8) for a in ("policy alone", "hold")]


def figures_of(traces: list[ScoredEpisode]) -> dict[str, Figure]:
    faulty = next(t for t in traces if t.delay is not None)
    return {
        "surprise": figures.surprise_figure([traces[0], faulty]),
    }


def test_figures_are_the_same_bytes_whatever_the_users_style_and_leave_it_alone(
    traces, tmp_path: Path
):
    before = {
        name: figures.save(f, tmp_path / f"{name}.png").read_bytes()
        for name, f in figures_of(traces).items()
    }
    with mpl.rc_context(
        {"axes.facecolor": "red", "font.size": 30, "axes.labelsize": 30, "ytick.direction": "in"}
    ):
        again = figures_of(traces)
        assert mpl.rcParams["font.size"] == 30.0
    for name, figure in again.items():
        assert figures.save(figure, tmp_path / "again.png").read_bytes() == before[name], name
    assert plt.get_fignums() == []


def test_infinite_and_zero_surprise_can_be_drawn(traces, tmp_path: Path):
    good = next(t for t in traces if t.delay is not None)
    surprise = good.surprise.copy()
    surprise[:5], surprise[30:] = 0.0, np.inf
    broken = dataclasses.replace(good, surprise=surprise)
    for name, figure in figures_of(
        [broken, *(t for t in traces if t.condition == "nominal")]
    ).items():
        assert figures.save(figure, tmp_path / f"{name}.png").stat().st_size > 5000


def test_a_figure_says_where_data_are_missing(traces):
    def legend(trace: ScoredEpisode) -> set[str]:
        return {text.get_text() for text in figures.surprise_figure([trace]).legends[0].get_texts()}

    whole = traces[0]
    lost = np.zeros((len(whole), 1), np.float32)
    lost[10:14] = np.nan
    assert legend(dataclasses.replace(whole, stream=lost)) - legend(whole) == {"missing data"}


def test_the_most_surprising_channels_come_first(traces):
    trace = next(t for t in traces if t.delay is not None)
    order = np.argsort(-trace.attribution[20:].max(axis=0))[:3]
    names = [trace.channels[i] for i in order]
    stream = np.random.default_rng(0).normal(size=(len(trace), len(trace.channels)))
    axes = figures.stream_figure(dataclasses.replace(trace, stream=stream), top=3).axes
    assert [ax.get_title(loc="left") for ax in axes] == names
    np.testing.assert_array_equal(axes[0].lines[0].get_ydata(), stream[:, order[0]])
    with pytest.raises(ValueError, match="without its stream"):
        figures.stream_figure(trace)


def test_a_day_is_drawn_in_few_points_with_its_peaks_and_by_the_time_of_day():
    rng = np.random.default_rng(0)
    surprise = rng.gamma(3.0, 2.0, 100_000)
    surprise[::20] = 50.0
    surprise[54_321] = 1e4
    stream = rng.normal(size=(len(surprise), 2))
    stream[7_000, 0] = -99.0
    day = ScoredEpisode(
        kind="day",
        seed=0,
        dt=0.3,
        threshold=20.0,
        surprise=surprise,
        origin=1_780_300_800.0,  # 08:00 UTC
        stream=stream,
        attribution=np.tile(surprise[:, None], 2),
        channels=("a", "b"),
    )
    for figure, peak in ((figures.surprise_figure([day]), 1e4), (figures.stream_figure(day), -99)):
        ax = figure.axes[0]
        curve = ax.lines[0].get_ydata()
        assert peak in curve
        assert len(curve) < 5000
        assert len(ax.lines) + len(ax.patches) < 1100
        assert ax.xaxis.get_major_formatter()(1_780_304_400.0) == "09:00:00"


class _Page(HTMLParser):
    """The tags and the text of a page."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, Any]]] = []
        self.text = ""
        self.feed(source)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, Any]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data

    def all(self, tag: str) -> list[dict[str, Any]]:
        return [attributes for name, attributes in self.tags if name == tag]


def test_a_report_holds_everything_and_fetches_nothing(traces, tmp_path: Path):
    table = tabulate("Detection", CONDITION_COLUMNS, by_condition(traces, 1.0))
    drawn = {"A figure": figures_of(traces)["surprise"]}
    out = write_report(
        tmp_path / "report.html", "Lift", "First.\n\nSecond.", [table], drawn, {"seed": 0}
    )
    source = out.read_text(encoding="utf-8")
    page = _Page(source)
    assert [s["aria-label"] for s in page.all("svg")] == ["A figure"]
    assert [len(page.all(tag)) for tag in ("table", "caption", "p", "script", "link")] == [
        1,
        1,
        2,
        0,
        0,
    ]
    assert not re.search(r"https?://|@import|url\((?!#)", source)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["report.html"]  # nothing unfinished


def test_the_opening_figure_shows_when_the_guard_acts_and_stands_before_the_tables(
    traces, tmp_path: Path
):
    trace = next(t for t in traces if t.delay is not None)
    overridden = np.zeros(len(trace), np.bool_)
    overridden[25:40] = True
    figure = figures.guarded_figure(dataclasses.replace(trace, overridden=overridden))
    legend = {text.get_text() for text in figure.legends[0].get_texts()}
    assert legend == {"threshold", "fault active", "in alarm", "the guard acts"}
    table = Table("A table", ("", "b"), [("a", "b")])
    out = write_report(tmp_path / "r.html", "t", "i", [table], {}, opening={"Opening": figure})
    source = out.read_text(encoding="utf-8")
    assert source.index("Opening") < source.index("A table")


def test_whatever_is_written_is_escaped(tmp_path: Path):
    evil = '<script>alert("x")</script> $title & co'
    table = Table(evil, (evil, "b"), [(evil, evil)])
    out = write_report(tmp_path / "r.html", evil, evil, [table], {evil: Figure()}, {evil: evil})
    page = _Page(out.read_text(encoding="utf-8"))
    assert not page.all("script")
    assert page.all("svg")[0]["aria-label"] == evil
    # In <title>, <h1>, <p>, <caption>, two <th>, one <td>, <figcaption>, <dt> and <dd>.
    assert page.text.count(evil) == 10


def test_a_table_of_conditions_has_the_numbers_of_the_summary(traces):
    rows = by_condition(traces, 0.5)
    table = tabulate("", CONDITION_COLUMNS, rows)
    nominal, push, _ = (dict(zip(table.headings, row, strict=True)) for row in table.rows)
    detected = rows[1].detected
    assert (push[""], push["found"], nominal["found"]) == (
        "push",
        f"{detected.k} of {detected.n}",
        "",
    )
    assert push["delay [ms]\nmedian, 95 %"].endswith(">500")  # there are misses
    found = sum(r.detected.k for r in rows)
    assert headline(rows).startswith(
        f"{found} of 16 faults detected; {false_alarms(rows[0].watched).k} of 8 nominal"
    )
