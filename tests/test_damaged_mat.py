"""MATLAB files with wrong bytes: a sentence or a record, never a crash, a hang or huge memory."""

import io
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import scipy.io.matlab
from scipy.io import loadmat, savemat
from scipy.sparse import csc_matrix

from psa_casadi.errors import InputError
from psa_casadi.records import read_record
from psa_casadi.records.read import file_bytes, mat_level5
from psa_casadi.records.read.mat_file import load_arrays
from tests.mat_bytes import (
    COMPRESSED,
    compressed,
    element,
    header,
    matrix,
    refusal,
    refused,
    structure,
)
from tests.mutations import changed, sentences

T = np.arange(24) / 8.0
CONTENT: dict[str, Any] = {
    "t": T,
    "y": (1000 * np.cos(T)).astype(np.int16),
    "log": {"u": np.sin(T), "deep": {"flag": T > 1.0}},
    "note": "rig 3",
    "cell": np.array([T], dtype=object),
    "cells": np.array([T, "a"], dtype=object),
    "sparse": csc_matrix(np.eye(3)),
    "z": T + 1j,
    "cube": np.zeros((2, 3, 4)),
    "one": 3.0,
    "none": np.zeros((0, 3)),
    "wide": np.arange(12, dtype=np.uint8).reshape(3, 4),
}


def content(version: str) -> bytes:
    stream = io.BytesIO()
    plain = {n: v for n, v in CONTENT.items() if version != "4" or n in ("t", "note", "wide", "z")}
    level: Literal["4", "5"] = "4" if version == "4" else "5"
    # SciPy writes to a stream too, which its stubs do not say
    savemat(stream, plain, format=level, do_compression="deflated" in version)  # type: ignore[arg-type]
    return stream.getvalue()


def by_scipy(data: bytes) -> dict[str, np.ndarray[Any, Any]]:
    """Return the arrays of numbers that SciPy's reader finds, as `load_arrays` names them."""

    def found(name: str, value: Any) -> dict[str, np.ndarray[Any, Any]]:
        if isinstance(value, dict):
            return {k: a for f, v in value.items() for k, a in found(f"{name}.{f}", v).items()}
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
            return {}
        if value.ndim == 1:
            return {name: value}
        upright = value if value.ndim == 2 and value.shape[0] >= value.shape[1] else value.T
        columns = range(upright.shape[1]) if value.ndim == 2 else ()
        return {f"{name}.{k + 1}": upright[:, k] for k in columns}

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        top: dict[str, Any] = loadmat(io.BytesIO(data), simplify_cells=True)  # type: ignore[arg-type]
    every = (found(name, value) for name, value in top.items() if not name.startswith("__"))
    return {name: array for part in every for name, array in part.items()}


def assert_as_scipy(data: bytes) -> None:
    own, other = load_arrays("a.mat", data), by_scipy(data)
    assert list(own) == list(other)
    for name, array in own.items():
        np.testing.assert_array_equal(array.values, other[name])


@pytest.mark.parametrize("version", ["4", "5", "5, deflated"])
def test_every_kind_of_array_is_read_as_scipy_reads_it(version: str) -> None:
    assert_as_scipy(content(version))


REAL = sorted((Path(scipy.io.matlab.__file__).parent / "tests" / "data").glob("test*_GLNX86.mat"))
REAL += sorted((Path(scipy.io.matlab.__file__).parent / "tests" / "data").glob("test*_SOL2.mat"))


@pytest.mark.skipif(not REAL, reason="this SciPy comes without its test files")
def test_files_that_matlab_wrote_are_read_as_scipy_reads_them() -> None:
    for path in REAL:
        if "hdf5" not in path.name:
            assert_as_scipy(path.read_bytes())


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("name", ["t", "time_of_day"])
def test_both_byte_orders_and_both_kinds_of_elements(order: str, name: str) -> None:
    data = header(order) + matrix(name, [1, 2, -3], order=order, stored=(3, "i2"))
    np.testing.assert_array_equal(load_arrays("a.mat", data)[name].values, [1.0, 2.0, -3.0])
    assert_as_scipy(data)


@pytest.mark.parametrize("version", ["4", "5", "5, deflated"])
def test_wrong_bytes_are_refused_or_read(version: str) -> None:
    data = content(version)
    count = sum(refused(wrong) for wrong in changed(data, 1000, seed=1))
    assert 200 < count < 1000


def test_wrong_bytes_below_the_compression_are_refused_or_read() -> None:
    inner = content("5")[128:]
    count = sum(
        refused(header() + element(COMPRESSED, zlib.compress(wrong)))
        for wrong in changed(inner[: 8 + struct.unpack("<I", inner[4:8])[0]], 1000, seed=2)
    )
    assert 200 < count < 1000


