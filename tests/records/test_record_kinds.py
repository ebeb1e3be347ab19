"""What files of laboratories have in common: tables, times, missing readings, names, numbers."""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from psa_casadi.common.errors import InputError
from psa_casadi.records import Record, read_record, read_records
from tests.records.laboratory_bytes import Cell, hdf5, mat, npz, parquet, tdms, xlsx
from tests.records.record_files import HEADER as HEAD
from tests.records.record_files import assert_is, here, kept, offered, refused, text
from tests.tiers import slow_but

N = 40
T = np.round(np.arange(N) * 4e-4, 7)
V = np.round(50 + 40 * np.sin(np.arange(N) / 3.0), 4)
X = np.round(5 + 4 * np.sin(np.arange(N) / 3.0 - 0.2), 4)


def table(*head: str, columns: Sequence[Any] = (T, V, X), mark: str = ",") -> str:
    return text(*head, columns=columns, mark=mark)


def written(folder: Path, content: str | bytes, name: str = "a.csv") -> Path:
    return kept(folder / name, content)


def is_read(record: Record, t: Any = T, v: Any = V, x: Any = X) -> None:
    assert_is(record, t, v, 1e-6 * x)


def clocks() -> dict[str, list[str]]:
    """Return the times of a record as instruments write them, by how."""
    micro = [round(1e6 * t) for t in T]
    stamp = [f"14:11:02.{m:06d}" for m in micro]
    late = [60 * 59 + 59 + (m + 995000) / 1e6 for m in micro]
    night = [f"{'23' if s < 3600 else '00'}:{int(s) % 3600 // 60:02d}:{s % 60:09.6f}" for s in late]
    epoch = [1709647862000000 + m for m in micro]
    return {
        "ISO": [f"2024-03-05 {s}" for s in stamp],
        "ISO, zone": [f"2024-03-05T{s}+01:00" for s in stamp],
        "German": [f"05.03.2024 {s}" for s in stamp],
        "American": [f"03/05/2024 02:11:02.{m:06d} PM" for m in micro],
        "month": [f"05-Mar-2024 {s}" for s in stamp],
        "clock": stamp,
        "midnight": night,
        "epoch s": [f"{e // 10**6}.{e % 10**6:06d}" for e in epoch],
        "epoch ms": [f"{e // 1000}.{e % 1000:03d}" for e in epoch],
        "epoch us": [str(e) for e in epoch],
        "epoch ns": [f"{e}000" for e in epoch],
        "milliseconds": [f"{1e3 * t:.4f} ms" for t in T],
        "too few digits": [f"{t:.3f}" for t in T],
    }


@pytest.mark.parametrize("how", clocks())
def test_times_are_seconds_from_the_first(how: str, tmp_path: Path) -> None:
    name = "time [s]" if how == "too few digits" else "Timestamp"
    text = table(f"{name},voltage [V],displacement [um]", columns=(clocks()[how], V, X))
    record = read_record(written(tmp_path, text))
    is_read(record)
    assert ("too few digits" in "".join(record.notes)) == (how == "too few digits")


def test_days_of_matlab_are_days(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"time": 739316 + T / 86400, "voltage": V, "displacement_um": X})
    record = read_record(tmp_path / "a.mat")
    np.testing.assert_allclose(np.diff(record.time), 4e-4, atol=2e-5)  # a float of days has no more


@pytest.mark.parametrize(
    "head",
    ["Sampling rate: 2500 Hz", "# dt = 0.4 ms", "Sample Interval,4.0E-04,s", "fs;2.5;kHz",
     "Increment (s),0.0004", "Sample rate [Hz]: 2500"],
)  # fmt: skip
def test_the_time_is_as_the_head_states_it(head: str, tmp_path: Path) -> None:
    text = table("rig 3", head, "voltage [V],displacement [um]", columns=(V, X))
    record = read_record(written(tmp_path, text))
    is_read(record)
    assert "that the file states, 0.0004 s" in record.notes[0]


MISSING = (
    "", "nan", "NaN", "n/a", "N/A", "#N/A", "NA", "null", "None", "---", "-", "--.--", "OVLD", "OL",
    "OVER", "Overflow", "∞", "-∞", "-FFFFFFF", "FFFFFFF", "1.#QNAN", "9.9E37",
    "-9.9E+37", "9.91E37",     "****", "#VALUE!", "Invalid", "Over range",
)  # fmt: skip


