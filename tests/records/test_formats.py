"""Records in other formats and spellings than a plain CSV file."""

import hashlib
from collections.abc import Mapping
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.feather
import pyarrow.parquet
import pytest
import pyuff
from numpy.typing import NDArray
from openpyxl import Workbook

from psa_casadi.common.errors import InputError
from psa_casadi.records import Record, read_record, read_records
from psa_casadi.records.read import apart
from psa_casadi.records.read.columns import parse_columns
from tests.records import laboratory_bytes
from tests.records.laboratory_bytes import hdf5, parquet, tdms
from tests.records.record_files import HEADER, ROWS, assert_is, here, kept, problems_of, write

N = 24
T = np.arange(N) / 8.0
U = np.sin(T)
Y = np.cos(T)
COLUMNS = "time=t:ms,voltage=u:mV,displacement=y:nm"
START = datetime(2024, 3, 5, 14, 11, 2)


def mat(path: Path, content: Mapping[str, Any], version: str = "5") -> Path:
    """Write a MATLAB file as MATLAB does: vectors upright, v7.3 as transposed HDF5."""
    if version == "7.3":
        arrays = {name: np.atleast_2d(values) for name, values in content.items()}
        path.write_bytes(hdf5(arrays, {}, userblock_size=512))
    else:
        packed = version == "7"
        path.write_bytes(laboratory_bytes.mat(content, do_compression=packed, oned_as="column"))
    return path


def table(path: Path, columns: Mapping[str, object]) -> Path:
    path.write_bytes(parquet(columns))
    return path


@pytest.mark.parametrize("version", ["5", "7", "7.3"])
@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int16])
def test_matlab_arrays_of_every_version_and_kind(
    tmp_path: Path, version: str, kind: type[np.generic]
) -> None:
    arrays: dict[str, NDArray[np.generic]] = {
        "t": np.arange(N).astype(kind),
        "u": (100 * U).astype(kind),
        "y": (1000 * Y).astype(kind),
    }
    path = mat(tmp_path / "rig.mat", arrays, version)
    record = read_record(path, columns=COLUMNS)
    t, u, y = (arrays[name].astype(float) for name in "tuy")
    assert_is(record, t / 1e3, u / 1e3, y / 1e9)
    assert record.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert (record.name, record.source) == ("rig", str(path))


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_structures_matrices_lying_vectors_and_names_with_units(
    tmp_path: Path, version: str
) -> None:
    content: dict[str, Any] = {
        "log": {"t": T, "deep": {"u": U}}, "m": np.column_stack([T, U, Y]), "lying": Y[None, :],
        "note": "rig 3",
    }  # fmt: skip
    if version == "7.3":
        content = {"log/t": T, "log/deep/u": U, "m": np.vstack([T, U, Y]), "lying": Y[None, :]}
    path = mat(tmp_path / "a.mat", content, version)
    record = read_record(path, columns="time=log.t,voltage=log.deep.u,displacement=lying:um")
    assert_is(record, T, U, Y / 1e6)
    record = read_record(path, columns="time=m.1:ms,voltage=m.2,displacement=m.3[mm]")
    assert_is(record, T / 1e3, U, Y / 1e3)
    named = {"time_ms": T, "voltage": U, "displacement_um": Y, "temperature_degC": 20 + Y}
    record = read_record(mat(tmp_path / "b.mat", named, version))
    assert_is(record, T / 1e3, U, Y / 1e6)
    np.testing.assert_allclose(np.asarray(record.temperature), 293.15 + Y)


def test_parquet_columns_are_named_as_in_a_csv_header(tmp_path: Path) -> None:
    columns = {
        "remark": ["ok"] * N,
        "displacement [counts]": np.arange(N, dtype=np.int32),
        "Time [ms]": T.astype(np.float32),
        "voltage [kV]": U,
        "Load Force [N]": Y,
    }
    path = table(tmp_path / "a.parquet", columns)
    record = read_record(path)
    assert_is(record, T / 1e3, U * 1e3, np.arange(N))
    assert record.displacement_unit == "counts"
    assert record.load_force is not None
    assert record.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    other = table(tmp_path / "b.pq", {"t [ms]": T, "Piezo": U, "x": Y, "voltage [V]": Y})
    record = read_record(other, columns="time=t,voltage=piezo:mV,displacement=x:um")
    assert_is(record, T / 1e3, U / 1e3, Y / 1e6)


def test_columns_of_a_csv_file_under_other_names(tmp_path: Path) -> None:
    header = "t [ms],amp out,LVDT [um],voltage [V]"
    path = write(tmp_path / "a.csv", header, *(f"{r},9" for r in ROWS))
    record = read_record(path, columns="time=t,voltage=amp out:mV,displacement=lvdt:µm")
    plain = read_record(write(tmp_path / "b.csv", HEADER, *ROWS))
    assert_is(record, plain.time / 1e3, plain.voltage / 1e3, plain.displacement)
    (problem,) = problems_of(path, columns="time=t,voltage=amp out,displacement=LVDT:mm")
    assert "line 1, column 'LVDT': the header gives the unit 'um', --columns gives 'mm'" in problem
    (problem,) = problems_of(path, columns="time=t,displacement=LVTD")
    assert "'LVTD', which --columns names for 'displacement', is not in the header" in problem
    assert "(present: time, voltage, amp out, LVDT)" in problem
    (problem,) = problems_of(
        write(tmp_path / "c.csv", "time [s],voltage [V],y", *ROWS), columns="displacement=y"
    )
    assert "line 1, column 'y': has no unit" in problem


