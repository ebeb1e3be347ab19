"""The quickest move of a stack between two positions, and the same move by a voltage step.

The voltage may go from -20 V to 120 V. The designed move ends at rest; a step to the same holding
voltage leaves the payload ringing.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from psa_casadi.design.tracking.minimum_time import QuickMove, quickest_move
from psa_casadi.design.tracking.targets import AmplifierLimits, Response, respond
from psa_casadi.examples.raster_scan import scanner

BEGIN, END = 2e-6, 10e-6
LIMITS = AmplifierLimits(min_voltage=-20.0, max_voltage=120.0)


def main(folder: Path) -> dict[str, float]:
    """Design the move, play a step beside it, draw both."""
    model = scanner()
    found = quickest_move(model, BEGIN, END, LIMITS)
    voltage = np.full_like(found.response.voltage, found.response.voltage[-1])
    voltage[:2] = found.response.voltage[0]
    step = respond(model, found.response.time, voltage)
    _draw(folder / "minimum_time.png", found, step)
    behind = found.response.time > found.start_time + found.move_time
    swing = float(np.ptp(step.displacement[behind])) / 2.0
    return {
        "time of the move [us]": 1e6 * found.move_time,
        "time that the linear part alone needs [us]": 1e6 * found.linear_time,
        "residual vibration [% of the move]": 100.0 * found.residual,
        "vibration behind a step instead [% of the move]": 100.0 * swing / abs(END - BEGIN),
    }


def _draw(path: Path, found: QuickMove, step: Response) -> None:
    t = 1e6 * (found.response.time - found.start_time)
    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    for response, colour, label in (
        (step, "#d55e00", "step"),
        (found.response, "#0072b2", "designed"),
    ):
        above.plot(t, 1e6 * response.displacement, color=colour, label=label)
        below.plot(t, response.voltage, color=colour, label=label)
    above.axhline(1e6 * END, color="#222222", linestyle="--", linewidth=0.9)
    above.set_ylabel("displacement [um]")
    below.set_ylabel("voltage [V]")
    below.set_xlabel("time [us]")
    for axes in (above, below):
        axes.axvspan(0.0, 1e6 * found.move_time, color="#eef3f7", zorder=0)
        axes.grid(color="#dddddd", linewidth=0.8)
        axes.margins(x=0.01)
        axes.legend(loc="lower right")
    figure.suptitle(f"Quickest move: {1e6 * found.move_time:.0f} us (shaded)")
    figure.savefig(path, dpi=110)
