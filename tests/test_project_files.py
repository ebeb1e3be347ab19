"""What surrounds the package is whole: workflows, README.md, and the wheel in an empty folder."""

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml  # type: ignore[import-untyped]

from build_scripts.measured_data import ROOT
from psa_casadi.version import __version__
from tests.tiers import slow

WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
#: What an installed package reads at run time, beside its modules.
DATA = (
    "psa_casadi/data/demo.csv",
    "psa_casadi/py.typed",
    "psa_casadi/report/page/page.css",
    "psa_casadi/report/page/page.js",
    "psa_casadi/report/page/live_model.js",
    "psa_casadi/examples/recipes/simulink.md",
    "psa_casadi/fmu_src/instance.c",
    "psa_casadi/fmu_src/page/page.c",
    "psa_casadi/fmu_src/windows/start.c",
    "psa_casadi/fmu_src/LICENSE",
)


def _steps(workflow: Path) -> Iterator[dict[str, Any]]:
    jobs = yaml.safe_load(workflow.read_text(encoding="utf-8"))["jobs"]
    for job in jobs.values():
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


def test_the_front_page_is_short_and_its_links_lead_somewhere() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    links = re.findall(r"\]\(([^)#\s]+)|src=\"([^\"]+)\"", text)
    paths = [a or b for a, b in links if not (a or b).startswith(("https://", "../../actions/"))]
    assert len(paths) > 20
    assert [p for p in paths if not (ROOT / p).exists()] == []
    badges = re.findall(r"\.\./\.\./actions/workflows/([\w.]+)/badge\.svg", text)
    assert set(badges) <= {w.name for w in WORKFLOWS}


@slow
def test_wheel_and_source_archive_are_whole(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "hatchling", "build", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    (source,) = tmp_path.glob("*.tar.gz")
    assert wheel.name == f"psa_casadi-{__version__}-py3-none-any.whl"
    with tarfile.open(source) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert names >= {"README.md", "docs/index.md", "docs/tutorials/ci.ipynb", "tests/conftest.py"}
    installed, empty = tmp_path / "installed", tmp_path / "empty"
    empty.mkdir()
    with zipfile.ZipFile(wheel) as archive:
        assert set(archive.namelist()) >= set(DATA)
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
            [sys.executable, "-m", "psa_casadi.cli", *command.split()],
            cwd=empty,
            env=os.environ | {"PYTHONPATH": str(installed)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    assert (empty / "van_der_pol").is_dir()
