"""Each part around a stack as FMU 2 and 3 and in Modelica, by Python and by name."""

import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from psa_casadi.cli.app import app
from psa_casadi.export.check.check import check_fmu
from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.modelica.package import modelica_text
from psa_casadi.model.parts import PARTS, part_model
from psa_casadi.simulation.stepper import run
from psa_casadi.variables import nominal_value
from tests.modelica_runs import simulated
from tests.tiers import slow


@slow
@pytest.mark.usefixtures("code_runs_here")
@pytest.mark.parametrize(("name", "fmi"), [(n, 2 + k % 2) for k, n in enumerate(PARTS)])
def test_a_part_passes_the_check_as_an_fmu(name: str, fmi: int, tmp_path: Path) -> None:
    path = export_fmu(part_model(name), tmp_path / f"{name}.fmu", fmi=fmi)
    report = check_fmu(path, part_model(name))
    assert report.passed, report


@pytest.mark.parametrize("name", PARTS)
def test_a_part_is_the_same_in_modelica(name: str) -> None:
    """The first input is a sine of half its usual size, the others rest; all outputs."""
    model = part_model(name)
    text = modelica_text(model, name="Part")
    first, *others = model.structure.inputs
    peak = 0.5 * nominal_value(first.nominal, model.values)
    span, omega = 2e-3, 2.0 * math.pi * 1e3
    rest = "".join(f", {i.name}={i.start!r}" for i in others)
    harness = (
        f"model Harness Part.Signal part({first.name}={peak!r}*(1 - cos({omega!r}*time)){rest});"
        " end Harness;"
    )
    got = simulated(text + harness, "Harness", span)
    t = np.linspace(0.0, span, 4001)
    u = np.tile([i.start for i in model.structure.inputs], (len(t), 1))
    u[:, 0] = peak * (1.0 - np.cos(omega * t))
    steps = run(model, t, u, np.zeros(len(model.state_names)), rtol=1e-8)
    names = (*model.state_names, *model.output_names)
    between = slice(40, None, 100)  # between two sample instants, where rumoca has points
    for variable, wanted in zip(names, np.hstack([steps.x, steps.y]).T, strict=True):
        at = np.interp(t[between], got["time"], got[f"part.{variable}"])
        error = np.abs(at - wanted[between]).max()
        assert error < 1e-4 * max(np.ptp(wanted), 1e-12), variable


@pytest.mark.parametrize("name", PARTS)
def test_a_part_is_exported_by_its_name(name: str, tmp_path: Path) -> None:
    path = tmp_path / "part.mo"
    result = CliRunner().invoke(app, ["export", "modelica", "--part", name, "-o", str(path)])
    assert result.exit_code == 0, result.stderr
    assert path.read_text(encoding="utf-8") == modelica_text(part_model(name))
    assert f"inside: {', '.join(PARTS[name].components)}" in result.stdout
