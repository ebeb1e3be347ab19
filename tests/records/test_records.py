import math
import subprocess
import sys
import time as clock
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import FloatArray
from psa_casadi.records import (
    Record,
    decaying_triangle,
    multisine,
    read_record,
    sine,
    time_grid,
    triangle,
    write_record,
)
from psa_casadi.records.noise import convolved, filtered, peaks
from psa_casadi.records.read import table
from tests.records.record_files import HEADER, ROWS, problems_of, write
from tests.tiers import slow

T = np.arange(24) / 8.0


def test_comments_quotes_blank_lines_and_capitals_are_tolerated(tmp_path: Path) -> None:
    quoted = [f'"{row.split(",")[0]}",{row.split(",", 1)[1]}' for row in ROWS]
    header = '"Time [s]", Voltage [V] ,"Load Force [N]"'
    path = write(tmp_path / "a.csv", "# rig 3", "# 2024", "", header, *quoted, "", " ")
    record = read_record(path, need_displacement=False)
    assert record.n == 20
    assert record.displacement is None
    assert record.load_force is not None
    assert not record.mask.any()
    assert record.mask.shape == (20,)


@given(
    st.lists(st.one_of(st.floats(-1e37, 1e37), st.just(math.nan)), min_size=16, max_size=40).filter(
        lambda values: np.isfinite(values).sum() >= 16
    )
)
def test_what_is_written_reads_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, values: list[float]
) -> None:
    path = tmp_path_factory.getbasetemp() / "round_trip.csv"
    instants = np.arange(len(values)) / 3.0
    write_record(path, {"time [s]": instants, "voltage [V]": instants, "displacement [m]": values})
    record = read_record(path)
    np.testing.assert_array_equal(record.time, instants)
    np.testing.assert_array_equal(np.asarray(record.displacement), values)


@slow
def test_a_million_rows_are_read_quickly(tmp_path: Path) -> None:
    rows = [f"{k / 10000:.4f},{k % 1000 / 10},{k % 1000 / 100}" for k in range(10**6)]
    path = write(tmp_path / "long.csv", HEADER, *rows)
    started = clock.process_time()
    assert read_record(path).n == 10**6
    assert clock.process_time() - started < 5.0


def make_record() -> Record:
    time = np.array([0.0, 0.1, 0.2, 0.3, 0.5])
    displacement = np.array([1.0, np.nan, 3.0, -1.0, 0.0]) * 1e-6
    return Record(name="r", time=time, voltage=2 * time, displacement=displacement)


def test_records_made_in_memory_are_distinguished_by_their_hash() -> None:
    record = make_record()
    assert record.sha256 == make_record().sha256
    other = Record(name="r", time=record.time, voltage=record.voltage, displacement=record.voltage)
    assert other.sha256 != record.sha256
    as_force = Record(name="r", time=record.time, voltage=record.voltage, load_force=record.voltage)
    assert as_force.sha256 != other.sha256


def test_a_slice_keeps_origin_and_all_columns() -> None:
    record = make_record()
    part = record.slice(1, -1)
    assert (part.name, part.sha256, part.n) == ("r[1:4]", record.sha256, 3)
    np.testing.assert_array_equal(part.time, record.time[1:4])
    assert part.load_force is None
    np.testing.assert_array_equal(part.mask, [False, True, True])
    with pytest.raises(InputError, match="fewer than two"):
        record.slice(3, 4)


def test_arrays_that_do_not_fit_are_all_named() -> None:
    with pytest.raises(InputError) as caught:
        Record(name="r", time=np.arange(4.0), voltage=np.arange(3.0), displacement=np.zeros((4, 1)))
    assert len(caught.value.problems) == 2
    assert "'voltage' has shape (3,)" in caught.value.problems[0]
    assert "'displacement' has shape (4, 1)" in caught.value.problems[1]
    with pytest.raises(InputError, match="has no range"):
        _ = Record(name="r", time=np.arange(4.0), voltage=np.arange(4.0)).range_m


