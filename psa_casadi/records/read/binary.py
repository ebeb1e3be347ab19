"""Files of other programs, read by the libraries that the field reads them with.

Each reader returns the tables of the file at a path. It runs in a process of its own
(`records.read.apart`), since what is damaged may crash a library or fill the memory.
"""

import math
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping
from datetime import date, datetime, time, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from psa_casadi.errors import InputError
from psa_casadi.records.read.arrays import Series, array_tables, series_in, told_step, unit_stated
from psa_casadi.records.read.file_bytes import check_size
from psa_casadi.records.read.names import name_without_unit, stated_unit
from psa_casadi.records.read.table import Cells, Table
from psa_casadi.records.read.text import text_tables

_MARKS = str.maketrans(dict.fromkeys('\t\r\n;"', " "))
_UNITS = ("units", "unit", "unit_string")


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


def matlab_tables(path: str) -> list[Table]:
    """Return the tables of a MATLAB file of any level, one of a Modelica tool, or of Simulink.

    A field of a structure is named `log.u`, of the second of several `log.2.u`. Of a matrix the
    series are named `m.1`, `m.2`, ...; they lie along its longer side.
    """
    import h5py  # noqa: PLC0415

    if h5py.is_hdf5(path):
        import pymatreader  # noqa: PLC0415

        with h5py.File(path, "r") as file:
            held = _check_links(path, file, set())
            check_size(path, sum(d.size * d.dtype.itemsize for d in held), "its arrays hold")
        tree = pymatreader.read_mat(path)
    else:
        from scipy.io import loadmat  # noqa: PLC0415

        tree = loadmat(path, simplify_cells=True)
    if {"Aclass", "name", "dataInfo"} <= set(tree):
        return array_tables(path, _modelica(path))
    return array_tables(path, [s for top, value in tree.items() for s in _of_tree(top, value)])


def _of_tree(name: str, value: Any) -> Iterator[Series]:
    value = _elements(value)
    if isinstance(value, list):
        value = {str(k): inner for k, inner in enumerate(value, 1)}
    if isinstance(value, Mapping):
        for field, inner, unit in _recorded(value) or ((k, v, None) for k, v in value.items()):
            if isinstance(inner, np.ndarray) and unit is not None:
                yield from series_in(f"{name}.{field}", inner, unit)
            else:
                yield from _of_tree(f"{name}.{field}", inner)
    elif isinstance(value, np.ndarray):
        yield from series_in(name, value)


def _elements(value: Any) -> Any:
    """Return several structures or cells as a list: they come as an array or by their fields."""
    if isinstance(value, np.ndarray) and value.dtype == object:
        return list(value.ravel())
    if isinstance(value, Mapping) and len(value) > 1:
        counts = {len(v) if isinstance(v, list) else 0 for v in value.values()}
        if len(counts) == 1 and (count := counts.pop()) > 1:
            return [{k: v[i] for k, v in value.items()} for i in range(count)]
    return value


def _recorded(value: Mapping[str, Any]) -> list[tuple[str, Any, str | None]] | None:
    """Return name, numbers and unit of what dSPACE ControlDesk records, None where it is another.

    There `X` holds the time in seconds as `Data`, and each element of `Y` a signal with its `Name`.
    Where there are several times, or signals of one name, they are counted.
    """
    times, signals = (_with_data(value.get(axis)) for axis in ("X", "Y"))
    if not times or not any(_told(signal, "Name") for signal in signals):
        return None
    texts = [_told(signal, "Name") for signal in signals]
    names = [name_without_unit(text) for text in texts]
    if "" in names or len(set(names)) < len(names):
        names = [f"Y.{k}" for k in range(1, len(names) + 1)]
    clocks = ["time"] if len(times) == 1 else [f"X.{k}" for k in range(1, len(times) + 1)]
    return [
        *((own, x["Data"], _told(x, "Unit") or "s") for own, x in zip(clocks, times, strict=True)),
        *(
            (own, y["Data"], _told(y, "Unit") or stated_unit(text) or "")
            for own, text, y in zip(names, texts, signals, strict=True)
        ),
    ]


def _with_data(value: Any) -> list[Mapping[str, Any]]:
    """Return the structures that hold numbers as `Data`, none where one does not."""
    value = _elements(value)
    several = value if isinstance(value, list) else [value]
    found = [v for v in several if isinstance(v, Mapping) and isinstance(v.get("Data"), np.ndarray)]
    return found if len(found) == len(several) else []


