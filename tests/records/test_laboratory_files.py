"""One record in the forms of laboratories: read unchanged, or refused with what to type."""

import gzip
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from psa_casadi.common.errors import InputError
from psa_casadi.records import read_record, record_from
from psa_casadi.records.read.columns import parse_columns
from tests.records import record_files
from tests.records.laboratory_bytes import Cell, gcs, hdf5, lvm, named, npy, npz, tdms, xlsx
from tests.records.record_files import T, V, X, assert_is, offered, problems_of, refused, text

TABLE = np.column_stack([T, V, X])
ROWS: list[list[float]] = TABLE.tolist()
NAMED = {"time": T, "voltage": V, "displacement_um": X}
VX = {"Voltage": V, "Position": X}
STATED = {"Voltage": {"unit_string": "V"}, "Position": {"unit_string": "um"}}
WAVE = {"wf_increment": 1e-3, "wf_start_offset": 0.0}
WAVES = {name: {**unit, **WAVE} for name, unit in STATED.items()}
H5_UNITS = {"run/t": "s", "run/drive voltage": "V", "run/sensor position": "um"}
H5 = dict(zip(H5_UNITS, (T, V, X), strict=True))
VX_ROWS = [row[1:] for row in ROWS]
DRIVEN = {"voltage": V, "displacement": X}
NAMES: list[list[Cell]] = [[None, "Time", "Voltage", "Weg"], [None, "s", "V", "µm"]]
FIELDS = named(T, V, X)

#: Files that are read unchanged, by their form; the name implies the ending.
READ: dict[str, str | bytes] = {
    "canonical names": text("time [s],voltage [V],displacement [um]"),
    "symbols with units": text("t [s],V [V],x [um]"),
    "round brackets": text("Time (s),Voltage (V),Displacement (um)"),
    "micro sign": text("Time (s),Voltage (V),Displacement (µm)"),
    "underscores": text("time_s,voltage_V,displacement_um"),
    "slashes": text("t/s,U/V,x/um"),
    "spaces in names": text("Elapsed time (s),Drive voltage (V),Sensor position (um)"),
    "quoted": text('"Time (s)","Voltage (V)","Position (um)"'),
    "German": text("Zeit [s];Spannung [V];Weg [um]", mark=";", point=","),
    "a row of units": text("time,voltage,displacement", "s,V,um"),
    "a row of units in brackets": text("Time,Voltage,Position", "(s),(V),(um)"),
    "a preamble": text(
        "Device;P-885.51", "Date;2026-11-25", "", "Time (s),Voltage (V),Position (um)"
    ),
    "a preamble of comments": text("# made by a logger", "# gain 10", "time_s,voltage_V,pos_um"),
    "a header in a comment": text("# time [s] voltage [V] position [um]", mark=" "),
    "tabs": text("time [s]\tvoltage [V]\tdisplacement [um]", mark="\t"),
    "spaces": text("time_s voltage_V displacement_um", mark="   "),
    "semicolons": text("time [s];voltage [V];displacement [um]", mark=";"),
    "UTF-16": text("Time (s),Voltage (V),Position (µm)").encode("utf-16"),
    "gzip": gzip.compress(text("time [s],voltage [V],displacement [um]").encode()),
    "Windows line ends": text("time [s],voltage [V],displacement [um]").replace("\n", "\r\n"),
    "old line ends": text("time [s],voltage [V],displacement [um]").replace("\n", "\r"),
    "UTF-8 with a mark": text("\ufefftime [s],voltage [V],displacement [µm]"),
    "Western Europe": text(
        "# Pr\xfcfstand 3", "time [s];voltage [V];displacement [µm]", mark=";"
    ).encode("cp1252"),
    "German, all quoted": re.sub(
        r"[^;\n]+", r'"\g<0>"', text("Zeit [s];Spannung [V];Weg [um]", mark=";", point=",")
    ),
    "a column more": text(
        "time_s,voltage_V,displacement_um,comment", columns=(T, V, X, ["ok"] * 20)
    ),
    "units written out": text("Time (sec),Voltage (Volts),Position (microns)"),
    "UTF-16 without a mark": text("Time (s),Voltage (V),Position (um)").encode("utf-16-le"),
    "quoted, units behind a comma": text('"Time, s","Voltage, V","Displacement, um"'),
    "LabVIEW, one time.lvm": lvm([*VX], ROWS, units=["Volts", "um"]),
    "LabVIEW, no time.lvm": lvm([*VX], VX_ROWS, columns="No", units=["V", "um"], comma=True),
    "LabVIEW, times of channels.lvm": lvm(["Voltage (V)", "Position (um)"], ROWS, columns="Multi"),
    "Excel.xlsx": xlsx([["Time (s)", "Voltage (V)", "Position (um)"], *ROWS]),
    "Excel, preamble and units.xlsx": xlsx(
        [["gain", 10, "V/V"], [], *NAMES, *([None, *row] for row in ROWS)]
    ),
    "Excel, second sheet.xlsx": xlsx([["notes"], ["date, place"]], [["t/s", "U/V", "x/um"], *ROWS]),
    "TDMS, waveforms.tdms": tdms(VX, WAVES),
    "TDMS, a channel of time.tdms": tdms(
        {"Time": T, **VX}, {"Time": {"unit_string": "s"}, **STATED}
    ),
    "HDF5, groups and units.h5": hdf5(H5, H5_UNITS),
    "HDF5, packed, a sample rate.hdf5": hdf5(
        DRIVEN,
        {"voltage": "V", "displacement": "um"},
        {"fs": 1e3},
        compression="gzip",
        shuffle=True,
    ),
    "HDF5, a table.h5": hdf5({"log": FIELDS}, {}),
    "NumPy archive.npz": npz(NAMED),
    "NumPy fields.npy": npy(FIELDS),
}


