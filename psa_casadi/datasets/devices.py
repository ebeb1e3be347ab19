"""Public datasets: what is published under which licence, and how a record is made of it."""

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

MIT = """\
Permission is hereby granted, free of charge, to any person obtaining a copy of this software and
associated documentation files (the "Software"), to deal in the Software without restriction,
including without limitation the rights to use, copy, modify, merge, publish, distribute,
sublicense, and/or sell copies of the Software, and to permit persons to whom the Software is
furnished to do so, subject to the following conditions:

The above copyright notice and this permission notice shall be included in all copies or substantial
portions of the Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT
NOT LIMITED TO THE WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND
NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES
OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR OTHERWISE, ARISING FROM, OUT OF OR IN
CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.
"""

CC_BY_4 = """\
This dataset is licensed under the Creative Commons Attribution 4.0 International License. You are
free to share (copy and redistribute the material in any medium or format) and to adapt (remix,
transform, and build upon the material for any purpose, even commercially), under the following
terms: Attribution - You must give appropriate credit, provide a link to the license, and indicate
if changes were made. You may do so in any reasonable manner, but not in any way that suggests the
licensor endorses you or your use. Full license text:
https://creativecommons.org/licenses/by/4.0/legalcode
"""


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

    `decimals` are those of the time, which begins at 0.
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


FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

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
        shown = self.sign * 1e6 * axis.T.reshape(-1)
        pairs = zip(voltage.tolist(), shown.tolist(), strict=True)
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
    own: FloatArray = displacements[:, axis] - np.fft.irfft(done, n=len(voltages), axis=0)
    return own


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


_FOLDER = (
    "https://raw.githubusercontent.com/yan9a/DiscreteBacklashOperator/"
    "79fd060d86cdf69be2388e29bf57b0766c273650/MatLabCode/DiscreteBacklashModel/"
)
_MODEL = Original(
    "Model_Vi_Do.dat",
    f"{_FOLDER}Model_Vi_Do.dat",
    "672714f09302b892721aa44d72f337a7ee1a0eb1d107f4d6797ab47d849428ae",
)
_TEST = Original(
    "Test_Vi_Do_Di.dat",
    f"{_FOLDER}Test_Vi_Do_Di.dat",
    "6c33cb76d3f6e12f5074626710f71aeb43d8411a5ad0a56469ad01904221aae5",
)


def _taken(first_row: int, rows: int) -> Columns:
    return Columns(first_row, rows, voltage=0, displacement=4, sample_rate=200.0)


def _dataset(name: str, description: str, *files: DatasetFile) -> Dataset:
    return Dataset(
        name=name,
        description=description,
        source="https://github.com/yan9a/DiscreteBacklashOperator",
        citation="Y. N. Aye and W. T. Ang, A Discrete Backlash Operator for Identification and"
        " Compensation of Hysteresis and Non-linearity for Piezoelectric Micromanipulator, ICSTSD"
        " 2018",
        licence="MIT, copyright (c) 2019 Yan Naing Aye",
        licence_text=f"MIT License\n\nCopyright (c) 2019 Yan Naing Aye\n\n{MIT}",
        files=files,
    )


MICROMANIPULATOR = _dataset(
    "micromanipulator",
    "piezo-driven flexure, open loop, 200 Hz, amplifier input 0 to 3.6 V, capacitive"
    " sensor with 0.07 um rms noise; the displacement's zero is arbitrary",
    DatasetFile(
        "sine_1hz.csv",
        "full-range sine, 1 Hz, 39 cycles",
        "c3556822db7e4a6ba79862ddb11cb16d33d4f881c49c1a6841a586d7c5296d64",
        (_MODEL,),
        _taken(100, 7927),
    ),
    DatasetFile(
        "minor_loops.csv",
        "1 Hz sine of ramped amplitude: nested minor loops",
        "e9b7d371edca78f9e6fabf6d24969e2320134ff6d2858e261fb16ea4593758bc",
        (_TEST,),
        _taken(100, 3600),
    ),
)

MICROMANIPULATOR_RESTS = _dataset(
    "micromanipulator_rests",
    "the same micromanipulator: what follows its minor loops in the same file; the voltage of the"
    " loops was corrected beforehand so that the displacement is a sine, and is none itself",
    DatasetFile(
        "groups_and_rests.csv",
        "a rest of 6.0 s, loops of 1 Hz that grow and shrink, a rest of 4.6 s, loops that grow",
        "ef407e6dd3153b5e87251226f2868e8dcb2c17caf76041e7dec3e3e91adf7aa2",
        (_TEST,),
        _taken(3700, 10455),
    ),
)


_MIRROR_FOLDER = (
    "https://raw.githubusercontent.com/merijnfloren/fsm-benchmark-data/"
    "539a12fef384b086a8562b500498b2fa3899ef70/data/"
)
_RATE = 6400.0
LEVELS = (100, 200, 300)
#: Displacements 1 and 2 are measured against the direction of their own actuators.
SIGNS = (-1, -1, 1)

