"""What surrounds the package is whole: workflows, README.md, and the wheel in an empty folder."""

import ast
import itertools
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml  # type: ignore[import-untyped]
from packaging.requirements import Requirement

import psa_casadi as psa
from build_scripts.measured_data import ROOT
from psa_casadi.records.read.formats import READERS
from tests.contract.helpers import PSA
from tests.tiers import posix, slow

WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
#: What an installed package reads at run time, besides its modules.
DATA = (
    "data/demo.csv", "py.typed", "report/page/page.css", "report/page/page.js",
    "report/page/live_model.js", "examples/recipes/simulink.md", "fmu_src/instance.c",
    "fmu_src/page/page.c", "fmu_src/windows/start.c", "fmu_src/LICENSE",
)  # fmt: skip


def read_yaml(path: Path) -> Any:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def _steps(workflow: Path) -> Iterator[dict[str, Any]]:
    for job in read_yaml(workflow)["jobs"].values():
        yield from job["steps"]


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda p: p.stem)
def test_a_workflow_runs_what_is_there(workflow: Path) -> None:
    steps = list(_steps(workflow))
    assert steps
    for step in steps:
        assert ("run" in step) != ("uses" in step), step
        for script in re.findall(r"(?:bash|sh) (\S+)", step.get("run", "")):
            assert (ROOT / script).is_file(), script
        if "uses" in step:
            assert re.fullmatch(r"[\w-]+/[\w-]+@(v\d+|release/v\d+)", step["uses"]), step


def test_the_release_attaches_wheel_source_and_parts_list() -> None:
    commands = "\n".join(
        s.get("run", "") for s in _steps(ROOT / ".github" / "workflows" / "release.yml")
    )
    for command in ("hatchling build", "cyclonedx_py environment", "gh release create"):
        assert command in commands