def assert_read(path: Path, columns: str | None = None) -> None:
    assert_is(read_record(path, columns=columns), T, V, 1e-6 * X, 1e-5)


def kept(folder: Path, form: str, content: str | bytes) -> Path:
    """Write a file whose ending is that of its form's name, else `.csv`."""
    return record_files.kept(folder / f"r{Path(form).suffix or '.csv'}", content)


@pytest.mark.parametrize("form", READ)
def test_a_laboratorys_file_is_read_as_it_is(form: str, tmp_path: Path) -> None:
    assert_read(kept(tmp_path, form, READ[form]))


#: Counted samples of two channels, with three empty cells.
COUNTED = (np.arange(20), V, X, *[[""] * 20] * 3)
#: Files that do not say enough.
OPEN: dict[str, str | bytes] = {
    "symbols without units": text("t,V,x"),
    "names without units": text("Elapsed time,Drive voltage,Position"),
    "no header": text(),
    "no header, spaces": text(mark=" "),
    "an oscilloscope, settings above": text(
        "Record Length,20,Points", "Sample Interval,0.001,s", "TIME,CH1,CH2"
    ),
    "an oscilloscope, names below settings": text("Model,X,1", "x-axis,1,2"),
    "an oscilloscope, volts": text("x-axis,1,2", "second,Volt,Volt"),
    "an oscilloscope, steps counted": text(
        "X,CH1,CH2,Start,Increment,",
        "Sequence,Volt,Volt,0.000000e+00,1.000000e-03,",
        columns=COUNTED,
    ),
    "channels with spaces": text("Zeit;Kanal A;Kanal B", "(s);(V);(mV)", mark=";", point=","),
    "LabVIEW, untitled.lvm": lvm(["Untitled", "Untitled 1"], ROWS),
    "data recorder.dat": gcs(
        ["Voltage of output channel 1", "Current Position of axis 1"], VX_ROWS
    ),
    "data recorder, axes by colon.txt": gcs(
        ["Voltage of Chan:1", "Real Position of AXIS:1"], VX_ROWS
    ),
    "Excel without units.xlsx": xlsx([["t", "V", "x"], *ROWS]),
    "Excel without a header.xlsx": xlsx(ROWS),
    "TDMS without units.tdms": tdms({"t": T, "ai0": V, "ai1": X}, {}),
    "HDF5 without units.h5": hdf5({"a/t": T, "a/u": V, "a/x": X}, {}),
    "NumPy matrix.npy": npy(TABLE),
    "NumPy matrix in an archive.npz": npz({"log": TABLE.T}),
}


@pytest.mark.parametrize("form", OPEN)
def test_what_cannot_be_decided_ends_with_the_line_to_type(form: str, tmp_path: Path) -> None:
    path = kept(tmp_path, form, OPEN[form])
    assert_read(path, **offered(refused(path)))  # one line for all that is open


