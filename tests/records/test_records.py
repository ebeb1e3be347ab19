import math
import time as clock
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import FloatArray
from psa_casadi.records import Record, read_record, write_record
from tests.records.record_files import HEADER, ROWS, write
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


def test_records_made_in_memory_are_told_apart_by_their_hash() -> None:
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
        ("time", np.zeros(24), "sample 1 the first of them: their time stands still"),
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
