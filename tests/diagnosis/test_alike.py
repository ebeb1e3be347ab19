"""Effects that records separate only by a form that nobody knows stay together in a set."""

from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.cli import diagnosis_files as files
from psa_casadi.design.experiment.experiment import resolving_experiment
from psa_casadi.diagnosis.pack import STACK, Task
from psa_casadi.diagnosis.search.steps import one_of_each
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.records.split import split
from tests.studies.plants.make import make_record
from tests.tiers import slow

TABLE = tuple(psa.EFFECTS.values())
BENDS = ("load_stiffness", "sensor_nonlinearity")


@pytest.mark.parametrize(
    ("rate", "free", "alike"),
    [(1e3, ["k_L", "m_B"], (BENDS,)), (2e4, ["k_L"], (BENDS,)), (2e4, ["k_L", "m_B"], ())],
)
def test_bends_are_alike_where_no_resonance_shows(
    rate: float, free: list[str], alike: tuple[tuple[str, ...], ...]
) -> None:
    time = np.arange(200) / rate
    model, voltage = psa.compose(psa.BASE), 10.0 + 10.0 * np.sin(0.02 * rate * time)
    displayed = psa.simulate(model, time, voltage).displacement
    experiments = (split(psa.Record(name="r", time=time, voltage=voltage, displacement=displayed)),)
    result = fit(model, experiments, free, sigma=[1e-8], evaluations=2)
    groups = Task(experiments, TABLE, STACK).indistinguishable(result)
    assert tuple(tuple(sorted(group)) for group in groups) == alike


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
    output, _ = one_of_each(result.contenders, result.experiments)
    assert len(output) == 1
    with pytest.raises(psa.InputError, match="bend the same curve"):
        resolving_experiment(result)
    assert files.with_next(result, tmp_path / "next.csv", lambda _: None) is result
