"""Records of about 200 MB: time against the format's own library, and whether each is exact."""

import resource
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import h5py
import nptdms
import numpy as np
from pyarrow import parquet
from scipy.io import loadmat

from psa_casadi.records import read_record
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table
from tests.records.test_record_kinds import WRITERS
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

#: Rows of three columns of 8 bytes; of text fewer; a workbook ends at 1,048,576.
ROWS = {".csv": 6_000_000, ".xlsx": 300_000}
_USUAL = 8_500_000


def _csv(path: Path) -> object:
    return np.loadtxt(path, delimiter=",", skiprows=1)


def _xlsx(path: Path) -> object:
    from python_calamine import CalamineWorkbook  # noqa: PLC0415

    return CalamineWorkbook.from_path(path).get_sheet_by_index(0).to_python()


def _h5(path: Path) -> object:
    with h5py.File(path) as file:
        return [file[name][()] for name in file]


def _tdms(path: Path) -> object:
    return [c[:] for g in nptdms.TdmsFile.read(path).groups() for c in g.channels()]


def _npz(path: Path) -> object:
    with np.load(path) as file:
        return [file[name] for name in file.files]


PEERS: Mapping[str, tuple[str, Callable[[Path], object]]] = {
    ".csv": ("numpy.loadtxt", _csv), ".xlsx": ("calamine", _xlsx), ".npz": ("numpy", _npz),
    ".mat": ("scipy.io", loadmat), ".h5": ("h5py", _h5), ".tdms": ("npTDMS", _tdms),
    ".parquet": ("pyarrow", lambda path: parquet.read_table(path).to_pandas()),
}  # fmt: skip


def run(progress: Progress, quick: bool) -> Outcome:
    """Return the table of the formats, with a hundredth of the rows if it is to be quick."""
    rows = []
    for suffix in PEERS:
        progress(suffix)
        rows.append(_read(suffix, ROWS.get(suffix, _USUAL) // (100 if quick else 1)))
    head = ("format", "MB", "rows and numbers", "peer", "time over the peer's", "peak MB, apart")
    note = (
        "A record is read once, checked and turned into SI units; the peer reads all columns of the"
        " same file. Binary files are read in a process of their own, whose start is included; its"
        " peak is the largest until then."
    )
    return Outcome((TitledTable("Long records, by format", Table(head, tuple(rows)), note),))


def _read(suffix: str, count: int) -> tuple[str, ...]:
    t = (np.arange(count) * 1e-5).round(9)
    columns: dict[str, Any] = {
        "time [s]": t, "voltage [V]": np.sin(t).round(9), "displacement [m]": np.cos(t).round(9),
    }  # fmt: skip
    name, peer = PEERS[suffix]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"record{suffix}"
        path.write_bytes(WRITERS[suffix](columns))
        took, record = _timed(read_record, path)
        theirs, _ = _timed(peer, path)
        size = path.stat().st_size / 1e6
    read = (record.time, record.voltage, record.displacement)
    same = all(map(np.array_equal, read, columns.values()))
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    exact = "as written" if same else "DIFFERENT"
    return suffix, number(size), exact, name, number(took / theirs), number(peak)


def _timed(read: Callable[[Path], Any], path: Path) -> tuple[float, Any]:
    start = time.perf_counter()
    found = read(path)
    return time.perf_counter() - start, found
