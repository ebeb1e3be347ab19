"""MATLAB files of version 7.3 that are damaged, huge or lead elsewhere: a sentence or a record."""

import io
import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from psa_casadi.records.read import mat_file
from psa_casadi.records.read.mat_file import load_arrays
from psa_casadi.records.read.mat_hdf5 import hdf5_arrays
from tests.mat_bytes import refusal, refused
from tests.mutations import changed
from tests.tiers import slow

T = np.arange(24) / 8.0


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Let files be read in this process, where thousands take a moment; `apart` keeps the other."""
    if "apart" not in request.keywords:
        monkeypatch.setattr(mat_file, "arrays_apart", hdf5_arrays)


def hdf5(fill: Callable[[Any], object]) -> bytes:
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        fill(file)
    return stream.getvalue()


def _twice(file: Any) -> None:
    file["g/h/t"] = T
    file["g/h/again"] = file["g"]


def _elsewhere(file: Any) -> None:
    file["t"] = T
    file["other"] = h5py.ExternalLink("/etc/passwd", "/")
    file["soft"] = h5py.SoftLink("/nowhere")


HUGE = {
    "stated": lambda f: f.create_dataset("t", (10**12,), "f8", chunks=(1000,)),
    "together": lambda f: [f.create_dataset(f"t{k}", (10**8,), "f8") for k in range(2)],
    "pieces": lambda f: f.create_dataset("t", (8,), "f8", chunks=(2**28,), maxshape=(None,)),
    "deflated": lambda f: f.create_dataset(
        "t", (10**10,), "f8", chunks=(10**6,), compression="gzip", fillvalue=1.0
    ),
}


@pytest.mark.parametrize("case", HUGE)
def test_a_huge_array_of_version_7_3_is_refused_before_it_is_read(case: str) -> None:
    assert "more than 1 GiB, the most that is read as one record" in refusal(hdf5(HUGE[case]))


def _inflating(file: Any) -> None:
    dataset = file.create_dataset("t", (1000,), "f8", chunks=(1000,), compression="gzip")
    dataset.id.write_direct_chunk((0,), zlib.compress(bytes(2**22)))


def _pressed(file: Any) -> None:
    file.create_dataset("t", data=T, chunks=(24,), compression="lzf")


def test_pieces_of_version_7_3_have_the_size_that_they_state() -> None:
    assert "a piece of the array '/t' is larger than it states" in refusal(hdf5(_inflating))
    assert "'/t' is packed in another way than gzip" in refusal(hdf5(_pressed))
    options = {"chunks": (10,), "compression": "gzip", "shuffle": True, "fletcher32": True}
    good = hdf5(lambda f: f.create_dataset("t", data=T, **options))
    np.testing.assert_array_equal(load_arrays("a.mat", good)["t"].values, T)


def test_links_of_version_7_3_are_not_followed(tmp_path: Path) -> None:
    assert list(load_arrays("a.mat", hdf5(_elsewhere))) == ["t"]
    assert "is reached twice" in refusal(hdf5(_twice))
    outside = tmp_path / "raw"
    outside.write_bytes(T.tobytes())
    layout = h5py.VirtualLayout((24,), "f8")
    layout[:] = h5py.VirtualSource(str(outside), "t", (24,))
    for fill in (
        lambda f: f.create_dataset("t", (24,), "f8", external=[(str(outside), 0, 192)]),
        lambda f: f.create_virtual_dataset("t", layout),
    ):
        assert "the array '/t' lies in another file" in refusal(hdf5(fill))


@slow
def test_wrong_bytes_of_version_7_3_are_refused_or_read() -> None:
    def fill(file: Any) -> None:
        file["t"] = T[None, :]
        file.create_dataset("y", data=T[None, :], chunks=(1, 8), compression="gzip", shuffle=True)
        file["log/u"] = T
        file["note"] = "rig 3"

    count = sum(refused(wrong) for wrong in changed(hdf5(fill), 1000, seed=3))
    assert 200 < count < 1000


@pytest.mark.apart
def test_a_process_of_its_own_reads_what_this_one_does(monkeypatch: pytest.MonkeyPatch) -> None:
    def fill(file: Any) -> None:
        file["log/t"], file["x"], file["log/inner/a b/é"] = T, 2.0 * T, T.astype(np.float32)

    apart = load_arrays("f.mat", hdf5(fill))
    monkeypatch.setattr(mat_file, "arrays_apart", hdf5_arrays)
    same = load_arrays("f.mat", hdf5(fill))
    assert set(apart) == set(same)
    assert {"log.t", "x"} < set(same)
    for name, array in same.items():
        np.testing.assert_array_equal(apart[name].values, array.values)
        assert apart[name].values.dtype == array.values.dtype


@pytest.mark.apart
def test_what_the_process_refuses_is_told() -> None:
    assert "more than 1 GiB" in refusal(hdf5(HUGE["stated"]))
    assert "no readable MATLAB file" in refusal(hdf5(_twice)[:300])


@pytest.mark.apart
@pytest.mark.skipif(os.name != "posix", reason="a script stands in for the interpreter")
def test_a_crash_of_the_library_is_a_damaged_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    crashing = tmp_path / "python"
    crashing.write_text("#!/bin/sh\nkill -SEGV $$\n")
    crashing.chmod(0o755)
    monkeypatch.setattr("sys.executable", str(crashing))
    assert "the library of HDF5 fails on it" in refusal(hdf5(_twice))
