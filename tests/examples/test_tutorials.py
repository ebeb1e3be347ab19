"""The notebooks are kept without outputs, and their pages are made by executing them."""

import json
from pathlib import Path
from typing import Any

import nbformat
import pytest
import yaml  # type: ignore[import-untyped]
from mkdocs.exceptions import PluginError

from build_scripts.measured_data import ROOT
from build_scripts.tutorial_pages import FOLDER, described, notebook_page
from tests.tiers import slow

NOTEBOOKS = sorted((ROOT / "docs" / FOLDER).glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_is_valid_and_holds_no_outputs(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert len(code) >= 5
    assert [c.source for c in code if c.outputs or c.execution_count is not None] == []
    assert notebook.metadata.kernelspec.name == "python3"


def test_every_notebook_is_in_the_menu() -> None:
    menu = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]
    pages = next(section["Tutorials"] for section in menu if "Tutorials" in section)
    assert sorted(pages) == [f"{FOLDER}/{path.stem}.md" for path in NOTEBOOKS]
    assert len(pages) == 5


def test_a_picture_is_described_by_the_heading_above_it() -> None:
    page = "# One\n![png](a.png)\n## A step\ntext\n![png](b.png)\n![kept](c.png)\n"
    assert described(page) == (
        "# One\n![Figure: One](a.png)\n## A step\ntext\n![Figure: A step](b.png)\n![kept](c.png)\n"
    )


def _notebook(*sources: str) -> str:
    code: dict[str, Any] = {
        "cell_type": "code",
        "execution_count": None,
        "metadata": {},
        "outputs": [],
    }
    cells: list[dict[str, Any]] = [
        {"cell_type": "markdown", "metadata": {}, "source": "# A title\n\nWords."}
    ]
    cells += [code | {"source": source} for source in sources]
    for k, cell in enumerate(cells):
        cell["id"] = f"cell-{k}"
    return json.dumps({"cells": cells, "metadata": {}, "nbformat": 4, "nbformat_minor": 5})


@slow
def test_a_page_holds_what_its_cells_print_and_draw() -> None:
    drawn = "import matplotlib.pyplot as plt\nplt.plot([1, 2])\nplt.show()"
    page, pictures = notebook_page("small.ipynb", _notebook("print(6 * 7)", drawn))
    assert page.startswith("# A title\n\n*This page is a notebook: [download it](small.ipynb)")
    assert "\n    42\n" in page
    (name,) = pictures
    assert pictures[name].startswith(b"\x89PNG")
    assert f"![Figure: A title]({name})" in page


@slow
def test_a_cell_that_fails_ends_the_build() -> None:
    with pytest.raises(PluginError, match=r"broken\.ipynb does not run:\n(?s:.*)ZeroDivisionError"):
        notebook_page("broken.ipynb", _notebook("1 / 0"))
