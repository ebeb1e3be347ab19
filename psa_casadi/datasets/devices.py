"""Public datasets: what is published under which licence, and how a record is made of it."""

import io
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from psa_casadi.common.units import ComplexArray, FloatArray


def _beside(name: str) -> str:
    """Return a text in the folder of this file."""
    return files("psa_casadi.datasets").joinpath(name).read_text(encoding="utf-8")


#: Addresses, sources, citations, licences and descriptions.
_PUBLISHED: dict[str, Any] = tomllib.loads(_beside("published.toml"))
#: The SHA-256 of every file, published or made of what is published, by its name.
_SHA256 = {name: sha for sha, name in map(str.split, _beside("published.sha256").splitlines())}


@dataclass(frozen=True)
class Original:
    """A file as its authors publish it."""

    name: str
    url: str
    sha256: str


#: The columns of every record: time in s, voltage in V with six decimals, displacement in um with
#: four. Well above the rounding of double precision, so that every machine writes the same bytes.
_HEAD = "time [s],voltage [V],displacement [um]"


def csv_text(samples: Iterable[tuple[float, float]], sample_rate: float, decimals: int) -> bytes:
    """Return the file of samples of voltage [V] and displacement [um] at a rate [1/s].

    `decimals` are those of the time, which starts at 0.
    """
    rows = [_HEAD]
    for k, (voltage, displacement) in enumerate(samples):
        rows.append(f"{k / sample_rate:.{decimals}f},{voltage:.6f},{displacement:.4f}")
    return ("\n".join(rows) + "\n").encode("ascii")


@dataclass(frozen=True)
class Columns:
    """A part of a table of numbers that becomes a record: rows, and two of its columns.

    `first_row` and the columns are counted from 0; the displacement is in um.
    """

    first_row: int
    rows: int
    voltage: int
    displacement: int
    sample_rate: float

    @property
    def words(self) -> str:
        """What is taken, in words."""
        return (
            f"{self.rows} rows from row {self.first_row} on, columns {self.voltage} and"
            f" {self.displacement}, all counted from 0"
        )

    def csv(self, originals: Sequence[bytes]) -> bytes:
        """Return the CSV file of the record, from the one table."""
        lines = originals[0].decode("ascii").splitlines()[self.first_row :][: self.rows]
        cells = [line.split() for line in lines]
        samples = ((float(c[self.voltage]), float(c[self.displacement])) for c in cells)
        return csv_text(samples, self.sample_rate, 3)


#: A line is excited whose mean amplitude is above this share of the largest one's.
_EXCITED = 0.01


@dataclass(frozen=True)
class OneAxis:
    """The voltage of one actuator and the displacement of its axis, in one experiment.

    The originals are arrays in NumPy's format, (samples of a period, axes, experiments, periods):
    voltages [V] and displacements [m] of the experiments that give the linear response, and the two
    of those from which the record is taken where these are others. All are counted from 0. `sign`
    is -1 where the displacement is measured against the actuator's direction.
    """

    axis: int
    sign: int
    experiment: int
    periods: int
    sample_rate: float

    @property
    def words(self) -> str:
        """What is taken, in words."""
        turned = ", its sign turned" if self.sign < 0 else ""
        periods = "the first period" if self.periods == 1 else f"the first {self.periods} periods"
        return (
            f"voltage {self.axis} and displacement {self.axis}{turned}, experiment"
            f" {self.experiment}, all counted from 0, {periods}; what the other actuators do by the"
            " linear response of the first two files is taken off"
        )

    def csv(self, originals: Sequence[bytes]) -> bytes:
        """Return the CSV file of the record."""
        arrays = [np.load(io.BytesIO(o), allow_pickle=False) for o in originals]
        response = linear_response(*arrays[:2])
        voltages, displacements = (a[:, :, self.experiment, : self.periods] for a in arrays[-2:])
        axis = own_part(response, voltages, displacements, self.axis)
        voltage = voltages[:, self.axis].T.reshape(-1)
        displacement = self.sign * 1e6 * axis.T.reshape(-1)
        pairs = zip(voltage.tolist(), displacement.tolist(), strict=True)
        return csv_text(pairs, self.sample_rate, 8)


