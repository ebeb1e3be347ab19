"""FMUs broken in one way each: the check must find every one, and name it."""

import pickle
import platform
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fmpy.validation import _validate_variable_names

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.export.check import agreement, binaries, check, description
from psa_casadi.export.check.agreement import expected_outputs
from psa_casadi.export.check.binaries import FUNCTIONS, read_binary
from psa_casadi.export.check.rows import OF_BINARIES
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.fmu.archive import MODEL_ENTRY, write_archive
from psa_casadi.export.fmu.platforms import PLATFORMS, host_platform
from psa_casadi.export.importer.archive import Archive
from psa_casadi.report.words.text import check_sentence
from tests.export.c_host.build import binary
from tests.export.fmu_models import entries, exported, model_named, recompiled, rewritten
from tests.tiers import slow, slow_but

STACK = "P-885.51"
#: Value references of the model's variables by name.
PLACES = {v.name: k for k, v in enumerate(variable_table(model_named(STACK).plant()), 1)}
SWITCH, KNOWNS = "switch.voltage_reversal", ("u", "voltage", "G", "R_s", "C_p")
KINDS = "tunable tunable dependent dependent dependent"


def _unknown(fmi: int, name: str, *knowns: str, kinds: str) -> str:
    """Return how the description lists the dependencies of an output."""
    places = " ".join(str(PLACES[n]) for n in knowns)
    attribute = "index" if fmi == 2 else "valueReference"
    return f'{attribute}="{PLACES[name]}" dependencies="{places}" dependenciesKind="{kinds}"'


def _dependency(
    name: str, before: tuple[str, str], after: tuple[str, str], fmi: int
) -> tuple[str, str]:
    """Return the edit of an entry; a pair has the knowns and their kinds."""
    old, new = (_unknown(fmi, name, *k.split(), kinds=kinds) for k, kinds in (before, after))
    return old, new


def _of_state(fmi: int, unit: str) -> tuple[str, str]:
    """Return the edit of the unit of der(u), the only variable in V/s that has no nominal value."""
    more = (' intermediateUpdate="true"' if fmi == 3 else "") + ' derivative="2"'
    return f'unit="V/s"{more}', f'unit="{unit}"{more}'


#: By name: old and new text for a version of FMI, the rows, and a part of the remark of one.
Faults = dict[str, tuple[Callable[[int], tuple[str, str]], set[str], str]]
DESCRIPTIONS: Faults = {
    "wrong token": (
        lambda v: ('guid="{', 'guid="{0') if v == 2 else ('Token="{', 'Token="{0'),
        {"co-simulation instantiates", "model exchange instantiates"},
        "not of the same export",
    ),
    "unit without a definition": (
        lambda _: ('<Unit name="N/V">', '<Unit name="N.V">'),
        {"description valid", "units defined", "units consistent"},
        "'k_L' has the unit 'N/V', which is not defined",
    ),
    "variable without a unit": (
        lambda _: (' unit="N.s/m" min', " min"),
        {"units defined"},
        "has the unit 'None'",
    ),
    "wrong unit of a derivative": (
        lambda v: _of_state(v, "V"), {"units consistent"}, "'der(u)' is in 'V', but 'u' is in 'V'",
    ),
    "wrong definition of a unit": (
        lambda _: ('<BaseUnit kg="-1" m="-2" s="4" A="2"', '<BaseUnit kg="-1" m="-2" s="3" A="2"'),
        {"units consistent"},
        "the unit 'F' is defined as",
    ),
    "wrong factor of a display unit": (
        lambda _: ('name="um" factor="1000000.0"', 'name="um" factor="1000.0"'),
        {"units consistent"},
        "the display unit 'um' has the factor 1000",
    ),
    "missing dependency": (
        lambda v: _dependency("charge", ("u C_p", "tunable dependent"), ("u", "tunable"), v),
        {"dependencies complete", "dependencies of the model"},
        "'charge' depends on 'C_p', which its dependencies do not list",
    ),
    "superfluous dependency": (
        lambda v: _dependency(
            "displacement", ("x", "constant"), ("x v_x", "constant constant"), v),
        {"dependencies of the model"},
        "'displacement' does not depend on 'v_x', which its dependencies list",
    ),
    "wrong kind of a dependency": (
        lambda v: _dependency(
            "charge", ("u C_p", "tunable dependent"), ("u C_p", "constant dependent"), v),
        {"dependencies of the model"},
        "'charge' depends on 'u' in the way 'tunable', not 'constant'",
    ),
    "wrong start value": (
        lambda _: ('start="0.0001"', 'start="0.0002"'),
        {"start values"},
        "'tau' starts at 0.0002, the model has 0.0001",
    ),
    "nominal value of zero": (
        lambda _: ('nominal="65.7"', 'nominal="0.0"'),
        {"nominal values"},  # a solver takes those of the binary
        "'f_H' has the nominal value 0",
    ),
    "wrong nominal value": (
        lambda _: ('nominal="65.7"', 'nominal="66.0"'),
        {"nominal values"},
        "'f_H' has another nominal value in the binary",
    ),
    "wrong number of event indicators": (
        lambda v: (
            ('EventIndicators="1"', 'EventIndicators="2"') if v == 2
            else (f"<EventIndicator {_unknown(3, SWITCH, *KNOWNS, kinds=KINDS)} />", "")),
        {"event indicators"},
        "event indicators are announced",
    ),
}  # fmt: skip


