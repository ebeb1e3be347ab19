"""What a diagnosis asks for next is what the records lack."""

import numpy as np
import pytest

from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.result import Cause
from psa_casadi.diagnosis.verdict import next_experiment, useful_records
from psa_casadi.records.record import Record


def _record(knots: list[tuple[float, float]]) -> Record:
    at, volts = np.array(knots).T
    time: FloatArray = np.arange(0.0, at[-1], 5e-3)
    return Record(name="r", time=time, voltage=np.interp(time, at, volts), displacement=1e-7 * time)


LOOP = [(0.0, 0.0), (5.0, 100.0), (10.0, 0.0), (15.0, 100.0), (20.0, 0.0)]
FAST = [(21.0, 100.0), (22.0, 0.0)]
SMALLER = [(24.0, 40.0), (26.0, 0.0), (27.0, 8.0), (28.0, 0.0)]
HELD = [(29.0, 60.0), (40.0, 60.0)]


@pytest.mark.parametrize(
    ("knots", "lacks"),
    [
        (LOOP, ["a hold", "three rates", "three amplitudes"]),
        ([*LOOP, *FAST], ["a hold", "three amplitudes"]),
        ([*LOOP, *FAST, *SMALLER], ["a hold"]),
        ([*LOOP, *SMALLER, *HELD], ["three rates"]),
        ([(0.0, 0.0), (40.0, 100.0)], ["a hold", "three rates", "three amplitudes", "repeats"]),
    ],
)
def test_what_is_lacking_is_asked_for_and_nothing_else(
    knots: list[tuple[float, float]], lacks: list[str]
) -> None:
    statement = str(useful_records([_record(knots)]))
    words = ["a hold", "three rates", "three amplitudes", "repeats"]
    assert statement.startswith("Record what these records lack: ")
    assert [w for w in words if w in statement] == lacks


def test_records_that_hold_all_of_it_lead_to_other_conditions() -> None:
    statement = str(useful_records([_record([*LOOP, *FAST, *SMALLER, *HELD])]))
    assert statement.startswith("These records hold what usually separates causes")
    # several records count together
    parts = [_record([*LOOP, *FAST]), _record([*LOOP, *SMALLER]), _record([*LOOP, *HELD])]
    assert str(useful_records(parts)) == statement


def test_causes_that_bend_one_curve_ask_for_a_column_also_where_structure_remains() -> None:
    bends = ("load_stiffness", "sensor_nonlinearity")
    causes = [Cause("hysteresis_memory", "plant", 0.99, {}, (), 0.7),
              Cause(bends[0], "plant", 0.5, {}, bends[1:], 0.2)]  # fmt: skip
    result = next_experiment(causes, "partly_explained", [bends], [_record(LOOP)], doubted=False)
    assert result.separates == bends
    assert "column displacement_2" in result.why
    assert "Record what these records lack" in result.why
