"""Files of other programs, read by the libraries that the field reads them with.

Each reader returns the tables of the file at a path. It runs in a separate process
(`records.read.apart`), since what is damaged may crash a library or fill the memory.
"""

import math
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.records.read.columns import (
    MARKS,
    name_and_unit,
    name_without_unit,
    stated_unit,
    understood,
    unit_named,
)
from psa_casadi.records.read.table import Cells, Columns, Table, check_size, unit_of_times
from psa_casadi.records.read.text import stated_step, text_tables

#: The attributes and properties that state a unit, in lower case.
_UNITS = ("units", "unit", "unit_string")


@dataclass(frozen=True, eq=False)
class Series:
    """One array of a file, by its name: `size` values, read on demand, in the unit it states."""

    name: str
    size: int
    values: Callable[[], Cells]
    unit: object = None

    @property
    def text(self) -> str:
        """The name with its unit: the stated one, or that which the values or the name imply."""
        last = self.name.rpartition(".")[2]
        label = last if re.match(r"\w*[^\W\d]", last) else self.name
        unit = self.unit
        if unit is None and not stated_unit(label):
            name = understood(label)
            values = self.values()[:9] if name and name.column == "time" and self.size > 1 else []
            if isinstance(values, np.ndarray) and len(values):
                is_instant = values.dtype.kind in "mM"
                unit = "s" if is_instant else unit_of_times(values.astype(np.float64))
        return f"{self.name} [{unit}]" if unit else self.name


def series_in(name: str, numbers: NDArray[Any], unit: object = None) -> Iterator[Series]:
    """Yield the series in an array: itself, its fields, or its columns counted from 1.

    Series lie along the longer side of a matrix. What is neither is left out.
    """
    if numbers.dtype.names:
        for field in numbers.dtype.names:
            yield from series_in(f"{name}.{field}" if name else field, numbers[field], unit)
        return
    if numbers.dtype.kind not in "biufmM":
        return
    numbers = np.atleast_1d(np.squeeze(numbers)) if numbers.size else numbers.ravel()
    if numbers.ndim == 1:
        yield Series(name or "1", numbers.size, lambda: numbers, unit)
    elif numbers.ndim == 2:
        for k, column in enumerate(numbers.T if len(numbers) >= len(numbers.T) else numbers, 1):
            text = f"{name}.{k}" if name else f"{k}"
            yield Series(text, column.size, lambda c=column: c, unit)  # type: ignore[misc]


def array_tables(
    path: str, arrays: Iterable[Series], stated: Iterable[str] = (), place: str = "sample"
) -> list[Table]:
    """Return the tables that series make: all of them, then those of each group with several.

    A group is also what the columns of one number of several matrices are; what is in none, such as
    a time, belongs to each.

    The first of a name counts. `stated` are lines such as "fs = 1000" that a file states elsewhere.
    """
    named: dict[str, Series] = {}
    for one in arrays:
        bare, bracketed = name_and_unit(one.name)
        name = MARKS.sub("_", bare or one.name.strip())
        unit = unit_named(one.unit, common=False) if isinstance(one.unit, str) else None
        unit = unit or (bracketed.strip() if bracketed else None)
        named.setdefault(name, replace(one, name=name, unit=unit))
    series, labels = list(named.values()), list(named)
    scalars = {n.rpartition(".")[2]: s.values() for n, s in named.items() if s.size == 1}

    def load(numbers: Sequence[int], most: int | None, _: Problems) -> Columns:
        if most is None:
            check_size(path, 8 * sum(series[k].size for k in numbers), "its columns hold")
        cells = [series[k].values()[: most or series[k].size] for k in numbers]
        return Columns(cells, np.arange(1, 1 + max(map(len, cells), default=0)))

    whole = Table(
        path=path, name="", header=[one.text for one in series], labels=labels,
        where=f"{path}: {'column' if place == 'row' else 'array'} names", place=place, load=load,
        step=stated_step([*stated, *statements(scalars)]), sizes=[one.size for one in series],
        headless=", ".join(labels) if all(map(str.isdecimal, labels)) else "",
    )  # fmt: skip
    groups: dict[str, list[int]] = {}
    for k, name in enumerate(labels):
        group, _, last = name.rpartition(".")
        groups.setdefault(last if last.isdecimal() else group, []).append(k)
    shared = groups.pop("", [])
    parts = [whole.part(n, [*shared, *item]) for n, item in groups.items() if len(item) > 1]
    return [whole, *(parts if len(parts) > 1 else [])]


def statements(attributes: Mapping[str, Any]) -> Iterator[str]:
    """Yield what attributes of one value state, as the lines above a table do."""
    for key, value in attributes.items():
        if np.size(value) == 1:
            name = "sample rate" if key.lower() == "rate" else key
            yield f"{name} = {np.asarray(value).reshape(-1)[0]}"


