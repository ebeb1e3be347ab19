"""What pyproject.toml says of other packages, against the imports and the workflow."""

import ast
import itertools
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
import yaml  # type: ignore[import-untyped]
from packaging.requirements import Requirement

from psa_casadi.records.read.formats import READERS

ROOT = Path(__file__).resolve().parent.parent
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
#: And those of other optional packages.
OTHERS = ("check",)
CLASSIFIED = [
    c.removeprefix("Programming Language :: Python :: ")
    for c in PROJECT["classifiers"]
    if c.startswith("Programming Language :: Python :: 3.")
]


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
    own = {*sys.stdlib_module_names, "psa_casadi"}
    return frozenset(
        (path, name, inside)
        for path, tree in _trees().items()
        for name, inside in _imports(tree)
        if name not in own
    )


@pytest.mark.parametrize("extra", ["", *EXTRAS])
def test_every_requirement_has_a_lower_bound(extra: str) -> None:
    found = EXTRAS[extra] if extra else CORE
    assert found
    for requirement in found:
        bounds = [s for s in requirement.specifier if s.operator == ">="]
        assert len(bounds) == (0 if requirement.name == PROJECT["name"] else 1), str(requirement)


def test_what_is_imported_is_what_is_required() -> None:
    optional = {r.name.lower() for extra in (*FORMATS, *OTHERS) for r in EXTRAS[extra]}
    imported = {name for _, name, _ in _third_party()}
    assert imported - optional == {r.name.replace("-", "_") for r in CORE}
    assert optional <= imported


@pytest.mark.parametrize("extra", FORMATS)
def test_an_optional_package_is_asked_for_in_a_sentence(extra: str) -> None:
    names = {r.name.lower() for r in EXTRAS[extra]}
    users = {(path, inside) for path, name, inside in _third_party() if name in names}
    assert users
    for path, inside in users:
        assert inside, f"{path} imports one of {names} when it is loaded"
    assert names <= {package for _, package, _ in READERS.values()}


def test_the_developers_install_has_every_extra() -> None:
    (own,) = [r for r in EXTRAS["dev"] if r.name == PROJECT["name"]]
    assert own.extras == EXTRAS.keys() - {"dev", "gpu"}  # which is large, and for one system


def test_the_workflow_runs_every_python_that_is_promised() -> None:
    text = (ROOT / ".github" / "workflows" / "check.yml").read_text(encoding="utf-8")
    jobs = yaml.safe_load(text)["jobs"]
    assert jobs["quick"]["strategy"]["matrix"]["python"] == CLASSIFIED
    assert PROJECT["requires-python"] == f">={CLASSIFIED[0]}"
    lowest = jobs["lowest"]["strategy"]["matrix"]["python"]
    assert lowest == [CLASSIFIED[0], CLASSIFIED[-1]]
