"""Any CasADi ODE as an FMU and a Modelica model: a Van der Pol oscillator in twelve lines.

`model` and the first lines of `main` are the whole of it; the rest draws what fmpy makes of the
FMU, which knows nothing of CasADi any more.
"""

from pathlib import Path

import casadi as ca
import numpy as np
from fmpy import simulate_fmu
from matplotlib.figure import Figure

import psa_casadi as psa


def model() -> psa.Model:
    """Return x'' = mu (1 - x^2) x' - x as a model that simulates and is exported."""
    x, v, mu = ca.SX.sym("x"), ca.SX.sym("v"), ca.SX.sym("mu")
    return psa.ode_model(
        {"x": ca.vertcat(x, v), "p": mu, "ode": ca.vertcat(v, mu * (1 - x**2) * v - x), "y": x},
        name="van_der_pol",
        states=[
            psa.State("x", "m", "position", 2.0, start=2.0),
            psa.State("v", "m/s", "rate", 2.0),
        ],
        parameters=[psa.Parameter("mu", 1.0, "1", (0.0, 1e3), "damping against amplitude")],
        outputs=[psa.Output("position", "m", "position", 2.0)],
    )


def main(folder: Path) -> dict[str, str | float]:
    """Export the oscillator (FMI 2.0, FMI 3.0, Modelica), run the FMU in fmpy, draw two of them."""
    oscillator = model()
    psa.export_fmu(oscillator, folder / "van_der_pol.fmu")
    psa.export_fmu(oscillator, folder / "van_der_pol_3.fmu", fmi=3)
    psa.export_modelica(oscillator, folder / "VanDerPol.mo")
    table: dict[str, str | float] = {}
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    axes = figure.subplots()
    for mu, colour in ((1.0, "#0072b2"), (5.0, "#d55e00")):
        result = simulate_fmu(
            str(folder / "van_der_pol.fmu"), fmi_type="CoSimulation", stop_time=40.0,
            output_interval=0.02, start_values={"mu": mu}, output=["position"],
        )  # fmt: skip
        axes.plot(result["time"], result["position"], color=colour, label=f"mu = {mu:g}")
        table[f"amplitude at mu = {mu:g} [m]"] = float(np.abs(result["position"][1000:]).max())
    axes.set(xlabel="time [s]", ylabel="position [m]", ylim=(-2.4, 3.0))
    axes.grid(color="#e4e7ea")
    axes.legend(loc="upper right", ncols=2)
    figure.savefig(folder / "van_der_pol.png", dpi=110)
    return table
