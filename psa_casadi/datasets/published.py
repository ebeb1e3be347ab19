"""What is published, by whom, under which licence, and the SHA-256 by which it is known."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Original:
    """A file as its authors publish it."""

    name: str
    url: str
    sha256: str


@dataclass(frozen=True)
class Extract:
    """A part of a table of numbers that becomes a record: rows, and two of its columns.

    `first_row` and the columns are counted from 0. The time begins at 0.
    """

    first_row: int
    rows: int
    voltage: int
    displacement: int
    sample_rate: float


@dataclass(frozen=True)
class DatasetFile:
    """One record of a dataset: its CSV file, and the original with the part that is taken of it."""

    name: str
    description: str
    sha256: str
    original: Original
    extract: Extract


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


_MIT = """\
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

_AYE = (
    "https://raw.githubusercontent.com/yan9a/DiscreteBacklashOperator/"
    "79fd060d86cdf69be2388e29bf57b0766c273650/MatLabCode/DiscreteBacklashModel/"
)

MICROMANIPULATOR = Dataset(
    name="micromanipulator",
    description="piezo-driven flexure, open loop, 200 Hz, amplifier input 0 to 3.6 V, capacitive"
    " sensor with 0.07 um rms noise; the displacement's zero is arbitrary",
    source="https://github.com/yan9a/DiscreteBacklashOperator",
    citation="Y. N. Aye and W. T. Ang, A Discrete Backlash Operator for Identification and"
    " Compensation of Hysteresis and Non-linearity for Piezoelectric Micromanipulator, ICSTSD 2018",
    licence="MIT, copyright (c) 2019 Yan Naing Aye",
    licence_text=f"MIT License\n\nCopyright (c) 2019 Yan Naing Aye\n\n{_MIT}",
    files=(
        DatasetFile(
            "sine_1hz.csv",
            "full-range sine, 1 Hz, 39 cycles",
            "c3556822db7e4a6ba79862ddb11cb16d33d4f881c49c1a6841a586d7c5296d64",
            Original(
                "Model_Vi_Do.dat",
                f"{_AYE}Model_Vi_Do.dat",
                "672714f09302b892721aa44d72f337a7ee1a0eb1d107f4d6797ab47d849428ae",
            ),
            Extract(first_row=100, rows=7927, voltage=0, displacement=4, sample_rate=200.0),
        ),
        DatasetFile(
            "minor_loops.csv",
            "1 Hz sine of ramped amplitude: nested minor loops",
            "e9b7d371edca78f9e6fabf6d24969e2320134ff6d2858e261fb16ea4593758bc",
            Original(
                "Test_Vi_Do_Di.dat",
                f"{_AYE}Test_Vi_Do_Di.dat",
                "6c33cb76d3f6e12f5074626710f71aeb43d8411a5ad0a56469ad01904221aae5",
            ),
            Extract(first_row=100, rows=3600, voltage=0, displacement=4, sample_rate=200.0),
        ),
    ),
)

#: Every dataset by name. A dataset stands here once its licence and its hashes were verified.
DATASETS: dict[str, Dataset] = {d.name: d for d in (MICROMANIPULATOR,)}
