"""The voltage for a path, designed on the exported FMU instead of on the model's equations.

CasADi imports the FMU's model-exchange side with `DaeBuilder`; the tracking program takes its
equations and their derivatives from the binary. The voltage is that of the symbolic model. The FMU
then plays it in fmpy (co-simulation) and follows the path.
"""

from pathlib import Path

import casadi as ca
import fmpy
import numpy as np
from matplotlib.figure import Figure

import psa_casadi as psa
from psa_casadi.design.tracking.targets import Dynamics, Target, checked_target
from psa_casadi.design.tracking.tracking import TrackedInput, track

#: A smooth move there and back of 8 um in 2 ms, in 80 samples.
SAMPLES, DURATION, STROKE = 80, 2e-3, 8e-6


def main(folder: Path) -> dict[str, float]:
    """Design on the FMU and on the model, compare, play the voltage in fmpy, draw."""
    model, path = psa.stack_model("P-885.51").plant(), there_and_back()
    fmu = psa.export_fmu(model, folder / "stack.fmu")
    unpacked = str(fmpy.extract(str(fmu), str(folder / "unpacked")))
    on_fmu = track(model, path, equations=lambda smooth: fmu_equations(unpacked, smooth))
    expected = track(model, path)
    played = fmpy.simulate_fmu(
        str(fmu), stop_time=DURATION, output_interval=DURATION / (SAMPLES - 1) / 50,
        input=np.array(
            list(zip(path.time, on_fmu.voltage, strict=True)),
            dtype=[("time", float), ("voltage", float)],
        ),
        start_values={"load_force": 0.0}, output=["displacement"], relative_tolerance=1e-7,
    )  # fmt: skip
    followed = np.interp(path.time, played["time"], played["displacement"])
    _draw(folder / "tracking_on_the_fmu.png", path, on_fmu, followed)
    difference = float(np.max(np.abs(on_fmu.voltage - expected.voltage)))
    return {
        "voltage differs from the symbolic model's by [V]": difference,
        "largest voltage [V]": float(on_fmu.voltage.max()),
        "error in fmpy [% of range, rms]": 100.0
        * float(np.sqrt(np.mean((followed - path.displacement) ** 2)))
        / path.span,
    }


def there_and_back() -> Target:
    """Return the path: two smooth steps, there and back."""
    time = np.linspace(0.0, DURATION, SAMPLES)
    rise = np.clip(2.0 * np.minimum(time, DURATION - time) / DURATION, 0.0, 1.0)
    return checked_target(time, STROKE * rise**3 * (10.0 - 15.0 * rise + 6.0 * rise**2))


def fmu_equations(unpacked: str, smooth: psa.Model) -> Dynamics:
    """Return the equations that an unpacked FMU of a stack has, with the values of `smooth`.

    `max_num_dir` keeps CasADi 3.8.2 from handing over several adjoint seeds, which it mixes up.
    """
    builder = ca.DaeBuilder("stack", unpacked)
    f = builder.create("f", ["x", "u", "p"], ["ode", "y"], {"max_num_dir": 1})
    time, x, v = ca.MX.sym("time"), ca.MX.sym("x", len(smooth.state_names)), ca.MX.sym("v")
    u = [v if i.name == "voltage" else ca.MX(i.start) for i in smooth.structure.inputs]
    xdot, y = f(x, ca.vertcat(*u), smooth.parameter_vector())
    row = smooth.output_names.index
    outputs = [xdot, y[row("displacement")], y[row("current")]]
    return Dynamics(ca.Function("on_fmu", [time, x, v], outputs), smooth.state_nominals())


def _draw(path: Path, target: Target, tracked_input: TrackedInput, followed: np.ndarray) -> None:
    t = 1e3 * target.time
    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    above.plot(t, 1e6 * target.displacement, color="#222222", linewidth=3.0, label="path")
    above.plot(t, 1e6 * followed, color="#56b4e9", label="the FMU in fmpy")
    above.set_ylabel("displacement [um]")
    below.plot(t, tracked_input.voltage, color="#0072b2", label="designed on the FMU")
    below.set_ylabel("voltage [V]")
    below.set_xlabel("time [ms]")
    for axes in (above, below):
        axes.grid(color="#dddddd", linewidth=0.8)
        axes.margins(x=0.01)
        axes.legend()
    figure.savefig(path, dpi=110)
