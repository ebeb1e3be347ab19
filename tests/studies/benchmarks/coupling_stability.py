"""Where a co-simulation turns unstable: predicted from the parts' matrices, and found by bisection.

The system gets a jump of 1 V at its input; whether the force on the stack settles shows in the size
of its second differences, early and late.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf, isfinite, log10, nan
from pathlib import Path

import numpy as np

from psa_casadi.export.importer.fmu import FmuError
from psa_casadi.export.importer.masters import Signals
from psa_casadi.export.ssp.archive import wiring_of
from psa_casadi.export.ssp.steps import stable_step
from psa_casadi.model.system import System
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table
from tests.export.ssp_master import SspArchive, couple, points
from tests.studies.benchmarks.table import TitledTable

_STIFFNESSES = (5e6, 2e7, 5e7, 1e8, 2e8, 5e8)
_KICK, _COUNT, _CLOSE, _LONG, _TOLERANCE = 1.0, 1500, 0.02, 1e-3, 1e-7
#: Ratio of one step to the next on the way up.
_WALK = 1.15
#: Share of the first roughness below which a coupling has settled.
_SETTLED = 1e-4


@dataclass(frozen=True)
class Limit:
    """The longest stable communication step [s] of one contact stiffness [N/m]."""

    stiffness: float
    slopes: bool
    predicted: float
    measured: float


def limits(system: System, path: Path, quick: bool) -> tuple[Limit, ...]:
    """Return the limits of a system with the parts `stack` and `flexure` and the input `command`.

    Contacts of several stiffnesses are tried, with inputs held and with input derivatives.
    """
    found = []
    with SspArchive(path) as archive:
        for stiffness in _STIFFNESSES[2:3] if quick else _STIFFNESSES:
            flexure = system.parts["flexure"].with_values({"k_c": stiffness})
            parts = {**system.parts, "flexure": flexure}
            wiring = wiring_of(replace(system, parts=parts))
            for slopes in (False, True):
                predicted = stable_step(wiring, rates=slopes)
                measured = _bisected(archive, predicted, {"flexure.k_c": stiffness}, slopes)
                found.append(Limit(stiffness, slopes, predicted, measured))
    return tuple(found)


def _bisected(
    archive: SspArchive, guess: float, values: Mapping[str, float], slopes: bool
) -> float:
    """Return the step between the last stable and the first unstable one, 2 percent apart.

    Infinity if none is predicted and steps of 1 ms are stable. Else the search walks up from a
    third of the guess in small strides, since longer steps than an unstable one may be stable.
    """
    if not isfinite(guess):
        return inf if settles(archive, _LONG, values, slopes=slopes) else nan
    low = guess / 3.0
    while not settles(archive, low, values, slopes=slopes):
        low /= 3.0
    high = _WALK * low
    while settles(archive, high, values, slopes=slopes):
        low, high = high, _WALK * high
    while log10(high / low) > log10(1.0 + _CLOSE):
        middle = (low * high) ** 0.5
        if settles(archive, middle, values, slopes=slopes):
            low = middle
        else:
            high = middle
    return float((low * high) ** 0.5)


def settles(archive: SspArchive, step: float, values: Mapping[str, float], *, slopes: bool) -> bool:
    """Return whether the force on the stack settles after a jump of the command.

    It does where its roughness falls, or is as small as what the parts' tolerances leave.
    """
    times = points(step, _COUNT * step)
    kick = Signals(("command",), times[:1], np.array([[_KICK]]), held=True)
    try:
        found = couple(
            archive,
            times,
            kick,
            ["flexure.reaction_force"],
            rates=slopes,
            values=values,
            tolerance=_TOLERANCE,
        )[:, 0]
    except FmuError:
        return False
    rough = np.abs(np.diff(found, 2))
    third = _COUNT // 3
    early, later, last = rough[:third].max(), rough[third:-third].max(), rough[-third:].max()
    return bool(last < max(later, _SETTLED * early))


def limits_table(found: tuple[Limit, ...]) -> TitledTable:
    """Return the limits, predicted and found."""
    rows = tuple(
        (
            number(1e-6 * f.stiffness), "input derivatives" if f.slopes else "held",
            _written(f.predicted), _written(f.measured),
        )
        for f in found
    )  # fmt: skip
    head = ("contact stiffness [N/um]", "inputs", "predicted [us]", "found [us]")
    note = (
        "Predicted: the spectral radius of the map over one step is 1, from the parts linearised at"
        " rest. Found: the own master on the FMUs, by bisection to 2 percent."
        " Where there is no limit, steps of 1 ms were stable."
    )
    return TitledTable("Longest stable communication step", Table(head, rows), note)


def _written(step: float) -> str:
    return number(1e6 * step) if isfinite(step) else "no limit" if step == inf else "unstable"
