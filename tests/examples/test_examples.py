"""Every example runs with its figures; the command prints, copies and runs them."""

import re
from pathlib import Path

import matplotlib.image
import nbformat
import numpy as np
import pytest
import yaml  # type: ignore[import-untyped]
from mkdocs.exceptions import PluginError
from nbformat import v4

import psa_casadi as psa
from build_scripts.measured_data import ROOT
from build_scripts.tutorial_pages import FOLDER, described, notebook_page
from psa_casadi.examples import use_in_casadi, van_der_pol
from psa_casadi.examples.index import examples, run_example
from tests.contract.helpers import Ended, command, refused
from tests.tiers import slow, slow_but

EXAMPLES = [e.name for e in examples().values() if e.kind == "example"]


def _slope_by_differences() -> float:
    """Return d displacement / d k_L [um per N/V] 2 ms after a step of 100 V, by two runs."""
    ends = []
    for share in (-1e-3, 1e-3):
        plant = psa.stack_model("P-885.51").plant()
        plant = plant.with_values({"k_L": (1.0 + share) * plant.values["k_L"]})
        u = np.tile([100.0, 0.0], (21, 1))
        run = psa.run(plant, np.linspace(0.0, 2e-3, 21), u, np.zeros(7), rtol=1e-10)
        ends.append(run.x[-1, plant.state_names.index("x")])
    return float(1e6 * (ends[1] - ends[0]) / (2e-3 * 7.3))


#: Between what the returned figures must lie, in their order, beyond that the example runs and
#: leaves its files. The limit cycle's amplitude is 2.0086 at mu = 1 and 2.0217 at mu = 5.
FIGURES: dict[str, list[tuple[float, float]]] = {
    "van_der_pol": [(2.0066, 2.0106), (2.0197, 2.0237)],
    "use_in_fmpy": [(14.0, 18.0), (0.1, np.inf), (0.0, 1e-5), (0.0, 0.0)],
    "use_in_casadi": [(14.0, 18.0), (0.0, np.inf), (0.0, 10.0), (0.0, 1e-5)],
    "co_simulation": [
        (0.0, np.inf), (0.0, 0.1), (0.0, 1e-3), (0.0, np.inf), (0.0, np.inf), (0.8, 1.2),
        (1.7, 2.5),
    ],
    "tracking_on_the_fmu": [(0.0, 1e-6), (40.0, 70.0), (0.0, 0.1)],
    "uncertainty_in_fmpy": [(24.0, np.inf), (20.0, np.inf), (1.0, 50.0), (0.5, 75.0)],
    "loose_load": [(28.0, 30.0), (0.0, 0.01), (0.0, 0.1), (6.5, 8.0)],
}  # fmt: skip
#: Examples that `tests/any_model` runs.
ELSEWHERE = ("motor_pack", "several_motors")


@pytest.mark.parametrize(
    "name",
    slow_but(["use_in_fmpy", "use_in_casadi"], [e for e in EXAMPLES if e not in ELSEWHERE]),
)
def test_the_example_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path.parent)
    result = run_example(name, Path(tmp_path.name))  # as `psa examples NAME -o FOLDER` is typed
    assert any(tmp_path.iterdir())
    for path in tmp_path.iterdir():
        assert path.is_dir() or path.stat().st_size > 0, path
        if path.suffix == ".png":
            assert np.std(matplotlib.image.imread(path)[..., :3]) > 0.01, path
    if name not in FIGURES:
        return
    assert isinstance(result, dict)
    for (what, value), (low, high) in zip(result.items(), FIGURES[name], strict=True):
        assert low <= value <= high, what
    if name == "use_in_casadi":
        assert list(result.values())[1] == pytest.approx(_slope_by_differences(), rel=1e-4)
    if name == "co_simulation":
        assert result["error at 2 us, with slopes [%]"] > result["error at 2 us, values held [%]"]
    if name == "uncertainty_in_fmpy":  # two ways; 20 samples determine one to a sixth
        *_, by_points, by_samples = result.values()
        assert by_samples == pytest.approx(by_points, rel=0.5)


