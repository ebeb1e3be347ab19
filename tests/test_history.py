"""A virtual history: the memory that a voltage before a record leaves."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.cli.app import app
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import InputError
from psa_casadi.model.model_file import dumps, loads
from psa_casadi.model.stacks import stack_model
from psa_casadi.simulation.history import settled_at
from psa_casadi.simulation.simulate import simulate
from tests.tiers import slow

STACK = stack_model("P-885.51")


@slow
def test_an_exported_model_starts_settled_and_stays_while_its_voltage_does(tmp_path: Path) -> None:
    """By fmpy: no transient at 60 V, where the way up and back down has left the hysteresis."""
    fmpy = pytest.importorskip("fmpy")
    settled = settled_at(STACK, 60.0, [120.0])
    path = psa.export_fmu(settled, tmp_path / "held.fmu", name="held")
    t = np.linspace(0.0, 0.02, 201)
    played = np.array([(0.0, 60.0), (0.02, 60.0)], dtype=[("time", float), ("voltage", float)])
    found = fmpy.simulate_fmu(
        str(path), stop_time=0.02, output_interval=1e-4, input=played, output=["displacement"]
    )["displacement"]
    down = np.concatenate([np.linspace(0.0, 120.0, 401), np.linspace(120.0, 60.0, 201)[1:]])
    way = np.linspace(0.0, 3.0, down.size)
    expected = reference.simulate(
        STACK.values, lambda time: float(np.interp(time, way, down)), way,
        mechanics="cascade", breakpoints=[2.0],
    ).states["x"]  # fmt: skip
    span = float(np.ptp(expected))
    assert len(found) == len(t)
    assert np.ptp(found) < 1e-7 * span
    # the reference comes down at 60 V/s, a lag of microseconds behind
    assert found[0] == pytest.approx(expected[-1], abs=1e-3 * span)
    assert abs(found[0] - simulate(STACK, t, np.full(t.size, 60.0)).displacement[0]) > 0.01 * span


def test_starts_go_with_a_model_through_its_file_its_plant_and_its_effects() -> None:
    settled = settled_at(STACK, 60.0, [120.0])
    assert settled.own_starts()["voltage"] == 60.0
    extended = settled.with_effect(EFFECTS["sensor_lag"], {"sensor_lag_time": 1e-4})
    assert loads(dumps(extended)).own_starts() == extended.own_starts()
    assert extended.plant().own_starts() == settled.own_starts()
    assert STACK.own_starts() == settled.with_declared_starts().own_starts() == {}
    assert "starts" not in dumps(STACK)
    with pytest.raises(InputError, match="no state or input 'q'"):
        STACK.with_starts({"q": 1.0})
    with pytest.raises(InputError, match="finite"):
        STACK.with_starts({"u": np.inf})
    broken = dumps(extended).replace('"voltage": 60.0', '"voltage": "high"')
    with pytest.raises(InputError, match="'starts' is"):
        loads(broken)


def test_a_modelica_package_states_the_same_starts(tmp_path: Path) -> None:
    path = tmp_path / "PiezoStack.mo"
    command = ["export", "modelica", "--stack", "P-885.51", "-o", str(path)]
    done = CliRunner().invoke(app, [*command, "--start-voltage", "60", "--history", "120"])
    assert done.exit_code == 0, done.output
    text = path.read_text()
    starts = settled_at(STACK, 60.0, [120.0]).own_starts()
    assert f'Real f_H(unit="N", start={starts["f_H"]!r}, fixed=true' in text
    assert 'input Real voltage(unit="V", start=60.0' in text
    refused = CliRunner().invoke(app, [*command, "--history", "120"])
    assert refused.exit_code == 2
    assert "--start-voltage" in refused.output
