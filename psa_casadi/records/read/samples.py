"""What every file format is read to: named columns of numbers, each cell with its place."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from psa_casadi.records.read.columns import ColumnMap
from psa_casadi.records.read.file_bytes import check_size
from psa_casadi.units import FloatArray


@dataclass(frozen=True, eq=False)
class Samples:
    """The columns of one file in the units of the file, before they are checked.

    `units` names the columns in the order of `values`, shape (rows, columns), where nan stands for
    a cell that is empty or unreadable. Row k stands in `place` number `lines[k]` of the file, such
    as "line" 17 of a CSV file. `reported` is True where a cell was already reported as unreadable.
    """

    path: str
    sha256: str
    place: str
    units: Mapping[str, str]
    values: FloatArray
    lines: NDArray[np.int64]
    reported: NDArray[np.bool_]


def scaled(samples: Samples, wanted: ColumnMap) -> Samples:
    """Return samples with every column multiplied by the scale that `wanted` gives it."""
    scales = {name: source.scale for name, source in wanted.items() if source.scale is not None}
    if not scales:
        return samples
    return replace(samples, values=samples.values * [scales.get(n, 1.0) for n in samples.units])


def whole_samples(
    path: str, sha256: str, place: str, columns: Mapping[str, tuple[str, NDArray[np.generic]]]
) -> Samples:
    """Return samples of arrays of numbers, `columns` giving unit and values (n,) by name.

    Rows are counted from 1.

    Raises:
        InputError: the numbers need more memory than a record may.
    """
    check_size(path, 8 * sum(array.size for _, array in columns.values()), "its columns hold")
    values = np.column_stack(
        [array.astype(np.float64, copy=False) for _, array in columns.values()]
    )
    return Samples(
        path=path,
        sha256=sha256,
        place=place,
        units={name: unit for name, (unit, _) in columns.items()},
        values=values,
        lines=np.arange(1, len(values) + 1, dtype=np.int64),
        reported=np.zeros(values.shape, dtype=np.bool_),
    )
