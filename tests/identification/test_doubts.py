"""Odd but readable records: a verdict, or a sentence that names the cause."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.identification.identify import identify
from psa_casadi.identification.start.doubts import (
    doubtful_quantity,
    doubtful_sign,
    doubtful_time,
    doubtful_unit,
    doubtful_voltage,
    refuse_few,
    refuse_unusable,
    refuse_wrapped,
)
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.model.effects import EFFECTS
from psa_casadi.records.record import Record
from psa_casadi.records.suspects import suspects
from tests.studies.plants.base import simulate_base
from tests.studies.plants.excitations import loops
from tests.studies.plants.stack import draw_stack

TABLE = [EFFECTS["slow_creep"], EFFECTS["sensor_jump"]]


@pytest.fixture(scope="module")
def record() -> Record:
    """Return the record of an independent plant, 29 um at 60 V."""
    rng = np.random.default_rng(3)
    stack, time = draw_stack(rng), np.arange(600) / 200.0
    voltage = np.round(0.95 * stack.u_rated * np.concatenate([np.zeros(10), loops(rng, 590)]), 3)
    y = simulate_base(stack, time, voltage).displacement
    y += 2e-4 * np.ptp(y) * rng.standard_normal(y.size)
    return Record(name="r", time=time, voltage=voltage, displacement=y)


def scaled(record: Record, t: float = 1.0, v: float = 1.0, y: float = 1.0) -> Record:
    displayed = y * np.asarray(record.displacement)
    return replace(
        record,
        time=t * record.time,
        voltage=v * record.voltage,
        displacement=displayed,
    )


@pytest.mark.parametrize(
    ("factors", "message"),
    [
        ({"y": 1e6}, "changes by 29 m, more than .*displacement is in um, not m .*=NAME:um"),
        ({"y": 1e9}, "displacement is in nm, not m .*--columns displacement=NAME:nm"),
        ({"y": 1e-12}, "changes by 2.9e-17 m, less than a stack with any sensor"),
        ({"y": 1e-310}, "less than a stack with any sensor"),
        ({"y": 1e95}, "The displacement reaches 2.9e[+]90: that is no reading"),
        ({"v": 1e6}, "reaches 6e[+]07 V.* voltage is in uV, not V .*--columns voltage=NAME:uV"),
        ({"v": 1e-310}, "changes by 6e-309 V only: that drives no stack"),
        ({"v": 1e95}, "The voltage reaches 6e[+]96: that is no reading"),
        ({"t": 1e12}, "takes .* s for its range .*in ns, not s .*--columns time=NAME:ns"),
        ({"t": 1e9}, "takes .* s for its range .*in ns, not s .*--columns time=NAME:ns"),
        ({"t": 1e6}, "takes .* s for its range .*in us, not s .*--columns time=NAME:us"),
        ({"t": 1e-6}, "a stack that follows would move at .*in s, not us .*--columns time=NAME:s"),
        ({"t": 1e-9}, "none can at more than 2 m/s.*in s, not ns .*--columns time=NAME:s"),
        ({"t": 1e-20}, "none can at more than 2 m/s"),
        ({"t": 1e-6, "y": 1e6}, "none can at more than 2 m/s"),
    ],
)
@pytest.mark.parametrize("command", [identify, diagnose])
def test_a_unit_far_off_is_refused_with_the_likely_one(
    command: Callable[[list[Record]], object],
    factors: dict[str, float],
    message: str,
    record: Record,
) -> None:
    with pytest.raises(InputError, match=message):
        command([scaled(record, **factors)])


@pytest.mark.parametrize(
    ("factors", "message"),
    [
        ({"y": 1e3}, "displacement is in um, not mm"),
        ({"y": 1e-3}, "displacement is in um, not nm"),
        ({"y": 1e-6}, "displacement is in um, not pm"),
        ({"v": 1e3}, "voltage is in mV, not V"),
        ({"v": 1e-3}, "voltage is in kV, not V"),
    ],
)
def test_a_unit_that_may_be_another_is_doubted(
    factors: dict[str, float], message: str, record: Record
) -> None:
    assert message in doubtful_unit([scaled(record, **factors)])
    assert doubtful_unit([scaled(record)]) == ""


def test_sign_and_time_are_doubted(record: Record) -> None:
    assert not doubtful_sign([scaled(record)])
    assert "the other way round" in doubtful_sign([scaled(record, y=-1.0)])
    assert not doubtful_time([scaled(record)])
    assert "(--columns time=NAME:ms)" in doubtful_time([scaled(record, t=1e6)])
    fast = doubtful_time([scaled(record, t=1e-4)])
    assert "few tests are above 0.1 m/s. The time is probably in s, not ms" in fast
    result = identify([scaled(record, y=-1.0)])
    assert "the other way round" in result.warnings[0]


def test_a_stray_voltage_is_named_with_its_time(record: Record) -> None:
    voltage = record.voltage
    stray = np.where(np.arange(600) == 300, 1e6, voltage)
    with pytest.raises(InputError, match=r"voltage is 1e\+06 V at 1.5 s, and all others lie with"):
        refuse_unusable([replace(record, voltage=stray)])
    with pytest.raises(InputError, match=r"reaches 1e[+]09 V, and changes by 60 V.*has an offset"):
        refuse_unusable([replace(record, voltage=voltage + 1e9)])
    with pytest.raises(InputError, match=r"voltage changes by .* V only: that drives no stack"):
        refuse_unusable([replace(record, voltage=50.0 + 1e-7 * voltage)])


@pytest.mark.parametrize(("t", "bound"), [(1e5, "R_s"), (1e-6, "c_P")])
def test_however_slow_the_sampling_the_start_is_within_bounds(
    t: float, bound: str, record: Record
) -> None:
    """A start outside would blame a parameter that the user did not set."""
    model = starting_model([scaled(record, t=t)])
    low, high = model.parameter(bound).bounds
    assert low <= model.values[bound] <= high


def test_a_spike_of_a_million_metres_moves_nothing(record: Record) -> None:
    y = np.asarray(record.displacement)
    spoiled = np.where(np.arange(600) == 300, 1e6, y)
    result = diagnose([replace(record, displacement=spoiled)], effects=TABLE)
    assert result.verdict == "adequate"


@pytest.mark.parametrize(("low", "high"), [(0.0, 0.6), (0.4, 1.0), (0.2, 0.8), (0.0, 0.95)])
def test_a_saturated_sensor_is_named_and_masked(low: float, high: float, record: Record) -> None:
    y = np.asarray(record.displacement)
    ends = y.min() + np.array([low, high]) * np.ptp(y)
    record = replace(record, displacement=np.clip(y, *ends))
    result = suspects(record)
    flat = (y <= ends[0]) & (low > 0.0) | (y >= ends[1]) & (high < 1.0)
    assert np.mean(result.mask != flat) < 0.01
    assert [e.upper for e in result.ends] == [False] * (low > 0.0) + [True] * (high < 1.0)
    value = 1e6 * ends[1 if high < 1.0 else 0]
    assert f"{value:.6g} µm" in str(result.saturation("r")[-1])


def test_a_saturated_record_is_diagnosed_without_its_flat_top(record: Record) -> None:
    y = np.asarray(record.displacement)
    record = replace(record, displacement=np.minimum(y, y.min() + 0.6 * np.ptp(y)))
    result = diagnose([record], effects=TABLE)
    assert result.verdict == "adequate"
    assert "the largest value, while the voltage moves the stack: the sensor" in result.notes[-1]


def test_what_is_flat_for_other_reasons_is_not_a_saturated_sensor(record: Record) -> None:
    voltage, y = record.voltage, np.asarray(record.displacement)
    quantum = np.ptp(y) / 50.0
    assert not suspects(replace(record, displacement=quantum * np.round(y / quantum))).ends
    held = np.minimum(voltage, 0.6 * voltage.max())
    assert not suspects(replace(record, voltage=held, displacement=np.round(1e-6 * held, 9))).ends
    assert not suspects(record).ends


def test_a_coarse_sensor_is_named(record: Record) -> None:
    y = np.asarray(record.displacement)
    quantum = np.ptp(y) / 9.0
    result = diagnose(
        [replace(record, displacement=quantum * np.round(y / quantum))], effects=TABLE
    )
    assert result.notes[-1].startswith("What is left of r is rounding to steps of 3.2 µm;")


def test_hardly_a_reading_left_is_refused_with_the_reason(record: Record) -> None:
    y = np.asarray(record.displacement)
    tenth = np.sort(y)[12]
    with pytest.raises(InputError, match=r"(?s)sensor is saturated there.*Only 12 of 600 reading"):
        identify([replace(record, displacement=np.minimum(y, tenth))])


@pytest.mark.parametrize("command", [identify, diagnose])
def test_a_sensor_that_wraps_round_is_named(
    command: Callable[[list[Record]], object], record: Record
) -> None:
    y = np.asarray(record.displacement)
    period = 0.6 * np.ptp(y)
    wrapped = replace(record, displacement=(y - y.min() + 0.1 * period) % period)
    with pytest.raises(
        InputError, match=r"jumps \d+ times by 1[67].\d+ um, up or down, and follows"
    ):
        command([wrapped])


def test_what_jumps_otherwise_is_not_wrapped(record: Record) -> None:
    time, voltage, y = record.time, record.voltage, np.asarray(record.displacement)
    switched = np.where(time % 1.0 < 0.5, 0.0, voltage)
    steps = replace(record, voltage=switched, displacement=4e-7 * switched)
    refuse_wrapped([scaled(record), steps])
    stray = np.where(np.isin(np.arange(600), (200, 400)), y - np.ptp(y), y)
    refuse_wrapped([replace(record, displacement=stray)])


def test_a_rate_an_integral_and_a_rectified_displacement_are_doubted(record: Record) -> None:
    time, y = record.time, np.asarray(record.displacement)
    assert not doubtful_quantity([scaled(record)])
    integral = replace(record, displacement=np.cumsum(y - y.mean()) * 5e-3)
    assert "the rate of the displacement follows the voltage" in doubtful_quantity([integral])
    rectified = replace(record, displacement=np.abs(y - y.min() - 0.5 * np.ptp(y)))
    assert "V the displacement follows the voltage" in doubtful_quantity([rectified])
    rate = replace(record, displacement=np.gradient(y, time))
    assert "the integral of the displacement follows" in doubtful_quantity([rate])


def test_a_voltage_in_counts_is_doubted(record: Record) -> None:
    voltage = record.voltage
    assert not doubtful_voltage([scaled(record)])
    counts = replace(record, voltage=np.round(32768.0 + 200.0 * voltage))
    result = diagnose([counts], effects=[])
    assert "no stack bears such a voltage, and what depends on its level" in result.doubt
    assert any("no stack bears more than 2000 V" in note for note in result.notes)


def test_hardly_a_reading_that_differs_is_refused(record: Record) -> None:
    y = np.asarray(record.displacement)
    ordered = np.sort(y)
    hardly, enough = (replace(record, displacement=np.maximum(y, ordered[-k])) for k in (16, 17))
    with pytest.raises(InputError, match=r"Only 15 readings of the displacement differ from"):
        refuse_few([hardly], [hardly], [])
    refuse_few([enough], [enough], [])


def _heavy(y: FloatArray) -> FloatArray:
    return y + 1e-3 * np.ptp(y) * np.random.default_rng(9).standard_t(1.5, y.size)


def _torn(y: FloatArray) -> FloatArray:
    return np.where(np.arange(y.size) % 200 < 60, np.nan, y)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("late", "change"),
    [(30.0, lambda y: y), (0.0, _heavy), (0.0, _torn)],
    ids=["late", "heavy", "torn"],
)
def test_an_odd_record_of_a_sound_stack_is_adequate(
    late: float,
    change: Callable[[FloatArray], FloatArray],
    record: Record,
) -> None:
    """A record that starts late, noise with heavy tails, runs of missing readings."""
    y = np.asarray(record.displacement)
    result = diagnose(
        [replace(record, time=record.time + late, displacement=change(y))], effects=TABLE
    )
    assert result.verdict == "adequate"
    assert not result.doubt


@pytest.mark.slow
def test_a_voltage_with_the_other_sign_is_reported(record: Record) -> None:
    voltage = record.voltage
    result = diagnose([replace(record, voltage=-voltage)], effects=TABLE)
    assert result.verdict == "not_driven"
    assert any("connected the other way round" in note for note in result.notes)
    assert result.next_experiment.why.startswith("Correct the record")