def test_options_for_one_file_apply_to_all(tmp_path: Path) -> None:
    text = "time=t:s,voltage=U:V,displacement=y:um"
    mine = ",".join(f"b.csv@{part}" for part in ("time=t:ms", "voltage=CH1:V", "displacement=y:um"))
    first = write(tmp_path / "a.csv", "t,U,y", *ROWS)
    second = write(tmp_path / "b.csv", "t,CH1,y", *ROWS)
    a, b = read_records([first, second], columns=f"{text},{mine}")
    assert_is(b, a.time / 1e3, a.voltage, a.displacement)
    (problem,) = problems_of(first, columns=mine)
    assert "line 1" in problem


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("voltage", "'voltage': is not understood; write NAME=ARRAY:UNIT"),
        ("voltage=", "'voltage=': is not understood"),
        ("voltag=u", "'voltag' is no column of a record; is 'voltage' meant?"),
        ("torque=u", "'torque' is no column of a record; there are time, voltage"),
        ("voltage=u,voltage=v", "'voltage=v': 'voltage' is specified twice"),
        ("a.csv@voltage=u,a.csv@voltage=v", "'a.csv@voltage' is specified twice"),
        ("voltage=u:um", "the unit 'um' does not measure voltage"),
        ("voltage=u:vlots", "the unit 'vlots' is unknown"),
        ("voltage=u:", "has no unit"),
    ],
)
def test_mistakes_of_the_columns_option(text: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_columns(text)
    (problem,) = caught.value.problems
    assert problem.startswith("--columns, '")
    assert expected in problem


def test_mistakes_of_a_matlab_file_are_reported_at_once(tmp_path: Path) -> None:
    t, y = T.copy(), Y.copy()
    t[5], y[9] = t[3], np.inf
    path = mat(tmp_path / "a.mat", {"t": t, "u": np.r_[U[:4], np.nan, U[5:]], "y": y, "z": Y[:7]})
    problems = problems_of(path, columns="time=t,voltage=u,displacement=y:um")
    assert len(problems) == 3
    assert "sample 6, column 'time': time goes back (from 0.5 in sample 5 to 0.375)" in problems[0]
    assert "in every sample; remove repeated samples" in problems[0]
    assert "sample 5, column 'voltage': found no value" in problems[1]
    assert "fill the cell or remove the sample" in problems[1]
    assert "sample 10, column 'displacement': found inf" in problems[2]
    problems = problems_of(path)
    assert "array names: 'time' has no unit (t), 'voltage' has no unit (u)" in problems[0]
    assert "--columns" not in "".join(problems)  # what would not read the file is not offered
    problems = problems_of(path, columns="time=t,voltage=w,displacement=y")
    assert "'w', which --columns names for 'voltage', is not in the header" in "".join(problems)
    assert "column 'y': has no unit; write it in brackets" in "".join(problems)
    (problem,) = problems_of(path, columns="time=t,voltage=u,displacement=z:um")
    assert "array 'z' (displacement) has 7 values, 'time' has 24" in problem


def test_files_that_differ_from_their_ending(tmp_path: Path) -> None:
    text = "\n".join([HEADER, *ROWS]).encode()
    broken = b"MATLAB 7.3".ljust(512) + b"\x89HDF\r\n\x1a\n" + b"x" * 50
    for name, content, kind in (
        ("text.mat", text, "MATLAB"), ("text.parquet", text, "Parquet"),
        ("broken.mat", broken, "MATLAB"),
    ):  # fmt: skip
        (problem,) = problems_of(kept(tmp_path / name, content))
        assert f"is no readable {kind} file" in problem
    empty = mat(tmp_path / "empty.mat", {"note": "nothing"})
    assert "the column 'time' is missing (present: nothing)" in problems_of(empty)[0]


def test_a_missing_optional_package_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = table(tmp_path / "a.parquet", {"time [s]": T, "voltage [V]": U, "displacement [um]": Y})
    monkeypatch.setattr(apart, "find_spec", lambda name: None)
    (problem,) = problems_of(path)
    assert "reading it needs pyarrow, which is not installed; run `pip install pyarrow`" in problem


def is_read(record: Record, accuracy: float = 1e-12) -> None:
    assert_is(record, T, U, 1e-6 * Y, accuracy)


@pytest.mark.parametrize("binary", [0, 1])
def test_universal_files_have_an_even_time_and_units(
    binary: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here(monkeypatch)
    file = pyuff.UFF(str(tmp_path / "a.uff"))
    for name, values, unit in (("voltage", U, "V"), ("displacement", Y, "um")):
        one = pyuff.prepare_58(
            binary=binary, func_type=1, rsp_node=1, rsp_dir=1, ref_dir=1, ref_node=1, data=values,
            x=T, id1=name, ord_data_type=4, num_pts=N, abscissa_spacing=1, abscissa_min=0.0,
            abscissa_inc=T[1], abscissa_spec_data_type=17, ordinate_spec_data_type=8,
            orddenom_spec_data_type=0, z_axis_spec_data_type=0, ordinate_axis_units_lab=unit,
        )  # fmt: skip
        file.write_sets(one, mode="add")
    is_read(read_record(tmp_path / "a.uff"), accuracy=1e-5)


def test_the_result_of_a_modelica_tool_has_names_and_units(tmp_path: Path) -> None:
    def texts(words: list[str]) -> Any:
        width = max(map(len, words))
        return np.array([list(w.ljust(width)) for w in words]).T.copy()

    lines = ["".join(row) for row in texts(["time", "drive.v", "tip.s"])]
    about = ["".join(row) for row in texts(["time [s]", "drive [V]", "tip [um]"])]
    content = {
        "Aclass": np.array([w.ljust(11) for w in ("Atrajectory", "1.1", "", "binTrans")]),
        "name": np.array(lines), "description": np.array(about),
        "dataInfo": np.array([[0, 2, 2], [1, 2, -3], [0, 0, 0], [-1, -1, -1]], dtype="i4"),
        "data_1": np.zeros((1, 2)), "data_2": np.stack([T, U, -Y]),
    }  # fmt: skip
    (tmp_path / "result.mat").write_bytes(laboratory_bytes.mat(content, "4"))
    columns = "voltage=drive.v,displacement=tip.s:um"
    is_read(read_record(tmp_path / "result.mat", columns=columns))


@pytest.mark.parametrize("kind", ["timestamp", "duration", "text"])
def test_instants_and_units_of_parquet(kind: str, tmp_path: Path) -> None:
    since = pyarrow.array((1e9 * T).astype("timedelta64[ns]"))
    stamps = pyarrow.array([START + timedelta(seconds=t) for t in T.tolist()])
    text = pyarrow.array([(START + timedelta(seconds=t)).isoformat() for t in T.tolist()])
    time = {"timestamp": stamps, "duration": since, "text": text}[kind]
    numbers = [pyarrow.array(U), pyarrow.array([None if k == 3 else y for k, y in enumerate(Y)])]
    fields = [
        pyarrow.field("Timestamp", time.type),
        pyarrow.field("drive", pyarrow.float64(), metadata={"unit": "V"}),
        pyarrow.field("tip", pyarrow.float64(), metadata={"units": "um"}),
    ]
    result = pyarrow.Table.from_arrays([time, *numbers], schema=pyarrow.schema(fields))
    pyarrow.parquet.write_table(result, tmp_path / "a.parquet")
    requested: dict[str, Any] = {"columns": "time=Timestamp:s"} if kind == "text" else {}
    record = read_record(tmp_path / "a.parquet", **requested)
    np.testing.assert_allclose(record.time, T, atol=1e-9)
    assert list(np.flatnonzero(~record.mask)) == [3]


def test_a_file_of_another_ending_is_known_by_its_first_bytes(tmp_path: Path) -> None:
    named = {"time [s]": T, "voltage [V]": U, "displacement [um]": Y}
    pyarrow.feather.write_feather(pyarrow.table(named), str(tmp_path / "a.feather"))
    feather, path = (tmp_path / "a.feather").read_bytes(), tmp_path / "a.log"
    units = {"time": "s", "voltage": "V", "displacement": "um"}
    arrays = hdf5(dict(zip(units, (T, U, Y), strict=True)), units)
    for content in (feather, parquet(named), tdms(named, {}), arrays):
        is_read(read_record(kept(path, content)))
    is_read(read_record(tmp_path / "a.feather"))


def test_dates_in_workbooks_and_instants_of_tdms(tmp_path: Path) -> None:
    book = Workbook()
    sheet = book.worksheets[0]
    sheet.append(["Datum", "U [V]", "Weg [um]"])
    for t, v, x in zip(T.tolist(), U.tolist(), Y.tolist(), strict=True):
        sheet.append([START + timedelta(seconds=8000 * t), v, x])
    book.save(tmp_path / "a.xlsx")
    record = read_record(tmp_path / "a.xlsx", columns="time=Datum")
    np.testing.assert_allclose(record.time, 8000 * T, atol=1e-3)
    instants = np.datetime64(START, "us") + (1e6 * T).astype("timedelta64[us]")
    channels = {"Timestamp": instants, "voltage": U, "displacement [um]": Y}
    (tmp_path / "a.tdms").write_bytes(tdms(channels, {}))
    is_read(read_record(tmp_path / "a.tdms"))


def test_a_sample_rate_next_to_the_arrays_is_their_clock(tmp_path: Path) -> None:
    rate = {"voltage_V": U, "displacement_um": Y, "fs": 8.0}
    is_read(read_record(mat(tmp_path / "a.mat", rate)))
