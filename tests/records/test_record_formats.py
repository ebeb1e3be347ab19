"""Formats of other programs, with units, times and structures as these write them."""

from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pytest
import pyuff
from nptdms import ChannelObject, TdmsWriter
from openpyxl import Workbook
from pyarrow import parquet
from scipy.io import savemat

from psa_casadi.records import Record, read_record
from tests.records.reading_here import here
from tests.records.record_files import assert_is

N = 40
T = np.arange(N) / 1000.0
V = np.round(50 + 40 * np.sin(np.arange(N) / 3.0), 4)
X = np.round(5 + 4 * np.sin(np.arange(N) / 3.0 - 0.2), 4)
START = datetime(2024, 3, 5, 14, 11, 2)


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    here(monkeypatch)


def is_read(record: Record, accuracy: float = 1e-12) -> None:
    assert_is(record, T, V, 1e-6 * X, accuracy)


@pytest.mark.parametrize("binary", [0, 1])
def test_universal_files_have_an_even_time_and_units(binary: int, tmp_path: Path) -> None:
    file = pyuff.UFF(str(tmp_path / "a.uff"))
    for name, values, unit in (("voltage", V, "V"), ("displacement", X, "um")):
        one = pyuff.prepare_58(
            binary=binary, func_type=1, rsp_node=1, rsp_dir=1, ref_dir=1, ref_node=1, data=values,
            x=T, id1=name, ord_data_type=4, num_pts=N, abscissa_spacing=1, abscissa_min=0.0,
            abscissa_inc=1e-3, abscissa_spec_data_type=17, ordinate_spec_data_type=8,
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
        "data_1": np.zeros((1, 2)), "data_2": np.stack([T, V, -X]),
    }  # fmt: skip
    savemat(tmp_path / "result.mat", content, format="4")
    columns = "voltage=drive.v,displacement=tip.s:um"
    is_read(read_record(tmp_path / "result.mat", columns=columns))


@pytest.mark.parametrize("kind", ["timestamp", "duration", "text"])
def test_instants_and_units_of_parquet(kind: str, tmp_path: Path) -> None:
    since = pyarrow.array((1e9 * T).astype("timedelta64[ns]"))
    stamps = pyarrow.array([START + timedelta(seconds=t) for t in T.tolist()])
    text = pyarrow.array([(START + timedelta(seconds=t)).isoformat() for t in T.tolist()])
    time = {"timestamp": stamps, "duration": since, "text": text}[kind]
    numbers = [pyarrow.array(V), pyarrow.array([None if k == 3 else x for k, x in enumerate(X)])]
    fields = [
        pyarrow.field("Timestamp", time.type),
        pyarrow.field("drive", pyarrow.float64(), metadata={"unit": "V"}),
        pyarrow.field("tip", pyarrow.float64(), metadata={"units": "um"}),
    ]
    table = pyarrow.Table.from_arrays([time, *numbers], schema=pyarrow.schema(fields))
    parquet.write_table(table, tmp_path / "a.parquet")
    asked: dict[str, Any] = {"columns": "time=Timestamp:s"} if kind == "text" else {}
    record = read_record(tmp_path / "a.parquet", **asked)
    np.testing.assert_allclose(record.time, T, atol=1e-9)
    assert list(np.flatnonzero(~record.mask)) == [3]


def test_dates_in_workbooks_and_instants_of_tdms(tmp_path: Path) -> None:
    book = Workbook()
    sheet = book.worksheets[0]
    sheet.append(["Datum", "U [V]", "Weg [um]"])
    for t, v, x in zip(T.tolist(), V.tolist(), X.tolist(), strict=True):
        sheet.append([START + timedelta(seconds=1000 * t), v, x])
    book.save(tmp_path / "a.xlsx")
    record = read_record(tmp_path / "a.xlsx", columns="time=Datum")
    np.testing.assert_allclose(record.time, 1000 * T, atol=1e-3)
    instants = np.datetime64(START, "us") + (1e6 * T).astype("timedelta64[us]")
    with TdmsWriter(tmp_path / "a.tdms") as writer:
        channels = {"Timestamp": instants, "voltage": V, "displacement [um]": X}
        writer.write_segment([ChannelObject("g", n, values) for n, values in channels.items()])
    is_read(read_record(tmp_path / "a.tdms"))


def test_a_sample_rate_beside_the_arrays_is_their_clock(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"voltage_V": V, "displacement_um": X, "fs": 1000.0})
    is_read(read_record(tmp_path / "a.mat"))
