"""Above each page of results: the command that printed it, where and when, and what has changed since."""

from __future__ import annotations

from pathlib import Path

from pages import ARCHIVE, RESULTS, Page, state
from sphinx.application import Sphinx

_NAMED = 6  # of the files that have changed


def banner(page: Page) -> str:
    """In MyST: the command, the commit, and how much of what it ran has changed; or that the page is of the archive."""
    meta = page.meta
    command = f"```sh\n{meta['command'].strip()}\n```"
    where = f" on {meta['machine']}" if "machine" in meta else " on a machine that was not noted"
    cost = f", in {meta['seconds'] / 60:.0f} min" if meta.get("seconds", 0) >= 60 else ""
    since = state(page)
    when = f"Measured at {meta['commit']}; {since}{_names(page)}.\n\n"
    when += f"Printed by version {meta['version']} on {meta['date']}{where}{cost}, by this command:"
    note = f":::{{admonition}} Where these figures come from\n:class: printed\n\n{when}\n\n{command}\n:::"
    if page.path.parent != ARCHIVE:
        return note
    older = "It is kept for what was decided by it. The [live pages](../index.md) say what holds today."
    return f":::{{warning}}\n**Archived:** this page is older, and is not printed anew. {older}\n:::\n\n{note}"


def _names(page: Page) -> str:
    changed = page.changed
    more = f" and {len(changed) - _NAMED} more" if len(changed) > _NAMED else ""
    return ": " + ", ".join(f"`{name}`" for name in changed[:_NAMED]) + more if changed else ""


def _read(app: Sphinx, docname: str, source: list[str]) -> None:
    path = Path(app.srcdir) / f"{docname}.md"
    if path.parent not in (RESULTS, ARCHIVE) or path.name == "index.md":
        return
    head, title, rest = source[0].partition("\n# ")
    heading, _, text = rest.partition("\n")
    source[0] = f"{head}{title}{heading}\n\n{banner(Page.read(path))}\n{text}"


def _outdated(app: Sphinx, *_: object) -> set[str]:
    """What has changed since is found out anew in every build, also where the page itself is as it was."""
    return {name for name in app.env.found_docs if name.startswith("results/")}


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("source-read", _read)
    app.connect("env-get-outdated", _outdated)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
