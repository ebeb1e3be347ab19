"""A raster scan that a stack follows: the plain voltage, the inverted model, the designed input.

The stack carries 0.5 kg, rings at 1.6 kHz, has hysteresis and creeps; the scan runs at a twentieth
of the resonance. The designed voltage comes from direct collocation and IPOPT, started from the
inverted model, and is judged by the full simulator.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import psa_casadi as psa
from psa_casadi.design.tracking.targets import Response, error_of, raster_scan, uncompensated
from psa_casadi.design.tracking.tracking import TrackedInput, track
from psa_casadi.simulation.linear_part import linear_part

#: Lines of the scan, samples, and its stroke [m].
LINES, SAMPLES, STROKE = 3, 600, 10e-6


def main(folder: Path) -> dict[str, float]:
    """Design the voltage, write it as a CSV, draw path, errors and voltages."""
    model = scanner()
    frequency = linear_part(model).first_resonance() / 20.0
    path = raster_scan(low=0.0, high=STROKE, frequency=frequency, lines=LINES, samples=SAMPLES)
    found, plain = track(model, path), uncompensated(model, path)
    psa.write_record(
        folder / "scan_voltage.csv", {"time [s]": path.time, "voltage [V]": found.voltage}
    )
    _draw(folder / "raster_scan.png", found, plain)
    return {
        "scan frequency [Hz]": frequency,
        "error of the plain voltage [% of range, rms]": error_of(
            path, plain.displacement
        ).rms_percent,
        "error of the inverted model [% of range, rms]": found.inverse.error.rms_percent,
        "error of the designed voltage [% of range, rms]": found.error.rms_percent,
    }


def scanner() -> psa.Model:
    """Return a P-885.51 that carries 0.5 kg and creeps by 2 % in every decade of time."""
    creep = {"creep_gain": 0.02, "creep_time": 0.01}
    stack = psa.stack_model("P-885.51").with_effect(psa.EFFECTS["slow_creep"], creep)
    return stack.with_values({"m_B": 0.5}).plant()


def _draw(path: Path, found: TrackedInput, plain: Response) -> None:
    t, wanted = 1e3 * found.target.time, found.target.displacement
    figure = Figure(figsize=(8.0, 7.5), layout="constrained")
    above, middle, below = figure.subplots(3, 1, sharex=True)
    above.plot(t, 1e6 * wanted, color="#222222", linewidth=3.0, label="path")
    above.plot(t, 1e6 * plain.displacement, color="#d55e00", label="plain voltage")
    above.plot(t, 1e6 * found.response.displacement, color="#56b4e9", label="designed voltage")
    above.set_ylabel("displacement [um]")
    share = 100.0 / found.target.span
    inverted = found.inverse.response.displacement
    errors = (
        (inverted, "#009e73", "inverted model"),
        (found.response.displacement, "#0072b2", "designed"),
    )
    for shown, colour, label in errors:
        middle.plot(t, share * (shown - wanted), color=colour, label=label)
    middle.set_ylabel("error [% of range]")
    below.plot(t, plain.voltage, color="#d55e00", label="plain")
    below.plot(t, found.voltage, color="#0072b2", label="designed")
    below.set_ylabel("voltage [V]")
    below.set_xlabel("time [ms]")
    for axes in (above, middle, below):
        axes.grid(color="#dddddd", linewidth=0.8)
        axes.margins(x=0.01)
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, frameon=False)
    rms = np.round(found.error.rms_percent, 3)
    figure.suptitle(f"Raster scan at 1/20 of the resonance: {rms:g} % of the range rms")
    figure.savefig(path, dpi=110)
