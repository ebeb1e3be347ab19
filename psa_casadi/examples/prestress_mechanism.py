"""A ringing stack mounted in a prestress mechanism: designed, exported, and co-simulated.

The glued stack rings with a damping ratio of 0.03. A mechanism of mass, damper and spring acts as
feedback around its mechanics (Yang and Zhu 2015, eq. 45): here it is designed for a ratio of 0.7
and may cost a tenth of the stroke; it costs bandwidth as well. Stack and mechanism then run as two
FMUs that pass force and motion to each other, and behave as the closed form predicts. The lag's
pole stays.
"""

from pathlib import Path

import matplotlib.ticker
import numpy as np
from matplotlib.figure import Figure

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.design.mechanism.loop import Mounting, step_response
from psa_casadi.design.mechanism.mechanism import (
    Limits,
    MechanismDesign,
    design_mechanism,
    mechanism_model,
    port_model,
    root_locus,
)
from psa_casadi.examples.co_simulation import Slave

END, STEP = 5e-4, 1e-7
_MOTION = ("displacement", "tip_velocity", "tip_acceleration")
_PLACES = ("tip_position", "tip_velocity", "tip_acceleration")


def main(folder: Path) -> dict[str, float]:
    """Design the mechanism, couple the two FMUs in a step of the rated voltage, compare."""
    linear = {"A": 0.0, "beta": 0.0, "gamma": 0.0, "delta": 0.0}
    stack = psa.stack_model("PTBS200").with_values(linear)
    design = design_mechanism(stack, damping=0.7, limits=Limits(stroke_loss=0.1))
    fmus = [
        psa.export_fmu(port_model(stack), folder / "stack.fmu"),
        psa.export_fmu(mechanism_model(design), folder / "mechanism.fmu"),
    ]
    time, x = _coupled(fmus, stack.values["u_rated"])
    expected = step_response(design.mechanics, design.mounting, time).displacement
    _draw(folder / "prestress_mechanism.png", design, time, x)
    return {
        "mass [g]": 1e3 * design.mounting.mass,
        "damping [N.s/m]": design.mounting.damping,
        "stiffness [N/um]": 1e-6 * design.mounting.stiffness,
        "damping ratio, free": design.free.damping,
        "damping ratio, mounted": design.reached.damping,
        "bandwidth, free [Hz]": design.free.whole_bandwidth,
        "bandwidth, mounted [Hz]": design.reached.whole_bandwidth,
        "overshoot, free [%]": 100.0 * design.free.overshoot,
        "overshoot, mounted [%]": 100.0 * design.reached.overshoot,
        "co-simulation against closed form [% of the stroke]": 100.0
        * float(np.abs(x - expected).max() / np.ptp(expected)),
    }


def _coupled(fmus: list[Path], voltage: float) -> tuple[FloatArray, FloatArray]:
    """Step both FMUs in turn with fmpy, values held; return times and displacement."""
    time = np.linspace(0.0, END, round(END / STEP) + 1)
    x = np.zeros(len(time))
    stack, mechanism = (Slave(path) for path in fmus)
    with stack, mechanism:
        stack.set({"voltage": voltage})
        for k, t in enumerate(time[:-1].tolist()):
            mechanism.set(dict(zip(_PLACES, stack.get(_MOTION), strict=True)))
            stack.set({"prestress_force": mechanism.get(["reaction_force"])[0]})
            stack.step(t, STEP)
            mechanism.step(t, STEP)
            x[k + 1] = stack.get(_MOTION[:1])[0]
    return time, x


def _draw(path: Path, d: MechanismDesign, time: FloatArray, x: FloatArray) -> None:
    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    steps, plane = figure.subplots(1, 2)
    free = step_response(d.mechanics, Mounting(0.0, 0.0, 0.0), time).displacement
    closed = step_response(d.mechanics, d.mounting, time).displacement
    steps.plot(1e3 * time, 1e6 * free, color="#d55e00", label="free stack", linewidth=1.0)
    steps.plot(1e3 * time, 1e6 * closed, color="#0072b2", label="mounted, closed form")
    steps.plot(1e3 * time, 1e6 * x, "--", color="#222222", label="mounted, two FMUs")
    steps.set(xlabel="time [ms]", ylabel="displacement [um]")
    for branch in root_locus(d, np.concatenate([[0.0], np.geomspace(1e-4, 3.0, 300)])).T:
        plane.plot(1e-3 * branch.real, 1e-3 * branch.imag, color="#8f979e", linewidth=1.0)
    for poles, mark, colour, label in (
        (d.free_poles, "x", "#d55e00", "free stack"),
        (d.poles, "o", "#0072b2", "mounted"),
        (np.array([complex(d.lag_pole)]), "s", "#222222", "lag, cannot be moved"),
    ):
        plane.plot(1e-3 * poles.real, 1e-3 * poles.imag, mark, color=colour, label=label)
    tall = 1.2e-3 * float(np.abs(d.free_poles).max())  # around the free stack's poles and the lag's
    plane.set(xlim=(-0.25 * tall, 0.02 * tall), ylim=(-tall, tall))
    plane.set(xlabel="real part [1000 rad/s]", ylabel="imaginary part [1000 rad/s]")
    plane.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(6))
    for axes in (steps, plane):
        axes.grid(color="#e4e7ea")
        axes.legend()
    figure.savefig(path, dpi=110)
