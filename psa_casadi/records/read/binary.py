"""Files of other programs, read by the libraries that the field reads them with.

Each reader returns the tables of the file at a path. It runs in a process of its own
(`records.read.apart`), since what is damaged may crash a library or fill the memory.
"""

import zipfile
from collections.abc import Callable
from datetime import date, datetime, time, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from psa_casadi.records.read.arrays import (
    UNITS,
    Series,
    array_tables,
    series_in,
    unit_stated,
)
from psa_casadi.records.read.file_bytes import check_size
from psa_casadi.records.read.hdf5 import hdf5_tables
from psa_casadi.records.read.matlab import matlab_tables
from psa_casadi.records.read.table import Cells, Table
from psa_casadi.records.read.text import text_tables

_MARKS = str.maketrans(dict.fromkeys('\t\r\n;"', " "))


def excel_tables(path: str) -> list[Table]:
    """Return the tables of a workbook (.xlsx, .xlsm, .xls, .ods), those of hidden sheets last."""
    from python_calamine import CalamineWorkbook, SheetVisibleEnum  # noqa: PLC0415

    book = CalamineWorkbook.from_path(path)
    shown = sorted(
        book.sheets_metadata, key=lambda sheet: sheet.visible != SheetVisibleEnum.Visible
    )
    found = []
    for sheet in shown:
        rows = book.get_sheet_by_name(sheet.name).to_python(skip_empty_area=False)
        lines = [
            "\t".join(map(_cell_text, row)) if any(c != "" for c in row) else "" for row in rows
        ]
        found += text_tables(path, _without_empty(lines), "row", sheet.name)
    return found


def _cell_text(cell: object) -> str:
    """Return a cell as text without the marks that separate cells of a table."""
    if isinstance(cell, float | int) and not isinstance(cell, bool):
        return repr(float(cell))
    if isinstance(cell, datetime | date | time):
        return cell.isoformat(sep=" ") if isinstance(cell, datetime) else cell.isoformat()
    if isinstance(cell, timedelta):
        return f"{cell.total_seconds()!r} s"
    return " ".join(str(cell).translate(_MARKS).split())


def _without_empty(lines: list[str]) -> list[str]:
    """Return rows of tab-separated cells without the columns that are empty in all of them."""
    width = max((line.count("\t") + 1 for line in lines), default=0)
    rows = [line.split("\t") + [""] * (width - 1 - line.count("\t")) for line in lines]
    kept = [k for k in range(width) if any(row[k] for row in rows)]
    return ["\t".join(row[k] for k in kept) if any(row) else "" for row in rows]


def tdms_tables(path: str) -> list[Table]:
    """Return the tables of a TDMS file: channels by their names, and groups where several are.

    Units and time are as the properties of the channels state them.
    """
    import nptdms  # noqa: PLC0415
    from nptdms.log import log_manager  # noqa: PLC0415

    log_manager.set_level(50)  # it tells of damage on the terminal
    file = nptdms.TdmsFile.read_metadata(path)
    channels = [c for group in file.groups() for c in group.channels()]
    if sum(len(c) * c.dtype.itemsize for c in channels) > 2 * Path(path).stat().st_size:
        raise ValueError("it states more numbers than it has bytes for")
    several = len(file.groups()) > 1
    found, steps = [], set()
    for channel in channels:
        if channel.dtype.kind not in "biufM":
            continue
        name = f"{channel.group_name}.{channel.name}" if several else channel.name
        unit = next((u for k, u in channel.properties.items() if k.lower() in UNITS), None)

        def read(group: str = channel.group_name, own: str = channel.name) -> Cells:
            with nptdms.TdmsFile.open(path) as whole:
                return np.asarray(whole[group][own][:])

        found.append(Series(name, len(channel), read, unit_stated(unit)))
        steps |= {float(s) for k, s in channel.properties.items() if k == "wf_increment" and s > 0}
    return array_tables(path, found, steps)


def parquet_tables(path: str) -> list[Table]:
    """Return the table of a Parquet or Feather file; only the columns of a record are read."""
    from pyarrow import feather, parquet  # noqa: PLC0415

    if path.lower().endswith((".feather", ".arrow")):
        whole = feather.read_table(path)
        schema, rows = whole.schema, whole.num_rows
    else:
        whole = None
        file = parquet.ParquetFile(path, pre_buffer=False, page_checksum_verification=True)
        schema, rows = file.schema_arrow, file.metadata.num_rows

    def read(name: str) -> Cells:
        return _arrow_cells((whole or file.read([name], use_threads=False)).column(name), rows)

    found = []
    for field in schema:
        about = {k.decode().lower(): v.decode() for k, v in (field.metadata or {}).items()}
        unit = next((u for k, u in about.items() if k in UNITS), None)
        found.append(Series(field.name, rows, partial(read, field.name), unit))
    return array_tables(path, found, place="row")


