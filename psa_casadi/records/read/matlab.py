"""MATLAB files of any level, those of dSPACE ControlDesk, and results of Modelica tools."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from psa_casadi.records.read.arrays import Series, array_tables, series_in
from psa_casadi.records.read.columns import name_without_unit, stated_unit
from psa_casadi.records.read.file_bytes import check_size
from psa_casadi.records.read.hdf5 import checked_datasets
from psa_casadi.records.read.table import Table


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
