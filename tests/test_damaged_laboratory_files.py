"""Workbooks, TDMS, HDF5, NumPy and instruments' text, damaged or made to fill the memory."""

import io
import sys
import tracemalloc
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from psa_casadi.errors import InputError
from psa_casadi.records import read_record
from psa_casadi.records.read import file_bytes, hdf5_series, read_arrays, read_xlsx
from psa_casadi.records.read.arrays import Arrays
from tests.fuzz.laboratory import sound_files
from tests.laboratory_bytes import Cell, hdf5, npy, npz, tdms, xlsx
from tests.mutations import changed, sentences

T = np.arange(24) / 8.0
COUNTS = {".xlsx": 30, ".h5": 40}


def refusal(path: Path, content: bytes) -> str:
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_record(path)
    (problem,) = caught.value.problems
    assert problem.startswith(f"{path}: ")
    return problem


@pytest.mark.parametrize("suffix", [".xlsx", ".tdms", ".h5", ".npz", ".npy", ".lvm", ".dat"])
def test_wrong_bytes_are_refused_or_read(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(read_arrays.LOADERS, ".h5", _here)
    path, refused, read = tmp_path / f"r{suffix}", 0, 0
    for content in sound_files()[suffix]:
        for wrong in changed(content, COUNTS.get(suffix, 60), seed=5):
            path.write_bytes(wrong)
            said = sentences(lambda: read_record(path))
            assert all(p.startswith((str(path), "... and")) for p in said)
            refused += bool(said)
            read += not said
    assert refused > 5
    assert read > 2


def _here(path: str, data: bytes) -> Arrays:
    """Read an HDF5 file in this process, as the one of its own does."""
    try:
        return hdf5_series.hdf5_series(path, data)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path}: {error}") from error


def test_a_workbook_that_unpacks_to_too_much_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    header: list[Cell] = ["t [s]", "V [V]", "x [um]"]
    rows: list[Sequence[Cell]] = [header, *([float(t)] * 3 for t in T)]
    content, stream = xlsx(rows), io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(content)) as archive,
        zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as bomb,
    ):
        for name in archive.namelist():
            filler = bytes(2**20) if name.endswith("styles.xml") else b""
            bomb.writestr(name, archive.read(name) + filler)
    monkeypatch.setattr(read_xlsx, "MOST_OF_A_PART", 2**19)
    assert "unpacks to 1 MiB, more than is read" in refusal(tmp_path / "a.xlsx", stream.getvalue())
    monkeypatch.setattr(read_xlsx, "MOST_CELLS", 40)
    assert "has more than 10 rows with 44 cells" in refusal(tmp_path / "b.xlsx", content)


def test_rows_that_a_workbook_only_states_are_not_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content, stream = xlsx([["t [s]", "V [V]", "x [um]"], [0.0, 1.0, 2.0]]), io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(stream, "w") as far:
        for name in archive.namelist():
            part = archive.read(name)
            if "worksheets/sheet" in name:
                assert b'<row r="2">' in part
                part = part.replace(b'<row r="2">', b'<row r="999999999">')
            far.writestr(name, part)
    monkeypatch.setattr(read_xlsx, "MOST_ROWS", 1000)
    assert "has more than 1000 rows" in refusal(tmp_path / "a.xlsx", stream.getvalue())


def test_arrays_hold_what_they_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stated = npy(T).replace(b"(24,)", b"(9" + b"0" * 9 + b",)", 1)
    assert "is no readable NumPy file" in refusal(tmp_path / "a.npy", stated)
    assert "Python objects" in refusal(tmp_path / "b.npy", npy(np.array([1.0, "x"], dtype=object)))
    monkeypatch.setattr(file_bytes, "MOST_BYTES", 10_000)
    zeros = npz({"time": np.zeros(2000)})
    assert len(zeros) < 2000
    assert "its arrays hold more than" in refusal(tmp_path / "a.npz", zeros)


def test_a_tdms_file_that_states_more_than_it_holds_takes_no_memory(tmp_path: Path) -> None:
    path, count = tmp_path / "a.tdms", (24).to_bytes(8, "little")
    content = tdms({"time": T, "voltage": T}, {})
    assert content.count(count) == 2
    path.write_bytes(content.replace(count, (2**40).to_bytes(8, "little")))
    tracemalloc.start()
    sentences(lambda: read_record(path, need_displacement=False))
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()


def test_pieces_of_hdf5_are_gzipped_or_plain(tmp_path: Path) -> None:
    content = hdf5({"time": T}, {}, compression="lzf", chunks=(24,))
    assert "is packed in another way than gzip" in refusal(tmp_path / "a.h5", content)


@pytest.mark.parametrize(
    ("module", "suffix", "extra"),
    [("openpyxl", ".xlsx", "excel"), ("nptdms", ".tdms", "tdms"), ("h5py", ".h5", "matlab")],
)
def test_a_missing_library_is_named_with_its_extra(
    module: str, suffix: str, extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = sound_files()[suffix][0]
    monkeypatch.setitem(sys.modules, module, None)
    said = refusal(tmp_path / f"a{suffix}", content)
    assert f"which is not installed; run `pip install 'psa-casadi[{extra}]'`" in said
