"""Results as files: one self-contained HTML page, and a benchmark's tables and rows."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from asm_gym.evaluation.comparison import BenchmarkResult
from asm_gym.evaluation.detection_tables import (
    kept_table,
    kinds_table,
    lead_table,
    monitors_table,
    splits_table,
)
from asm_gym.evaluation.tables import Table, markdown
from asm_gym.files import write_text

FEWEST_SPACES = 3  # between the words of a sentence

_LINKED = re.compile(r"^(incidents/[0-9]+\.csv)$")  # files beside a report
_LINK = r'<a href="\1">\1</a>'

_PAGE = Template(Path(__file__).with_name("report.html").read_text(encoding="utf-8"))


def write_report(
    path: str | Path,
    title: str,
    intro: str,
    tables: Sequence[Table],
    drawn: Mapping[str, Figure],
    details: Mapping[str, object] | None = None,
    opening: Mapping[str, Figure] | None = None,
    cards: Mapping[str, Figure] | None = None,
) -> Path:
    """Write an HTML file, which appears when it is complete.

    Args:
        intro: plain text; an empty line starts a new paragraph.
        drawn: figures by caption.
        details: how to make the report again: arguments, seed, versions.
        opening: figures by caption that stand before the tables.
        cards: small figures by caption, one for each alarm.
    """
    path = Path(path)
    parts = [f"<p>{escape(p)}</p>" for p in intro.split("\n\n") if p.strip()]
    if opening:
        parts += [_figure(caption, figure) for caption, figure in opening.items()]
    if cards:
        parts.append(_figures("Alarms, the largest first", "cards", cards))
    if tables:
        parts.append("<section><h2>Results</h2>\n" + "\n".join(map(_table, tables)) + "</section>")
    if drawn:
        parts.append(_figures("Figures", "figures", drawn))
    if details:
        items = "\n".join(
            f"<dt>{escape(name)}</dt><dd>{escape(str(value))}</dd>"
            for name, value in details.items()
        )
        parts.append(f"<section><h2>How this was made</h2>\n<dl>{items}</dl></section>")
    write_text(path, _PAGE.substitute(title=escape(title), body="\n".join(parts)))
    return path


def _figures(heading: str, kind: str, drawn: Mapping[str, Figure]) -> str:
    """Return a section of figures by caption; ``kind`` is their class in the page's style."""
    shown = "\n".join(_figure(caption, figure) for caption, figure in drawn.items())
    return f'<section><h2>{heading}</h2>\n<div class="{kind}">{shown}</div></section>'


def _table(table: Table) -> str:
    """Return a table; on a narrow screen each cell stands in a line of its own, behind its heading."""
    headings = [escape(heading) for heading in table.headings]
    columns = list(zip(*table.rows, strict=True)) or [()] * len(headings)
    kinds = [' class="text"' if any(map(_is_sentence, cells)) else "" for cells in columns]
    titles = zip(kinds, headings, strict=True)
    lines = ["".join(f"<th{kind}>{heading}</th>" for kind, heading in titles)]
    for row in table.rows:
        name, *cells = (_LINKED.sub(_LINK, escape(str(cell))) for cell in row)
        named = zip(kinds[1:], headings[1:], cells, strict=True)
        values = "".join(
            f'<td{kind} data-name="{heading}">{cell}</td>' for kind, heading, cell in named
        )
        lines.append(f"<th>{name}</th>{values}")
    head, *body = (f"<tr>{line}</tr>\n" for line in lines)
    caption = f"<caption>{escape(table.caption)}</caption>"
    content = f"<thead>{head}</thead>\n<tbody>{''.join(body)}</tbody>"
    return f'<div class="scroll"><table>{caption}\n{content}</table></div>'


def _is_sentence(cell: object) -> bool:
    """Return whether a cell may break into lines, as numbers and names may not."""
    text = str(cell)
    return text.count(" ") >= FEWEST_SPACES and "±" not in text


def _figure(caption: str, figure: Figure) -> str:
    buffer = io.StringIO()
    without_date = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    # ids are the same each time, and differ between figures
    with mpl.rc_context({"svg.hashsalt": caption}):
        figure.savefig(buffer, format="svg", metadata=without_date)
    text = buffer.getvalue()
    svg = re.sub(r' xmlns(:xlink)?="[^"]*"', "", text[text.index("<svg") :])  # HTML needs none
    svg = svg.replace("<svg ", f'<svg role="img" aria-label="{escape(caption)}" ', 1)
    return f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>"


def publish(folder: Path, result: BenchmarkResult, details: Mapping[str, Any]) -> None:
    """Write ``results.md`` and ``report.html``."""
    tables = [monitors_table(result), kept_table(result), splits_table(result), kinds_table(result)]
    if len(result.monitors) > 1:
        tables.insert(1, lead_table(result))
    write_text(folder / "results.md", "\n\n".join(map(markdown, tables)) + "\n")
    intro = (
        f"{len(result.detectability)} faulty episodes, {len(result.monitors)} monitors. The ideal "
        "observer knows the healthy twin of every faulty episode and the sensors' noise: no "
        "monitor can do better than its row."
    )
    write_report(folder / "report.html", "Who notices what", intro, tables, {}, details=details)