XML = "modelDescription.xml"
VERSIONS = (2, 3)
#: Mistakes in the description that the quick tier tries.
FEW = ("wrong token", "missing dependency", "wrong start value", "wrong unit of a derivative")
#: Mistakes that differ between the versions; the others come in one version, in turn.
TWICE = ("wrong token", "missing dependency", "wrong unit of a derivative",
         "wrong number of event indicators")  # fmt: skip
WRONG = [(fault, fmi) for k, fault in enumerate(DESCRIPTIONS) for fmi in VERSIONS
         if fault in (*TWICE, *FEW) or fmi == VERSIONS[k % 2]]  # fmt: skip
harmless = pytest.mark.usefixtures("code_runs_here")
#: Any change of description or sources fails this row too.
ALWAYS = "reproducible"
#: More indicators than there are cannot be read; of fewer, as of FMI 3, the solver asks for none.
BESIDES = {("wrong number of event indicators", 2): {"model exchange"}}


def _failures(report: psa.CheckReport) -> dict[str, str]:
    return {row.name: row.remark for row in report.failures}


def _edit(old: str, new: str) -> Callable[[bytes], bytes]:
    return lambda content: content.replace(old.encode(), new.encode(), 1)


def _binary(fmi: int) -> str:
    return next(n for n in entries(STACK, fmi) if n.startswith("binaries/"))


