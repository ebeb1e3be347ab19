"""Bends that records separate by their form alone: a set of causes, and a model for each."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import psa_casadi as psa
from psa_casadi.cli import diagnosis_files as files
from psa_casadi.cli.app import app
from psa_casadi.common.units import FloatArray
from psa_casadi.design.experiment.experiment import resolving_experiment
from psa_casadi.diagnosis.pack import STACK, Task
from psa_casadi.diagnosis.search.state import one_of_each
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.records.split import split
from tests.studies.plants.make import make_record
from tests.tiers import slow

TABLE = tuple(psa.EFFECTS.values())
BENDS = ("load_stiffness", "sensor_nonlinearity")


@pytest.mark.parametrize(
    ("rate", "free", "equivalent"),
    [(1e3, ["k_L", "m_B"], (BENDS,)), (2e4, ["k_L"], (BENDS,)), (2e4, ["k_L", "m_B"], ())],
)
def test_bends_are_equivalent_where_no_resonance_shows(
    rate: float, free: list[str], equivalent: tuple[tuple[str, ...], ...]
) -> None:
    time = np.arange(200) / rate
    model, voltage = psa.compose(psa.BASE), 10.0 + 10.0 * np.sin(0.02 * rate * time)
    displayed = psa.simulate(model, time, voltage).displacement
    experiments = (split(psa.Record(name="r", time=time, voltage=voltage, displacement=displayed)),)
    result = fit(model, experiments, free, sigma=[1e-8], evaluations=2)
    groups = Task(TABLE, STACK).indistinguishable(result)
    assert tuple(tuple(sorted(group)) for group in groups) == equivalent


@slow
def test_a_bend_is_not_blamed_on_the_sensor_alone(tmp_path: Path) -> None:
    """The bend's entry is in the table; an arc tangent is no polynomial."""
    path = tmp_path / "a.csv"
    make_record("sensor_nonlinearity", 1, path, visible=(2.0, 2.5))
    record = psa.read_record(path).slice(0, 3000)
    result = psa.diagnose([record], effects=[psa.EFFECTS[n] for n in BENDS])
    assert result.verdict == "ambiguous"
    (cause,) = result.causes
    assert {cause.effect, *cause.cannot_be_told_from} == set(BENDS)
    one, other = (f.probability for f in cause.families)
    assert cause.confidence == pytest.approx(one, rel=1e-3)
    assert one == pytest.approx(other, rel=1e-3)
    assert "no voltage below the resonances separates" in result.next_experiment.why
    output, _ = one_of_each(result.contenders)
    assert len(output) == 1
    with pytest.raises(psa.InputError, match="bend the same curve"):
        resolving_experiment(result)
    assert files.with_next(result, tmp_path / "next.csv", lambda _: None) is result


NOISE = 5e-9
FEW = [
    psa.EFFECTS[n] for n in ("sensor_nonlinearity", "load_stiffness", "slow_creep", "sensor_lag")
]
TIME = np.linspace(0.0, 5.998, 3000)


def _reading() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return voltage, the reading of a bent sensor, and the bend alone [m]."""
    voltage = 55.0 - 35.0 * np.cos(2 * np.pi * TIME) - 15.0 * np.sin(2 * np.pi * 0.37 * TIME)
    x = psa.simulate(psa.stack_model("P-885.51"), TIME, voltage).displacement
    place = (x - x.min()) / np.ptp(x)
    bend = 0.02 * np.ptp(x) * place * (1.0 - place)
    noise = NOISE * np.random.default_rng(5).standard_normal(x.size)
    return voltage, np.asarray(x + bend + noise, dtype=np.float64), bend


@slow
def test_both_plants_are_offered_and_differ_by_the_bend() -> None:
    """One plant has the bend, the other leaves it to the sensor: apart they are the bend itself."""
    voltage, reading, bend = _reading()
    d = psa.diagnose(
        [psa.Record(name="r", time=TIME, voltage=voltage, displacement=reading)], effects=TABLE
    )
    assert d.verdict == "ambiguous"
    (a,) = d.alternatives
    assert {a.cause, a.instead} == {"sensor_nonlinearity", "load_stiffness"}
    assert a.rms_ratio == pytest.approx(1.0, abs=0.05)
    assert {c.name for c in a.model.components} >= {a.instead}
    plants = [m.plant() for m in (d.model, a.model)]
    assert sum("load_stiffness" in {c.name for c in p.components} for p in plants) == 1
    # offset and slope of the bend are those of the base
    columns = np.column_stack([np.ones(TIME.size), reading])
    curved = bend - columns @ np.linalg.lstsq(columns, bend, rcond=None)[0]
    span = float(np.ptp(reading))
    assert a.plant_differs_m > 0.5 * float(np.abs(curved).max())
    assert a.plant_differs_m < 0.2 * span
    assert a.plant_differs_percent == pytest.approx(100.0 * a.plant_differs_m / span, rel=0.05)
    assert json.loads(d.to_json())["alternatives"][0]["instead"] == a.instead
    assert "which these data do not decide" in " ".join(psa.story(d).split())


@slow
def test_the_command_writes_the_other_model_next_to_the_extended_one(tmp_path: Path) -> None:
    voltage, reading, _ = _reading()
    record, out = tmp_path / "r.csv", tmp_path / "ext.json"
    psa.write_record(
        record, {"time [s]": TIME, "voltage [V]": voltage, "displacement [m]": reading}
    )
    rest = [f"--leave-out={name}" for name, effect in psa.EFFECTS.items() if effect not in FEW]
    done = CliRunner().invoke(app, ["diagnose", str(record), "-o", str(out), *rest])
    assert done.exit_code == 0, done.output
    (other,) = set(tmp_path.glob("ext_*.json"))
    models = [psa.load_model(p) for p in (out, other)]
    bends = [{c.name for c in m.effects} for m in models]
    assert sorted(b.pop() for b in bends) == ["load_stiffness", "sensor_nonlinearity"]
    assert f"written: {other}" in done.output.replace("\n", "")
    again = CliRunner().invoke(
        app, ["diagnose", str(record), "--model", str(other), "-o", str(out)]
    )
    assert again.exit_code == 2
    assert "could overwrite it" in " ".join(again.output.split())