def test_writing_refuses_what_could_not_be_read_back(tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    with pytest.raises(InputError) as caught:
        write_record(path, {"time": [0, 1], "voltage [vlt]": [0, 1], "x [m]": [1, 2, 3]})
    assert len(caught.value.problems) == 3
    with pytest.raises(InputError, match="no columns to write"):
        write_record(path, {})
    assert not path.exists()


@pytest.mark.parametrize(
    ("column", "values", "sentence"),
    [
        ("time", T[::-1], "sample 1 the first of them: the samples are not in the order of time"),
        ("time", np.zeros(24), "sample 1 the first of them: their time repeats"),
        ("voltage", np.where(T < 1.0, np.nan, T), "sample 0, column 'voltage': found no value"),
        ("current", np.full(24, np.inf), "column 'current': found inf, expected a finite number"),
        ("displacement", np.full(24, 1e200), "expected a measured number, below 1e[+]100"),
    ],
)
def test_arrays_are_checked_as_files_are(column: str, values: FloatArray, sentence: str) -> None:
    sound: dict[str, Any] = {"time": T, "voltage": T, "displacement": 1e-6 * T}
    assert Record(name="r", **sound).n == 24
    with pytest.raises(InputError, match=sentence):
        Record(name="r", **{**sound, column: values})


TIME = time_grid(2.0, 1e-3)


@given(st.floats(-50, 100), st.floats(0.1, 200), st.floats(0.6, 60))
def test_no_voltage_leaves_its_range(low: float, span: float, frequency: float) -> None:
    high = low + span
    made = (
        sine(TIME, low, high, frequency),
        triangle(TIME, low, high, frequency),
        decaying_triangle(TIME, low, high, 5),
        multisine(TIME, low, high, (1.0, 1.0 + frequency), seed=1),
    )
    for voltage in made:
        assert voltage.shape == TIME.shape
        assert low <= voltage.min()
        assert voltage.max() <= high
    for voltage in made[:3]:
        assert voltage[0] == pytest.approx(low, abs=1e-9)


def test_sine_and_triangle_reach_their_ends_at_their_times() -> None:
    for voltage in (sine(TIME, -10.0, 90.0, 2.0), triangle(TIME, -10.0, 90.0, 2.0)):
        assert voltage[[0, 250, 500, 750, 1000]] == pytest.approx([-10, 90, -10, 90, -10])
        assert voltage[125] == pytest.approx(40.0)
    rates = np.abs(np.diff(triangle(TIME, -10.0, 90.0, 2.0))) / 1e-3
    np.testing.assert_allclose(rates, 2 * 2.0 * 100.0, rtol=1e-9)


@pytest.mark.parametrize("centre", [0.0, 50.0])
def test_a_decaying_triangle_nests_its_reversals(centre: float) -> None:
    voltage = decaying_triangle(TIME, 0.0, 100.0, 8, centre=centre)
    slope = np.sign(np.diff(voltage))
    turns = voltage[1:-1][np.flatnonzero(np.diff(slope))]
    upper, lower = turns[turns > centre + 1e-9], turns[turns < centre - 1e-9]
    assert upper.size == 8
    assert (np.diff(upper) < 0).all()
    assert (np.diff(lower) > 0).all()
    assert lower.size == (7 if centre else 0)
    assert abs(voltage[-1] - centre) < 0.2
    branch = voltage[:126]
    np.testing.assert_allclose(np.diff(branch), branch[-1] / 125, rtol=1e-9)


def test_a_multisine_is_flat_in_its_band_and_empty_outside() -> None:
    voltage = multisine(TIME, 0.0, 100.0, (5.0, 100.0), seed=3)
    lines = np.abs(np.fft.rfft(voltage)) / TIME.size
    inside = np.zeros(lines.size, dtype=bool)
    inside[10:201] = True
    np.testing.assert_allclose(lines[inside], lines[10], rtol=1e-9)
    assert lines[1:][~inside[1:]].max() < 1e-12
    assert (voltage.min(), voltage.max()) == pytest.approx((0.0, 100.0))
    again = multisine(TIME, 0.0, 100.0, (5.0, 100.0), seed=3)
    np.testing.assert_array_equal(voltage, again)
    assert np.abs(voltage - multisine(TIME, 0.0, 100.0, (5.0, 100.0), seed=4)).max() > 1.0


def test_what_the_grid_cannot_show_is_refused() -> None:
    for call in (
        partial(sine, TIME, 0.0, 1.0, 500.0),
        partial(triangle, TIME, 0.0, 1.0, 0.0),
        partial(decaying_triangle, TIME, 0.0, 1.0, 1000),
        partial(multisine, TIME, 0.0, 1.0, (1.0, 501.0), seed=0),
    ):
        with pytest.raises(InputError, match=r"cannot be resolved .* up to 500 Hz"):
            call()
    with pytest.raises(InputError, match="low below high"):
        sine(TIME, 1.0, 1.0, 1.0)
    with pytest.raises(InputError, match=r"no multiple of 0\.5 Hz"):
        multisine(TIME, 0.0, 1.0, (1.1, 1.4), seed=0)
    with pytest.raises(InputError, match="centre 5"):
        decaying_triangle(TIME, 0.0, 1.0, 4, centre=5.0)


RANDOM = np.random.default_rng(7)


@pytest.mark.parametrize("lower", [[1.0], [1.0, -0.95], [1.0, -1.9, 0.95]])
def test_filtered(lower: list[float]) -> None:
    x = RANDOM.standard_normal((500, 3))
    upper = [0.5, 0.0, -0.2]
    expected = signal.lfilter(upper, lower, x, axis=0)
    np.testing.assert_allclose(filtered(upper, lower, x), expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(filtered(upper, lower, x[:, 0]), expected[:, 0], rtol=1e-10)
    np.testing.assert_allclose(filtered(upper, lower, x[:2]), expected[:2])
    assert not filtered(upper, lower, x[:0]).size


def test_convolved() -> None:
    x, half = RANDOM.standard_normal((500, 3)), RANDOM.standard_normal(40)
    kernel = np.concatenate([half[:0:-1], half])
    expected = signal.oaconvolve(x, kernel[:, None], mode="same", axes=0)
    np.testing.assert_allclose(convolved(x, kernel), expected, atol=1e-11)


def test_peaks() -> None:
    values = np.abs(RANDOM.standard_normal(5000))
    where, _ = signal.find_peaks(values, distance=24)
    expected = where[np.argsort(values[where])[::-1]][:20]
    np.testing.assert_array_equal(peaks(values, 24, 20), expected)


def test_a_diagnosis_without_pages_loads_no_drawing_and_no_statistics() -> None:
    code = (
        "import sys, psa_casadi.diagnosis.diagnose, psa_casadi.report.words.text;"
        "print(*{'matplotlib', 'plotly', 'fmpy', 'scipy.signal', 'scipy.stats'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def with_row(row: int, text: str) -> list[str]:
    return [*ROWS[:row], text, *ROWS[row + 1 :]]


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        (
            "time [s],displacement [um]",
            r"line 1: the column 'voltage' is missing \(present: time, d",
        ),
        ("time [s],voltge [V],displacement [um]", r"'voltge' is unknown; if 'voltage' is meant"),
        (f"{HEADER},load_fource [N]", r"'load_fource' is unknown; if 'load_force' is meant"),
        ("time [s],voltage [vlot],displacement [um]", r"'vlot' is unknown; units of voltage .*kV"),
        ("time [s],voltage,displacement [um]", r"'voltage' has no unit .*'voltage \[V\]'"),
        ("time [s],voltage [],displacement [um]", r"column 'voltage': has no unit"),
        ("time [V],voltage [V],displacement [um]", r"'time': the unit 'V' does not measure time"),
        (
            "time [s],voltage [V],displacement [V]",
            r"not measure length; .* um, nm, pm, counts, or say what 1 in",
        ),
        (f"{HEADER},Voltage [mV]", r"column 4: 'voltage' occurs twice .*\(first as column 2\)"),
        (
            f"time [s],voltage [V],displacement [um{'9' * 500}]",
            r"line 1, column 'displacement': 'um9{58}' is not a unit string; write symbols",
        ),
        ("time [s],voltage [kV99],displacement [um]", r"'voltage': .*kV99' is not a unit string"),
        ("0,1,2", r"line 1: found '0,1,2', expected a header; write .*'time \[s\],voltage \[V\]"),
    ],
)
def test_mistakes_of_the_header(tmp_path: Path, header: str, expected: str) -> None:
    rows = [f"{row},1" if header.count(",") == 3 else row for row in ROWS]
    rows = [row.rsplit(",", 1)[0] if header.count(",") == 1 else row for row in rows]
    problems = problems_of(write(tmp_path / "a.csv", header, *rows))
    assert len(problems) == 1
    with pytest.raises(InputError, match=expected):
        raise InputError(problems)


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        ("0.004,abc,1", "line 6, column 'voltage': found 'abc', expected a number; correct"),
        ("0.004,1_0,1", "line 6, column 'voltage': found '1_0', expected a number"),
        ("0.004,1,#REF!", "line 6, column 'displacement': found '#REF!', expected a number"),
        ("0.004,,1", "line 6, column 'voltage': found no value, expected a number"),
        ("nan,1,1", "line 6, column 'time': found no value, expected a number"),
        ("0.004,inf,1", "line 6, column 'voltage': found inf, expected a finite number"),
        ("0.004,1,-inf", "line 6, column 'displacement': found -inf, expected a finite number"),
        ("0.004,1e101,1", "line 6, column 'voltage': found 1e+101, expected a measured number"),
        ("0.003,1,1", "line 6, column 'time': time repeats (from 0.003 in line 5 to 0.003)"),
        ("0.002,1,1", "line 6, column 'time': time goes back (from 0.003 in line 5 to 0.002)"),
        ("0.004,1", "line 6: found 2 cells, expected 3 as in the header"),
        ("0.004,1,1,1", "line 6: found 4 cells, expected 3 as in the header"),
    ],
)
def test_mistakes_of_a_row(tmp_path: Path, row: str, expected: str) -> None:
    problems = problems_of(write(tmp_path / "a.csv", HEADER, *with_row(4, row)))
    assert len(problems) == 1
    assert expected in problems[0]
    assert problems[0].endswith(".")
    assert ";" in problems[0]


