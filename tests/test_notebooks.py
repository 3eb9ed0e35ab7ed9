"""The notebooks run from top to bottom, and are kept without what they printed."""

from __future__ import annotations

import json
from importlib.util import find_spec

import pytest

from tests.wheel import ROOT

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def cells(path):
    return [cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_is_kept_without_output(path):
    assert not any(cell["outputs"] or cell["execution_count"] for cell in cells(path))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_runs(path, tmp_path):
    if not find_spec("nbclient") or not find_spec("ipykernel"):
        pytest.skip("pip install 'asm-gym[notebooks]'")
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [str(o.get("data", "")) for c in notebook.cells if c.cell_type == "code" for o in c.outputs]
    assert any("<svg" in text for text in shown)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_the_code_of_a_notebook_runs_without_a_notebook(path, tmp_path, monkeypatch):
    if path.stem == "guard_an_agent":
        pytest.importorskip("IPython", reason="pip install 'asm-gym[notebooks]'")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "__main__"}
    for cell in cells(path):
        exec(compile("".join(cell["source"]), str(path), "exec", dont_inherit=True), names)


def test_collecting_in_a_notebook_shows_a_bar():
    if not find_spec("nbclient") or not find_spec("ipykernel") or not find_spec("ipywidgets"):
        pytest.skip("pip install 'asm-gym[notebooks]'")
    from nbclient import NotebookClient
    from nbformat.v4 import new_code_cell, new_notebook

    code = "from asm_gym import collect\nlen(collect('asm_gym/SyntheticArm-v0', 'sway', episodes=2, workers=1))"
    notebook = new_notebook(cells=[new_code_cell(code)])
    NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
    shown = [kind for output in notebook.cells[0].outputs for kind in output.get("data", {})]
    assert "application/vnd.jupyter.widget-view+json" in shown