def _unit_in(properties: Mapping[str, Any]) -> object:
    """Return what properties state as the unit of an array, None without one."""
    return next((value for key, value in properties.items() if key.lower() in _UNITS), None)


def hdf5_tables(path: str) -> list[Table]:
    """Return the tables of an HDF5 file: datasets, fields of tables, units and time by attributes.

    A dataset in a group is named `group.dataset`. The attribute `units` or `unit` is the unit; a
    sample time [s] or rate [Hz] among the attributes the time where no dataset has it.
    """
    import h5py  # noqa: PLC0415

    with h5py.File(path, "r") as file:
        held = list(checked_datasets(path, file, set()))
        series = [s for item in held for s in _of_dataset(path, item)]
        about = [file, *held, *(item.parent for item in held)]
        stated = [line for item in about for line in statements(_attributes(item))]
    return array_tables(path, series, stated)


def _of_dataset(path: str, item: Any) -> Iterator[Series]:
    import h5py  # noqa: PLC0415

    if not item.shape:
        return
    place, name = item.name, item.name.strip("/").replace("/", ".")
    unit, size = _unit_in(_attributes(item)), max(item.shape)

    def read() -> Any:
        with h5py.File(path, "r") as file:
            data = file[place]
            return data.asstr()[()].ravel().tolist() if data.dtype.kind == "O" else data[()]

    if sum(n != 1 for n in item.shape) == 1 and item.dtype.kind in "biuf":
        yield Series(name, size, lambda: np.ravel(read()), unit)
    elif item.dtype.kind in "biufV":
        check_size(path, item.size * item.dtype.itemsize, "its arrays hold")
        yield from series_in(name, read(), unit)
    elif h5py.check_string_dtype(item.dtype):
        yield Series(name, size, read)


def checked_datasets(path: str, group: Any, numbers: set[int]) -> list[Any]:
    """Return the datasets below a group. Links are not followed, and none lies in another file."""
    import h5py  # noqa: PLC0415

    address = h5py.h5o.get_info(group.id).addr
    if address in numbers:
        raise ValueError(f"the group '{group.name}' is reached twice")
    numbers.add(address)
    datasets = []
    for name in group:
        if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        child = group[name]
        if isinstance(child, h5py.Group):
            datasets += checked_datasets(path, child, numbers)
        elif isinstance(child, h5py.Dataset) and child.shape is not None:
            if child.external or child.is_virtual:
                raise InputError(
                    f"{path}: the array '{child.name}' lies in another file; save the values"
                    " themselves."
                )
            if child.chunks:
                piece = math.prod(child.chunks) * child.dtype.itemsize
                check_size(path, piece, f"a piece of the array '{child.name}' holds")
            datasets.append(child)
    return datasets


def _attributes(item: Any) -> dict[str, Any]:
    """Return the attributes with their keys in lower case, texts as such."""
    attributes = {}
    for key, value in item.attrs.items():
        one = value.flat[0] if isinstance(value, np.ndarray) and value.size == 1 else value
        text = one.decode(errors="replace") if isinstance(one, bytes) else one
        attributes[str(key).lower()] = text
    return attributes


def matlab_tables(path: str) -> list[Table]:
    """Return the tables of a MATLAB file of any level, one of a Modelica tool, or of Simulink.

    A field of a structure is named `log.u`, of the second of several `log.2.u`. Of a matrix the
    series are named `m.1`, `m.2`, ...; they lie along its longer side.
    """
    import h5py  # noqa: PLC0415

    if h5py.is_hdf5(path):
        import pymatreader  # noqa: PLC0415

        with h5py.File(path, "r") as file:
            held = checked_datasets(path, file, set())
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
    elif isinstance(value, np.ndarray | np.number | float | int):
        yield from series_in(name, np.asarray(value))


def _elements(value: Any) -> Any:
    """Return several structures or cells as a list: they come as an array or by their fields."""
    if isinstance(value, np.ndarray) and value.dtype == object:
        return list(value.ravel())
    if isinstance(value, Mapping) and len(value) > 1:
        counts = {len(v) if isinstance(v, list) else 0 for v in value.values()}
        if len(counts) == 1 and (count := counts.pop()) > 1:
            return [{k: v[i] for k, v in value.items()} for i in range(count)]
    return value


