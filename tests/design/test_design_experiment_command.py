"""`psa design experiment` at the command line: what it writes, from what it is given."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import psa_casadi as psa
from psa_casadi.cli.app import app
from psa_casadi.design.experiment.experiment import usual_records
from psa_casadi.design.experiment.limits import Limits
from tests.tiers import slow

STACK = "P-885.51"


@slow
def test_the_command_fits_the_rivals_to_the_records_at_hand(tmp_path: Path) -> None:
    effect = psa.EFFECTS["sensor_nonlinearity"]
    model = psa.stack_model(STACK).with_effect(effect)
    gain = effect.gain or ""
    model = model.with_values({gain: 0.3 * model.parameter(gain).typical(model.values)})
    plan = usual_records(Limits(0.0, 70.0, 0.8, 80), np.inf)["triangle"]
    read = psa.simulate(model, plan.time, plan.voltage).outputs["displacement"]
    read = read + 5e-9 * np.random.default_rng(2).standard_normal(plan.n)
    measured, output = tmp_path / "measured.csv", tmp_path / "voltage.csv"
    psa.write_record(
        measured,
        {"time [s]": plan.time, "voltage [V]": plan.voltage, "displacement [um]": 1e6 * read},
    )
    arguments = [
        "design", "experiment", "--stack", STACK, "--record", str(measured), "--family", "steps",
        "--starts", "1", "--separate", "sensor_nonlinearity", "slow_creep", "-o", str(output),
    ]  # fmt: skip
    found = CliRunner().invoke(app, arguments)
    assert found.exit_code == 0, found.output
    record = psa.read_record(output, need_displacement=False)
    assert (record.n, record.time[-1]) == (plan.n, pytest.approx(plan.time[-1]))
    assert plan.voltage.min() - 1e-9 <= record.voltage.min()
    assert record.voltage.max() <= plan.voltage.max() + 1e-9


def test_the_command_tells_all_mistakes_at_once(tmp_path: Path) -> None:
    arguments = [
        "design", "experiment", "--separate", "creeping", "--noise", "-1", "--starts", "0",
        "-o", str(tmp_path / "no" / "where.csv"),
    ]  # fmt: skip
    found = CliRunner().invoke(app, arguments)
    assert found.exit_code == 2
    for part in ("creeping", "--noise", "--starts", "does not exist", "No model is given"):
        assert part in found.output