_ORIGINALS = {
    "u_100mV_train.npy": "a53d6ee47ac1ea784c70e7634ce816467fb61effd8706eaf6b52f68142380a81",
    "y_100mV_train.npy": "06892ff7fc943712898d7ca741205e4d6574bec2a20e69a0052f986c27bd10ad",
    "u_100mV_test.npy": "627a9b7b21d475451a1a9aa9144e54f638fc21c824c1a52aaca29b5869d7dc33",
    "y_100mV_test.npy": "a1541232b74db701f40df56e85b28a8d4cf5ea433bd7b3fc12d9196fa0e9770a",
    "u_200mV_train.npy": "59356f9b403b839231cf903acf6c99df33e0f4fbc820f4edd44dc169ac38dd3e",
    "y_200mV_train.npy": "b25b16b07fdbc7980bab4e98906ddaf2eaee41be0957c8911a469c3c426479d1",
    "u_200mV_test.npy": "0053438fb9c6ae8ee46e0dd18838febe3183996f3ad3ae9eb8dfc3bdbaba7d18",
    "y_200mV_test.npy": "7935a6b7251d9a87f1351a3cb71b6282c414b3156c227813bb1cb3ebde2cb7b4",
    "u_300mV_train.npy": "0436437998307e8f8c86f824c1fee4e225f212861878bf58d42b2a5e2ecd0cb5",
    "y_300mV_train.npy": "38acb224027e728d7a3c44a0ce5538fcb74c836be585a1b318a6728c8a6820fb",
    "u_300mV_test.npy": "2bc566ae64d9000e69fbbc95092ac9c04c083bb398e4f16f2eb105645844e401",
    "y_300mV_test.npy": "b46edea962a149b7a5abd89f819e6f1ec03ba4d68b0ac83e2a8fc84c2b0ebaf3",
}
_AXES = {
    "axis_1_100mV.csv": "e7464cb9adf92382e5ed113ae0438c09ee27c9cb1278c54030518d91f111c041",
    "axis_2_100mV.csv": "5e417107d46b3a3020b606eb38ed40951b9ed2a26d733e15019411f803a79e5d",
    "axis_3_100mV.csv": "682a8c0ab0109bc7d770d778d1da4b2a2cf675499fedb9a2861559d92d1ae910",
    "axis_1_200mV.csv": "d8630d7cf3ef1ab0e7f64b2aa99e49f41c9b7ed37645f5eca1f9ef4969c95b0e",
    "axis_2_200mV.csv": "689fc52f75855c1cb2a1bf6be510b677ffea34941a1504a67fba141184951c8a",
    "axis_3_200mV.csv": "ac2ff7cf9a346a7b550661c09b377aa1cfea991a6767e7c158bd8a62225b83cb",
    "axis_1_300mV.csv": "370531ab989cf3e7555c679bab8946d2cb9b2fb418b8b1ae5d5e6ee56cf3de17",
    "axis_2_300mV.csv": "d426292410bf6a9e51c2c526a9511a0919705f702caa06cfd4285dd5affdc87d",
    "axis_3_300mV.csv": "8c8cf8b11ad0a411238d38eb5e9d75e33620610a2f9203b7cf37d617fbdcb745",
    "axis_1_100mV_test_1.csv": "509d16d22f73c294e5941db22587bf36cdf77d4db287d3638af9f627710a4fc9",
    "axis_1_100mV_test_2.csv": "2cc2c71b2380d0e113478a3cd8b2349b7aa949b05bc5e20342761c96002bb925",
    "axis_1_100mV_test_3.csv": "b26c922f6bd14a6690daa04caf6fdacda8b5a63d25a9da58b027e566287002af",
    "axis_2_100mV_test_1.csv": "3a463ffa0157c83f96d3b543e2f94a03ba8c2d6da4e82797e66b1dc4f2fe1d7c",
    "axis_2_100mV_test_2.csv": "fd72e7b1c13bab042b513c50337ecf31ce2334d7e19207a76241cfb5d40b0962",
    "axis_2_100mV_test_3.csv": "5721af44ac32559d0d1f8fb826370aea85c485fdb36c7f22630064a571362227",
    "axis_3_100mV_test_1.csv": "408a835cc26241a5ad8aa864e348c65681b076284397e330d9a033fb26ce81b1",
    "axis_3_100mV_test_2.csv": "2f32306cb3b3ca48c48242b06c57c5a0b10ab882f1c10a33f77c45e12b4919b6",
    "axis_3_100mV_test_3.csv": "6dccdd500b84c12015f71155d2fa5575d4888fdde1318dc2b467d6dd0ea99cf5",
    "axis_1_200mV_test_1.csv": "b9cf512ec02653bd60b4c9d77ad00d52551497190afbaff45e07d491d0adfec6",
    "axis_1_200mV_test_2.csv": "c5ce2319c8a22c1e9f22b95b3b5c00118383ae613006069da6788e44e1ccdb25",
    "axis_1_200mV_test_3.csv": "58ba335a466515816f47c3965771c229808c6967dbacbf8964a249e87bf64be1",
    "axis_2_200mV_test_1.csv": "e08a68608fa506407901293e020c8ae42d2c30146efacfac72eeb3b74db30cfc",
    "axis_2_200mV_test_2.csv": "efdb5f41a3b5c39ceae1dd9cfef58446642dc2b1a5f9b71b8b760f972cbc529f",
    "axis_2_200mV_test_3.csv": "035b6364bebe3029ea8634ec925041542832d114947bb3926f5df2c9cebb0012",
    "axis_3_200mV_test_1.csv": "f799e391f0f895728b2c9030d28401b00cdec2b9f02092107aa4041c308c6d1a",
    "axis_3_200mV_test_2.csv": "c0b363c42ddc3da3203c8ad11310d567032f86ad1b28450653a5ddc95a469b17",
    "axis_3_200mV_test_3.csv": "d03fd02ff15c9a0747793f6c54a4d497ed868f62f63d8c4a4a8ceddf6852650a",
    "axis_1_300mV_test_1.csv": "2a29bde3112d2e28f8860b0f83914f670d1ab888f2ca15d5054d8cd10833b86a",
    "axis_1_300mV_test_2.csv": "b205cde2f0d71b08f4d8c40cb8fe3f809c2f78de01d7a4e97778b70d6c35e95a",
    "axis_1_300mV_test_3.csv": "92fb5fa43366b6ddaa110388ff0b73c5d8041d20fa3dd0568b1c50d74f0dfe52",
    "axis_2_300mV_test_1.csv": "ecbdf4a94466e920e39055347dc270c1b4a568799611415dc2b2370fabb1d3c1",
    "axis_2_300mV_test_2.csv": "30809f1a8395b0ddcd67de4c5a0b6929185df27fa5ff6325eb602249581a70f8",
    "axis_2_300mV_test_3.csv": "bf1bf0e46a48bbbde1c9db627737ce3fdf222d6cd793f19e10ab870c0af51937",
    "axis_3_300mV_test_1.csv": "d35e2b8761ef59965652eeab55838bac8d45593036087a236f60b68754d46a86",
    "axis_3_300mV_test_2.csv": "9b4f650ca76e826f0ecb8415fe1e50b0630f4a1dfb0e4d7c99cad737f49fe161",
    "axis_3_300mV_test_3.csv": "38ecc1334a9c1453820d01a2ec5435f3389f8bc7fda12749db862b32ec170ccf",
}