@pytest.mark.parametrize(
    ("head", "columns", "line"),
    [
        ("t,V,x", None, "time=t:s,voltage=V:V,displacement=x:um"),
        ("time [s],V,x", None, "voltage=V:V,displacement=x:um"),
        ("t,V,x", "time=t:ms", "time=t:ms,voltage=V:V,displacement=x:um"),
        ("t,V,x [um]", "voltage=V", "voltage=V,time=t:s"),
    ],
)
def test_the_line_to_type_is_reported_once_and_works(
    head: str, columns: str | None, line: str, tmp_path: Path
) -> None:
    time = 1e3 * T if ":ms" in line else T
    path = kept(tmp_path, "a", text(head, columns=(time, V, X)))
    (problem,) = problems_of(path, columns=columns)
    assert offered(problem) == {"columns": line}
    assert_read(path, columns=line)


@pytest.mark.parametrize(
    "spoil", [lambda d: d[:40], lambda d: d[:10] + b"\0" * 9 + d[19:], lambda _: b"\x1f\x8b"]
)
def test_a_damaged_gzip_file_is_refused(spoil: Callable[[bytes], bytes], tmp_path: Path) -> None:
    path = record_files.kept(tmp_path / "r.csv.gz", spoil(gzip.compress(text().encode())))
    with pytest.raises(InputError, match="damaged gzip"):
        read_record(path)


def test_a_sample_time_replaces_a_column(tmp_path: Path) -> None:
    path = kept(tmp_path, "a.npz", npz({"voltage": V, "displacement_um": X}))
    with pytest.raises(InputError, match=r"give the time between samples: --sample-time 0\.001"):
        read_record(path)
    record = read_record(path, sample_time=1e-3)
    np.testing.assert_allclose(record.time, T, rtol=1e-12)
    path.write_bytes(npz(NAMED))
    record = read_record(path, sample_time=2e-3)
    np.testing.assert_allclose(record.time, 2 * T, rtol=1e-12)
    assert "the times of the file are left out" in record.notes[0]
    table = {"voltage [V]": V, "displacement [um]": X}
    np.testing.assert_allclose(record_from(table, sample_time=0.5).time, 500 * T, rtol=1e-12)
    with pytest.raises(InputError, match=r"the sample time -1\.0 s is no time"):
        record_from(table, sample_time=-1.0)


def test_channels_of_several_instants_are_no_record(tmp_path: Path) -> None:
    content = lvm(["Voltage (V)", "Position (um)"], ROWS, columns="Multi")
    path = kept(tmp_path, "a.lvm", content.replace(b"0.003000\t", b"0.003100\t", 1))
    with pytest.raises(InputError, match=r"line 19: the channels were sampled at different insta"):
        read_record(path)


def test_a_mistake_in_a_workbook_is_reported_with_its_row(tmp_path: Path) -> None:
    rows: list[list[float | str]] = [[*row] for row in ROWS]
    rows[4][1] = "off"
    path = kept(tmp_path, "a.xlsx", xlsx([["t [s]", "V [V]", "x [um]"], *rows]))
    with pytest.raises(InputError, match="row 6, column 'voltage': found 'off'"):
        read_record(path)


def test_a_scale_defines_the_unit_in_the_file(tmp_path: Path) -> None:
    path = kept(tmp_path, "a", text("x-axis,1,2", "second,Volt,Volt"))
    record = read_record(path, columns="time=x-axis,voltage=1:15V,displacement=2:-2.5e0 um")
    np.testing.assert_allclose(record.voltage, 15.0 * V, rtol=1e-12)
    np.testing.assert_allclose(np.asarray(record.displacement), -2.5e-6 * X, rtol=1e-12)
    archive = kept(tmp_path, "a.npz", npz({"time": T, "u": V, "x": X}))
    record = read_record(archive, columns="voltage=u:1e1V,displacement=x:.5nm")
    np.testing.assert_allclose(record.voltage, 10.0 * V, rtol=1e-12)
    np.testing.assert_allclose(np.asarray(record.displacement), 0.5e-9 * X, rtol=1e-12)


@pytest.mark.parametrize("scale", ["0", "-0.0", "1e999"])
def test_a_scale_that_leaves_nothing_is_refused(scale: str) -> None:
    with pytest.raises(InputError, match="leaves nothing of the numbers"):
        parse_columns(f"displacement=x:{scale}um")