def _told(signal: Mapping[str, Any], field: str) -> str:
    text = signal.get(field)
    return text.strip() if isinstance(text, str) else ""


def _modelica(path: str) -> Iterator[Series]:
    """Yield the trajectories of a result of Dymola or OpenModelica.

    Source: Dymola User Manual, "Matlab interface" (class Atrajectory, dataInfo).
    """
    from scipy.io import loadmat  # noqa: PLC0415

    found = loadmat(path, chars_as_strings=False)
    upright = "".join(found["Aclass"][3]).strip("\0 ") != "binTrans"
    name, info, units = (
        found[k] if upright else found[k].T for k in ("name", "dataInfo", "description")
    )
    for text, (block, at, *_), about in zip(name, np.atleast_2d(info), units, strict=True):
        data = found.get(f"data_{block or 2}")
        if data is None or at == 0:
            continue
        row = (data.T if upright else data)[abs(int(at)) - 1]
        unit = re.search(r"\[([^\]|]*)", "".join(about))
        own = "".join(text).strip("\0 ")
        is_time = own.lower() == "time"
        stated = unit[1] if unit else "s" if is_time else None
        yield from series_in("time" if is_time else own, np.sign(at) * row, stated)


def hdf5_tables(path: str) -> list[Table]:
    """Return the tables of an HDF5 file: datasets, fields of tables, units and time by attributes.

    A dataset in a group is named `group.dataset`. The attribute `units` or `unit` says the unit; a
    sample time [s] or rate [Hz] among the attributes the time where no dataset has it.
    """
    import h5py  # noqa: PLC0415

    with h5py.File(path, "r") as file:
        held = list(_check_links(path, file, set()))
        found = [s for item in held for s in _of_dataset(path, item)]
        about = [file, *held, *(item.parent for item in held)]
        steps = {step for item in about for step in told_step(_attributes(item))}
    return array_tables(path, found, steps)


def _of_dataset(path: str, item: Any) -> Iterator[Series]:
    import h5py  # noqa: PLC0415

    name = item.name.strip("/").replace("/", ".")
    unit = next((u for k, u in _attributes(item).items() if k in _UNITS), None)
    place, size = item.name, max(item.shape or (0,))

    def read() -> Any:
        with h5py.File(path, "r") as file:
            found = file[place]
            return found.asstr()[()].ravel().tolist() if found.dtype.kind == "O" else found[()]

    if item.shape and sum(n != 1 for n in item.shape) == 1 and item.dtype.kind in "biuf":
        yield Series(name, size, lambda: np.ravel(read()), unit_stated(unit))
    elif item.shape and item.dtype.kind in "biufV":
        check_size(path, item.size * item.dtype.itemsize, "its arrays hold")
        yield from series_in(name, read(), unit)
    elif item.shape and h5py.check_string_dtype(item.dtype):
        yield Series(name, size, read)


def _check_links(path: str, group: Any, seen: set[int]) -> list[Any]:
    """Return the datasets below a group. Links are not followed, and none lies in another file."""
    import h5py  # noqa: PLC0415

    address = h5py.h5o.get_info(group.id).addr
    if address in seen:
        raise ValueError(f"the group '{group.name}' is reached twice")
    seen.add(address)
    found = []
    for name in group:
        if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        item = group[name]
        if isinstance(item, h5py.Group):
            found += _check_links(path, item, seen)
        elif isinstance(item, h5py.Dataset) and item.shape is not None:
            if item.external or item.is_virtual:
                raise InputError(
                    f"{path}: the array '{item.name}' lies in another file; save the values"
                    " themselves."
                )
            if item.chunks:
                piece = math.prod(item.chunks) * item.dtype.itemsize
                check_size(path, piece, f"a piece of the array '{item.name}' holds")
            found.append(item)
    return found


def _attributes(item: Any) -> dict[str, Any]:
    """Return the attributes with their keys in lower case, texts as such."""
    found = {}
    for key in item.attrs:
        value = item.attrs[key]
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.reshape(-1)[0]
        found[str(key).lower()] = (
            value.decode("utf-8", "replace") if isinstance(value, bytes) else value
        )
    return found


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
        unit = next((u for k, u in channel.properties.items() if k.lower() in _UNITS), None)

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
        unit = next((u for k, u in about.items() if k in _UNITS), None)
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