def test_a_quote_that_never_ends_is_reported_as_a_mistake(tmp_path: Path) -> None:
    rows = with_row(4, '0.004,"' + "9" * 200_000 + ",1")
    (problem,) = problems_of(write(tmp_path / "a.csv", HEADER, *rows))
    assert "line 6, column 'voltage': found '\"999" in problem
    header = f'{HEADER},"{"x" * 200_000}'
    assert read_record(write(tmp_path / "b.csv", header, *(f"{row},1" for row in ROWS))).n == 20


def test_one_file_has_one_decimal_sign(tmp_path: Path) -> None:
    for sign, other, name in ((",", ".", "comma"), (".", ",", "point")):
        rows = [row.replace(",", ";").replace(".", sign) for row in ROWS]
        rows[4] = f"0{other}004;4;0{sign}4"
        (problem,) = problems_of(write(tmp_path / "a.csv", HEADER.replace(",", ";"), *rows))
        assert f"line 6, column 'time': found '0{other}004'" in problem
        assert f"other numbers of this file have a decimal {name}, write this one so too" in problem


def test_decimal_commas_between_commas_are_not_a_row_too_long(
    tmp_path: Path,
) -> None:
    rows = [f"0,00{k},1,5,0,{k}" for k in range(9)]
    problems = problems_of(write(tmp_path / "a.csv", HEADER, *rows))
    assert "line 2: found 6 cells, expected 3 as in the header; where numbers have" in problems[0]
    assert "separate the cells by semicolons" in problems[0]


