"""Pages of results: they know the command that printed them, and say so where the code they measured has changed."""

from __future__ import annotations

import datetime
from pathlib import Path

import pytest

from tests import documents

pages = documents.tool("pages")
printed = documents.tool("printed")

TEXT = """---
command: echo 42
rooms: [spec.py]
version: 0.0.1
date: 2026-01-01
code: unrecorded
---
# A figure

Before.

<!-- printed by the command above: edits are lost -->

41

<!-- end of what was printed -->

After.
"""


@pytest.fixture
def page(tmp_path: Path):
    path = tmp_path / "figure.md"
    path.write_text(TEXT)
    return pages.Page.read(path)


def test_a_page_older_than_the_code_it_measures_says_so():
    silent = [p.path.name for p in pages.pages() if p.is_old and not p.says_so]
    assert not silent, f"the code that these pages measure has changed: run `make stale`, or `make page` for {silent}"
    shy = [p.path.name for p in pages.pages() if p.says_so and not p.is_old]
    assert not shy, f"these pages are not stale any more: run `make stale` for {shy}"


def test_a_stale_page_carries_a_banner_and_a_fresh_one_only_its_command(page):
    old, fresh = printed.banner(page), printed.banner(page.printed_anew("42"))
    assert "**Stale.**" in old
    assert "`spec.py`" in old
    assert "Stale" not in fresh
    assert "echo 42" in old
    assert "echo 42" in fresh


def test_printing_replaces_what_was_printed_and_keeps_the_text_around_it(page):
    new = pages.run(page)
    new.write()
    again = pages.Page.read(page.path)
    assert "Before." in again.text
    assert "After." in again.text
    assert "```text\n42\n```" in again.text
    assert "41" not in again.text
    assert again.meta["code"] == pages.digest(["spec.py"])
    assert again.meta["date"] == datetime.date.today()
    assert not again.is_old
    assert not again.says_so


def test_what_a_command_leaves_in_a_file_is_taken_from_there(page, tmp_path):
    table = tmp_path / "table.md"
    page.meta.update(command=f"echo '| a |' > {table}", printed=str(table))
    text = pages.run(page).text
    assert "| a |" in text
    assert "```" not in text


def test_a_command_that_fails_leaves_the_page_as_it_was(page):
    page.meta["command"] = "exit 3"
    with pytest.raises(Exception, match="exit status 3"):
        pages.run(page)
    assert page.path.read_text() == TEXT


def test_a_mark_comes_and_goes_with_the_code(page):
    assert page.marked().says_so
    page.meta.update(code=pages.digest(["spec.py"]), stale=True)
    assert not page.marked().says_so


def test_a_digest_is_of_code_and_not_of_what_is_said_about_it(tmp_path):
    module = tmp_path / "room" / "module.py"
    module.parent.mkdir()

    def digest(text: str) -> str:
        module.write_text(text)
        return pages.digest(["room"], tmp_path)

    first = digest('"""A module."""\n\n\ndef f(x):\n    """Doubles."""\n    return 2 * x\n')
    assert digest('"""The module."""\ndef f(x):\n    """Twice x."""  # so\n    return (2\n        * x)\n') == first
    assert digest('"""A module."""\n\n\ndef f(x):\n    """Doubles."""\n    return 3 * x\n') != first
    assert digest("def f(x):\n    return x * 2\n") != first
    assert digest("def f(*, x=None):\n    return 2 * x\n") != digest("def f(*, x):\n    return 2 * x\n")


def test_a_digest_of_what_does_not_exist_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="attic"):
        pages.digest(["attic"], tmp_path)


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        (TEXT.replace("code: unrecorded\n", ""), "lacks code"),
        (TEXT.replace("---\n", ""), "front matter"),
        (TEXT.replace(pages.END, ""), "must stand once"),
    ],
)
def test_a_page_that_lacks_something_is_refused_with_a_reason(broken, reason, tmp_path):
    path = tmp_path / "broken.md"
    path.write_text(broken)
    with pytest.raises(ValueError, match=reason):
        pages.Page.read(path)
