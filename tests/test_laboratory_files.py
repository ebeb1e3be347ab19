"""One record in the forms that laboratories keep it in: read as it is, or told what to type."""

import gzip
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from psa_casadi.errors import InputError
from psa_casadi.records import read_record

N = 20
T = np.arange(N) * 1e-3
V = np.arange(N) % 7 + 0.5
X = np.arange(N) % 7 / 10 + 0.25


def rows(delimiter: str = ",", time: float = 1.0, point: str = ".") -> list[str]:
    lines = (
        delimiter.join(f"{c:.6g}" for c in cells) for cells in zip(time * T, V, X, strict=True)
    )
    return [line.replace(".", point) if point != "." else line for line in lines]


def text(*head: str, **form: str) -> bytes:
    return "\n".join([*head, *rows(**form), ""]).encode()  # type: ignore[arg-type]


READ: dict[str, bytes] = {
    "own names": text("time [s],voltage [V],displacement [um]"),
    "symbols with units": text("t [s],V [V],x [um]"),
    "round brackets": text("Time (s),Voltage (V),Displacement (um)"),
    "micro sign": text("Time (s),Voltage (V),Displacement (µm)"),
    "underscores": text("time_s,voltage_V,displacement_um"),
    "slashes": text("t/s,U/V,x/um"),
    "spaces in names": text("Elapsed time (s),Drive voltage (V),Sensor position (um)"),
    "quoted": text('"Time (s)","Voltage (V)","Position (um)"'),
    "German": text("Zeit [s];Spannung [V];Weg [um]", delimiter=";", point=","),
    "a row of units": text("time,voltage,displacement", "s,V,um"),
    "a row of units in brackets": text("Time,Voltage,Position", "(s),(V),(um)"),
    "a preamble": text(
        "Device;P-885.51", "Date;2026-11-25", "", "Time (s),Voltage (V),Position (um)"
    ),
    "a preamble of comments": text("# made by a logger", "# gain 10", "time_s,voltage_V,pos_um"),
    "a header in a comment": text("# time [s] voltage [V] position [um]", delimiter=" "),
    "tabs": text("time [s]\tvoltage [V]\tdisplacement [um]", delimiter="\t"),
    "spaces": text("time_s voltage_V displacement_um", delimiter="   "),
    "semicolons": text("time [s];voltage [V];displacement [um]", delimiter=";"),
    "UTF-16": text("Time (s),Voltage (V),Position (µm)").decode().encode("utf-16"),
    "gzip": gzip.compress(text("time [s],voltage [V],displacement [um]")),
    "Windows line ends": text("time [s],voltage [V],displacement [um]").replace(b"\n", b"\r\n"),
    "a column more": "\n".join(
        ["time_s,voltage_V,displacement_um,comment", *(f"{r},ok" for r in rows()), ""]
    ).encode(),
}


def assert_read(path: Path, columns: str | None = None) -> None:
    record = read_record(path, columns=columns)
    assert record.displacement is not None
    np.testing.assert_allclose(record.time, T, rtol=1e-12)
    np.testing.assert_allclose(record.voltage, V, rtol=1e-12)
    np.testing.assert_allclose(record.displacement, 1e-6 * X, rtol=1e-5)


@pytest.mark.parametrize("form", READ)
def test_a_laboratorys_file_is_read_as_it_is(form: str, tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_bytes(READ[form])
    assert_read(path)


OPEN: dict[str, bytes] = {
    "symbols without units": text("t,V,x"),
    "names without units": text("Elapsed time,Drive voltage,Position"),
    "no header": text(),
    "no header, spaces": text(delimiter=" "),
}


@pytest.mark.parametrize("form", OPEN)
def test_what_cannot_be_decided_ends_with_the_line_to_type(form: str, tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_bytes(OPEN[form])
    with pytest.raises(InputError) as caught:
        read_record(path)
    typed = re.search(r"--columns (\S.*?) \(with your units\)", str(caught.value))
    assert typed is not None, caught.value
    assert_read(path, columns=typed[1])


@pytest.mark.parametrize(
    ("head", "given", "line"),
    [
        ("t,V,x", None, "time=t:s,voltage=V:V,displacement=x:um"),
        ("time [s],V,x", None, "voltage=V:V,displacement=x:um"),
        ("t,V,x", "time=t:ms", "time=t:ms,voltage=V:V,displacement=x:um"),
        ("t,V,x [um]", "voltage=V", "voltage=V,time=t:s"),
    ],
)
def test_the_line_to_type_is_told_once_and_works(
    head: str, given: str | None, line: str, tmp_path: Path
) -> None:
    path = tmp_path / "r.csv"
    milliseconds = 1e3 if ":ms" in line else 1.0
    path.write_text("\n".join([head, *rows(time=milliseconds), ""]))
    with pytest.raises(InputError) as caught:
        read_record(path, columns=given)
    assert re.findall(r"--columns (\S+) \(with your units\)", str(caught.value)) == [line]
    assert len(caught.value.problems) == 1
    assert_read(path, columns=line)


def test_two_cells_for_one_column_are_not_guessed(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    lines = ["time_s,voltage_V,position_um,stroke_um", *(f"{r},0" for r in rows())]
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match="may be more than one column"):
        read_record(path)
    assert_read(path, "displacement=position_um:um")


def test_an_own_name_goes_before_another(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    lines = ["time [s],voltage [V],displacement [um],x [um]", *(f"{r},0" for r in rows())]
    path.write_text("\n".join(lines) + "\n")
    assert_read(path)


def test_a_unit_that_does_not_fit_is_told(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_bytes(text("Time (V),Voltage (V),Position (um)"))
    with pytest.raises(InputError, match="does not measure time"):
        read_record(path)


@pytest.mark.parametrize(
    "spoil", [lambda d: d[:40], lambda d: d[:10] + b"\0" * 9 + d[19:], lambda _: b"\x1f\x8b"]
)
def test_a_damaged_gzip_file_is_refused(spoil: Callable[[bytes], bytes], tmp_path: Path) -> None:
    path = tmp_path / "r.csv.gz"
    path.write_bytes(spoil(READ["gzip"]))
    with pytest.raises(InputError, match="damaged gzip"):
        read_record(path)