def linear_response(voltages: FloatArray, displacements: FloatArray) -> ComplexArray:
    """Return the response (lines, displacements, voltages) [m/V], 0 at lines without excitation.

    Both arrays are (samples of a period, axes, experiments, periods).
    """
    u, y = (np.fft.rfft(a.mean(axis=3), axis=0) for a in (voltages, displacements))
    size = np.abs(u).mean(axis=(1, 2))
    excited = size > _EXCITED * size.max()
    u, y = u[excited], y[excited]
    across = u.conj().transpose(0, 2, 1)
    response = np.zeros((len(size), displacements.shape[1], voltages.shape[1]), dtype=complex)
    # G (U U*) = Y U*, solved from the right
    left = (u @ across).transpose(0, 2, 1)
    response[excited] = np.linalg.solve(left, (y @ across).transpose(0, 2, 1)).transpose(0, 2, 1)
    return response


def own_part(
    response: ComplexArray, voltages: FloatArray, displacements: FloatArray, axis: int
) -> FloatArray:
    """Return the displacement (samples, periods) of an axis without what other actuators do [m].

    `voltages` and `displacements` are (samples, axes, periods) of one experiment.
    """
    others = np.arange(voltages.shape[1]) != axis
    u = np.fft.rfft(voltages[:, others], axis=0)
    done = np.einsum("kj,kjp->kp", response[:, axis, others], u)
    return np.asarray(displacements[:, axis] - np.fft.irfft(done, n=len(voltages), axis=0))


@dataclass(frozen=True)
class DatasetFile:
    """One record of a dataset: its CSV file, the originals, and what makes it of them."""

    name: str
    description: str
    sha256: str
    originals: tuple[Original, ...]
    conversion: Columns | OneAxis


@dataclass(frozen=True)
class Dataset:
    """Public records of one device."""

    name: str
    description: str
    source: str
    citation: str
    licence: str
    licence_text: str
    files: tuple[DatasetFile, ...]

    @property
    def originals(self) -> dict[str, Original]:
        """The files as their authors publish them, by name."""
        return {o.name: o for file in self.files for o in file.originals}


def _file(
    name: str, description: str, device: str, originals: Sequence[str],
    conversion: Columns | OneAxis,
) -> DatasetFile:  # fmt: skip
    folder = _PUBLISHED["folders"][device]
    files = tuple(Original(o, f"{folder}{o}", _SHA256[o]) for o in originals)
    return DatasetFile(name, description, _SHA256[name], files, conversion)


def _taken(name: str, part: dict[str, Any]) -> DatasetFile:
    """Return the record of columns of a table that `published.toml` names."""
    columns = Columns(part["first_row"], part["rows"], 0, 4, sample_rate=200.0)
    return _file(name, part["description"], "micromanipulator", [part["original"]], columns)


LEVELS = (100, 200, 300)
#: Displacements 1 and 2 are measured against the direction of their actuators.
SIGNS = (-1, -1, 1)


def _axis(axis: int, level: int, signal: int | None = None) -> DatasetFile:
    """Return the record of one axis: of the first training signal, or of a test signal."""
    name = f"axis_{axis + 1}_{level}mV{'' if signal is None else f'_test_{signal + 1}'}.csv"
    parts = ("train",) if signal is None else ("train", "test")
    which = "first training signal" if signal is None else f"test signal {signal + 1}"
    length = "one period" if signal is None else "two periods"
    return _file(
        name,
        f"axis {axis + 1} and its actuator, {which}, {level} mV rms, {length}",
        "steering_mirror",
        [f"{what}_{level}mV_{part}.npy" for part in parts for what in "uy"],
        OneAxis(axis, SIGNS[axis], signal or 0, len(parts), sample_rate=6400.0),
    )


def _files(name: str) -> tuple[DatasetFile, ...]:
    if name == "steering_mirror":
        return tuple(_axis(a, level) for level in LEVELS for a in range(3))
    if name == "steering_mirror_test":
        return tuple(_axis(a, level, k) for level in LEVELS for a in range(3) for k in range(3))
    return tuple(_taken(n, part) for n, part in _PUBLISHED["columns"][name].items())


def _dataset(name: str, device: str, description: str) -> Dataset:
    licence = _beside(f"{device}_licence.txt")
    texts = _PUBLISHED["devices"][device]
    return Dataset(name, description, **texts, licence_text=licence, files=_files(name))


DATASETS: dict[str, Dataset] = {
    name: _dataset(name, **words) for name, words in _PUBLISHED["datasets"].items()
}
"""Every dataset by name. A dataset is listed once its licence and its hashes were verified."""
