"""What the verdict states: causes that held-out samples confirm, gaps, gains, the next record."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import sawtooth

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.held_out import Compared, Gain, coverage_notes, unconfirmed
from psa_casadi.diagnosis.result import Cause
from psa_casadi.diagnosis.task import LIMITS
from psa_casadi.diagnosis.verdict import next_experiment, useful_records
from psa_casadi.identification.start.doubts import doubtful_quantity
from psa_casadi.model.effects import EFFECTS
from psa_casadi.records.drive import is_tone_separable
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment, gaps, whole, without_gaps
from psa_casadi.records.suspects import suspects
from psa_casadi.report.words.text import story
from tests.studies.plants.base import simulate_base
from tests.studies.plants.excitations import loops
from tests.studies.plants.make import make_record
from tests.studies.plants.stack import draw_stack
from tests.tiers import slow


@pytest.fixture(scope="module")
def triangle() -> Record:
    """A record of triangles without a hidden effect, 29 um at 60 V."""
    rng = np.random.default_rng(3)
    stack, time = draw_stack(rng), np.arange(1200) / 200.0
    voltage = np.round(0.95 * stack.u_rated * (0.5 + 0.5 * sawtooth(2 * np.pi * time, 0.5)), 3)
    y = simulate_base(stack, time, voltage).displacement
    noise = 2e-4 * np.ptp(y) * rng.standard_normal(y.size)
    return Record(name="r", time=time, voltage=voltage, displacement=y + noise)


def saturated_above(record: Record, share: float) -> Record:
    """Return the record of a sensor that is saturated above a share of its range."""
    y = record.displacement
    assert y is not None
    return replace(record, displacement=np.minimum(y, y.min() + share * np.ptp(y)))


@slow
@pytest.mark.parametrize(
    ("share", "effect", "message"),
    [
        (0.12, "self_heating", "only 4 of the readings that count are held out, and no model"),
        pytest.param(
            0.15,
            "hysteresis_memory",
            "the sensor is saturated in 94 % of the readings",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_record_that_hides_nearly_all_names_no_cause(
    share: float, effect: str, message: str, triangle: Record
) -> None:
    result = diagnose([saturated_above(triangle, share)], effects=[EFFECTS[effect]])
    assert result.causes == ()
    assert message in result.doubt
    assert result.doubt in " ".join(story(result).split())


@pytest.mark.parametrize("share", [0.12, 0.15, 0.2, 0.5])
def test_an_end_is_reported_with_little_data_below_it(share: float, triangle: Record) -> None:
    record = saturated_above(triangle, share)
    y = record.displacement
    assert y is not None
    (end,) = suspects(record).ends
    np.testing.assert_array_equal(end.where, y == y.max())


def test_a_window_of_the_motion_is_no_integral(triangle: Record) -> None:
    """Within it, the voltage of rises is higher than that of falls: it follows the rate."""
    y = triangle.displacement
    assert y is not None
    observed = np.abs(y - y.min() - 0.5 * np.ptp(y)) < 0.03 * np.ptp(y)
    assert not doubtful_quantity([replace(triangle, displacement=np.where(observed, y, np.nan))])


def held(record: Record, count: int) -> tuple[Experiment, ...]:
    e = whole(record)
    last = np.arange(record.n) >= record.n - count
    return (replace(e, used=e.used & ~last, held_out=e.used & last),)


@pytest.mark.parametrize(
    ("count", "interval", "lost", "partly", "hidden", "message"),
    [
        (15, (50.0, 60.0), -9.0, False, 0.0, "only 15 of the readings that count"),
        (16, (50.0, 60.0), -9.0, False, 0.51, "saturated in 51 % of the readings"),
        (16, (-101.0, 98.0), 1.1, False, 0.0, "gain, -101 to 98 %, reaches from an error that"),
        (16, (-101.0, 98.0), 0.9, False, 0.0, ""),
        (16, (-101.0, 97.0), 1.1, False, 0.0, ""),
        (16, (-99.0, 98.0), 1.1, True, 0.5, ""),
    ],
)
def test_what_held_out_samples_confirm(
    count: int,
    interval: tuple[float, float],
    lost: float,
    partly: bool,
    hidden: float,
    message: str,
    triangle: Record,
) -> None:
    experiments = held(triangle, count)
    gain = Gain(40.0, interval)
    note = unconfirmed(
        experiments, gain, whole=97.5, lost=lost, partly=partly, hidden=hidden, limits=LIMITS
    )
    assert message in str(note)
    assert (note is not None) == bool(message)
    few = [n for n in coverage_notes(experiments) if n.code == "held_out_says_little"]
    assert len(few) == (count < 16)


T = np.arange(900) / 200.0


@pytest.fixture(scope="module")
def looped() -> psa.Record:
    """Loops of an independent plant without a hidden effect."""
    rng = np.random.default_rng(3)
    stack = draw_stack(rng)
    voltage = np.round(0.95 * stack.u_rated * np.concatenate([np.zeros(10), loops(rng, 890)]), 3)
    y = simulate_base(stack, T, voltage).displacement
    noise = 2e-4 * np.ptp(y) * rng.standard_normal(y.size)
    return psa.Record(name="r", time=T, voltage=voltage, displacement=y + noise)


def without(record: psa.Record, *ranges: tuple[int, int]) -> psa.Record:
    kept = np.ones(record.n, dtype=bool)
    for a, b in ranges:
        kept[a:b] = False
    assert record.displacement is not None
    return psa.Record(
        name="r", time=record.time[kept], voltage=record.voltage[kept],
        displacement=record.displacement[kept],
    )  # fmt: skip


def test_what_happened_in_a_gap_is_no_cause(looped: psa.Record) -> None:
    record = without(looped, (300, 500))
    result = psa.diagnose([record], effects=[psa.EFFECTS["rate_dependent_hysteresis"]])
    assert result.verdict == "adequate"
    assert {e.record.name for e in result.experiments} == {"r[0:300]", "r[300:700]"}
    assert "r: no sample for 1.005 s from 1.495 s on, while the voltage moves" in result.notes[-1]


def record(time: FloatArray, voltage: FloatArray) -> psa.Record:
    return psa.Record(name="r", time=time, voltage=voltage, displacement=1e-6 * voltage)


SINE = 50.0 * np.sin(2.0 * np.pi * T)
RAMP = 10.0 * T
NO_GAP: dict[str, psa.Record] = {
    "even": record(T, SINE),
    "logarithmic": record(np.geomspace(1e-3, 1e3, 900), SINE),
    "slower from the middle on": record(np.r_[T[:450], T[450] + 100.0 * T[:450]], SINE),
    "pairs of samples": record(np.sort(np.r_[T, T + 1e-5]), np.repeat(SINE, 2)),
    "held meanwhile": record(np.r_[T[:450], T[450:] + 60.0], np.where(T < 1.0, SINE, SINE[200])),
    "one slope": record(np.r_[T[:450], T[450:] + 60.0], np.r_[RAMP[:450], RAMP[450:] + 600.0]),
    "a few lost samples": without(record(T, SINE), (100, 105), (300, 303)),
    "at the end": without(record(T, SINE), (500, 890)),
}


@pytest.mark.parametrize("case", NO_GAP)
def test_what_is_no_gap(case: str) -> None:
    assert gaps(NO_GAP[case]) == ()
    parts, statement = without_gaps([NO_GAP[case]])
    assert parts == [NO_GAP[case]]
    assert not statement


N = 4000


def grid(step: float) -> FloatArray:
    return np.linspace(0.0, (N - 1) * step, N)


def test_a_mains_line_between_the_harmonics_of_a_drive_is_distinguished_from_them() -> None:
    time = np.linspace(0.0, 4.999, 5000)
    triangle, fifth = (
        Record(name="triangle", time=time, voltage=np.arcsin(np.sin(2.0 * np.pi * f * time)))
        for f in (4.0, 5.0)
    )
    assert is_tone_separable(49.97, triangle, hum=True)
    assert not is_tone_separable(49.97, triangle, hum=False)
    assert not is_tone_separable(47.0, triangle, hum=True)
    assert not is_tone_separable(49.97, fifth, hum=True)  # the drive's tenth harmonic
    assert is_tone_separable(60.02, triangle, hum=False)  # above its twelfth
    noise = Record(name="noise", time=time, voltage=np.random.default_rng(0).standard_normal(5000))
    assert is_tone_separable(60.02, noise, hum=False)


def test_gain_is_the_reduction_of_the_held_out_rms() -> None:
    time = grid(1e-3)
    rng = np.random.default_rng(5)
    truth = np.sin(2 * np.pi * time)
    held = np.arange(N) >= 3000
    record = Record(
        name="r", time=time, voltage=truth, displacement=truth + 0.01 * rng.standard_normal(N)
    )
    experiment = Experiment(record, ~held, held)
    base = truth + 0.1 * rng.standard_normal(N)
    gain = Compared([experiment], [base], [truth]).gain
    assert gain.holdout_rms_reduction_percent == pytest.approx(90, abs=1.5)
    assert gain.interval[0] < gain.holdout_rms_reduction_percent < gain.interval[1]
    assert gain.held_out_records == 0
    assert Compared([experiment] * 4, [base] * 4, [truth] * 4).gain.held_out_records == 4


def test_what_the_other_parts_lose_is_counted_without_the_one_that_gains_most() -> None:
    """Eight parts of 125: one falls from 10 to 1, the others rise by a tenth or stay."""
    time = grid(1e-3)
    record = Record(name="r", time=time, voltage=time, displacement=np.zeros(N))
    held = np.arange(N) >= N - 1000
    experiment = Experiment(record, ~held, held)
    first = np.arange(N) < N - 1000 + 125
    base, after = np.where(first, 10.0, 1.0), np.where(first, 1.0, 1.1)
    lost = Compared([experiment], [base], [after]).lost_elsewhere(2.0)
    assert lost == pytest.approx(875 / 2.0 * np.log(1.1))
    none = Compared([experiment], [base], [np.ones(N)]).lost_elsewhere(2.0)
    assert none == pytest.approx(0.0, abs=1e-9)


def test_a_slow_triangle_is_blind_to_fast_effects(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    path = tmp_path_factory.mktemp("blind") / "r.csv"
    truth = make_record(None, 3, path)
    record = psa.read_record(path)
    time = np.linspace(0.0, 1499 * 0.02, 1500)
    voltage = 40 * (1 - np.abs(1 - (time / 15) % 2))
    slow = psa.simulate(psa.stack_model("demo"), time, voltage).displacement
    noisy = slow + truth.sigma * np.random.default_rng(0).standard_normal(len(slow))
    result = psa.diagnose([Record(name="slow", time=time, voltage=voltage, displacement=noisy)])
    assert record.n > 0
    assert "sensor_delay" in {b.effect for b in result.blind_to}
    assert result.verdict in ("adequate", "ambiguous")


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
def test_what_is_lacking_is_requested_and_nothing_else(
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
