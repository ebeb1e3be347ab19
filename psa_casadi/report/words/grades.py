"""How well the records determine each parameter, in one word each."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from psa_casadi.identification.determinacy import DETERMINED_WIDTH
from psa_casadi.identification.identify import Identification
from psa_casadi.model.compose import Model

Degree = Literal["determined", "weak", "undetermined", "on its bound", "fixed"]
DEGREES: tuple[Degree, ...] = get_args(Degree)

#: A relative standard error above this is weak.
WEAK_ERROR = 0.1
#: Two parameters whose estimates correlate by more than this are known only together.
STRONG_CORRELATION = 0.95
_NORMAL_95 = 1.959963984540054


@dataclass(frozen=True)
class Grade:
    """One parameter's relative standard error, and what that makes of it.

    It is over the value, or over an ordinary change of a parameter that may be zero
    (`by_change`); a fixed parameter has none (nan).
    """

    name: str
    error: float
    degree: Degree
    by_change: bool = False


def grades(found: Identification) -> tuple[Grade, ...]:
    """Return a grade for every parameter of the identified model, in the model's order."""
    return tuple(grade(found, p.name) for p in found.model.structure.parameters)


def grade(found: Identification, name: str) -> Grade:
    """Return the grade of one parameter."""
    known, values = found.determinacy, found.model.values
    if name not in known.standard_errors:
        return Grade(name, float("nan"), "fixed")
    parameter = found.model.parameter(name)
    size = abs(values[name]) if parameter.log else parameter.typical(values)
    error = known.standard_errors[name] / size if size > 0 else float("inf")
    degree: Degree = "weak" if error > WEAK_ERROR else "determined"
    if name in known.on_bound:
        degree = "on its bound"
    elif name in known.undetermined:
        degree = "undetermined"
    return Grade(name, error, degree, by_change=not parameter.log)


def determined(model: Model, found: Identification | None = None) -> frozenset[str]:
    """Return the parameters that the records determine, if only weakly.

    Without the identification that found them they are those whose 95 % interval is that of a
    standard error below `DETERMINED_WIDTH`.
    """
    if found is not None:
        known = {g.name for g in grades(found) if g.degree in ("determined", "weak")}
        return frozenset(known | set(found.read_off))
    return frozenset(n for n in model.provenance.intervals if _is_narrow(model, n))


def _is_narrow(model: Model, name: str) -> bool:
    interval, parameter = model.provenance.intervals[name], model.parameter(name)
    if parameter.log:
        width = math.log(interval.high / interval.low) if interval.low > 0.0 else math.inf
    else:
        width = (interval.high - interval.low) / (parameter.typical(model.values) or math.inf)
    return width <= 2.0 * _NORMAL_95 * DETERMINED_WIDTH


def named(graded: tuple[Grade, ...], degree: Degree) -> list[str]:
    """Return the names of the parameters of one degree."""
    return [g.name for g in graded if g.degree == degree]


def strong_pairs(found: Identification) -> list[tuple[str, str, float]]:
    """Return the pairs of parameters that are known only together, the strongest first."""
    names, matrix = found.determinacy.names, found.determinacy.correlations
    pairs = [
        (names[i], names[k], float(matrix[i, k]))
        for i in range(len(names))
        for k in range(i + 1, len(names))
        if abs(matrix[i, k]) >= STRONG_CORRELATION
    ]
    return sorted(pairs, key=lambda pair: -abs(pair[2]))