def _recorded(value: Mapping[str, Any]) -> list[tuple[str, Any, str | None]]:
    """Return name, numbers and unit of what dSPACE ControlDesk records, none where it is another.

    There `X` holds the time in seconds as `Data`, and each element of `Y` a signal with its `Name`.
    Where there are several times, or signals of one name, they are counted.
    """
    signals: list[tuple[str, Any, str | None]] = []
    for axis, usual in (("X", "s"), ("Y", "")):
        elements = _elements(value.get(axis))
        several = elements if isinstance(elements, list) else [elements]
        data = [s.get("Data") if isinstance(s, Mapping) else None for s in several]
        if not all(isinstance(numbers, np.ndarray) for numbers in data):
            return []
        texts, units = (
            [t.strip() if isinstance(t := s.get(key), str) else "" for s in several]
            for key in ("Name", "Unit")
        )
        names = [name_without_unit(t) if axis == "Y" else "time" for t in texts]
        if not any(names):
            return []
        if "" in names or len(set(names)) < len(names):
            names = [f"{axis}.{k}" for k in range(1, len(names) + 1)]
        for name, text, unit, numbers in zip(names, texts, units, data, strict=True):
            signals.append((name, numbers, unit or stated_unit(text) or usual))
    return signals


def _modelica(path: str) -> Iterator[Series]:
    """Yield the trajectories of a result of Dymola or OpenModelica.

    Source: Dymola User Manual, "Matlab interface" (class Atrajectory, dataInfo).
    """
    from scipy.io import loadmat  # noqa: PLC0415

    content = loadmat(path, chars_as_strings=False)
    upright = "".join(content["Aclass"][3]).strip("\0 ") != "binTrans"
    parts = (content[key] for key in ("name", "dataInfo", "description"))
    names, info, units = (part if upright else part.T for part in parts)
    for text, (block, at, *_), about in zip(names, np.atleast_2d(info), units, strict=True):
        data = content.get(f"data_{block or 2}")
        if data is None or at == 0:
            continue
        row = (data.T if upright else data)[abs(int(at)) - 1]
        unit = re.search(r"\[([^\]|]*)", "".join(about))
        name = "".join(text).strip("\0 ")
        name = "time" if name.lower() == "time" else name
        stated = unit[1] if unit else "s" if name == "time" else None
        yield from series_in(name, np.sign(at) * row, stated)


_MARKS = str.maketrans(dict.fromkeys('\t\r\n;"', " "))


def excel_tables(path: str) -> list[Table]:
    """Return the tables of a workbook (.xlsx, .xlsm, .xls, .ods), those of hidden sheets last."""
    from python_calamine import CalamineWorkbook, SheetVisibleEnum  # noqa: PLC0415

    book = CalamineWorkbook.from_path(path)
    tables = []
    for sheet in sorted(book.sheets_metadata, key=lambda s: s.visible != SheetVisibleEnum.Visible):
        rows = book.get_sheet_by_name(sheet.name).to_python(skip_empty_area=False)
        cells = [list(map(_cell_text, row)) for row in rows]
        kept = [k for k, column in enumerate(zip_longest(*cells)) if any(column)]
        lines = ["\t".join(row[k] for k in kept) if any(row) else "" for row in cells]
        tables += text_tables(path, lines, "row", sheet.name)
    return tables


def _cell_text(cell: object) -> str:
    """Return a cell as text without the marks that separate cells of a table."""
    if isinstance(cell, float | int) and not isinstance(cell, bool):
        return repr(float(cell))
    if isinstance(cell, timedelta):
        return f"{cell.total_seconds()!r} s"
    return " ".join(str(cell).translate(_MARKS).split())


def tdms_tables(path: str) -> list[Table]:
    """Return the tables of a TDMS file: channels by their names, and groups where several are.

    Units and time are as the properties of the channels state them.
    """
    import nptdms  # noqa: PLC0415
    from nptdms.log import log_manager  # noqa: PLC0415

    log_manager.set_level(50)  # it reports damage on the terminal
    file = nptdms.TdmsFile.read_metadata(path)
    channels = [c for group in file.groups() for c in group.channels()]
    if sum(len(c) * c.dtype.itemsize for c in channels) > 2 * Path(path).stat().st_size:
        raise ValueError("it states more numbers than it has bytes for")
    several = len(file.groups()) > 1
    series, stated = list[Series](), list[str]()
    for channel in channels:
        if channel.dtype.kind not in "biufM":
            continue
        name = f"{channel.group_name}.{channel.name}" if several else channel.name

        def read(group: str = channel.group_name, text: str = channel.name) -> Cells:
            with nptdms.TdmsFile.open(path) as whole:
                return np.asarray(whole[group][text][:])

        series.append(Series(name, len(channel), read, _unit_in(channel.properties)))
        stated += statements({k: v for k, v in channel.properties.items() if k == "wf_increment"})
    return array_tables(path, series, stated)