@slow
def test_wheel_and_source_archive_are_whole(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "hatchling", "build", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    (source,) = tmp_path.glob("*.tar.gz")
    assert wheel.name == f"psa_casadi-{psa.__version__}-py3-none-any.whl"
    with tarfile.open(source) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert names >= {"README.md", "docs/index.md", "docs/tutorials/ci.ipynb", "tests/conftest.py"}
    installed, empty = tmp_path / "installed", tmp_path / "empty"
    empty.mkdir()
    with zipfile.ZipFile(wheel) as archive:
        assert set(archive.namelist()) >= {f"psa_casadi/{place}" for place in DATA}
        modules = {p.relative_to(ROOT).as_posix() for p in (ROOT / "psa_casadi").rglob("*.py")}
        assert set(archive.namelist()) >= modules
        archive.extractall(installed)
    for command in (
        "effects slow_creep --figure creep.png",
        "export fmu --stack P-885.51 -o stack.fmu",
        "check stack.fmu",
        "examples van_der_pol -o van_der_pol",
    ):
        done = subprocess.run(
            [*PSA, *command.split()], cwd=empty, env=os.environ | {"PYTHONPATH": str(installed)},
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
    assert (empty / "van_der_pol").is_dir()


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
CORE = [Requirement(text) for text in PROJECT["dependencies"]]
EXTRAS = {
    extra: [Requirement(text) for text in texts]
    for extra, texts in PROJECT["optional-dependencies"].items()
}
#: The package is parsed once: with pytest-xdist by one process.
pytestmark = pytest.mark.xdist_group("dependencies")

#: The parts of a statement that hold statements.
_PARTS = ("body", "orelse", "finalbody", "handlers", "cases")
#: The extras that a file format needs.
FORMATS = ("parquet", "tdms", "uff")
CLASSIFIED = [
    c.removeprefix("Programming Language :: Python :: ")
    for c in PROJECT["classifiers"]
    if c.startswith("Programming Language :: Python :: 3.")
]


def test_the_conda_recipe_and_the_metadata_are_those_of_the_package() -> None:
    recipe = read_yaml(ROOT / "build_scripts" / "conda" / "recipe.yaml")
    needs = {r.replace("-base", "").replace(" ", "") for r in recipe["requirements"]["run"]}
    assert needs == {str(r) for r in CORE if r.marker is None} | {
        f"python{PROJECT['requires-python']}"
    }
    versions = {recipe["context"]["version"]}
    versions |= {read_yaml(ROOT / f)["version"] for f in ("CITATION.cff", "codemeta.json")}
    assert versions == {psa.__version__}


@cache
def _trees() -> dict[Path, ast.Module]:
    paths = sorted((ROOT / "psa_casadi").rglob("*.py"))
    return {path: ast.parse(path.read_bytes()) for path in paths}


def _imports(node: ast.AST, *, inside: bool = False) -> Iterator[tuple[str, bool]]:
    """Yield the top package of every import below a node, and whether a function makes it."""
    for child in itertools.chain.from_iterable(getattr(node, part, ()) for part in _PARTS):
        if isinstance(child, ast.Import):
            yield from ((alias.name.split(".")[0], inside) for alias in child.names)
        elif isinstance(child, ast.ImportFrom) and child.module and not child.level:
            yield child.module.split(".")[0], inside
        else:
            function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
            yield from _imports(child, inside=inside or function)


@cache
def _third_party() -> frozenset[tuple[Path, str, bool]]:
    """Return file, package and whether a function imports it, of what is neither ours nor Python's.

    Each package here is imported under the name that it is installed by, in lower case.
    """
    ours = {*sys.stdlib_module_names, "psa_casadi"}
    return frozenset(
        (path, name, inside)
        for path, tree in _trees().items()
        for name, inside in _imports(tree)
        if name not in ours
    )


@pytest.mark.parametrize("extra", ["", *EXTRAS])
def test_every_requirement_has_a_lower_bound(extra: str) -> None:
    for requirement in EXTRAS[extra] if extra else CORE:
        bounds = [s for s in requirement.specifier if s.operator == ">="]
        assert len(bounds) == (0 if requirement.name == PROJECT["name"] else 1), str(requirement)


def test_what_is_imported_is_what_is_required() -> None:
    optional = {r.name.lower() for extra in (*FORMATS, "check") for r in EXTRAS[extra]}
    imported = {name for _, name, _ in _third_party()}
    assert imported - optional == {r.name.replace("-", "_") for r in CORE}
    assert optional <= imported


@pytest.mark.parametrize("extra", FORMATS)
def test_an_optional_package_is_imported_where_it_is_used(extra: str) -> None:
    names = {r.name.lower() for r in EXTRAS[extra]}
    users = {(path, inside) for path, name, inside in _third_party() if name in names}
    assert users
    for path, inside in users:
        assert inside, f"{path} imports one of {names} when it is loaded"
    assert names <= {package for _, package, _ in READERS.values()}


def test_the_developers_install_has_every_extra() -> None:
    (whole,) = [r for r in EXTRAS["dev"] if r.name == PROJECT["name"]]
    assert whole.extras == EXTRAS.keys() - {"dev", "gpu"}  # which is large, and for one system


def test_the_workflow_runs_every_python_that_is_promised() -> None:
    jobs = read_yaml(ROOT / ".github" / "workflows" / "check.yml")["jobs"]
    assert jobs["quick"]["strategy"]["matrix"]["python"] == CLASSIFIED
    assert PROJECT["requires-python"] == f">={CLASSIFIED[0]}"
    lowest = jobs["lowest"]["strategy"]["matrix"]["python"]
    assert lowest == [CLASSIFIED[0], CLASSIFIED[-1]]


#: What others wrote is loaded once; each of our modules is then imported in a separate fork.
SCRIPT = """
import importlib, os, sys
import casadi, fmpy, h5py, msgspec, numpy, pint, scipy, typer
for name in sys.argv[1:]:
    if os.fork() == 0:
        try:
            importlib.import_module(name)
        except BaseException as error:
            print(f"{name}: {error!r}", flush=True)
        os._exit(0)
    os.wait()
"""


@slow
@posix
def test_every_module_can_be_imported_first(tmp_path: Path) -> None:
    package = Path(psa.__file__).parent
    names = [
        ".".join(path.relative_to(package.parent).with_suffix("").parts).removesuffix(".__init__")
        for path in sorted(package.rglob("*.py"))
        if path.name != "__main__.py"
    ]
    assert len(names) > 100
    (tmp_path / "circle_a.py").write_text("import circle_b\nvalue = circle_b.value\n")
    (tmp_path / "circle_b.py").write_text("from circle_a import value\n")
    run = subprocess.run(
        [sys.executable, "-c", SCRIPT, "circle_a", *names],
        capture_output=True, text=True, check=True, cwd=tmp_path,
    )  # fmt: skip
    (result,) = run.stdout.splitlines()  # the circle that is there, and no other
    assert result.startswith("circle_a: ImportError")
