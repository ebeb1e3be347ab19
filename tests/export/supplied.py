"""FMUs of other tools, made here: by PythonFMU (FMI 2) and PythonFMU3 (FMI 3), and of C files.

Those of PythonFMU have co-simulation only.
"""

import tempfile
import zipfile
from functools import cache
from importlib.resources import files
from pathlib import Path

import casadi as ca
import fmpy
import numpy as np
from fmpy.fmi2 import FMU2Model
from pythonfmu.builder import FmuBuilder as Builder2
from pythonfmu3.builder import FmuBuilder as Builder3
from scipy.integrate import solve_ivp

import psa_casadi as psa
from psa_casadi.common.files import temporary_folder
from psa_casadi.common.units import FloatArray
from psa_casadi.simulation.compiler import compiler_command, run_compiler

_FOLDER = tempfile.TemporaryDirectory()
_SUPPLIERS = Path(__file__).with_name("suppliers")
TIMES = np.linspace(0.0, 100.0, 501)
INFLOW = 0.02 * (1.0 + np.sin(TIMES / 8.0) + 0.8 * np.sin(TIMES / 3.0))


@cache
def supplied(name: str) -> Path:
    """Return the FMU of a file of suppliers/: `tank` (FMI 2) or `ball` (FMI 3)."""
    build = (Builder2 if name == "tank" else Builder3).build_FMU
    made: Path = build(_SUPPLIERS / f"{name}.py", dest=_FOLDER.name)
    return made


@cache
def _library(source: Path, *flags: str, stubs: bool) -> bytes:
    code = source.read_text("utf-8")
    lacking = [n for n in dir(FMU2Model) if n.startswith("fmi2") and f" {n}(" not in code]
    refusals = "".join(f"int {name}(void) {{ return 3; }}\n" for name in lacking if stubs)
    command = [*compiler_command(), "-O1", "-fPIC", "-shared", f"-I{files('fmpy') / 'c-code'}"]
    with temporary_folder() as folder:
        (folder / "model.c").write_text(code, encoding="utf-8")
        (folder / "stubs.c").write_text(refusals, encoding="utf-8")
        run_compiler([*command, *flags, "model.c", "stubs.c", "-lm", "-o", "library"], folder)
        return (folder / "library").read_bytes()


def compiled_fmu(name: str, *flags: str, stubs: bool = False, **words: object) -> Path:
    """Return the FMU of a C file, and of the description in its folder with some words put in.

    With `stubs` the functions of model exchange that the file lacks return an error.
    """
    source = Path(__file__).parent / name
    path = Path(tempfile.mkdtemp(dir=_FOLDER.name)) / f"{source.stem}.fmu"
    description = source.with_name("modelDescription.xml").read_text("utf-8").format(**words)
    place = f"binaries/{fmpy.platform}/{source.stem}{fmpy.sharedLibraryExtension}"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description)
        archive.writestr(place, _library(source, *flags, stubs=stubs))
    return path


@cache
def pendulum(*, indicators: int = 0, once: str = "false") -> Path:
    """Return the FMU of a pendulum, which has model exchange only."""
    return compiled_fmu("pendulum/pendulum.c", stubs=True, indicators=indicators, once=once)


def level(area: float, outlet: float, flow: FloatArray = INFLOW) -> FloatArray:
    """Return the level of the supplier's tank with an open valve, by SciPy."""

    def rate(t: float, h: FloatArray) -> FloatArray:
        inputs = float(np.interp(t, TIMES, flow))
        return (inputs - outlet * np.sqrt(np.maximum(0.0, 19.62 * h))) / area

    result = solve_ivp(rate, (0.0, 100.0), [0.2], t_eval=TIMES, rtol=1e-9, max_step=0.2)
    return np.asarray(result.y[0])


def lagged(y: FloatArray, time: float) -> FloatArray:
    """Return what a sensor with a lag shows of an output at `TIMES`."""

    def rate(t: float, z: FloatArray) -> FloatArray:
        return (float(np.interp(t, TIMES, y)) - z) / time

    result = solve_ivp(rate, (0.0, 100.0), y[:1], t_eval=TIMES, rtol=1e-8, max_step=0.2)
    return np.asarray(result.y[0])


def bounces(g: float, e: float, times: FloatArray) -> FloatArray:
    """Return the height of a ball dropped from 1 m, from the sum of its flights."""
    starts, lasts = 0.0, np.sqrt(2.0 / g)
    first = np.where(times < lasts, 1.0 - 0.5 * g * times**2, 0.0)
    starts, speed = lasts, e * np.sqrt(2.0 * g)
    text = first
    while speed > 1e-3:
        at, lasts = times - starts, 2.0 * speed / g
        text = np.where((at >= 0) & (at < lasts), speed * at - 0.5 * g * at**2, text)
        starts, speed = starts + lasts, e * speed
    return np.asarray(text)


def main() -> None:
    """Write what docs/howto/fmu.md takes for granted: tank.fmu, run.csv and plant.fmu."""
    Path("tank.fmu").write_bytes(supplied("tank").read_bytes())
    measured = lagged(level(0.7, 0.01), 3.0)
    measured += 1e-3 * np.random.default_rng(1).standard_normal(len(TIMES))
    columns = [TIMES, INFLOW, np.ones(len(TIMES)), measured]
    head = "time,inflow,valve,level"
    np.savetxt("run.csv", np.column_stack(columns), delimiter=",", header=head, comments="")
    speed, torque = ca.SX.sym("speed"), ca.SX.sym("torque")
    rate = (torque - 0.01 * speed - 1e-5 * speed**3) / 2e-3
    plant = {"x": speed, "u": torque, "ode": rate, "y": speed}
    psa.export_fmu(psa.ode_model(plant, name="plant", outputs=["shown"]), "plant.fmu")


if __name__ == "__main__":
    main()
