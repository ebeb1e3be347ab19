"""An FMU of a stack in fmpy: a whole run, other parameters, step by step, there and back.

`simulate_fmu` is enough for a run. The second half drives the same FMU call by call, as a test
bench or a controller does, stores its state, goes on, and returns to it.
"""

from pathlib import Path
from typing import Any

import numpy as np
from fmpy import simulate_fmu
from matplotlib.figure import Figure

import psa_casadi as psa
from psa_casadi.examples.co_simulation import Slave

#: Duration of one triangle and the communication step [s].
END, STEP = 4e-2, 1e-4


def main(folder: Path) -> dict[str, float]:
    """Run the FMU of a P-885.51 on a triangle of 100 V; draw its loop with less hysteresis too."""
    fmu = psa.export_fmu(psa.stack_model("P-885.51"), folder / "stack.fmu")
    rows = [(0.0, 0.0, 0.0), (END / 2, 100.0, 0.0), (END, 0.0, 0.0)]  # a triangle, as fmpy reads it
    voltage = np.array(rows, dtype=[(n, np.float64) for n in ("time", "voltage", "load_force")])
    whole = _run(fmu, voltage, {})
    less = _run(fmu, voltage, {"A": 0.5 * psa.stack_model("P-885.51").values["A"]})
    by_steps, again = _step_by_step(fmu, voltage)
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    axes = figure.subplots()
    for run, colour, label in ((whole, "#0072b2", "the stack"), (less, "#d55e00", "A halved")):
        volts = np.interp(run["time"], voltage["time"], voltage["voltage"])
        axes.plot(volts, 1e6 * run["displacement"], color=colour, label=label)
    axes.set(xlabel="voltage [V]", ylabel="displacement [um]")
    axes.grid(color="#e4e7ea")
    axes.legend(loc="upper left")
    figure.savefig(folder / "use_in_fmpy.png", dpi=110)
    span, expected = float(np.ptp(whole["displacement"])), _expected()
    return {
        "stroke [um]": 1e6 * span,
        "error at the end, simulate_fmu [% of the stroke]": 100.0
        * abs(whole["displacement"][-1] - expected)
        / span,
        "error at the end, with slopes of the voltage [% of the stroke]": 100.0
        * abs(by_steps - expected)
        / span,
        "second half repeated from the stored state differs by [m]": abs(by_steps - again),
    }


def _expected() -> float:
    """Return the displacement at the end [m] by the model itself, the voltage linear in between."""
    plant = psa.stack_model("P-885.51").plant()
    t = np.linspace(0.0, END, 401)
    u = np.column_stack([100.0 * (1.0 - np.abs(2.0 * t / END - 1.0)), np.zeros_like(t)])
    y = psa.run(plant, t, u, np.zeros(len(plant.state_names)), rtol=1e-10).y
    return float(y[-1, plant.output_names.index("displacement")])


def _run(fmu: Path, voltage: Any, start_values: dict[str, float]) -> Any:
    """Run the FMU with its solver; fmpy holds the voltage during each communication step."""
    return simulate_fmu(
        str(fmu), fmi_type="CoSimulation", stop_time=END, output_interval=STEP, input=voltage,
        start_values=start_values, output=["displacement"], relative_tolerance=1e-8,
    )  # fmt: skip


def _step_by_step(fmu: Path, voltage: Any) -> tuple[float, float]:
    """Drive the FMU call by call; return the last displacement [m], twice.

    The second time only the second half runs, from the state that was stored in the middle. Before
    every step the FMU gets the voltage and its slope, so it knows the ramp within the step.
    """
    half = round(END / STEP / 2)
    with Slave(fmu) as slave:
        _drive(slave, voltage, range(half))
        middle = slave.fmu.getFMUState()
        _drive(slave, voltage, range(half, 2 * half))
        (first,) = slave.get(["displacement"])
        slave.fmu.setFMUState(middle)
        _drive(slave, voltage, range(half, 2 * half))
        (again,) = slave.get(["displacement"])
        slave.fmu.freeFMUState(middle)
    return first, again


def _drive(slave: Slave, voltage: Any, steps: range) -> None:
    for k in steps:
        time = k * STEP
        now, then = np.interp([time, time + STEP], voltage["time"], voltage["voltage"])
        slave.set({"voltage": float(now)}, {"voltage": float(then - now) / STEP})
        slave.step(time, STEP)
