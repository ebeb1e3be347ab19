"""Uncertainty of an FMU: its parameter sets simulated in fmpy, the band of the displacement.

An FMU of an identified model holds sets of its parameters within their uncertainty, as SSV files:
`mean`, pairs of sigma points, random samples. Any tool that reads SSV can choose one by its name;
here Python's XML reader does. The sigma points give the standard deviation of the displacement as
the root of the summed squares of their half differences; the samples show it without that rule.
"""

import shutil
from importlib import resources
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from fmpy import extract, read_model_description, simulate_fmu
from matplotlib.figure import Figure

import psa_casadi as psa

#: Where an FMU keeps its parameter sets.
SETS = Path("extra", "org.fmi-standard.fmi-ls-ref", "parameter_sets")
#: Duration of the run, the communication step [s], and the highest voltage [V].
END, STEP, PEAK = 0.4, 2e-3, 60.0


def main(folder: Path) -> dict[str, float]:
    """Diagnose the record that ships with the package, export it, and draw the band of a sweep."""
    record = resources.files("psa_casadi").joinpath("data", "demo.csv")
    with resources.as_file(record) as path:
        model = psa.diagnose(path).model
    fmu = psa.export_fmu(model, folder / "stack.fmu", parameter_sets=20)
    unpacked = Path(extract(str(fmu)))
    try:
        runs = {
            p.stem: _run(unpacked, parameter_set(p)) for p in sorted((unpacked / SETS).iterdir())
        }
    finally:
        shutil.rmtree(unpacked, ignore_errors=True)
    mean = runs["mean"]["displacement"]
    by_points = deviation(runs)
    by_samples = np.std([r["displacement"] for n, r in runs.items() if "sample" in n], axis=0)
    _draw(folder / "uncertainty_in_fmpy.png", runs["mean"]["time"], mean, by_points, runs)
    return {
        "parameter sets": float(len(runs)),
        "stroke [um]": 1e6 * float(np.ptp(mean)),
        "widest standard deviation, sigma points [nm]": 1e9 * float(np.max(by_points)),
        "widest standard deviation, samples [nm]": 1e9 * float(np.max(by_samples)),
    }


def parameter_set(path: Path) -> dict[str, float]:
    """Return the values of an SSV file by the names of the parameters."""
    space = "{http://ssp-standard.org/SSP1/SystemStructureParameterValues}"
    return {
        p.attrib["name"]: float(real.attrib["value"])
        for p in ET.parse(path).getroot().iter(f"{space}Parameter")
        for real in p.iter(f"{space}Real")
    }


def deviation(runs: dict[str, Any]) -> np.ndarray:
    """Return the standard deviation of the displacement (n,) [m] by the pairs of sigma points."""
    pairs = [n.removesuffix("_plus") for n in runs if n.endswith("_plus")]
    halves = [
        0.5 * (runs[f"{n}_plus"]["displacement"] - runs[f"{n}_minus"]["displacement"])
        for n in pairs
    ]
    return np.array(np.sqrt(np.sum(np.square(halves), axis=0)))


def _run(unpacked: Path, values: dict[str, float]) -> Any:
    """Run the FMU up to the highest voltage and back."""
    rows = [(0.0, 0.0, 0.0), (END / 2, PEAK, 0.0), (END, 0.0, 0.0)]
    voltage = np.array(rows, dtype=[(n, np.float64) for n in ("time", "voltage", "load_force")])
    return simulate_fmu(
        str(unpacked), model_description=read_model_description(str(unpacked)),
        fmi_type="CoSimulation", stop_time=END, output_interval=STEP, input=voltage,
        start_values=values, output=["displacement"], relative_tolerance=1e-8,
    )  # fmt: skip


def _draw(
    path: Path, time: np.ndarray, mean: np.ndarray, deviation: np.ndarray, runs: dict[str, Any]
) -> None:
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    for name, result in runs.items():
        if name.startswith("sample"):
            axes.plot(time, 1e9 * (result["displacement"] - mean), color="#b5bcc2", lw=0.8)
    band = 1e9 * 1.96 * deviation
    axes.fill_between(time, -band, band, color="#0072b2", alpha=0.25, label="95 %, sigma points")
    axes.plot([], [], color="#b5bcc2", label="samples")
    axes.set(xlabel="time [s]", ylabel="displacement less that of the mean [nm]")
    axes.grid(color="#e4e7ea")
    axes.legend(loc="upper left")
    figure.savefig(path, dpi=110)