def test_words_for_no_reading_are_masked_and_counted(tmp_path: Path) -> None:
    cells = [*MISSING, *(str(x) for x in X)]
    count, size = len(MISSING), len(cells)
    t, v = np.arange(size) / 8.0, np.arange(size) % 7
    record = read_record(written(tmp_path, table(HEAD, columns=(t, v, cells))))
    assert list(np.flatnonzero(~record.mask)) == list(range(count))
    assert f"{count} readings of the displacement are missing" in record.notes[0]
    np.testing.assert_allclose(np.asarray(record.displacement)[count:], 1e-6 * X)
    rows: list[list[Cell]] = [[float(a), float(b), c] for a, b, c in zip(t, v, cells, strict=True)]
    record = read_record(written(tmp_path, xlsx([HEAD.split(","), *rows]), "a.xlsx"))
    assert list(np.flatnonzero(~record.mask)) == list(range(count))


NUMBERS: dict[str, tuple[Callable[[float], str], str]] = {
    "Fortran": (lambda x: f"{x:.4E}".replace("E", "D"), ","),
    "thousands": (lambda x: f"{1e4 * x:,.1f}", ";"),
    "German thousands": (lambda x: f"{1e4 * x:,.1f}".translate(str.maketrans(",.", ".,")), ";"),
    "Swiss thousands": (lambda x: f"{1e4 * x:,.1f}".replace(",", "'"), ";"),
    "French thousands": (
        lambda x: f"{1e4 * x:,.1f}".translate(str.maketrans(",.", "\u202f,")),
        ";",
    ),
    "units in the cells": (lambda x: f"{x} um", ","),
    "units of their own": (lambda x: f"{x} um" if x > 5 else f"{1e3 * x:.1f} nm", ","),
}


@pytest.mark.parametrize("how", NUMBERS)
def test_numbers_as_programs_write_them(how: str, tmp_path: Path) -> None:
    form, mark = NUMBERS[how]
    large = "thousands" in how
    unit = "displacement" if "units" in how else f"displacement [{'A' if large else 'um'}]"
    unit = "displacement [Å]" if large else unit
    head = f"time [s]{mark}voltage [V]{mark}{unit}"
    points = [str(t).replace(".", "," if how[:2] in ("Ge", "Fr") else ".") for t in T]
    volts = [str(v).replace(".", "," if how[:2] in ("Ge", "Fr") else ".") for v in V]
    text = table(head, columns=(points, volts, [form(x) for x in X]), mark=mark)
    is_read(read_record(written(tmp_path, text)))


def test_comments_remarks_and_lines_below_are_no_samples(tmp_path: Path) -> None:
    lines = table(HEAD).splitlines()
    lines[9:9] = ["# the door was opened", "% gain 10", "; later"]
    lines += ["Mean,50.0,5.0", "End of data"]
    is_read(read_record(written(tmp_path, "\n".join(lines))))
    origin = table("Time\tVoltage\tDisplacement", "s\tV\tum", "\tE-504\tsensor 2", mark="\t")
    is_read(read_record(written(tmp_path, origin)))
    wide = table("Time (s)   Drive voltage (V)   Stack displacement (um)", mark="   ")
    is_read(read_record(written(tmp_path, wide)))
    is_read(read_record(written(tmp_path, table("TIME(S) VOLTAGE(V) DISP(UM)", mark=" "))))


NAMES: dict[str, dict[str, Any]] = {
    "Sample,voltage [V],displacement [um]": {"sample_time": 1e-3},
    "No.,OUT1 [V],OUT2 [um]": {"sample_time": 1e-3},
    "time [s],Sync (V),displacement [um]": {},
    "time [s],TTL,Gate,displacement [um]": {},
    "time_s,voltage_1,displacement_1": {
        "columns": "voltage=voltage_1:V,displacement=displacement_1:um"
    },
    "time_s,Vplus_1,Vplus_2,Displacement_2,Displacement_1": {
        "columns": "voltage=Vplus_1:V,displacement=Displacement_1:um"
    },
}


@pytest.mark.parametrize("head", NAMES)
def test_names_that_count_or_mark_are_never_the_time_or_the_drive(
    head: str, tmp_path: Path
) -> None:
    names = head.split(",")
    fill = {"S": np.arange(N), "N": np.arange(N) + 1, "t": T, "d": X, "D": X}
    columns = [fill.get(n[0], X if n == "OUT2 [um]" else V) for n in names]
    path = written(tmp_path, table(head, columns=columns))
    result, wanted = offered(refused(path)), dict(NAMES[head])
    parts = wanted.pop("columns", "").split(",")
    assert {*filter(None, parts)} <= {*result.pop("columns", "").split(",")}
    assert result == wanted


