"""Columns by their units, never against their names; the head of a file as the page shows it."""

import gzip
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet
from scipy.io import savemat

from psa_casadi.common.errors import InputError
from psa_casadi.records import Record, read_record
from psa_casadi.records.read.apart import head_of
from psa_casadi.records.read.columns import Field, parse_columns
from tests.records.laboratory_bytes import Cell, xlsx
from tests.records.record_files import T, V, X, assert_is, offered, refused, table, text


def is_read(record: Record, t: float = 1.0, v: float = 1.0, x: float = 1e-6) -> None:
    """Demand the record that was written, its columns in units of these sizes."""
    assert_is(record, t * T, v * V, x * X, 1e-5)


def suggestion(path: Path) -> str:
    """Return what is suggested for the file, once for all that is open; it can be parsed."""
    line: str = offered(refused(path))["columns"]
    assert parse_columns(line)
    return line


@pytest.mark.parametrize(
    ("head", "sizes"),
    [
        (["Elapsed (us),PZT cmd (V),Probe (mm)"], (1e-6, 1.0, 1e-3)),
        (["Clock (ms),U_amp (V),s (nm)"], (1e-3, 1.0, 1e-9)),
        (["t/s,U/V,s/um"], (1.0, 1.0, 1e-6)),
        (["Clock_ms,Drive_mV,Probe_nm"], (1e-3, 1e-3, 1e-9)),
        (["Clock [ms],Drive [mV],Probe [nm]"], (1e-3, 1e-3, 1e-9)),
        (["ms,mV,nm"], (1e-3, 1e-3, 1e-9)),
        (["Seconds,Millivolts,Microns"], (1.0, 1e-3, 1e-6)),
        (["Time,Command,Disp.", "s,V,um"], (1.0, 1.0, 1e-6)),
        (["Time (s),Command,Disp.", "(s),(V),(um)"], (1.0, 1.0, 1e-6)),
        (["of 12 March", "", "Clock (s),Bridge (V),Stage (um)"], (1.0, 1.0, 1e-6)),
        (["# Clock (s),Bridge (V),Stage (um)"], (1.0, 1.0, 1e-6)),
        (["T (s),U (V),x (um)"], (1.0, 1.0, 1e-6)),
    ],
)
def test_columns_are_recognised_by_their_units(
    head: list[str], sizes: tuple[float, float, float], tmp_path: Path
) -> None:
    is_read(read_record(table(tmp_path / "a.csv", *head)), *sizes)


@pytest.mark.parametrize(
    ("head", "monitor"),
    [
        ("Time (s),HV out (V),s (um),Drive Monitor/mV", 1e-3),
        ("Time (s),PZT cmd (V),Probe (um),PZT mon (V)", None),
        ("Time (s),Bridge (V),Probe (um),Position sensor (V)", None),
        ("Time (s),Bridge (V),Probe (um),Setpoint (um)", None),
        ("Time (s),Bridge (V),Probe (um),Velocity (um/s)", None),
        ("Time (s),Bridge (V),Probe (um),T (degC)", None),
        ("Time (s),U (V),x (um),V_min", None),
    ],
)
def test_what_a_name_speaks_against_is_left_alone(
    head: str, monitor: float | None, tmp_path: Path
) -> None:
    record = read_record(table(tmp_path / "a.csv", head, columns=(T, V, X, 9.0 + X)))
    is_read(record)
    if monitor is None:
        assert record.monitor_voltage is None
    else:
        np.testing.assert_allclose(np.asarray(record.monitor_voltage), monitor * (9.0 + X))


@pytest.mark.parametrize(
    ("head", "line"),
    [
        ("t,mV,nm", "time=t:s"),
        ("Elapsed (us),CH1,CH2", "voltage=CH1:V,displacement=CH2:um"),
        ("CH1,Elapsed,nm", "time=Elapsed:s,voltage=CH1:V"),
        ("t (s),U1 (V),U2 (V),Probe (um)", "voltage=U1 (V):V"),
        ("t (s),LV (V),HV (V),Probe (um)", "voltage=HV (V):V"),
        ("t (s),U (V),Command (V),Probe (um)", "voltage=U (V):V"),
        ("t (s),Drive,CH2 (V),Probe (um)", "voltage=CH2 (V):V"),
        ("t (s),HV out,Drive Monitor/mV,s (nm)", "voltage=HV out:V"),
        ("t (s),Probe (mV),Drive (mV)", "displacement=Probe (mV):1um"),
        ("t (s),CH1 (mV),CH2 (mV)", "voltage=CH1 (mV):mV,displacement=CH2 (mV):1um"),
        ("t (s),CH1_V,CH2_V", "voltage=CH1_V:V,displacement=CH2_V:1um"),
        ("t (s),U (V),Probe (um),Stage (nm)", "displacement=Probe (um):um"),
        ("Zeit,Kanal A,Kanal B", "time=Zeit:s,voltage=Kanal A:V,displacement=Kanal B:um"),
        ("t,U_amp,x", "time=t:s,voltage=U_amp:V,displacement=x:um"),
    ],
)
def test_what_is_open_is_requested_and_never_suggested_against_a_unit(
    head: str, line: str, tmp_path: Path
) -> None:
    columns = (T, V, X, X)[: head.count(",") + 1]
    columns = (V, T, X) if head == "CH1,Elapsed,nm" else columns
    assert suggestion(table(tmp_path / "a.csv", head, columns=columns)) == line


