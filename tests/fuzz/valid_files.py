"""Valid record files of many forms, from which the damaged ones are made; the same on every run."""

import io
import struct
import zlib
from functools import cache
from typing import Any, cast

import numpy as np

_N = 18
_T = np.arange(_N) / 8.0
_U = np.round(50.0 * np.sin(_T), 3)
_Y = np.round(5.0 * np.cos(_T), 4)


@cache
def csv_texts() -> tuple[str, ...]:
    """Return CSV files: units, separators, decimals, comments, quotes, missing cells, columns."""
    rows = list(zip(_T, _U, _Y, strict=True))
    plain = "\n".join(f"{t},{u},{y}" for t, u, y in rows)
    comma = "\n".join(f"{t};{u};{y}" for t, u, y in rows).replace(".", ",")
    wide = "\n".join(f"{y},{t},{u},{u / 9:.3f},0.5,{20 + y}" for t, u, y in rows)
    holes = "\n".join(f"{t},{u},{y if k not in (3, 4) else ''}" for k, (t, u, y) in enumerate(rows))
    quoted = "\n".join(f'"{t}","{u}","{y}"' for t, u, y in rows)
    tabs = plain.replace(",", "\t")
    return (
        f"time [s],voltage [V],displacement [um]\n{plain}\n",
        f"# made by hand\n\ntime [ms],voltage [mV],displacement [nm]\n{plain}\n",
        f"time [s];voltage [V];displacement [um]\n{comma}\n",
        "displacement [um],time [s],voltage [V],load_force [N],current [A],temperature [K]\n"
        + wide,
        f"time [s],voltage [V],displacement [um]\n{holes}\n",
        f'"time [s]","voltage [V]","displacement [counts]"\n{quoted}\n',
        f"time [min]\tvoltage [kV]\tdisplacement [µm]\n{tabs}\n",
        "Time [s],VOLTAGE [V],displacement [um],note\n" + plain.replace("\n", ",x\n") + ",x\n",
    )


@cache
def mat_files() -> tuple[bytes, ...]:
    """Return MATLAB files of versions 4, 5 and 7: vectors, structures, matrices, classes, text."""
    arrays: dict[str, Any] = {"time": _T, "voltage": _U, "displacement_um": _Y}
    matrix = np.column_stack([_T, _U, _Y])
    more: dict[str, Any] = {
        **arrays,
        "voltage_mV": _U.astype(np.int16),
        "log": {"u": _U.astype(np.float32), "name": "piezo", "deep": {"m": matrix}},
        "m": matrix,
        "cells": np.array(["a", 1.0, "b"], dtype=object),
        "flags": _U > 0,
        "z": _U + 1j,
    }
    return (
        _mat(arrays, "4"),
        _mat(arrays, "5"),
        _mat(arrays, "5", do_compression=True),
        _mat(more, "5"),
        _mat(more, "5", do_compression=True, oned_as="column"),
    )


def _mat(arrays: dict[str, Any], version: Any, **options: Any) -> bytes:
    from scipy.io import savemat  # noqa: PLC0415 - slow to import

    buffer = io.BytesIO()
    savemat(cast(Any, buffer), arrays, format=version, **options)
    data = buffer.getvalue()
    # its first line has the date
    return data if version == "4" else b"MATLAB 5.0 MAT-file".ljust(116) + data[116:]


@cache
def hdf5_files() -> tuple[bytes, ...]:
    """Return MATLAB files of version 7.3: plain, nested, compressed in chunks."""
    plain: dict[str, Any] = {"time": _T, "voltage": _U, "displacement_um": _Y}
    return (
        _hdf5(plain),
        _hdf5({**plain, "log": {"u": _U, "deep": {"m": np.column_stack([_T, _U])}}}),
        _hdf5(plain, chunks=(1, 6), compression="gzip", shuffle=True, fletcher32=True),
    )


def _hdf5(content: dict[str, Any], **options: Any) -> bytes:
    import h5py  # noqa: PLC0415 - needed for these files only

    buffer = io.BytesIO()
    with h5py.File(buffer, "w", userblock_size=512) as file:
        _fill(file, content, options)
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    return head + buffer.getvalue()[len(head) :]


def _fill(group: Any, content: dict[str, Any], options: dict[str, Any]) -> None:
    for name, value in content.items():
        if isinstance(value, dict):
            _fill(group.create_group(name), value, options)
        else:
            group.create_dataset(name, data=np.atleast_2d(value), **options)


@cache
def parquet_files() -> tuple[bytes, ...]:
    """Return Parquet files: floats, integers with nulls, dictionaries, decimals, encodings."""
    import pyarrow  # noqa: PLC0415 - needed for these files only
    from pyarrow import parquet  # noqa: PLC0415

    plain = {"time [s]": _T, "voltage [V]": _U, "displacement [um]": _Y}
    numbers: Any = pyarrow.array([None if k == 3 else k * k for k in range(_N)], pyarrow.int16())
    tables = (
        (plain, {"compression": "none"}),
        (plain, {"compression": "snappy", "use_dictionary": False, "row_group_size": 7}),
        ({**plain, "displacement [um]": numbers}, {"compression": "gzip"}),
        (
            {**plain, "note": ["x"] * _N, "list": [[1.0]] * _N},
            {"compression": "none", "data_page_version": "2.0", "write_page_checksum": True},
        ),
    )
    found = []
    for columns, options in tables:
        sink = io.BytesIO()
        parquet.write_table(pyarrow.table(columns), sink, **options)
        found.append(sink.getvalue())
    return tuple(found)


def recompressed(data: bytes, place: int, inner: bytes) -> bytes:
    """Return a MATLAB file whose compressed element at a place holds other bytes."""
    size = struct.unpack_from("<I", data, place + 4)[0]
    packed = zlib.compress(inner)
    head = struct.pack("<II", 15, len(packed))
    return data[:place] + head + packed + data[place + 8 + size :]