def several(folder: Path) -> dict[str, Path]:
    """Return files that hold two records, the second with twice the voltage, by their form."""
    second = table(HEAD, columns=(T, 2 * V, X))
    rows = [list(map(float, r)) for r in zip(T, V, X, strict=True)]
    twice = [list(map(float, r)) for r in zip(T, 2 * V, X, strict=True)]
    others = table(f"{HEAD},,{HEAD}", columns=(T, V, X, [""] * N, T, 2 * V, X))
    again = table(HEAD, columns=(np.r_[T, T], np.r_[V, 2 * V], np.r_[X, X]))
    with h5py.File(folder / "groups.h5", "w") as file:
        for k in (1, 2):
            for name, values, unit in (("t", T, "s"), ("u", k * V, "V"), ("x", X, "um")):
                file[f"run_{k}/{name}"] = values
                file[f"run_{k}/{name}"].attrs["units"] = unit
    trials = {"time_s": T, "voltage_V": np.array([V, 2 * V]), "displacement_um": np.array([X, X])}
    runs = np.empty((1, 2), dtype=[("time_s", object), ("voltage_V", object), ("pos_um", object)])
    runs[0, 0], runs[0, 1] = (T, V, X), (T, 2 * V, X)
    savemat(folder / "structs.mat", {"run": runs})
    return {
        "stacked": written(folder, f"{table('rig 3', HEAD)}\nrun 2\n{second}", "stacked.csv"),
        "blocks": written(folder, again, "blocks.csv"),
        "beside": written(folder, others, "beside.csv"),
        "sheets": written(
            folder, xlsx([HEAD.split(","), *rows], [HEAD.split(","), *twice]), "sheets.xlsx"
        ),
        "trials": written(folder, npz(trials), "trials.npz"),
        "groups": folder / "groups.h5",
        "structs": folder / "structs.mat",
    }


def test_several_tables_are_listed_chosen_and_taken_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here(monkeypatch)
    for form, path in several(tmp_path).items():
        statement = refused(path)
        requested = offered(statement)
        assert "table=all" in statement, form
        is_read(read_record(path, **requested))
        first, second = read_records([path], columns="table=all")
        is_read(first)
        is_read(second, v=2 * V)
        assert len({first.sha256, second.sha256}) == len({first.name, second.name}) == 2
        is_read(read_record(path, columns="table=2"), v=2 * V)