def test_every_example_and_recipe_has_a_separate_title() -> None:
    result = examples()
    assert set(FIGURES) <= set(EXAMPLES) <= set(result)
    titles = [e.title for e in result.values()]
    assert len(set(titles)) == len(titles)
    assert all(15 < len(t) < 120 for t in titles), titles
    for name in EXAMPLES:
        assert "def main(folder: Path)" in result[name].text, name


def test_twelve_lines_make_a_model() -> None:
    """As in the title: what `model` does and the exports, the documentation left out."""
    text = examples()["van_der_pol"].text
    body = text.partition("def model()")[2].partition("\n\n\n")[0].splitlines()[2:]
    exports = [line for line in text.splitlines() if line.startswith("    psa.export_")]
    assert "ode_model" in body[1]
    assert len(body) <= 12
    assert len(exports) == 3


def test_the_imported_fmu_is_not_the_symbolic_model(tmp_path: Path) -> None:
    """Same values by the FMU of another parameter would be a comparison of a thing with itself."""
    plant = psa.stack_model("P-885.51").plant()
    fmu = psa.export_fmu(plant, tmp_path / "stack.fmu")
    f = use_in_casadi.imported(fmu, tmp_path / "unpacked")
    assert "FmuFunction" in f.class_name()
    assert "FmuFunction" not in use_in_casadi.symbolic(plant).class_name()


def _run(*words: str | Path) -> Ended:
    return command("examples", *words)


def test_the_list_names_all() -> None:
    displayed = _run()
    assert displayed.code == 0
    table, _, _ = displayed.out.rpartition("\n\n")
    head, _, *rows = re.split(r"\n(?=\S)", table)
    title = head.index("what it shows")
    for row, (name, example) in zip(rows, examples().items(), strict=True):
        assert row.split()[:2] == [name, example.kind]
        assert " ".join(line[title:] for line in row.splitlines()).split() == example.title.split()
    assert _run("--quiet").out.split() == list(examples())


def test_a_recipe_is_printed_and_copied_with_its_scripts(tmp_path: Path) -> None:
    assert _run("simulink").out == examples()["simulink"].text
    folder = tmp_path / "new" / "folder"
    assert _run("Simulink.md", "-o", str(folder)).code == 0
    assert {p.name for p in folder.iterdir()} == {"simulink.md", "run_stack.m"}
    assert "add_block" in (folder / "run_stack.m").read_text(encoding="utf-8")
    assert _run("van_der_pol", "-o", tmp_path / "script", "--copy-only").code == 0
    (copied,) = (tmp_path / "script").glob("*.py")
    compile(copied.read_text("utf-8"), str(copied), "exec")


def test_an_example_is_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def main(folder: Path) -> dict[str, float]:
        (folder / "left.txt").write_text("left", encoding="utf-8")
        return {"amplitude [m]": 2.0}

    monkeypatch.setattr(van_der_pol, "main", main)
    ran = _run("van-der-pol", "-o", str(tmp_path))
    assert ran.code == 0
    assert "amplitude [m]: 2\n" in ran.out
    assert "left.txt" in ran.out
    assert (tmp_path / "left.txt").is_file()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["openmodellica"], "did you mean openmodelica"),
        (["-o", "x"], "-o needs the name"),
        (["ci", "--copy-only"], "--copy-only needs a folder"),
    ],
)
def test_mistakes_are_named(words: list[str], sentence: str, tmp_path: Path) -> None:
    assert sentence in refused("examples", *words)
    with pytest.raises(psa.InputError, match="no example named 'ci' to run"):
        run_example("ci", tmp_path)


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
    assert len(pages) == 9


def test_a_picture_is_described_by_the_heading_above_it() -> None:
    page = "# One\n![png](a.png)\n## A step\ntext\n![png](b.png)\n![kept](c.png)\n"
    expected = page.replace("[png](a", "[Figure: One](a").replace("[png](b", "[Figure: A step](b")
    assert described(page) == expected


def _notebook(*sources: str) -> str:
    cells = [v4.new_markdown_cell("# A title\n\nWords."), *map(v4.new_code_cell, sources)]
    return str(nbformat.writes(v4.new_notebook(cells=cells)))


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
