"""FMUs broken in one way each: the check must find every one, and name it."""

import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from psa_casadi.errors import InputError
from psa_casadi.export.check import CheckReport, check_fmu
from psa_casadi.export.platforms import compile_library, host_platform
from tests.fmu_models import exported, model_named, rewritten

STACK = "P-885.51"
XML = "modelDescription.xml"


def _failures(report: CheckReport) -> dict[str, str]:
    return {row.name: row.remark for row in report.failures}


def _edit(old: str, new: str) -> Callable[[bytes], bytes]:
    return lambda content: content.replace(old.encode(), new.encode(), 1)


def _recompiled(source: Path, target: Path, file: str, old: str, new: str) -> Path:
    """Change one source file, compile all, and put the binary in place."""
    with zipfile.ZipFile(source) as archive:
        texts = {
            n.removeprefix("sources/"): archive.read(n).decode()
            for n in archive.namelist()
            if n.startswith("sources/")
        }
        binary = next(n for n in archive.namelist() if n.startswith("binaries/"))
    if old not in texts[file]:
        raise ValueError(f"{file} has no '{old}'")
    texts[file] = texts[file].replace(old, new, 1)
    library = compile_library(texts, "psa", host_platform())
    return rewritten(source, target, {binary: lambda _: library})


def test_token_mismatch(tmp_path: Path) -> None:
    broken = rewritten(exported(STACK), tmp_path / "b.fmu", {XML: _edit('guid="{', 'guid="{0')})
    found = _failures(check_fmu(broken))
    assert set(found) == {"co-simulation instantiates", "model exchange instantiates"}
    assert "not of the same export" in found["co-simulation instantiates"]


def test_missing_unit_definition(tmp_path: Path) -> None:
    change = _edit('<Unit name="N/V">', '<Unit name="N.V">')
    found = _failures(check_fmu(rewritten(exported(STACK), tmp_path / "b.fmu", {XML: change})))
    assert set(found) == {"description valid", "units defined"}
    assert "'k_L' has the unit 'N/V', which is not defined" in found["units defined"]


def test_missing_dependency(tmp_path: Path) -> None:
    """charge = C_p u: the entry of C_p is taken out."""
    model = model_named(STACK).plant()
    place = 2 + 2 * len(model.state_names) + len(model.input_names) + len(model.output_names)
    place += model.parameter_names.index("C_p")
    old = f'dependencies="2 {place}" dependenciesKind="tunable dependent"'
    change = _edit(old, 'dependencies="2" dependenciesKind="tunable"')
    found = _failures(check_fmu(rewritten(exported(STACK), tmp_path / "b.fmu", {XML: change})))
    assert found == {
        "dependencies complete": "'charge' depends on 'C_p', which its dependencies do not list"
    }


def test_wrong_start_value(tmp_path: Path) -> None:
    change = _edit('start="0.0001"', 'start="0.0002"')
    found = _failures(check_fmu(rewritten(exported(STACK), tmp_path / "b.fmu", {XML: change})))
    assert found == {"start values": "'tau' starts at 0.0002, the model has 0.0001"}


SOURCES = {
    "wrong sign of a derivative": (
        "model_casadi.c",
        "return call(psa_ode, t, x, u, p, xdot, NULL);",
        "const int r = call(psa_ode, t, x, u, p, xdot, NULL); xdot[0] = -xdot[0]; return r;",
        {"equations", "directional derivatives"},
    ),
    "wrong directional derivative": (
        "model_directional.c",
        "arg[5] = dx;",
        "arg[5] = NULL; (void)dx;",
        {"directional derivatives"},
    ),
    "state shared by instances": (
        "instance.c",
        "const psa_status status = psa_solver_advance(",
        "static double shared; shared += 1.0; solver->x[0] += 1e-6 * shared;"
        " const psa_status status = psa_solver_advance(",
        {"life cycle", "independent instances", "snapshots"},
    ),
    "input held where a rate is given": (
        "values.c",
        "state->input.rate[index] = rate[i];",
        "state->input.rate[index] = 0.0 * rate[i];",
        {"co-simulation, step 0.001 s"},
    ),
    "parameters without effect during a run": (
        "values.c",
        "else state->p[v->index] = value;",
        "else if (state->phase == PSA_INSTANTIATED) state->p[v->index] = value;",
        {"parameter changes"},
    ),
    "checksum not looked at": (
        "snapshot.c",
        "if (found.checksum != expected.checksum)",
        "if (found.checksum != expected.checksum && size == 0)",
        {"snapshots"},
    ),
    "every call allowed": (
        "instance.c",
        "if (ALLOWED[call] & instance->state.phase) return 1;",
        "if (call != PSA_CALL_COUNT || ALLOWED[call]) return 1;",
        {"illegal calls"},
    ),
    "a step beside the communication point": (
        "instance.c",
        "target = point + size;",
        "target = point + 0.999 * size;",
        {"co-simulation, step 0.01 s"},
    ),
}


@pytest.mark.parametrize("fault", SOURCES)
def test_wrong_sources(fault: str, tmp_path: Path) -> None:
    file, old, new, rows = SOURCES[fault]
    broken = _recompiled(exported(STACK), tmp_path / "b.fmu", file, old, new)
    report = check_fmu(broken)
    assert report.compared
    assert rows <= set(_failures(report)), _failures(report)


def test_no_fmu(tmp_path: Path) -> None:
    path = tmp_path / "text.fmu"
    path.write_text("no archive")
    with pytest.raises(InputError, match="cannot be read as an FMU"):
        check_fmu(path)