@pytest.mark.parametrize(
    ("order", "problem"),
    [
        ([k for n in range(30) for k in (n, n)], "their time repeats; remove repeated lines"),
        (range(30)[::-1], "the lines are not in the order of time; sort them by it"),
    ],
)
def test_many_lines_out_of_order_are_reported_in_one_sentence(
    order: Sequence[int], problem: str, tmp_path: Path
) -> None:
    lines = [f"{k / 1000},{k % 7},{k % 7 / 10}" for k in order]
    (sentence,) = problems_of(write(tmp_path / "a.csv", HEADER, *lines))
    assert "are not later than the one before, line" in sentence
    assert problem in sentence


@pytest.mark.parametrize("row", ["inf,nan,1", "a,b,c"])
def test_a_file_full_of_mistakes_lists_twenty_and_counts_the_others(
    tmp_path: Path, row: str
) -> None:
    problems = problems_of(write(tmp_path / "a.csv", HEADER, *[row] * 500))
    expected = {"inf,nan,1": 1000, "a,b,c": 1501}[row]
    assert len(problems) == 21
    assert problems[-1] == f"... and {expected - 20} more"


def test_instants_that_are_one_in_seconds_are_refused(tmp_path: Path) -> None:
    rows = [f"{k}e-323,{k},{k}" for k in range(1, 21)]
    assert read_record(write(tmp_path / "a.csv", HEADER, *rows)).n == 20
    header = HEADER.replace("[s]", "[ms]")
    (problem,) = problems_of(write(tmp_path / "b.csv", header, *rows))
    assert "instants are the same in seconds" in problem


def test_lines_without_end_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "a.csv", HEADER, *ROWS, *[""] * 1000)
    assert read_record(path).n == 20
    monkeypatch.setattr(table, "MOST_BYTES", 10_000)
    (problem,) = problems_of(path)
    assert "its lines need more than" in problem


def test_files_that_are_no_csv_are_named_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "empty.csv").write_text("\n \n")
    (tmp_path / "comments.csv").write_text("# only\n# comments\n")
    (tmp_path / "binary.csv").write_bytes(b"PK\x03\x04\x00\x00\x08")
    (tmp_path / "wide.csv").write_bytes("time [s]".encode("utf-16")[:-1])
    reasons = {
        "absent.csv": "there is no such file; check the name",
        "": "is a directory; name the CSV files in it",
        "empty.csv": "the file is empty",
        "comments.csv": "holds no header and no data",
        "binary.csv": "is not text but a binary file",
        "wide.csv": "starts as UTF-16 text and is none",
    }
    for name, reason in reasons.items():
        (problem,) = problems_of(tmp_path / name)
        assert reason in problem
