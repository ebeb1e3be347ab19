"""Files of records that are damaged, huge or lead elsewhere: a sound record or a sentence."""

import io
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from psa_casadi.common.errors import InputError
from psa_casadi.records import read_record
from psa_casadi.records.read import apart
from psa_casadi.records.read import table as tables
from psa_casadi.records.read.choose import Request
from psa_casadi.records.read.formats import READERS
from tests.mutations import sentences
from tests.records.laboratory_bytes import hdf5, npy, npz, tdms, xlsx

T = np.arange(24) / 8.0
NAMES = ("time [s]", "voltage [V]", "displacement [um]")


def refusal(path: Path, content: bytes) -> str:
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_record(path)
    assert all(str(path) in problem for problem in caught.value.problems)
    return str(caught.value)


def columns(path: Path, **form: Any) -> bytes:
    """Return a Parquet file with the columns of a record and others."""
    values = {name: (k + 1.0) * T for k, name in enumerate(NAMES)}
    others = {"note": ["ok"] * T.size, "list": [[1.0, 2.0]] * T.size}
    parquet.write_table(pyarrow.table({**values, **others}), path, **form)
    return path.read_bytes()


@pytest.mark.skipif(os.name != "posix", reason="a script replaces the interpreter")
@pytest.mark.parametrize("way", ["kill -SEGV $$", "exit 3", "sleep 60"])
def test_a_library_that_crashes_or_never_ends_is_a_damaged_file(
    way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    crashing = tmp_path / "python"
    crashing.write_text(f"#!/bin/sh\n{way}\n")
    crashing.chmod(0o755)
    monkeypatch.setattr("sys.executable", str(crashing))
    monkeypatch.setattr(apart, "_TIME", 0.5)
    assert "is no readable HDF5 file" in refusal(tmp_path / "a.h5", hdf5({"t": T}, {}))


def bomb(part: str, before: bytes, filler: bytes) -> bytes:
    """Return a workbook with a filler in a part of it, before some text."""
    content = xlsx([["t [s]", "V [V]", "x [um]"], *([float(t)] * 3 for t in T)])
    stream = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(content)) as archive,
        zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for name in archive.namelist():
            xml = archive.read(name)
            packed.writestr(name, xml.replace(before, filler + before, part in name))
    return stream.getvalue()


BOMBS = {
    "cells": ("worksheets/sheet", b'<row r="2"', b'<row r="1">' + b"<c/>" * 10**6 + b"</row>"),
    "formats": ("styles.xml", b"</cellXfs>", b"<xf/>" * 10**6),
    "nested": ("worksheets/sheet", b'<row r="2"', b"<a>" * 10**5 + b"</a>" * 10**5),
}


@pytest.mark.parametrize("kind", BOMBS)
def test_small_workbooks_that_unpack_to_much_are_read(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "a.xlsx"
    path.write_bytes(bomb(*BOMBS[kind]))
    np.testing.assert_array_equal(read_record(path).time, T)


def test_what_needs_more_memory_than_its_size_may_is_refused(tmp_path: Path) -> None:
    far = b'<row r="9"><c r="XFD1048576"><v>1</v></c></row>'
    content = bomb("worksheets/sheet", b"</sheetData>", far)
    assert "needs more memory" in refusal(tmp_path / "a.xlsx", content)


def test_arrays_hold_what_they_state(tmp_path: Path) -> None:
    stated = npy(T).replace(b"(24,)", b"(9" + b"0" * 9 + b",)", 1)
    assert "is no readable NumPy file" in refusal(tmp_path / "a.npy", stated)
    assert "Python objects" in refusal(tmp_path / "b.npy", npy(np.array([1.0, "x"], dtype=object)))
    path, count = tmp_path / "a.tdms", (24).to_bytes(8, "little")
    content = tdms({"time": T, "voltage": T}, {})
    assert content.count(count) == 2
    stated = content.replace(count, (2**40).to_bytes(8, "little"))
    assert "is no readable TDMS file" in refusal(path, stated)


def here(path: Path) -> tuple[str, ...]:
    """Read a file in this process, and return what is wrong with it."""
    request = Request(needed=("voltage",))
    return apart.read_here(apart.FileTask(str(path), request, str(path.parent))).problems


def test_no_more_is_read_than_a_record_may_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "MOST_BYTES", 10_000)
    arrays = hdf5({"time": np.zeros((2, 2000))}, {})
    for name, content in (("a.npz", npz({"time": np.zeros(2000)})), ("a.h5", arrays)):
        (tmp_path / name).write_bytes(content)
        assert "its arrays hold more than" in here(tmp_path / name)[0]
    zeros = {name: np.zeros(2000) for name in NAMES}
    parquet.write_table(pyarrow.table(zeros), tmp_path / "a.parquet", compression="zstd")
    assert "its columns hold more than" in here(tmp_path / "a.parquet")[0]
    values = {name: T * (k + 1) for k, name in enumerate(NAMES)}
    text = {"remark": ["a" * 10_000] * 24, "time.part": T, "blob": [{"x": 1.0}] * 24}
    parquet.write_table(pyarrow.table({**text, **values}), tmp_path / "b.parquet")
    assert here(tmp_path / "b.parquet") == ()  # the long texts are no column of a record


def _twice(file: Any) -> None:
    file["g/h/t"] = T
    file["g/h/again"] = file["g"]


def _elsewhere(file: Any) -> None:
    file["t"] = T
    file["other"] = h5py.ExternalLink("/etc/passwd", "/")
    file["soft"] = h5py.SoftLink("/nowhere")


def filled(path: Path, fill: Callable[[Any], object]) -> Path:
    with h5py.File(path, "w") as file:
        fill(file)
    return path


@pytest.mark.parametrize("suffix", [".h5", ".mat"])
def test_links_of_hdf5_are_not_followed(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    if suffix == ".h5":
        (table,) = READERS[suffix][0](str(filled(path, _elsewhere)))
        assert table.labels == ["t"]
    assert "is reached twice" in here(filled(path, _twice))[0]
    outside = tmp_path / "raw"
    outside.write_bytes(T.tobytes())
    layout = h5py.VirtualLayout((24,), "f8")
    layout[:] = h5py.VirtualSource(str(outside), "t", (24,))
    for fill in (
        lambda f: f.create_dataset("t", (24,), "f8", external=[(str(outside), 0, 192)]),
        lambda f: f.create_virtual_dataset("t", layout),
    ):
        assert "the array '/t' lies in another file" in here(filled(path, fill))[0]


def test_a_wrong_size_in_the_statements_on_a_column_does_not_end_this_process(
    tmp_path: Path,
) -> None:
    """A damaged histogram of a column's statistics ends the process of pyarrow 26.0.1."""
    path = tmp_path / "a.parquet"
    whole = columns(path)
    place = whole.index(b"displacement [um]")
    for k in range(place - 8, place + 8, 4):
        path.write_bytes(whole[:k] + bytes([whole[k] ^ 0x10]) + whole[k + 1 :])
        assert all(str(path) in p for p in sentences(lambda: read_record(path)))