def parquet_tables(path: str) -> list[Table]:
    """Return the table of a Parquet or Feather file; only the columns of a record are read."""
    from pyarrow import feather, parquet  # noqa: PLC0415

    if ending_of(path) in (".feather", ".arrow"):
        whole = feather.read_table(path)
        schema, rows = whole.schema, whole.num_rows
    else:
        whole = None
        file = parquet.ParquetFile(path, pre_buffer=False, page_checksum_verification=True)
        schema, rows = file.schema_arrow, file.metadata.num_rows

    def read(name: str) -> Cells:
        return _arrow_cells((whole or file.read([name], use_threads=False)).column(name), rows)

    series = []
    for field in schema:
        about = {k.decode(): v.decode() for k, v in (field.metadata or {}).items()}
        series.append(Series(field.name, rows, partial(read, field.name), _unit_in(about)))
    return array_tables(path, series, place="row")


def _arrow_cells(column: Any, rows: int) -> Cells:
    """Return a column as numbers, null as nan, as instants, or as texts."""
    import pyarrow  # noqa: PLC0415

    if len(column) != rows:
        raise ValueError(f"{len(column)} of the {rows} rows that it states")
    kinds = pyarrow.types
    if kinds.is_time(column.type):
        column = column.cast(pyarrow.duration(column.type.unit))
    elif kinds.is_decimal(column.type):
        column = column.cast(pyarrow.float64(), safe=False)
    elif not (
        kinds.is_temporal(column.type)
        or kinds.is_integer(column.type)
        or kinds.is_floating(column.type)
    ):
        return ["" if v is None else str(v) for v in column.to_pylist()]
    return np.asarray(column.to_numpy())


def numpy_tables(path: str) -> list[Table]:
    """Return the tables of a NumPy file: of a matrix the columns, of an archive all by name.

    Nothing is unpickled.
    """
    content = np.load(path, allow_pickle=False, mmap_mode="r" if path.endswith(".npy") else None)
    if isinstance(content, np.ndarray):
        return array_tables(path, series_in("", content))
    with zipfile.ZipFile(path) as archive:
        check_size(path, sum(m.file_size for m in archive.infolist()), "its arrays hold")
    return array_tables(path, [s for name in content.files for s in series_in(name, content[name])])


def universal_tables(path: str) -> list[Table]:
    """Return the tables of a universal file (UFF, data set 58, text or binary)."""
    import pyuff  # noqa: PLC0415

    series: list[Series] = []
    stated: list[str] = []
    for k, one in enumerate(pyuff.UFF(path).read_sets() or []):
        if one.get("type") != 58:
            continue
        name = str(one.get("id1") or "").strip()
        name = name if name and name.upper() != "NONE" else f"channel {k + 1}"
        unit = str(one.get("ordinate_axis_units_lab") or "").strip()
        series += series_in(name, np.real(one["data"]), unit)
        if one.get("abscissa_spacing") == 1:
            stated += statements({"dt": one["abscissa_inc"]})
        elif not stated:
            series += series_in("time", np.asarray(one["x"]), "s")
    return array_tables(path, series, stated)


#: What reads a file, by its ending, the package that it needs, and what messages call it.
READERS: dict[str, tuple[Callable[[str], list[Table]], str, str]] = {
    ending: (reader, package, kind)
    for reader, package, kind, endings in (
        (excel_tables, "python_calamine", "Excel", ".xlsx .xlsm .xls .xlsb .ods"),
        (matlab_tables, "pymatreader", "MATLAB", ".mat"),
        (hdf5_tables, "h5py", "HDF5", ".h5 .hdf5 .hdf"),
        (tdms_tables, "nptdms", "TDMS", ".tdms"),
        (numpy_tables, "numpy", "NumPy", ".npy .npz"),
        (parquet_tables, "pyarrow", "Parquet", ".parquet .pq"),
        (parquet_tables, "pyarrow", "Feather", ".feather .arrow"),
        (universal_tables, "pyuff", "universal", ".uff .unv .uf .bunv"),
    )
    for ending in endings.split()
}
_MAGIC = {
    b"\x89HDF": ".h5", b"PK\x03\x04": ".xlsx", b"PAR1": ".parquet", b"TDSm": ".tdms",
    b"\x93NUM": ".npy", b"MATL": ".mat", b"ARRO": ".feather", b"\xd0\xcf\x11\xe0": ".xls",
}  # fmt: skip


def ending_of(path: str) -> str:
    """Return the ending that decides how a file is read, "" for text.

    If the name has another, the first bytes of the file decide.
    """
    ending = Path(path).suffix.lower()
    if ending in READERS or ending in (".csv", ".gz"):
        return ending if ending in READERS else ""
    try:
        with Path(path).open("rb") as stream:
            return _MAGIC.get(stream.read(4), "")
    except OSError:
        return ""