def test_packets_have_no_separate_time(tmp_path: Path) -> None:
    packets = table(HEAD, columns=(np.tile([0.0, 1e-5], N // 2), V, X))
    path = written(tmp_path, packets)
    statement = refused(path)
    assert "the time restarts every 2 lines" in statement
    assert offered(statement) == {"sample_time": 1e-3}
    is_read(read_record(path, sample_time=4e-4))


def channel(values: Any, unit: str, time: Any = T) -> str:
    return table(f"time [s],channel [{unit}]", columns=(time, values))


def test_channels_in_separate_files_are_joined(tmp_path: Path) -> None:
    one = written(tmp_path, channel(V, "V"), "v.csv")
    two = written(tmp_path, channel(X, "um"), "x.csv")
    assert "files of one channel each are joined as FILE+FILE" in refused(one)
    (record,) = read_records([one, two])
    is_read(record)
    is_read(read_record(f"{one}+{two}"))
    late = written(tmp_path, channel(X, "um", T + 1e-4), "late.csv")
    (record,) = read_records([one, late])
    assert record.n == N - 1
    assert "late.csv has another clock" in " ".join(record.notes)
    np.testing.assert_allclose(
        np.asarray(record.displacement), 1e-6 * np.interp(T[1:], T + 1e-4, X), rtol=1e-12
    )
    other = written(tmp_path, channel(X, "um", T + 9.0), "other.csv")
    assert "have no instants in common" in refused(Path(f"{one}+{other}"))


def test_dates_of_files_to_be_joined_are_on_one_clock(tmp_path: Path) -> None:
    def stamped(late: float) -> list[str]:
        return [f"2024-03-05 14:11:02.{round(1e6 * (t + late)):06d}" for t in T]

    drive = table("Timestamp,U [V]", columns=(stamped(0.0), V))
    sensor = table("Timestamp,x [um]", columns=(stamped(2e-3), X))  # starts five samples later
    paths = [written(tmp_path, drive, "v.csv"), written(tmp_path, sensor, "x.csv")]
    (record,) = read_records(paths)
    is_read(record, t=T[5:], v=V[5:], x=X[:-5])
    bare = written(tmp_path, channel(X, "um"), "bare.csv")
    assert "some have dates or clock times, others numbers" in refused(Path(f"{paths[0]}+{bare}"))


def tektronix(name: str, values: Any) -> str:
    head = {"Record Length": N, "Sample Interval": 4e-4, "Source": name, "Vertical Units": "V",
            "Horizontal Units": "s"}  # fmt: skip
    cells = [*(f"{k},{v}" for k, v in head.items()), *[","] * (N - len(head))]
    rows = zip(cells, T, values, strict=True)
    return "\n".join(f"{cell},,{t:.12f},{v:10.5f}," for cell, t, v in rows)


def test_settings_next_to_the_samples_are_no_samples(tmp_path: Path) -> None:
    channels = {"CH1": V, "CH2": X}
    paths = [written(tmp_path, tektronix(n, y), f"F0000{n}.CSV") for n, y in channels.items()]
    with pytest.raises(InputError) as caught:
        read_records(paths)
    requested = offered(str(caught.value))
    assert requested == {"columns": "voltage=CH1:V,displacement=CH2:1um"}
    is_read(*read_records(paths, **requested))
    bad = paths[0].read_text().replace(f"{V[3]:10.5f}", "  oops")
    assert "line 4, column 'voltage': found 'oops'" in refused(written(tmp_path, bad, "b.csv"))


@pytest.mark.parametrize(
    ("unit", "size"),
    [("inch", 0.0254), ("thou", 2.54e-5), ("mil", 2.54e-5), ("Å", 1e-10), ("cm", 1e-2)],
)
def test_any_unit_of_the_right_dimension_is_read(unit: str, size: float, tmp_path: Path) -> None:
    record = read_record(written(tmp_path, table(f"time [s],voltage [V],displacement [{unit}]")))
    np.testing.assert_allclose(np.asarray(record.displacement), size * X, rtol=1e-12)


def csv(columns: Mapping[str, Any]) -> bytes:
    rows = (",".join(map(repr, map(float, row))) for row in zip(*columns.values(), strict=True))
    return "\n".join([",".join(columns), *rows, ""]).encode()


def named(columns: Mapping[str, Any]) -> dict[str, Any]:
    return {re.sub(r"\W+", "_", name).strip("_"): values for name, values in columns.items()}


WRITERS: dict[str, Callable[[Mapping[str, Any]], bytes]] = {
    ".csv": csv,
    ".xlsx": lambda c: xlsx([list(c), *np.column_stack(list(c.values())).tolist()]),
    ".h5": lambda c: hdf5(named(c), {}, compression="lzf"),
    ".parquet": lambda c: parquet(c, row_group_size=64),
    ".tdms": lambda c: tdms(c, {}),
    ".npz": npz,
    ".mat": lambda c: mat(named(c)),
}


@pytest.mark.parametrize("width", [3, 12])
@pytest.mark.parametrize("rows", slow_but([16, 101, 1000], [16, 99, 100, 101, 1000, 100_000]))
@pytest.mark.parametrize("suffix", WRITERS)
def test_every_row_is_read_bit_for_bit(
    suffix: str, rows: int, width: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here(monkeypatch)
    width = 3 if (suffix, rows) == (".xlsx", 100_000) else width
    draw = np.random.default_rng(rows)
    steps, *others = draw.uniform(1e-4, 1e-3, (width, rows)).round(12)  # a workbook has 15 digits
    names = [*HEAD.replace("um", "m").split(","), *(f"extra {k}" for k in range(width - 3))]
    columns = dict(zip(names, [np.cumsum(steps).round(12), *others], strict=True))
    path = tmp_path / f"a{suffix}"
    path.write_bytes(WRITERS[suffix](columns))
    record = read_record(path)
    np.testing.assert_array_equal(record.time, columns["time [s]"])
    np.testing.assert_array_equal(record.voltage, columns["voltage [V]"])
    np.testing.assert_array_equal(np.asarray(record.displacement), columns["displacement [m]"])