def _arrow_cells(column: Any, rows: int) -> Cells:
    """Return a column as numbers, null as nan, as instants, or as texts."""
    import pyarrow  # noqa: PLC0415

    if len(column) != rows:
        raise ValueError(f"{len(column)} of the {rows} rows that it states")
    kinds = pyarrow.types
    if kinds.is_timestamp(column.type) or kinds.is_date(column.type):
        column = column.cast(pyarrow.timestamp("ns"), safe=False)
    elif kinds.is_time(column.type) or kinds.is_duration(column.type):
        column = column.cast(pyarrow.duration(column.type.unit)).cast(pyarrow.duration("ns"))
    elif kinds.is_integer(column.type) and not column.null_count:
        pass
    elif (
        kinds.is_integer(column.type)
        or kinds.is_floating(column.type)
        or kinds.is_decimal(column.type)
    ):
        column = column.cast(pyarrow.float64(), safe=False)
    else:
        return ["" if v is None else str(v) for v in column.to_pylist()]
    return np.asarray(column.to_numpy())


def numpy_tables(path: str) -> list[Table]:
    """Return the tables of a NumPy file: of a matrix the columns, of an archive all by name.

    Nothing is unpickled.
    """
    found = np.load(path, allow_pickle=False, mmap_mode="r" if path.endswith(".npy") else None)
    if isinstance(found, np.ndarray):
        return array_tables(path, series_in("", found))
    with zipfile.ZipFile(path) as archive:
        check_size(path, sum(m.file_size for m in archive.infolist()), "its arrays hold")
    return array_tables(path, [s for name in found.files for s in series_in(name, found[name])])


def universal_tables(path: str) -> list[Table]:
    """Return the tables of a universal file (UFF, data set 58, text or binary)."""
    import pyuff  # noqa: PLC0415

    found: list[Series] = []
    steps = []
    for k, one in enumerate(pyuff.UFF(path).read_sets() or []):
        if one.get("type") != 58:
            continue
        name = str(one.get("id1") or "").strip()
        name = name if name and name.upper() != "NONE" else f"channel {k + 1}"
        unit = str(one.get("ordinate_axis_units_lab") or "").strip()
        found += series_in(name, np.real(one["data"]), unit)
        if one.get("abscissa_spacing") == 1:
            steps.append(float(one["abscissa_inc"]))
        elif not steps:
            found += series_in("time", np.asarray(one["x"]), "s")
    return array_tables(path, found, steps)


#: What reads a file, by its ending, and the package that it needs.
READERS: dict[str, tuple[Callable[[str], list[Table]], str]] = {
    **dict.fromkeys((".xlsx", ".xlsm", ".xls", ".xlsb", ".ods"), (excel_tables, "python_calamine")),
    ".mat": (matlab_tables, "pymatreader"),
    **dict.fromkeys((".h5", ".hdf5", ".hdf"), (hdf5_tables, "h5py")),
    ".tdms": (tdms_tables, "nptdms"),
    **dict.fromkeys((".npy", ".npz"), (numpy_tables, "numpy")),
    **dict.fromkeys((".parquet", ".pq", ".feather", ".arrow"), (parquet_tables, "pyarrow")),
    **dict.fromkeys((".uff", ".unv", ".uf", ".bunv"), (universal_tables, "pyuff")),
}
#: Files whose makers' programs write something that is read, by their ending.
EXPORTS = {
    ".raw": "a result of SPICE", ".trc": "a LeCroy waveform", ".isf": "a Tektronix waveform",
    ".wfm": "an oscilloscope's waveform", ".bin": "a binary waveform", ".ibw": "an Igor wave",
    ".psdata": "a PicoScope file", ".svd": "a Polytec file", ".pvd": "a Polytec file",
    ".mf4": "a measurement file", ".mdf": "a measurement file", ".opj": "an Origin project",
    ".opju": "an Origin project", ".d7d": "a Dewesoft file", ".dxd": "a Dewesoft file",
}  # fmt: skip
_MAGIC = {
    b"\x89HDF": ".h5", b"PK\x03\x04": ".xlsx", b"PAR1": ".parquet", b"TDSm": ".tdms",
    b"\x93NUM": ".npy", b"MATL": ".mat", b"ARRO": ".feather", b"\xd0\xcf\x11\xe0": ".xls",
}  # fmt: skip


def ending_of(path: str) -> str:
    """Return the ending that says how a file is read, "" for text.

    Where the name has another, the first bytes of the file tell.
    """
    ending = Path(path).suffix.lower()
    if ending in READERS or ending in (".csv", ".gz"):
        return ending if ending in READERS else ""
    try:
        with Path(path).open("rb") as stream:
            return _MAGIC.get(stream.read(4), "")
    except OSError:
        return ""
