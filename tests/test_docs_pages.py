"""Pages of results: they know the command that printed them and what it ran, and git says what has changed since."""

from __future__ import annotations

import datetime
from dataclasses import replace
from pathlib import Path

import pytest

from tests import documents

pages = documents.tool("pages")
printed = documents.tool("printed")
ran = documents.tool("ran")
kept = documents.tool("kept")

FILE = "asm_gym/__init__.py"
TEXT = """---
command: echo 42
version: 0.0.1
date: 2026-01-01
commit: '0123456'
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


def test_few_pages_are_live_and_the_readme_quotes_no_other():
    live = {page.path.resolve() for page in pages.pages()}
    assert 0 < len(live) <= pages.MOST
    assert len(pages.pages(pages.ARCHIVE)) > 0
    readme = (documents.ROOT / "README.md").read_text()
    assert "docs/results/archive" not in readme


def test_every_page_of_the_archive_says_so_and_a_live_one_does_not():
    old = pages.pages(pages.ARCHIVE)[0]
    assert "**Archived:**" in printed.banner(old)
    assert old.meta["command"].split("\n")[0] in printed.banner(old)
    assert not any("Archived" in printed.banner(page) for page in pages.pages())


def test_printing_replaces_what_was_printed_and_keeps_the_text_around_it(page):
    pages.run(page).write()
    again = pages.Page.read(page.path)
    assert "Before." in again.text
    assert "After." in again.text
    assert "```text\n42\n```" in again.text
    assert "41" not in again.text
    assert again.meta["commit"] == ran.commit()
    assert again.meta["date"] == datetime.date.today()
    assert "cores" in again.meta["machine"]
    pages.run(again).write()
    assert pages.Page.read(page.path).text == again.text


def test_what_printing_cost_is_told_apart_from_how_long_it_took(page):
    page.meta["command"] = "python -c 'import time; time.sleep(2)'"
    page = pages.run(page)
    assert page.meta["seconds"] >= 2
    assert page.meta["processor"] < page.meta["seconds"]
    page.meta.update(seconds=7200, processor=3600)
    assert pages._total([page]) == "1.0 h, and 0 that were not timed yet"


def test_what_a_command_ran_is_kept_with_its_ids_from_processes_that_it_started_too(page, tmp_path):
    (tmp_path / "inner.py").write_text("import asm_gym; open('pyproject.toml').read(); open('/dev/null').read()")
    (tmp_path / "outer.py").write_text(
        f"import subprocess, sys\nsubprocess.run([sys.executable, {str(tmp_path / 'inner.py')!r}], check=True)"
    )
    page.meta["command"] = f"python {tmp_path / 'outer.py'}"
    pages.run(page).write()
    again = pages.Page.read(page.path)
    assert {FILE, "pyproject.toml"} <= set(again.files)
    assert "LICENSE" not in again.files
    assert all((documents.ROOT / name).is_file() for name in again.files)
    assert not any(name.startswith("docs/") for name in again.files)
    assert again.files[FILE] == ran.blob(documents.ROOT / FILE)
    assert ran._git("hash-object", FILE).startswith(again.files[FILE])
    assert not again.changed


def test_the_banner_counts_what_has_changed_since(page):
    files = {FILE: ran.blob(documents.ROOT / FILE), "asm_gym/gone.py": "0" * 12, "LICENSE": "1" * 12}
    banner = printed.banner(replace(page, kept={"files": files}))
    assert "Measured at 0123456; 2 of its 3 files changed since: `asm_gym/gone.py`, `LICENSE`." in banner
    assert "echo 42" in banner
    banner = printed.banner(replace(page, kept={"files": {FILE: files[FILE]}}))
    assert "none of its 1 files changed since" in banner
    assert "was not recorded" in printed.banner(page)
    assert "on a machine that was not noted" in printed.banner(page)


def test_a_file_that_was_moved_or_whose_comments_are_others_has_not_changed():
    here = documents.ROOT / FILE
    assert ran.changed({"asm_gym/elsewhere.py": ran.blob(here)}) == []
    assert ran.changed({"asm_gym/elsewhere.py": "0" * 12}) == ["asm_gym/elsewhere.py"]
    assert ran.changed({FILE: "0" * 12}) == [FILE]


def test_an_older_version_that_git_keeps_is_compared_as_code(monkeypatch):
    source = (documents.ROOT / FILE).read_bytes()
    monkeypatch.setattr(
        ran, "_content", lambda was: {"commented": source + b"# more\n", "other": source + b"x = 1\n"}[was]
    )
    assert ran.changed({FILE: "commented"}) == []
    assert ran.changed({FILE: "other"}) == [FILE]


def test_a_skeleton_is_of_code_and_not_of_what_is_said_about_it():
    first = ran.skeleton(b'"""A module."""\n\n\ndef f(x):\n    """Doubles."""\n    return 2 * x\n')
    again = b'"""The module."""\ndef f(x):\n    """Twice x."""  # so\n    return (2\n        * x)\n'
    assert ran.skeleton(again) == first
    assert ran.skeleton(b'"""A module."""\n\n\ndef f(x):\n    """Doubles."""\n    return 3 * x\n') != first
    assert ran.skeleton(b"def f(x):\n    return x * 2\n") != first
    assert ran.skeleton(b"def f(*, x=None):\n    return 2 * x\n") != ran.skeleton(b"def f(*, x):\n    return 2 * x\n")


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


def test_pages_goes_on_where_it_was_interrupted_and_passes_over_what_fails(page, tmp_path, monkeypatch, capsys):
    ran_before = replace(page, path=tmp_path / "done.md", kept={"files": {FILE: ran.blob(documents.ROOT / FILE)}})
    fails = replace(page, path=tmp_path / "fails.md", meta=page.meta | {"command": "exit 3"})
    monkeypatch.setattr(pages, "pages", lambda: [ran_before, fails, page])
    assert pages.print_all(again=False) == 1
    said = capsys.readouterr()
    assert "2 of 3 pages to print" in said.out
    assert "failed: " in said.out
    assert "exit status 3" in said.err
    assert "42" in page.path.read_text()
    assert not (tmp_path / "done.md").exists()
    assert [p.path.stem for p in pages.to_print([ran_before, fails], again=True)] == ["done", "fails"]


def test_what_a_page_reads_is_made_before_it(page, tmp_path):
    made = replace(page, path=tmp_path / "maker.md")
    reads = replace(page, path=tmp_path / "a.md", meta=page.meta | {"reads": {"runs/nowhere": "maker"}})
    assert pages.to_print([reads, made], again=False) == [made, reads]
    fresh = replace(made, kept={"files": {FILE: ran.blob(documents.ROOT / FILE)}})
    assert pages.to_print([reads, fresh], again=False) == [fresh, reads]
    there = replace(reads, meta=page.meta | {"reads": {"docs": "maker"}})
    assert pages.to_print([there, fresh], again=False) == [there]


def test_every_page_that_is_read_is_live():
    live = {page.path.stem for page in pages.pages()}
    assert {maker for page in pages.pages() for maker in page.meta.get("reads", {}).values()} <= live


def test_a_check_that_prints_something_else_makes_its_page_superseded(page, capsys):
    page.meta["check"] = "echo 'found 0.956 of 154'"
    checked = pages.checked(page)
    assert checked.kept["check"]["printed"] == "found 0.956 of 154\n"
    checked.write()
    assert pages.verify([pages.Page.read(page.path)]) == 0
    assert "holds" in capsys.readouterr().out
    checked.meta["check"] = "echo 'found 0.8 of 154'"
    assert pages.verify([checked]) == 1
    said = capsys.readouterr().out
    assert "prints something else: superseded" in said
    assert "- found 0.956 of 154\n    + found 0.8 of 154" in said
    checked.meta["check"] = "exit 3"
    assert pages.verify([checked]) == 1


def test_a_page_whose_command_was_not_watched_counts_what_its_check_runs(page):
    page.meta.update(commit="HEAD", check="python -c 'import asm_gym'")
    checked = pages.checked(page)
    assert checked.files[FILE] == ran.blob_at("HEAD", FILE)
    assert ran._git("rev-parse", f"HEAD:{FILE}").startswith(checked.files[FILE])
    assert f"of the {len(checked.files)} files that its check runs changed since" in pages.state(checked)
    gone = pages.checked(replace(page, meta=page.meta | {"commit": "0123456"}))
    assert set(gone.changed) == set(gone.files)
    watched = replace(page, kept={"files": {"LICENSE": "1" * 12}})
    assert "files" not in pages.checked(watched).kept["check"]


def test_a_page_without_a_check_is_passed_over_and_said(page, capsys):
    assert pages.verify([page]) == 0
    said = capsys.readouterr().out
    assert "nothing is kept of a check" in said
    assert "0 of 1 pages are superseded, 1 were not checked; 0 s of a core" in said


@pytest.mark.parametrize(
    ("text", "short"),
    [
        ("0.123456", "0.123"),
        ("-0.00123456", "-0.00123"),
        ("12.3456 kg", "12.3 kg"),
        ("98765 rows", "98800 rows"),
        ("154 of 1.5", "154 of 1.5"),
        ("1.000 and 12.0", "1.00 and 12.0"),
        ("1234.5", "1230"),
        ("0.0", "0.0"),
        ("panda-v0 at e1s", "panda-v0 at e1s"),
        ("┃ a ┃ 1.0 ┃\n━━━━\n  b", "a 1.0\nb"),
    ],
)
def test_numbers_are_rounded_and_frames_left_out(text, short):
    assert kept.rounded(text) == short
    assert kept.rounded(short) == short


@pytest.mark.parametrize(
    ("was", "now", "same"),
    [
        ("0.95 found", "0.91 found", True),  # 4 %
        ("0.95 found", "0.89 found", False),  # 6 %
        ("3 of 42", "4 of 42", True),  # one unit
        ("3 of 42", "5 of 42", False),
        ("a 1.0", "b 1.0", False),
        ("a 1.0", "a 1.0\nb", False),
        ("a", "a 1.0", False),
        ("0.02", "0.03", True),
        ("1.00", "0.50", False),
        ("1.0", "-1.0", False),
    ],
)
def test_a_check_may_differ_by_its_tolerance_or_by_one_unit_and_not_in_words(was, now, same):
    assert (kept.different(was, now, 0.05) == []) is same
    assert (kept.different(now, was, 0.05) == []) is same


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        (TEXT.replace("commit: '0123456'\n", ""), "lacks commit"),
        (TEXT.replace("---\n", ""), "front matter"),
        (TEXT.replace(pages.END, ""), "must stand once"),
    ],
)
def test_a_page_that_lacks_something_is_refused_with_a_reason(broken, reason, tmp_path):
    path = tmp_path / "broken.md"
    path.write_text(broken)
    with pytest.raises(ValueError, match=reason):
        pages.Page.read(path)