@pytest.mark.parametrize("level", ["4", "5"])
def test_no_wrong_byte_beside_the_numbers_changes_the_numbers(level: Literal["4", "5"]) -> None:
    stream = io.BytesIO()
    arrays = {"t": T, "u": np.sin(T), "y": (1000 * np.cos(T)).astype(np.int16)}
    # SciPy writes to a stream too, which its stubs do not say
    savemat(stream, arrays, format=level)  # type: ignore[arg-type]
    data = stream.getvalue()
    places = set(range(len(data)))
    for array in arrays.values():
        begin = data.index(array.tobytes())
        places -= set(range(begin, begin + array.nbytes))
    good, changes = load_arrays("a.mat", data), 0
    for place in sorted(places):
        for value in {data[place] ^ (1 << bit) for bit in range(8)}:
            wrong = data[:place] + bytes([value]) + data[place + 1 :]
            found: dict[str, Any] = {}
            if not sentences(lambda w=wrong, f=found: f.update(load_arrays("a.mat", w))):  # type: ignore[misc]
                for name in found.keys() & good.keys():
                    changes += not np.array_equal(found[name].values, good[name].values)
    assert changes == 0


def test_a_type_that_does_not_fit_is_named() -> None:
    good = matrix("t", T)
    assert "a variable has the type 99" in refusal(header() + element(99, good))
    wrong = matrix("t", T, stored=(8, "f8"))  # a reserved storage type ended the process in SciPy
    assert "an array has the type 8" in refusal(header() + wrong)
    assert "an array has the class 77" in refusal(header() + matrix("t", T, kind=77))
    wrong = matrix("t", T, kind=10)  # int16
    assert "an array of int16 is stored as float64" in refusal(header() + wrong)
    wrong = matrix("t", T, stored=(9, "f4"))
    assert "an array of the dimensions [24, 1] has 96 bytes" in refusal(header() + wrong)
    assert "has the name 't\\x1b[2J'" in refusal(header() + matrix("t\x1b[2J", T))
    flags = element(6, bytes(8 * 10**5))
    assert "800000 bytes stand where a few integers" in refusal(header() + element(14, flags))
    assert "begins where" in refusal(header() + good[:-8])
    cut = compressed(good)
    assert "does not have the" in refusal(header() + element(COMPRESSED, cut[8:-6]))


def test_a_name_that_stands_twice_names_nothing() -> None:
    field = matrix("", T)
    data = header() + matrix("t", T) + matrix("t", 2 * T)
    data += structure("log", [("u", field), ("v", field), ("u", field)])
    assert list(load_arrays("a.mat", data)) == ["log.v"]


def test_structures_without_end_and_names_without_end_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    inner = matrix("", T)
    for _ in range(100):
        inner = structure("", [("a", inner)])
    assert "more than 32 deep" in refusal(header() + compressed(inner))
    monkeypatch.setattr(mat_level5, "_MOST_NAMES", 1000)
    empty = element(14, b"")
    many = structure("s", [(f"{k:x}", empty) for k in range(1001)])
    assert "more than 1000 arrays" in refusal(header() + compressed(many))


def deflated_zeros(size: int) -> bytes:
    """Return a compressed variable of at least so many zeros, made in little time and memory."""
    parts = struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIii", 5, 8, size // 8, 1)
    parts += struct.pack("<II", 1 | 1 << 16, ord("t")) + struct.pack("<II", 9, size)
    stream = zlib.compressobj()
    whole = stream.compress(struct.pack("<II", 14, len(parts) + size) + parts)
    whole += stream.flush(zlib.Z_FULL_FLUSH)
    piece = stream.compress(bytes(2**22)) + stream.flush(zlib.Z_FULL_FLUSH)
    return element(COMPRESSED, whole + piece * (size // 2**22 + 1))


def test_a_small_file_of_a_huge_array_is_refused_before_it_is_unpacked() -> None:
    data = header() + deflated_zeros(3 * 2**30)
    assert len(data) < 2**23
    assert (
        "unpacked, its variables hold more than 1 GiB, the most that is read as one record"
        in refusal(data)
    )


def test_many_arrays_together_may_not_be_huge(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file_bytes, "MOST_BYTES", 900)
    one = compressed(matrix("t", T)), compressed(matrix("u", T)), compressed(matrix("v", T))
    load_arrays("a.mat", header() + b"".join(one))
    more = compressed(matrix("w", T))
    assert "more than 8.38e-07 GiB" in refusal(header() + b"".join(one) + more)


@pytest.mark.skipif(not Path("/dev/zero").is_char_device(), reason="this system has no /dev/zero")
def test_a_file_without_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file_bytes, "MOST_BYTES", 10**6)
    for name in ("a.mat", "a.csv", "a.parquet"):
        (tmp_path / name).symlink_to("/dev/zero")
        with pytest.raises(InputError, match=r"holds more than .* GiB"):
            read_record(tmp_path / name)
