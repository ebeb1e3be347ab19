"""FMUs that another version of CasADi made: the check knows them, and what was changed in them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import pytest

from psa_casadi.export.check.check import CheckRow, check_fmu
from psa_casadi.export.fmu import sources
from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.simulation.compiler import c_code, generate_c
from tests.fmu_models import model_named, rewritten
from tests.tiers import slow_but

STACK = "P-885.51"
XML = "modelDescription.xml"
NOW = ca.CasadiMeta.version()


def _as_another_writes(text: str) -> str:
    """What differs from CasADi 3.8.0 to 3.8.2, and names of variables, which may come to differ."""
    return text.replace(f"CasADi {NOW}", "CasADi 3.7.9").replace("a0", "b0") + "/* no version */\n"


@pytest.fixture(scope="module")
def older(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An FMU whose C another CasADi generated; what is tried here needs no binary."""
    generate, derivatives = generate_c, c_code

    def generated(*args: Any, **options: Any) -> dict[str, str]:
        return {n: _as_another_writes(t) for n, t in generate(*args, **options).items()}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sources, "generate_c", generated)
        patch.setattr(sources, "c_code", lambda *args: _as_another_writes(derivatives(*args)))
        patch.setattr("psa_casadi.export.fmu.archive.compile_library", lambda *_: b"no binary")
        return export_fmu(model_named(STACK), tmp_path_factory.mktemp("fmu") / "older.fmu")


def _reproducible(path: Path) -> CheckRow:
    return next(row for row in check_fmu(path).rows if row.name == "reproducible")


@pytest.mark.usefixtures("code_runs_here")
def test_an_export_of_another_casadi_is_reproducible(older: Path) -> None:
    row = _reproducible(older)
    assert row.passed, row.remark
    assert "CasADi 3.7.9" in row.remark
    assert f"CasADi {NOW}" in row.remark


#: What is changed in it, and what the row says then.
CHANGES: dict[str, tuple[str, Callable[[bytes], bytes], str]] = {
    "equation": ("sources/model.c", lambda t: t.replace(b"b0", b"c0", 1), "the token is"),
    "version": ("sources/model.c", lambda t: t.replace(b"3.7.9", NOW.encode()), "model.c differs"),
    "start value": ("sources/fmi_data.c", lambda t: t + b"\n", "fmi_data.c differs"),
    "solver": ("sources/solver.c", lambda t: t + b"\n", "solver.c differs"),
    "bound": (XML, lambda t: t.replace(b'min="', b'min="-', 1), f"{XML} differs"),
}


@pytest.mark.usefixtures("code_runs_here")
@pytest.mark.parametrize("change", slow_but(["equation", "start value"], CHANGES))
def test_a_change_of_it_is_found(change: str, older: Path, tmp_path: Path) -> None:
    place, edit, said = CHANGES[change]
    row = _reproducible(rewritten(older, tmp_path / "changed.fmu", {place: edit}))
    assert not row.passed
    assert said in row.remark
