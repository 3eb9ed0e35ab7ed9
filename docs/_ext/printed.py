"""Above each page of results: the command that printed it, the version, and whether the code has changed since."""

from __future__ import annotations

from pathlib import Path

from pages import RESULTS, Page
from sphinx.application import Sphinx


def banner(page: Page) -> str:
    """In MyST: the command, and a warning where the code that was measured has changed."""
    command = page.meta["command"].strip("\n")
    shell = f"```sh\n{command}\n```"
    when = f"Printed by version {page.meta['version']} on {page.meta['date']}, by this command:"
    note = f":::{{admonition}} Where these figures come from\n:class: printed\n\n{when}\n\n{shell}\n:::"
    if not page.is_old:
        return note
    rooms = ", ".join(f"`{room}`" for room in page.meta["rooms"])
    stale = (
        "The code that this page measures has changed since it was printed: something in "
        f"{rooms}. The command may print other figures today."
    )
    return f":::{{warning}}\n**Stale.** {stale}\n:::\n\n{note}"


def _read(app: Sphinx, docname: str, source: list[str]) -> None:
    path = Path(app.srcdir) / f"{docname}.md"
    if path.parent != RESULTS or path.name == "index.md":
        return
    head, title, rest = source[0].partition("\n# ")
    heading, _, text = rest.partition("\n")
    source[0] = f"{head}{title}{heading}\n\n{banner(Page.read(path))}\n{text}"


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("source-read", _read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
