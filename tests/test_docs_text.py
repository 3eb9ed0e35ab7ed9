"""README and docs: links lead somewhere, names exist, figures have a command, and sentences are short."""

from __future__ import annotations

import re
from pathlib import Path
from statistics import mean

import pytest

from tests import documents

PAGES = documents.written()
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
CODE = re.compile(r"`[^`\n]*`")
NAMED = re.compile(r"`((?:asm_gym|tests|scripts|policies|wrappers|docs)/[\w./-]*)`")
GUIDES = [documents.ROOT / "README.md", documents.DOCS / "start.md", *sorted((documents.DOCS / "guides").glob("*.md"))]
DECISIONS = [p for p in sorted((documents.DOCS / "decisions").glob("*.md")) if p.name != "index.md"]
STATUS = re.compile(r"\*\*Status:\*\* \S.* · \*\*Date:\*\* \d{4}-\d\d-\d\d · \*\*Evidence:\*\* \S")


def prose(text: str) -> list[str]:
    """Paragraphs and items of a list as plain text: no code, tables, headings, pictures, or comments."""
    text = re.sub(r"<!--.*?-->", "", documents.FENCE.sub("", text), flags=re.S)
    text = re.sub(r"^(#|\||\$\$|!\[).*$", "", text, flags=re.M)
    text = re.sub(r"^\s*(?:[-*]|\d+\.) ", "\n\n", text, flags=re.M)
    text = LINK.sub(lambda m: m[0][1:].partition("]")[0], text)
    return [" ".join(part.split()) for part in text.split("\n\n") if part.strip()]


def sentences(text: str) -> list[str]:
    return [s for part in prose(text) for s in re.split(r"(?<=[.!?:])[*_)]*\s+(?=[A-Z`*0-9\[(])", part) if s]


def anchors(path: Path) -> set[str]:
    """Of the headings of a page, as forges make them."""
    headings = re.findall(r"^#+ (.*)$", documents.FENCE.sub("", documents.body(path)), re.M)
    plain = (re.sub(r"[^\w\- ]", "", LINK.sub(lambda m: m[0], h).lower()) for h in headings)
    return {p.strip().replace(" ", "-") for p in plain}


@pytest.mark.parametrize("page", PAGES, ids=documents.name)
def test_links_within_the_repository_lead_somewhere(page: Path):
    for target in LINK.findall(CODE.sub("", documents.FENCE.sub("", documents.body(page)))):
        if re.match(r"[a-z]+:", target):
            continue
        place, _, anchor = target.partition("#")
        there = (page.parent / place).resolve() if place else page
        if re.match(r"(\.\./)*(reference/api|api|environments)/", place):  # made by a build, which checks it
            continue
        assert there.is_file(), f"{documents.name(page)}: {target}"
        assert not anchor or anchor in anchors(there), f"{documents.name(page)}: {target}; there are {anchors(there)}"


@pytest.mark.parametrize("page", PAGES, ids=documents.name)
def test_files_that_are_named_exist(page: Path):
    named = [n for n in NAMED.findall(documents.body(page)) if not n.startswith("docs/_build")]  # a build makes it
    missing = [n for n in named if not (documents.ROOT / n).exists()]
    assert not missing, f"{documents.name(page)} names {missing}"


def test_every_promise_names_tests_that_are_there():
    named = re.findall(r"`(tests/\w+\.py)(?:::(\w+))?`", (documents.ROOT / "SECURITY.md").read_text(encoding="utf-8"))
    assert len(named) > 20
    for file, test in named:
        path = documents.ROOT / file
        assert path.is_file(), file
        assert not test or re.search(rf"^(def|class) {test}\b|^{test} = ", path.read_text(encoding="utf-8"), re.M), test


def test_every_page_can_be_reached_from_the_first():
    listed = {p for page in PAGES for p in _toctree(page)}
    lost = [documents.name(p) for p in PAGES if p.is_relative_to(documents.DOCS) and p not in listed]
    assert lost == ["docs/index.md"]


def _toctree(page: Path) -> list[Path]:
    trees = re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(), re.S)
    return [(page.parent / f"{line}.md").resolve() for tree in trees for line in tree.split() if ":" not in line]


@pytest.mark.parametrize("page", GUIDES, ids=documents.name)
def test_sentences_are_short(page: Path):
    lengths = [len(s.split()) for s in sentences(documents.body(page))]
    assert mean(lengths) < 20, f"{mean(lengths):.1f} words a sentence"
    longest = max(sentences(documents.body(page)), key=lambda s: len(s.split()))
    assert max(lengths) <= 40, longest


def test_the_readme_is_short():
    assert len((documents.ROOT / "README.md").read_text().splitlines()) < 100


def test_a_cell_of_the_readme_holds_one_number():
    number = re.compile(r"(?<![\w.])[+-]?\d*\.?\d+")
    for line in (documents.ROOT / "README.md").read_text().splitlines():
        if line.startswith("| ") and "---" not in line:
            first, *cells = line.strip("| ").split(" | ")
            assert all(len(number.findall(cell)) <= 1 for cell in cells), f"{first}: {cells}"


def test_figures_in_the_readme_stand_on_the_page_that_was_printed():
    text = (documents.ROOT / "README.md").read_text()
    detection = documents.body(documents.DOCS / "results" / "detection.md")
    found = _table(text, "| monitor |")
    assert len(found) == 4
    for cells in found:
        auroc, seldom, ten, one, alarms = (c.strip("* ") for c in cells[1:])
        shares = "".join(rf".*\| {share} [|(]" for share in (seldom, ten, one))
        assert re.search(rf"\| {auroc} [|(]{shares}.*\| {alarms} of 1768 [|(]", detection), cells


def _table(text: str, head: str) -> list[list[str]]:
    lines = text[text.index(head) :].split("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines]


@pytest.mark.parametrize("page", DECISIONS, ids=documents.name)
def test_a_decision_has_a_status_a_date_and_evidence(page: Path):
    for part in documents.body(page).split("\n## ")[1:]:
        title, _, rest = part.partition("\n")
        if title != "Tried and rejected":
            assert STATUS.match(rest.strip()), f"{documents.name(page)}: {title}"


@pytest.mark.parametrize("page", DECISIONS, ids=documents.name)
def test_what_was_rejected_stands_in_one_table_a_room(page: Path):
    assert documents.body(page).count("\n## Tried and rejected\n") == 1
    assert "| tried |" in documents.body(page)


def test_nothing_says_that_association_is_free_of_backpropagation():
    code = [p for room in ("asm_gym", "policies", "wrappers", "scripts") for p in (documents.ROOT / room).rglob("*.py")]
    for path in [*PAGES, *code]:
        text = " ".join(path.read_text(encoding="utf-8").split())
        assert "no backpropagation, through time or otherwise" not in text, path
        assert "nothing but local products" not in text, path


def test_sentences_are_counted_as_they_are_read():
    text = "# A\n\nOne two. Three `x.y` four!\n\n| a | b |\n|---|---|\n\n- five six\n- seven: [eight](nine.md) ten\n"
    assert [len(s.split()) for s in sentences(text)] == [2, 3, 2, 3]
