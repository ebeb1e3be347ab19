"""One parameter over devices, on the scale that it is fitted on: value or logarithm."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from psa_casadi.components import COMPONENTS
from psa_casadi.effects import EFFECTS
from psa_casadi.population.finding import NORMAL_95, Finding, Found
from psa_casadi.units import FloatArray


@dataclass(frozen=True, eq=False)
class Estimates:
    """Estimates (n,) and standard errors (n,) of a parameter, `places` of the devices that have it.

    On a logarithmic scale theta is ln(value/unit); else both are in the SI unit.
    """

    name: str
    unit: str
    meaning: str
    log: bool
    places: tuple[int, ...]
    theta: FloatArray
    errors: FloatArray

    def value(self, theta: float) -> float:
        """Return a theta as a value in the SI unit."""
        return math.exp(theta) if self.log else theta


def estimates(findings: Sequence[Finding], name: str) -> Estimates:
    """Return what the devices tell of a parameter; devices that do not tell it are left out.

    A 95 % interval [low, high] has the standard error ln(high/low)/3.92 on a logarithmic scale,
    else (high - low)/3.92, as the intervals of a fit are made.
    """
    rows = [(k, f.parameters[name]) for k, f in enumerate(findings) if name in f.parameters]
    told = [(k, p) for k, p in rows if _tells(p)]
    log = name in _logarithmic() and all(_positive(p) for _, p in told)
    theta = np.array([math.log(p.value) if log else p.value for _, p in told])
    errors = np.array([_error(p, log) for _, p in told])
    first = rows[0][1] if rows else Found(0.0, "", None)
    return Estimates(name, first.unit, first.meaning, log, tuple(k for k, _ in told), theta, errors)


def names_of(findings: Sequence[Finding]) -> tuple[str, ...]:
    """Return the names of the parameters that a device tells, in the order of the first files."""
    found = (n for f in findings for n, p in f.parameters.items() if _tells(p))
    return tuple(dict.fromkeys(found))


def _tells(p: Found) -> bool:
    return p.told and p.interval is not None and p.interval[1] > p.interval[0]


def _positive(p: Found) -> bool:
    return p.value > 0.0 and p.interval is not None and p.interval[0] > 0.0


def _error(p: Found, log: bool) -> float:
    low, high = p.interval or (math.nan, math.nan)
    width = math.log(high / low) if log else high - low
    return width / (2.0 * NORMAL_95)


@cache
def _logarithmic() -> frozenset[str]:
    """Return the parameters that are fitted on a logarithmic scale."""
    every = (*COMPONENTS.values(), *EFFECTS.values())
    return frozenset(p.name for c in every for p in c.parameters if p.log)


def display_unit(name: str, unit: str) -> str:
    """Return the unit that a parameter is shown in."""
    return _display_units().get(name, unit)


@cache
def _display_units() -> dict[str, str]:
    every = (*COMPONENTS.values(), *EFFECTS.values())
    return {p.name: p.display_unit for c in every for p in c.parameters if p.display_unit}
