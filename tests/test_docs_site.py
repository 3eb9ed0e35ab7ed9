"""The documentation builds as a site, without a warning, and fetches nothing."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests import documents

docstrings = documents.tool("docstrings")
reference = documents.tool("reference")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-b", "html", "-W", "--keep-going", "-q", "-d", str(made / "trees")]
    done = subprocess.run(
        [*command, str(documents.DOCS), str(made / "html")],
        env=os.environ | {"PYTHONPATH": str(documents.ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return made / "html"


@pytest.mark.slow
def test_the_site_fetches_nothing_while_it_is_read(site: Path):
    for page in site.rglob("*.html"):
        tags = re.findall(r"<(?:script|img|iframe|source)[^>]*\bsrc=\"([^\"]*)\"", page.read_text())
        tags += re.findall(r"<link(?![^>]*rel=\"(?:canonical|author)\")[^>]*href=\"([^\"]*)\"", page.read_text())
        assert not [t for t in tags if re.match(r"(?:https?:)?//", t)], page
    for style in site.rglob("*.css"):
        assert not re.search(r"(?:url\(|@import\s+)['\"]?(?:https?:)?//", style.read_text()), style


@pytest.mark.slow
def test_equations_are_drawn_by_the_browser(site: Path):
    page = (site / "concepts.html").read_text()
    assert page.count("<math ") >= 5
    assert "\\hat" not in page
    assert "$$" not in page


@pytest.mark.slow
def test_pages_say_on_the_site_what_they_ran_and_which_are_of_the_archive(site: Path):
    pages = documents.tool("pages")
    for page in (*pages.pages(), *pages.pages(pages.ARCHIVE)):
        built = (site / page.path.relative_to(documents.DOCS).with_suffix(".html")).read_text()
        assert ("<strong>Archived:</strong>" in built) is (page.path.parent == pages.ARCHIVE), page.path
        assert f"Measured at {page.meta['commit']}; " in built
        first = page.meta["command"].split()[:2]
        assert all(word in built for word in first if "=" not in word), page.path


def test_every_room_of_the_package_has_a_page_of_reference():
    package = documents.ROOT / "asm_gym"
    rooms = {p.parent.name for p in package.glob("*/__init__.py")} - {"scripts"}
    assert rooms == set(reference.ROOMS)
    assert "asm_gym.memory.association" in list(reference.modules(package, "memory"))


def test_equations_in_docstrings_stay_as_they_are():
    lines = ["What it is, |x|.", "", "    y = |x| + 1", "", "Args:", "    x: a ``a|b`` number."]
    made = docstrings.literal_blocks(lines)
    assert made == [
        *(r"What it is, \|x\|.", "", "::", "", "    y = |x| + 1", ""),
        *("Args:", "    x: a ``a|b`` number.", ""),
    ]


def test_columns_in_docstrings_stay_as_they_are():
    made = docstrings.literal_blocks(["The detector.", "", "value      s / |q|", "           see there", "", "So."])
    assert made == [
        *("The detector.", "", "::", "", "    value      s / |q|", "               see there", ""),
        *("So.", ""),
    ]