@pytest.mark.parametrize(
    ("head", "problem"),
    [
        ("t (s),Drive Monitor (V),Probe (um)", "column 'voltage' is missing"),
        ("t (s),Position sensor (V),Probe (um)", "column 'voltage' is missing"),
        ("t (s),U (V),Setpoint (um)", "column 'displacement' is missing"),
        ("t (s),U (V),um/s", "column 'displacement' is missing"),
        ("V/um,t/s,x/um", "column 'voltage' is missing"),
    ],
)
def test_nothing_is_suggested_that_is_not_meant(head: str, problem: str, tmp_path: Path) -> None:
    statement = refused(table(tmp_path / "a.csv", head))
    assert problem in statement
    assert "--columns" not in statement


def test_columns_without_a_unit_have_that_of_the_name(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", "Elapsed (us),A_mV,B (V),C/nm,D (nm)", columns=(T, V, V, X, X))
    is_read(read_record(path, columns="voltage=A_mV,displacement=C/nm"), 1e-6, 1e-3, 1e-9)
    statement = refused(path, columns="time=Elapsed (us):s,voltage=A_mV,displacement=C/nm")
    assert "the header gives the unit 'us', --columns gives 's'" in statement
    archive = tmp_path / "a.npz"
    np.savez(archive, a=T, b_mV=V, c_mV=V, x=X)
    is_read(read_record(archive, columns="time=a,voltage=b_mV,displacement=x:um"), 1.0, 1e-3)


@pytest.mark.parametrize(
    ("head", "mark", "point"),
    [
        (["sep=;", "Clock (s);Bridge (V);Stage (um)"], ";", ","),
        (['"sep=;"', "Time, s;Voltage, V;Stage, um"], ";", "."),
        (["sep=|", "t [s]|u [V]|x [um]"], "|", "."),
        (["SEP=\t", "ch0\tch1\tch2", "s\tV\tum"], "\t", ","),
        (["sep=,", "t [s],u [V],x [um]"], ",", "."),
    ],
)
def test_excels_first_line_sets_the_separator(
    head: list[str], mark: str, point: str, tmp_path: Path
) -> None:
    path = table(tmp_path / "a.csv", *head, mark=mark, point=point)
    is_read(read_record(path))
    path.write_text(path.read_text().replace(f"{5 * 1e-3:.6g}".replace(".", point), "oops"))
    assert f"line {len(head) + 6}, column 'time': found 'oops'" in refused(path)


def structures(*items: Mapping[str, Any]) -> Any:
    """Return several MATLAB structures of the same fields, as SciPy writes them."""
    result = np.empty((1, len(items)), dtype=[(key, object) for key in items[0]])
    for k, item in enumerate(items):
        result[0, k] = tuple(item.values())
    return result


def recorded(path: Path, *signals: Mapping[str, Any], clocks: int = 1, packed: bool = True) -> Path:
    """Write what dSPACE ControlDesk records: `X` with the time, `Y` with the signals."""
    times = structures(*[{"Type": "double", "Data": T}] * clocks)
    content = {"X": times, "Y": structures(*signals), "Description": {"General": {"Version": "5"}}}
    savemat(path, {"exp001": content}, do_compression=packed)
    return path


@pytest.mark.parametrize("packed", [True, False])
def test_a_recording_of_control_desk_is_read(tmp_path: Path, *, packed: bool) -> None:
    named = [{"Name": "Model Root/U_amp [V]", "Data": V}, {"Name": "Probe (um)", "Data": X}]
    is_read(read_record(recorded(tmp_path / "a.mat", *named, packed=packed)))
    stated = [
        {"Name": "Model Root/DAC/cmd", "Data": V, "Unit": "V", "XIndex": 1.0},
        {"Name": "Model Root/ADC/monitor", "Data": V, "Unit": "V", "XIndex": 1.0},
        {"Name": "Weg µ", "Data": X, "Unit": "um", "XIndex": 1.0},
    ]
    path = recorded(tmp_path / "b.mat", *stated, packed=packed)
    is_read(read_record(path))
    columns = "voltage=exp001.Model Root/ADC/monitor,displacement=exp001.Weg µ:nm"
    is_read(read_record(path, columns=columns), x=1e-9)


def test_what_a_recording_leaves_open_is_requested(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    for names, (drive, moved) in (
        (("Out1", "Out1"), ("Y.1", "Y.2")),
        (("Model Root/cmd", "Model Root/Out1"), ("Model Root/cmd", "Model Root/Out1")),
    ):
        line = f"voltage=exp001.{drive}:V,displacement=exp001.{moved}:um"
        signals = [{"Name": n, "Data": y} for n, y in zip(names, (V, X), strict=True)]
        assert suggestion(recorded(path, *signals)) == line
        is_read(read_record(path, columns=line))
    assert suggestion(recorded(path, *signals, clocks=2)) == line  # the two clocks are the same


ROWS = text().splitlines()


def fields(*units: str) -> dict[str, Field]:
    """Return the fields of a record whose columns are in order, in these units."""
    names = ("time", "voltage", "displacement")
    return {n: Field(k, u) for k, (n, u) in enumerate(zip(names, units, strict=True))}


def test_names_units_and_first_rows_of_a_table(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", "of 12 March", "", "time [ms],Drive (V),x/um")
    head = head_of(path, 3)
    assert head.names == ("time", "Drive (V)", "x/um")
    assert head.units == ("ms", "V", "um")
    assert head.rows == tuple(tuple(row.split(",")) for row in ROWS[:3])
    assert head.guess == fields("ms", "V", "um")
    packed = tmp_path / "a.csv.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert head_of(packed, 3) == head


def test_what_is_requested_is_guessed_as_it_is_suggested(tmp_path: Path) -> None:
    head = head_of(table(tmp_path / "a.csv", "Elapsed (us),CH1,CH2"))
    assert head.guess == fields("us", "V", "um")
    head = head_of(table(tmp_path / "b.csv", "t (s),CH1 (mV),CH2 (mV)"))
    assert head.units == ("s", "mV", "mV")
    assert head.guess["voltage"] == Field(1, "mV")
    assert head.guess["displacement"] == Field(2, "um")  # of a sensor's volts: to be scaled
    head = head_of(table(tmp_path / "c.csv", "t (s),Drive Monitor (V),Setpoint (um)"))
    assert head.guess == {"time": Field(0, "s"), "monitor_voltage": Field(1, "V")}


def test_a_name_with_a_mark_of_the_option_is_no_name(tmp_path: Path) -> None:
    head = head_of(table(tmp_path / "a.csv", '"time [s]","U, V","x: um"'))
    assert head.names == ("time", "", "")
    assert head.guess["voltage"] == Field(1, "V")


def test_arrays_of_several_lengths(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, t=T, u_mV=V, x=X, fs=1e3 * np.ones(2))
    head = head_of(path, 3)
    assert head.names == ("t", "u_mV", "x", "fs")
    assert head.units == ("", "mV", "", "")
    assert head.rows == (
        ("0", "0.5", "0.25", "1000"),
        ("0.001", "1.5", "0.35", "1000"),
        ("0.002", "2.5", "0.45", ""),
    )
    assert head.guess == fields("s", "mV", "um")


def test_workbooks_and_parquet_files_have_the_same_head(tmp_path: Path) -> None:
    names: list[Cell] = ["time [s]", "U_amp [V]", "note"]
    cells: list[list[Cell]] = [[float(t), float(v), "ok"] for t, v in zip(T, V, strict=True)]
    book, file = tmp_path / "a.xlsx", tmp_path / "a.parquet"
    book.write_bytes(xlsx([names, *cells]))
    columns = dict(zip(names, zip(*cells, strict=True), strict=True))
    parquet.write_table(pyarrow.table({n: list(c) for n, c in columns.items()}), file)
    for path in (book, file):
        head = head_of(path, 2)
        assert head.names == ("time", "U_amp", "note")
        assert head.units == ("s", "V", "")
        assert [row[1:] for row in head.rows] == [("0.5", "ok"), ("1.5", "ok")]
        assert head.guess["voltage"] == Field(1, "V")


def test_the_head_of_one_of_several_tables(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", "time [s],U [V],x [um]")
    second = ["run 2", "Clock [ms],Drive [V],Probe [nm]", *ROWS, ""]
    path.write_text("\n".join([path.read_text(), *second]))
    assert head_of(path).tables == ("1", "2")
    assert head_of(path).names == ("time", "U", "x")
    assert head_of(path, table="2").units == ("ms", "V", "nm")


@pytest.mark.parametrize("name", ["a.csv", "a.mat", "a.xlsx", "a.parquet", "a.npz"])
def test_a_file_that_is_none_is_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    with pytest.raises(InputError, match="there is no such file"):
        head_of(path)
    path.write_bytes(b"PK\x03\x04\x00\x00\x08")
    with pytest.raises(InputError, match=name):
        head_of(path)
