"""Each module can be imported first: circles that only some orders of imports meet are found."""

import subprocess
import sys
from pathlib import Path

import pytest

import psa_casadi
from tests.tiers import slow

#: What others wrote is loaded once; each of our modules is then imported in a fork of its own.
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
@pytest.mark.skipif(sys.platform == "win32", reason="os.fork of POSIX")
def test_every_module_can_be_imported_first(tmp_path: Path) -> None:
    package = Path(psa_casadi.__file__).parent
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
    (found,) = run.stdout.splitlines()  # the circle that is there, and no other
    assert found.startswith("circle_a: ImportError")