@pytest.fixture(autouse=True)
def _reference_runs_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a sound FMU would give is the same for every fault: it is computed once."""

    def remembered(*arguments: Any) -> FloatArray:
        key = pickle.dumps(arguments)
        if key not in _OUTPUTS:
            _OUTPUTS[key] = expected_outputs(*arguments)
        return _OUTPUTS[key]

    monkeypatch.setattr(agreement, "expected_outputs", remembered)


_OUTPUTS: dict[bytes, FloatArray] = {}


@harmless
@pytest.mark.parametrize(("fault", "fmi"), slow_but([(fault, 2) for fault in FEW], WRONG))
def test_wrong_description(fault: str, fmi: int, tmp_path: Path) -> None:
    edit, rows, remark = DESCRIPTIONS[fault]
    changes = {XML: _edit(*edit(fmi))}
    result = _failures(psa.check_fmu(rewritten(exported(STACK, fmi), tmp_path / "b.fmu", changes)))
    assert set(result) == rows | {ALWAYS} | BESIDES.get((fault, fmi), set()), result
    assert any(remark in result[row] for row in rows), result


#: Faults that share a binary, as each has a row that none of the others in it fails: file, text,
#: what takes its place, and the rows that fail.
CORE: dict[str, tuple[tuple[str, str, str, set[str]], ...]] = {
    "wrong sign of a derivative": (
        ("model_casadi.c",
         "return call(psa_ode, t, x, u, p, xdot, NULL, w);",
         "const int r = call(psa_ode, t, x, u, p, xdot, NULL, w); xdot[0] = -xdot[0]; return r;",
         {"equations", "directional derivatives"}),
    ),
    "state shared by instances": (
        ("instance.c",
         "const psa_status status =\n            psa_solver_advance(",
         "static double shared; shared += 1.0; solver->x[0] += 1e-6 * shared;"
         " const psa_status status = psa_solver_advance(",
         {"life cycle", "independent instances", "snapshots"}),
    ),
    "rates held, parameters without effect during a run, indicators that stand still": (
        ("values.c", "state->input.rate[index] = rate[i];",
         "state->input.rate[index] = 0.0 * rate[i];", {"co-simulation, step 0.001 s"}),
        ("values.c", "else state->p[v->index] = value;",
         "else if (state->phase == PSA_INSTANTIATED) state->p[v->index] = value;",
         {"parameter changes"}),
        ("values.c", "state->facing[i] * instance->z[i] +", "0.0 * instance->z[i] +",
         {"event indicators", "event indicators of the model"}),
    ),
    "directional derivatives, rise of a start, line, checksum, communication points": (
        ("model_directional.c", "arg[5] = dx;", "arg[5] = NULL; (void)dx;",
         {"directional derivatives"}),
        ("start.c", "input.rate[PSA_VOLTAGE] = state->start_voltage / RISE;",
         "input.rate[PSA_VOLTAGE] = 0.0;", {"settled start"}),
        ("instance.c", "if (state->stride > 0.0)", "if (state->stride < 0.0)",
         {"line of the input"}),
        ("snapshot.c", "if (found.checksum != expected.checksum)",
         "if (found.checksum != expected.checksum && size == 0)", {"snapshots"}),
        ("instance.c", "{size + (point - now), point + size};",
         "{0.999 * size + (point - now), point + size};", {"co-simulation, step 0.01 s"}),
    ),
}  # fmt: skip


@slow
@harmless
@pytest.mark.parametrize("faults", CORE)
def test_wrong_sources(faults: str, tmp_path: Path) -> None:
    edits: dict[str, tuple[tuple[str, str], ...]] = {}
    for file, old, new, _ in CORE[faults]:
        edits[file] = (*edits.get(file, ()), (old, new))
    report = psa.check_fmu(recompiled(tmp_path / "b.fmu", 2, edits))
    assert report.compared
    result = set(_failures(report))
    assert all(rows <= result for *_, rows in CORE[faults]), result


#: Faults of the FMI 3.0 face that share a binary, as each fails another row.
FACE = {
    "fmi3_values.c": (
        (
            "    return psa_fmi3_status(psa_adjoint_derivative(core, unknowns, nunknowns, knowns,"
            " nknowns, seed,\n                                                  sensitivity));",
            "    const psa_result r = psa_adjoint_derivative(core, unknowns, nunknowns, knowns,"
            " nknowns, seed, sensitivity);\n    if (nknowns) sensitivity[0] *= 1.0 + 1e-6;\n"
            "    return psa_fmi3_status(r);",
        ),
    ),
    "fmi3_interfaces.c": (("*terminate = fmi3False;", "*terminate = fmi3True;"),),
    "values.c": (("state->facing[i] = -state->facing[i];", "instance->fresh = 0;"),),
}
MISSING = {
    "fmi3_clocks.c": (
        (
            "fmi3Status fmi3ActivateModelPartition(",
            "FMI3_Export fmi3Status fmi3ActivateModelPartitions(fmi3Instance, fmi3ValueReference,"
            " fmi3Float64);\nfmi3Status fmi3ActivateModelPartitions(",
        ),
    ),
}


@slow
@harmless
def test_wrong_face_of_fmi_3(tmp_path: Path) -> None:
    result = _failures(psa.check_fmu(recompiled(tmp_path / "b.fmu", 3, FACE)))
    rows = {"adjoint derivatives", "life cycle", "event indicators", "model exchange", "snapshots"}
    assert rows == set(result), result
    assert "stays negative after an event" in result["event indicators"]


@slow
@harmless
def test_a_function_under_another_name(tmp_path: Path) -> None:
    result = _failures(psa.check_fmu(recompiled(tmp_path / "b.fmu", 3, MISSING)))
    assert {"functions present", "no other symbols", "binary loads"} == set(result), result
    assert "fmi3ActivateModelPartition is missing" in result["functions present"]
    assert "fmi3ActivateModelPartitions is exported" in result["no other symbols"]
    assert "fmi3ActivateModelPartition" in result["binary loads"]


@slow
def test_binaries_that_cannot_be_used(tmp_path: Path) -> None:
    """Missing, cut off, or of something else: a failed row, whatever loading them does."""
    fmi = 2
    name, content = _binary(fmi), entries(STACK, fmi)[_binary(fmi)]
    left = {n: c for n, c in entries(STACK, fmi).items() if n != name}
    for wrong in (None, content[: len(content) // 2], b"no library at all"):
        path = tmp_path / "b.fmu"
        write_archive(path, left if wrong is None else {**left, name: wrong})
        report = psa.check_fmu(path)
        assert not report.compared
        assert "binary loads" in _failures(report)
        assert {row.name for row in report.rows if row.passed} >= {"units defined", ALWAYS}


@slow
@pytest.mark.xdist_group("platforms")
@pytest.mark.parametrize("name", PLATFORMS)
@pytest.mark.parametrize("fmi", VERSIONS)
def test_binaries_of_all_platforms_are_inspected(name: str, fmi: int) -> None:
    result = read_binary(binary(fmi, PLATFORMS[name]))
    assert (result.platform, result.exports) == (name, FUNCTIONS[fmi])
    assert any(n.startswith("GLIBC_2.") for n in result.needs) == name.endswith("linux")


def test_without_lief_the_binaries_are_not_inspected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(binaries, "has_lief", lambda: False)
    with pytest.raises(psa.InputError, match="run `pip install lief`"):
        psa.check_fmu(exported(STACK, 2), portable=True)
    monkeypatch.setattr(check, "rows_apart", lambda *_: [])
    report = psa.check_fmu(exported(STACK, 2))
    assert report.left_out == OF_BINARIES
    text = check_sentence(report)
    assert "Left out, as lief is not installed (`pip install lief`): functions present" in text


@pytest.mark.skipif(host_platform().suffix != ".so", reason="patches the names of an ELF file")
def test_the_oldest_system_that_a_binary_loads_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that loads here passes, with a note; `portable` and other platforms ask for more."""
    path, change = tmp_path / "b.fmu", _edit("GLIBC_2.2.5\0", "GLIBC_2.29\0\0")
    with Archive(rewritten(exported(STACK, 2), path, {_binary(2): change})) as newer:
        for libc, portable, problem in (
            ("2.36", False, None), ("2.29", False, None),
            ("2.28", False, "systems with GNU libc 2.28"), ("", False, "with GNU libc 2.17 "),
            ("2.36", True, "with GNU libc 2.17 "),
        ):  # fmt: skip
            monkeypatch.setattr(platform, "libc_ver", lambda v=libc: ("glibc", v))
            row = binaries.libc_row(newer, portable=portable)
            assert row.passed == (problem is None)
            assert (problem or "loads on GNU libc 2.29 and later") in row.remark
        monkeypatch.setattr(platform, "libc_ver", lambda: ("glibc", "2.36"))
        other = "riscv64-linux" if host_platform().name != "riscv64-linux" else "x86_64-linux"
        monkeypatch.setattr(binaries, "host_platform", lambda: PLATFORMS[other])
        foreign = binaries.libc_row(newer)
    assert "needs GLIBC_2.29, which systems with GNU libc 2.17 lack" in foreign.remark


