"""The micromanipulator of Y. N. Aye: a sine, minor loops, and sines with rests between them."""

from psa_casadi.datasets.conversions.columns import Columns
from psa_casadi.datasets.devices.licences import MIT
from psa_casadi.datasets.published import Dataset, DatasetFile, Original

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
