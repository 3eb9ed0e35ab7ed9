"""The report, its figures and its film, read back from the files and the figures' own artists."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from asm_gym.evaluation import figures
from asm_gym.evaluation.detection_tables import detection_table, headline, outcome_table
from asm_gym.evaluation.film import write_gif, write_video
from asm_gym.evaluation.metrics import by_condition, false_alarms, time_matched_auroc
from asm_gym.evaluation.report import write_json, write_report
from asm_gym.evaluation.scored_episode import InterventionOutcome, ScoredEpisode, TraceDetail, moments_of
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.tables import Column, Table, tabulate


def a_trace(condition: str, seed: int, acting: str = "policy alone") -> ScoredEpisode:
    """60 steps of 0.05 s; faults begin at step 20 and are seen, or not, as chance has it."""
    rng = np.random.default_rng([seed, len(condition)])
    surprise = rng.gamma(3.0, 2.0, 60)
    fault = np.zeros(60, np.bool_)
    if condition != "nominal":
        fault[20:40] = True
        surprise[20 + rng.integers(8) : 40] += 30 * rng.random()
    attribution = rng.dirichlet(np.ones(20), 60) * surprise[:, None]
    channels = tuple(f"joint_position[{i}]" for i in range(20))
    return ScoredEpisode(
        condition, seed, 0.05, 20.0, surprise, 20 if fault.any() else None, acting=acting,
        outcome=InterventionOutcome(True, False, 10 * rng.random()), detail=TraceDetail(attribution, channels, fault),
    ).attributed(attribution, channels)  # fmt: skip


@pytest.fixture(scope="module")
def traces() -> list[ScoredEpisode]:
    names = ("nominal", "push", "weak joint")
    return [a_trace(c, s, a) for c in names for s in range(8) for a in ("policy alone", "hold")]


def figures_of(traces: list[ScoredEpisode]) -> dict[str, Figure]:
    faulty = next(t for t in traces if t.delay is not None)
    return {
        "surprise": figures.surprise_figure([traces[0], faulty]),
        "delay": figures.delay_figure(by_condition(traces, 1.0)),
        "roc": figures.roc_figure(by_condition(traces, 1.0)),
        "attribution": figures.attribution_figure(faulty),
        "maxima": figures.maxima_figure(by_condition(traces, 1.0)),
    }


def test_figures_are_the_same_bytes_each_time_whatever_the_users_style(traces: list[ScoredEpisode], tmp_path: Path):
    before = {name: figures.save(f, tmp_path / f"{name}.png").read_bytes() for name, f in figures_of(traces).items()}
    with mpl.rc_context({"axes.facecolor": "red", "font.size": 30, "axes.labelsize": 30, "ytick.direction": "in"}):
        again = figures_of(traces)
    for name, figure in again.items():
        assert figures.save(figure, tmp_path / "again.png").read_bytes() == before[name], name


def test_figures_leave_pyplot_and_the_users_style_alone(traces: list[ScoredEpisode]):
    with mpl.rc_context({"font.size": 17.0}):
        figures_of(traces)
        assert mpl.rcParams["font.size"] == 17.0
    assert plt.get_fignums() == []


def test_the_roc_curve_encloses_the_auroc_it_names(traces: list[ScoredEpisode]):
    ax = figures.roc_figure(by_condition(traces, 1.0)).axes[0]
    alone = [t for t in traces if t.watched_only]
    nominal = [t for t in alone if t.condition == "nominal"]
    for line, condition in zip(ax.lines[1:], ("push", "weak joint"), strict=True):
        x, y = (np.asarray(v, float) / 100 for v in line.get_data())
        area = float(np.sum(np.diff(x) * y[:-1]))  # steps hold their value to the right
        auroc = time_matched_auroc([t for t in alone if t.condition == condition], nominal, 1.0)
        assert area == pytest.approx(auroc)
        assert line.get_label() == f"{condition}: {auroc:.3f}"


def test_the_delay_curve_ends_at_the_share_detected_in_the_window(traces: list[ScoredEpisode]):
    ax = figures.delay_figure(by_condition(traces, 0.5)).axes[0]
    rows = [r for r in by_condition(traces, 0.5) if r.name != "nominal"]
    assert any(0 < r.detected.value < 1 for r in rows)
    for line, row in zip(ax.lines, rows, strict=True):
        x, y = line.get_data()
        assert x[-1] == 500.0
        assert y[-1] == pytest.approx(100 * row.detected.value)


def test_curves_differ_in_colour_and_in_line(traces: list[ScoredEpisode]):
    lines = figures.delay_figure(by_condition(traces, 1.0)).axes[0].lines
    assert len({line.get_color() for line in lines}) == 2
    assert len({str(line._dash_pattern) for line in lines}) == 2


def test_infinite_and_zero_surprise_can_be_drawn(traces: list[ScoredEpisode], tmp_path: Path):
    good = next(t for t in traces if t.delay is not None)
    surprise = good.surprise.copy()
    surprise[:5], surprise[30:] = 0.0, np.inf
    attribution = good.detail.attribution.copy()
    attribution[30:] = np.inf
    detail = dataclasses.replace(good.detail, attribution=attribution)
    broken = dataclasses.replace(good, surprise=surprise, detail=detail)
    for name, figure in figures_of([broken, *(t for t in traces if t.condition == "nominal")]).items():
        assert figures.save(figure, tmp_path / f"{name}.png").stat().st_size > 5000


def test_attribution_shows_the_channels_with_the_greatest_share_first(traces: list[ScoredEpisode]):
    trace = next(t for t in traces if t.delay is not None)
    labels = [text.get_text() for text in figures.attribution_figure(trace, top=3).axes[0].get_yticklabels()]
    peaks = trace.detail.attribution[20:].max(axis=0)
    assert labels == [trace.detail.channels[i] for i in np.argsort(-peaks)[:3]]


def test_a_strip_shows_how_each_alarm_began_and_the_channel_that_raised_it():
    surprise, attribution = np.ones(100), np.ones((100, 2))
    surprise[[20, 21, 60]] = 30.0, 50.0, np.inf
    attribution[20], attribution[21] = (10.0, 20.0), (40.0, 10.0)  # the other one follows, and surprises more
    stream = np.arange(200.0).reshape(100, 2)
    detail = TraceDetail(attribution, ("q", "torque"), np.zeros(100, np.bool_), stream)
    trace = ScoredEpisode("log.csv", 0, 0.01, 20.0, surprise, detail=detail)
    moments = moments_of(trace)
    assert [(m.start, m.stop, m.channel, m.excess) for m in moments] == [(20, 22, 1, 2.5), (60, 61, 0, np.inf)]
    first, second, third = figures.moments_figure(moments).axes
    assert first.get_title(loc="left") == "torque, 0.21 s, 2.5×"
    np.testing.assert_array_equal(first.lines[0].get_ydata(), stream[:71, 1])
    assert first.lines[1].get_xdata()[0] == pytest.approx(0.21)
    assert second.get_title(loc="left") == "q, 0.61 s, inf×"
    assert not third.get_visible()
    with pytest.raises(ValueError, match="without the detail"):
        moments_of(dataclasses.replace(trace, detail=None))


def test_the_stream_is_shown_beside_its_twin_and_the_most_surprising_channel_first(traces: list[ScoredEpisode]):
    trace = next(t for t in traces if t.delay is not None)
    rng = np.random.default_rng(0)
    stream, twin = rng.normal(size=(2, len(trace), len(trace.detail.channels)))
    axes = figures.stream_figure(
        dataclasses.replace(trace, detail=dataclasses.replace(trace.detail, stream=stream, twin=twin)), top=2
    ).axes
    peaks = trace.detail.attribution[trace.onset :].max(axis=0)
    order = np.argsort(-peaks)[:2]
    assert [ax.get_title(loc="left") for ax in axes] == [trace.detail.channels[i] for i in order]
    healthy, sensed = (line.get_ydata() for line in axes[0].lines[:2])
    np.testing.assert_array_equal(healthy, twin[:, order[0]])
    np.testing.assert_array_equal(sensed, stream[:, order[0]])
    with pytest.raises(ValueError, match="without its stream"):
        figures.stream_figure(trace)
    with pytest.raises(ValueError, match="without the detail"):
        figures.stream_figure(dataclasses.replace(trace, detail=None))


def test_nothing_to_draw_is_an_error(traces: list[ScoredEpisode]):
    with pytest.raises(ValueError, match="no traces to draw"):
        figures.surprise_figure([])
    with pytest.raises(ValueError, match="needs nominal traces"):
        figures.roc_figure(by_condition([t for t in traces if t.condition == "push"], 1.0))


class _Page(HTMLParser):
    """What a page holds: its text, its tags with their attributes, and its cells."""

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


def test_a_report_holds_everything_and_fetches_nothing(traces: list[ScoredEpisode], tmp_path: Path):
    rows = by_condition(traces, 1.0)
    drawn = figures_of(traces)
    saved = figures.save(drawn["roc"], tmp_path / "roc.png")
    frames = [np.full((32, 48, 3), i, np.uint8) for i in range(5)]
    film = write_video(tmp_path / "film.mp4", frames, fps=20)
    out = write_report(
        tmp_path / "report.html", "Lift", "First.\n\nSecond.",
        [detection_table(rows), outcome_table(rows)],
        {"As a figure": drawn["maxima"], "As a file": saved}, film, {"seed": 0},
    )  # fmt: skip
    source = out.read_text(encoding="utf-8")
    page = _Page(source)

    images = page.all("img")
    assert [i["alt"] for i in images] == ["As a file"]
    assert [s["aria-label"] for s in page.all("svg")] == ["As a figure"]
    assert base64.b64decode(images[0]["src"].removeprefix("data:image/png;base64,")) == saved.read_bytes()
    assert base64.b64decode(page.all("video")[0]["src"].removeprefix("data:video/mp4;base64,")) == film.read_bytes()
    assert len(page.all("table")) == len(page.all("caption")) == 2
    assert {a.get("scope") for a in page.all("th")} == {"col", "row"}
    assert len(page.all("p")) == 2
    assert not page.all("script")
    assert not page.all("link")
    assert not re.search(r"https?://|@import|url\((?!#)", source)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["film.mp4", "report.html", "roc.png"]  # nothing unfinished


def test_a_figure_says_its_numbers_under_the_pointer(traces: list[ScoredEpisode], tmp_path: Path):
    trace = traces[0]
    write_report(tmp_path / "r.html", "A", "", [], {"Seen": figures.surprise_figure([trace])})
    said = re.findall(
        r"<title>([\d.]+) s: surprise ([\d.e+-]+), threshold 20(, in alarm)?<", (tmp_path / "r.html").read_text()
    )
    assert [float(s) for _, s, _ in said] == pytest.approx(list(trace.surprise), rel=5e-3)
    assert [bool(a) for _, _, a in said] == trace.alarm.tolist()
    assert float(said[-1][0]) == pytest.approx(len(trace) * trace.dt)


def test_whatever_is_written_is_escaped(tmp_path: Path):
    evil = '<script>alert("x")</script> $title & co'
    table = Table(evil, (evil, "b"), [(evil, evil)])
    out = write_report(tmp_path / "r.html", evil, evil, [table], {evil: Figure()}, None, {evil: evil})
    page = _Page(out.read_text(encoding="utf-8"))
    assert not page.all("script")
    assert page.all("svg")[0]["aria-label"] == evil
    # In <title>, <h1>, <p>, <caption>, two <th>, one <td>, <figcaption>, <dt> and <dd>.
    assert page.text.count(evil) == 10


def test_a_report_that_fails_leaves_the_last_one(tmp_path: Path):
    out = write_report(tmp_path / "r.html", "Good", "", [], {})
    before = out.read_bytes()
    with pytest.raises(FileNotFoundError):
        write_report(out, "Bad", "", [], {"gone": tmp_path / "gone.png"})
    assert out.read_bytes() == before


def test_a_row_must_have_as_many_cells_as_there_are_headings():
    with pytest.raises(ValueError, match="the table has 2 columns, but a row of 1"):
        Table("t", ("a", "b"), [("x",)])


def test_a_new_column_is_a_heading_and_a_function():
    table = tabulate("numbers", (Column("n", str), Column("squared", lambda n: f"{n * n:d}")), [2, 3])
    assert (table.headings, table.rows) == (["n", "squared"], [("2", "4"), ("3", "9")])


def test_tables_say_what_the_summary_says(traces: list[ScoredEpisode]):
    rows = by_condition(traces, 0.5)
    push = rows[1]
    cells = dict(zip(*((t := detection_table(rows)).headings, t.rows[1]), strict=True))
    low, high = (round(100 * x) for x in push.detected.interval)
    assert cells["Condition"] == "push"
    assert cells["Detected"] == f"{push.detected.k} of 8 ({low}–{high} %)"
    assert cells["AUROC"] == f"{push.auroc:.2f}"
    assert cells["95th percentile [ms]"] == "> 500"  # there are misses
    assert detection_table(rows).rows[0][3] == ""  # a nominal episode has nothing to detect
    assert [row[:2] for row in outcome_table(rows).rows][:2] == [("nominal", "policy alone"), ("nominal", "hold")]
    found = sum(r.detected.k for r in rows)
    assert headline(rows).startswith(f"{found} of 16 faults detected; {false_alarms(rows[0].watched).k} of 8 nominal")


def test_a_video_reads_back_with_its_frames_rate_and_colours(tmp_path: Path):
    colours = ((200, 30, 30), (30, 200, 30), (30, 30, 200))
    frames = [np.broadcast_to(np.array(c, np.uint8), (33, 47, 3)).copy() for c in colours]
    path = write_video(tmp_path / "v.mp4", frames, fps=10)
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    back = [np.frombuffer(f, np.uint8).reshape(34, 48, 3) for f in reader]  # padded to even sides
    assert meta["codec"] == "h264"
    assert meta["pix_fmt"].startswith("yuv420p")
    assert meta["fps"] == 10
    assert len(back) == 3
    for frame, colour in zip(back, colours, strict=True):
        assert np.abs(frame.reshape(-1, 3).mean(axis=0) - colour).max() < 12
    assert path.read_bytes().index(b"moov") < path.read_bytes().index(b"mdat")  # plays before it is all there


def test_a_gif_reads_back_with_its_frames_rate_and_colours(tmp_path: Path):
    frames = [np.zeros((30, 40, 3), np.uint8) for _ in range(3)]
    for k, frame in enumerate(frames):
        frame[:, : 10 * (k + 1)] = (200, 30, 30)
    with Image.open(write_gif(tmp_path / "v.gif", frames, fps=20)) as back:
        assert (back.size, back.n_frames, back.info["loop"]) == ((40, 30), 3, 0)
        for k, frame in enumerate(frames):
            back.seek(k)
            assert back.info["duration"] == 50  # [ms]
            np.testing.assert_array_equal(np.asarray(back.convert("RGB")), frame)


def test_a_video_that_fails_leaves_nothing_behind(tmp_path: Path):
    with pytest.raises(ValueError, match="at least one frame"):
        write_video(tmp_path / "v.mp4", [], fps=10)
    with pytest.raises(ValueError, match=r"all frames must have the shape \(32, 32, 3\), got \(16, 32, 3\)"):
        write_video(tmp_path / "v.mp4", [np.zeros((32, 32, 3), np.uint8), np.zeros((16, 32, 3), np.uint8)], fps=10)
    with pytest.raises(ValueError, match=r"a frame must be \(H, W, 3\) uint8"):
        write_video(tmp_path / "v.mp4", [np.zeros((32, 32), np.uint8)], fps=10)
    assert list(tmp_path.iterdir()) == []


def test_a_delay_that_never_ended_is_null_in_json(tmp_path):
    write_json(tmp_path / "new" / "x.json", {"delay": [np.inf, 2.0], "share": Share(1, 4), "none": np.nan})
    found = json.loads((tmp_path / "new" / "x.json").read_text())
    assert found == {"delay": [None, 2.0], "share": {"k": 1, "n": 4}, "none": None}
