"""A stack made linear: feed-forward of the observed hysteresis, and the same tracked online.

All parameters of the stack are 10 % off the values in the controller, and the stack ages
besides. The observer alone (paper eq. 37) leaves what it does not know; recursive least squares
(38) learns it from the displacement sensor while the scan runs. Each sample costs a few
microseconds, and the identification is also exported: as FMU 2.0, FMU 3.0 and Modelica.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import psa_casadi as psa
from psa_casadi.examples.linearisation_trial import Drive, ageing, driven, off_values
from psa_casadi.online import identifier_for

END, PERIOD = 4.0, 5e-4
#: The part that is looked at: the last second, five periods.
LAST = slice(-round(1.0 / PERIOD), None)
_LOOK = (
    ("none", "plain", "#d55e00"),
    ("feed-forward", "observer, values 10 % off", "#e69f00"),
    ("tracked", "tracked online", "#0072b2"),
)


def main(folder: Path) -> dict[str, float]:
    """Drive an ageing stack in three ways, draw the errors, export the identification."""
    plant = psa.stack_model("P-885.51")
    known = off_values(plant, 0.1, seed=0)
    time = np.arange(0.0, END, PERIOD)
    drift = ageing(plant, END, loss=0.02, growth=0.1)
    runs = {kind: driven(plant, kind, known, time, drift=drift) for kind, _, _ in _LOOK}
    block = identifier_for(known, PERIOD, noise=2e-8)
    psa.export_fmu(block, folder / "online_identification.fmu")
    psa.export_fmu(block, folder / "online_identification_3.fmu", fmi=3)
    psa.export_modelica(block, folder / "OnlineIdentification.mo", name="OnlineIdentification")
    _draw(folder / "linearise_online.png", runs)
    table = {
        f"nonlinearity, {label} [% of the range]": 100.0 * runs[kind].nonlinearity(LAST)
        for kind, label, _ in _LOOK
    }
    estimate = runs["tracked"].estimate
    if estimate is not None:
        table["estimate of A over its true value"] = estimate.parameters["A"] / (
            plant.values["A"] * drift(END)["A"]
        )
    return table


def _draw(path: Path, runs: dict[str, Drive]) -> None:
    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    loops, errors = figure.subplots(1, 2)
    for kind, label, colour in _LOOK:
        d = runs[kind]
        loops.plot(d.wanted[LAST], 1e6 * d.displacement[LAST], color=colour, label=label)
        error = 100.0 * d.errors(LAST) / float(np.ptp(d.displacement))
        errors.plot(d.time, error, color=colour, label=label, linewidth=0.8)
    loops.set(xlabel="wanted voltage of a linear stack [V]", ylabel="displacement [um]")
    errors.set(xlabel="time [s]", ylabel="distance from a straight line [% of the range]")
    for axes in (loops, errors):
        axes.grid(color="#e4e7ea")
    loops.legend(loc="upper left")
    figure.savefig(path, dpi=110)
