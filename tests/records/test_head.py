"""The head of a file: names that `--columns` takes, units, first rows, what is taken for what."""

import gzip
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from psa_casadi.common.errors import InputError
from psa_casadi.records.read.apart import head_of
from psa_casadi.records.read.columns import Field
from tests.records.laboratory_bytes import Cell, xlsx
from tests.records.record_files import T, V, X, table, text

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


def test_what_is_asked_is_guessed_as_it_is_suggested(tmp_path: Path) -> None:
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