def _axis(axis: int, level: int, signal: int | None = None) -> DatasetFile:
    """Return the record of one axis: of the first training signal, or of a test signal."""
    name = f"axis_{axis + 1}_{level}mV{'' if signal is None else f'_test_{signal + 1}'}.csv"
    parts = ("train",) if signal is None else ("train", "test")
    originals = [f"{what}_{level}mV_{part}.npy" for part in parts for what in "uy"]
    said = "first training signal" if signal is None else f"test signal {signal + 1}"
    length = "one period" if signal is None else "two periods"
    return DatasetFile(
        name,
        f"axis {axis + 1} and its own actuator, {said}, {level} mV rms, {length}",
        _AXES[name],
        tuple(Original(o, f"{_MIRROR_FOLDER}{o}", _ORIGINALS[o]) for o in originals),
        OneAxis(axis, SIGNS[axis], signal or 0, len(parts), _RATE),
    )


def _mirror(name: str, description: str, files: tuple[DatasetFile, ...]) -> Dataset:
    return Dataset(
        name=name,
        description=description,
        source="https://github.com/merijnfloren/fsm-benchmark-data",
        citation="M. Floren, L. Peri, J. De Maeyer, W. De Munter, D. Vandepitte and J.-P. Noel,"
        " Data-driven state-space identification and nonlinearity assessment of the CubeSpec Fine"
        " Steering Mirror, ISMA-USD 2024, 2042-2052",
        licence="CC BY 4.0, copyright (c) 2025 Merijn Floren, KU Leuven",
        licence_text="Creative Commons Attribution 4.0 International (CC BY 4.0)\n\nCopyright (c)"
        f" 2025 Merijn Floren, KU Leuven\n\n{CC_BY_4}\nChanged: one axis is taken, its sign turned"
        " where its actuator lowers it, and what the other actuators do is taken off.\n",
        files=files,
    )


STEERING_MIRROR = _mirror(
    "steering_mirror",
    "a satellite's mirror on three piezo actuators, each axis with its own one: random-phase"
    " multisines up to 3 kHz, 6.4 kHz, steady state, three levels",
    tuple(_axis(axis, level) for level in LEVELS for axis in range(3)),
)

STEERING_MIRROR_TEST = _mirror(
    "steering_mirror_test",
    "the same mirror: the test signals of the benchmark, to judge a model by",
    tuple(_axis(a, level, k) for level in LEVELS for a in range(3) for k in range(3)),
)


_ALL = (MICROMANIPULATOR, MICROMANIPULATOR_RESTS, STEERING_MIRROR, STEERING_MIRROR_TEST)

#: Every dataset by name. A dataset stands here once its licence and its hashes were verified.
DATASETS: dict[str, Dataset] = {d.name: d for d in _ALL}
