"""Parquet files with wrong bytes or of huge columns: a sentence or a record."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from psa_casadi.errors import InputError
from psa_casadi.records import read_record
from psa_casadi.records.read import file_bytes
from tests.mutations import changed, sentences

T = np.arange(24) / 8.0
NAMES = ("time [s]", "voltage [V]", "displacement [um]")
FORMS: dict[str, dict[str, Any]] = {
    "dictionaries": {},
    "plain": {"compression": "none", "use_dictionary": False},
    "groups": {"compression": "zstd", "data_page_version": "2.0", "row_group_size": 10},
}


def written(path: Path, **form: Any) -> bytes:
    rows = 24
    columns = {name: (k + 1.0) * np.arange(rows) for k, name in enumerate(NAMES)}
    table = pyarrow.table({**columns, "note": ["ok"] * rows, "list": [[1.0, 2.0]] * rows})
    parquet.write_table(table, path, **form)
    return path.read_bytes()


@pytest.mark.parametrize("form", FORMS)
def test_wrong_bytes_are_refused_or_read(tmp_path: Path, form: str) -> None:
    path = tmp_path / "a.parquet"
    refused = 0
    for wrong in changed(written(path, **FORMS[form]), 60, seed=4):
        path.write_bytes(wrong)
        said = sentences(lambda: read_record(path))
        assert all(p.startswith((str(path), "... and")) for p in said)
        refused += bool(said)
    assert 20 < refused < 60


def test_a_wrong_size_in_the_statements_on_a_column_does_not_end_the_process(
    tmp_path: Path,
) -> None:
    """What pyarrow 26.0.1 says of a column ends the process where its histogram is damaged."""
    path = tmp_path / "a.parquet"
    whole = written(path)
    place = whole.index(b"displacement [um]")
    for k in range(place - 40, place + 40):
        path.write_bytes(whole[:k] + bytes([whole[k] ^ 0x10]) + whole[k + 1 :])
        assert all(str(path) in p for p in sentences(lambda: read_record(path)))


def test_huge_columns_are_refused_before_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.parquet"
    rows = 2**18
    columns = {name: np.zeros(rows) for name in NAMES}
    parquet.write_table(pyarrow.table(columns), path, compression="zstd")
    assert path.stat().st_size < 24 * rows / 100
    monkeypatch.setattr(file_bytes, "MOST_BYTES", 24 * rows - 1)
    monkeypatch.setattr(parquet.ParquetFile, "iter_batches", None)
    with pytest.raises(InputError, match=r"its columns hold more than .* GiB, the most that is"):
        read_record(path)


def test_what_is_no_column_of_a_record_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.parquet"
    columns = {name: T * (k + 1) for k, name in enumerate(NAMES)}
    text = {"remark": ["a" * 10_000] * 24, "time.part": T, "blob": [{"x": 1.0}] * 24}
    parquet.write_table(pyarrow.table({**text, **columns}), path)
    monkeypatch.setattr(file_bytes, "MOST_BYTES", 20_000)
    record = read_record(path)
    np.testing.assert_array_equal(record.voltage, 2 * T)
    np.testing.assert_array_equal(record.time, T)


def test_a_record_longer_than_a_block_is_read_whole(tmp_path: Path) -> None:
    rows = 2**18 + 5
    path = tmp_path / "a.parquet"
    columns = {name: np.arange(rows, dtype=np.int32) for name in NAMES}
    parquet.write_table(pyarrow.table(columns), path, row_group_size=100_000)
    record = read_record(path)
    np.testing.assert_array_equal(record.time, np.arange(rows, dtype=float))
