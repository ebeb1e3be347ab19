"""One record as instruments and programs write it; the same bytes on every run."""

import io
import zipfile
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray
from openpyxl import Workbook

Cell = float | str | None


def xlsx(*sheets: Sequence[Sequence[Cell]]) -> bytes:
    """Return a workbook with these sheets, without dates."""
    book = Workbook()
    book.remove(book.worksheets[0])
    for rows in sheets:
        sheet = book.create_sheet()
        for row in rows:
            sheet.append(row)
    stream, dated = io.BytesIO(), io.BytesIO()
    book.save(dated)
    with zipfile.ZipFile(dated) as parts, zipfile.ZipFile(stream, "w") as archive:
        for name in parts.namelist():
            if name == "docProps/core.xml":
                continue
            archive.writestr(zipfile.ZipInfo(name), parts.read(name), zipfile.ZIP_DEFLATED)
    return stream.getvalue()


def tdms(channels: Mapping[str, ArrayLike], properties: Mapping[str, Any]) -> bytes:
    """Return a TDMS file with one group; each channel has the properties of its name."""
    from nptdms import ChannelObject, TdmsWriter  # noqa: PLC0415 - slow to import

    stream = io.BytesIO()
    objects = [
        ChannelObject("run", name, np.asarray(values), properties.get(name, {}))
        for name, values in channels.items()
    ]
    with TdmsWriter(stream) as writer:
        writer.write_segment(objects)
    return stream.getvalue()


def mat(arrays: Mapping[str, Any], version: Literal["4", "5"] = "5", **options: Any) -> bytes:
    """Return a MATLAB file of version 4 or 5, without the date."""
    from scipy.io import savemat  # noqa: PLC0415 - slow to import

    stream: Any = io.BytesIO()
    savemat(stream, arrays, format=version, **options)
    data: bytes = stream.getvalue()
    return data if version == "4" else b"MATLAB 5.0 MAT-file".ljust(116) + data[116:]


def parquet(columns: Mapping[str, Any], **options: Any) -> bytes:
    """Return a Parquet file of columns by their names."""
    import pyarrow  # noqa: PLC0415 - slow to import
    from pyarrow import parquet  # noqa: PLC0415

    sink = io.BytesIO()
    parquet.write_table(pyarrow.table(dict(columns)), sink, **options)
    return sink.getvalue()


def hdf5(
    content: Mapping[str, ArrayLike],
    units: Mapping[str, str],
    attributes: Mapping[str, Any] | None = None,
    *,
    userblock_size: int = 0,
    **options: Any,
) -> bytes:
    """Return an HDF5 file of datasets by their places, with `units` and the file's attributes.

    With a `userblock_size` [bytes] it starts as a MATLAB file of version 7.3 does.
    """
    stream = io.BytesIO()
    with h5py.File(stream, "w", userblock_size=userblock_size) as file:
        for name, values in content.items():
            file.create_dataset(name, data=np.asarray(values), **options)
            if name in units:
                file[name].attrs["units"] = units[name]
        file.attrs.update(attributes or {})
    data = stream.getvalue()
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    return head + data[len(head) :] if userblock_size else data


def named(t: ArrayLike, u: ArrayLike, x: ArrayLike) -> NDArray[np.generic]:
    """Return a record as an array with fields."""
    rows = [tuple(row) for row in np.column_stack([t, u, x])]
    return np.array(rows, dtype=[("time", "f8"), ("voltage", "f8"), ("displacement_um", "f8")])


def npy(array: NDArray[np.generic]) -> bytes:
    """Return an array as NumPy saves it."""
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npz(arrays: Mapping[str, NDArray[np.generic]], kind: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return arrays as `numpy.savez_compressed` does, without the date."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", kind) as archive:
        for name, array in arrays.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), npy(array), kind)
    return stream.getvalue()


def lvm(
    names: Sequence[str],
    rows: Sequence[Sequence[float]],
    *,
    columns: str = "One",
    units: Sequence[str] = (),
    step: float = 1e-3,
    comma: bool = False,
) -> bytes:
    """Return a LabVIEW measurement; without times ("No") the rows hold the channels only."""
    count = len(names)
    head = ["LabVIEW Measurement", "Writer_Version\t2", "Separator\tTab", f"X_Columns\t{columns}",
            "Time_Pref\tRelative", "Date\t2026/11/25", "***End_of_Header***", "",
            f"Channels\t{count}", "Samples" + f"\t{len(rows)}" * count]  # fmt: skip
    if units:
        head.append("\t".join(["Y_Unit_Label", *units]))
    head += ["X_Dimension" + "\tTime" * count, "X0" + "\t0.0000000000000000E+0" * count,
             "Delta_X" + f"\t{step:.6f}" * count, "***End_of_Header***"]  # fmt: skip
    if columns == "Multi":
        body = ["\t".join(f"X_Value\t{n}" for n in names) + "\tComment"]
        body += ["\t".join(f"{t:.6f}\t{v:.6f}" for v in row) for t, *row in rows]
    else:
        body = ["\t".join(["X_Value", *names, "Comment"])]
        body += ["\t".join([*[""] * (columns == "No"), *(f"{v:.6f}" for v in r)]) for r in rows]
    text = "\r\n".join([*head, *body, ""])
    return (text.replace(".", ",") if comma else text).encode()


def gcs(names: Sequence[str], rows: Sequence[Sequence[float]], step: float = 1e-3) -> bytes:
    """Return what a PI controller's data recorder gives (GCS array)."""
    head = ["# REM E-727", "#", "# VERSION = 1", "# TYPE = 1", "# SEPARATOR = 32",
            f"# DIM = {len(names)}", f"# SAMPLE_TIME = {step:.6f}", f"# NDATA = {len(rows)}",
            *(f"# NAME{k} = {name}" for k, name in enumerate(names)), "# END_HEADER"]  # fmt: skip
    return "\n".join([*head, *(" ".join(f"{v:.6f}" for v in row) for row in rows), ""]).encode()