@slow
@harmless
@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a compiler of the system")
def test_what_the_compiler_of_the_system_makes_passes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No wheel of a compiler: the FMU is for systems like this one, and sound."""
    monkeypatch.setattr("psa_casadi.export.fmu.platforms.has_zig", lambda: False)
    monkeypatch.setenv("CC", "gcc")
    report = psa.check_fmu(psa.export_fmu(model_named(STACK), tmp_path / "model.fmu"))
    assert report.passed, _failures(report)
    assert "loads on GNU libc 2." in next(r.remark for r in report.rows if r.name == "GNU libc")


@pytest.mark.parametrize("fmi", VERSIONS)
def test_a_binary_in_the_folder_of_another_platform(fmi: int, tmp_path: Path) -> None:
    """Importers go by the folder alone, and would fail to load it."""
    path, result = tmp_path / "b.fmu", entries(STACK, fmi)
    write_archive(path, {**result, "binaries/riscv64-linux/psa.so": result[_binary(fmi)]})
    with Archive(path) as moved:
        (problem,) = binaries.misplaced_binaries(moved)
    assert problem.startswith(f"riscv64-linux holds a binary for {host_platform().name}")
    with Archive(exported(STACK, fmi)) as whole:
        assert not list(binaries.misplaced_binaries(whole))


@slow
@harmless
def test_sources_and_model_that_are_not_those_of_the_binary(tmp_path: Path) -> None:
    path, fmi = tmp_path / "b.fmu", 2
    change = _edit("\n", "\n\n")
    result = _failures(
        psa.check_fmu(rewritten(exported(STACK, fmi), path, {"sources/solver.c": change}))
    )
    assert result == {ALWAYS: "sources/solver.c differs"}
    lost = {n: c for n, c in entries(STACK, fmi).items() if n != "sources/linear.c"}
    write_archive(path, lost)
    assert "sources/linear.c is missing" in _failures(psa.check_fmu(path))[ALWAYS]
    changed = {MODEL_ENTRY: lambda _: b"{"}
    report = psa.check_fmu(rewritten(exported(STACK, fmi), path, changed))
    assert set(_failures(report)) == {"model inside"}
    assert not report.compared


@slow
@harmless
def test_a_folder_in_place_of_a_source(tmp_path: Path) -> None:
    path, name = tmp_path / "b.fmu", "sources/solver.c"
    files = {f"{n}/x" if n == name else n: c for n, c in entries(STACK, 2).items()}
    write_archive(path, files)
    assert set(_failures(psa.check_fmu(path))) == {ALWAYS}


def test_no_fmu(tmp_path: Path) -> None:
    path = tmp_path / "text.fmu"
    path.write_text("no archive")
    with pytest.raises(psa.InputError, match="cannot be read as an FMU"):
        psa.check_fmu(path)
    for old, new, match in (
        ('fmiVersion="2.0"', 'fmiVersion="1.0"', "export it again"),
        ("</fmiModelDescription>", "", "cannot be read as an FMU"),
    ):
        rewritten(exported(STACK, 2), path, {XML: _edit(old, new)})
        with pytest.raises(psa.InputError, match=match):
            psa.check_fmu(path)


NAMES = [
    "a", "_b1", "a.b[3].c", "a[1,2]", "der(a.b)", "der(a,2)", "'x y'.z", "'a b'[1]", "'?-~'", "",
    "1a", "a b", "a.", "a[]", "a[1", "der(a", "der()", "ä", "a\n", "'", "''", "a..b", "a[b]", "'ä'",
]  # fmt: skip


def test_names_are_judged_as_by_the_grammar_of_fmpy() -> None:
    made = SimpleNamespace(
        variableNamingConvention="structured",
        modelVariables=[SimpleNamespace(name=n, sourceline=1) for n in NAMES],
    )
    text = " ".join(_validate_variable_names(made))
    assert [n for n in NAMES if not description._NAMES["structured"].fullmatch(n)] == [
        n for n in NAMES if f'"{n}" (line 1) is not a legal' in text
    ]


def test_many_variables_take_little_time_each(tmp_path: Path) -> None:
    """The grammar of fmpy took half a minute for them."""
    kind = '" valueReference="9" variability="tunable" causality="parameter"><Real start="1"/>'
    more = "".join(f'<ScalarVariable name="e_{k}{kind}</ScalarVariable>' for k in range(20_000))
    more += f'<ScalarVariable name="no name{kind}</ScalarVariable>'
    end = "</ModelVariables>"
    path = rewritten(exported(STACK, 2), tmp_path / "m.fmu", {XML: _edit(end, more + end)})
    with Archive(path) as archive:
        started = time.process_time()
        items = list(description.invalid(archive))
        assert time.process_time() - started < 10.0
    assert len(items) == 1
    assert items[0].startswith("'no name' (line ")


def test_the_time_of_a_check_is_that_of_all_its_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    def slowly(archive: Archive) -> tuple[str, ...]:
        time.sleep(0.2)
        return ()

    monkeypatch.setitem(description.DESCRIBED, "units defined", slowly)
    monkeypatch.setitem(description.DESCRIBED, "units consistent", slowly)
    report = psa.check_fmu(exported(STACK, 2), timeout=0.3)
    assert not report.passed
    assert report.rows[-1].name == "time"
    assert "time limit of 0.3 s of the whole check (--timeout sets it)" in report.rows[-1].remark
