"""How well each parameter is determined, and which are known only together."""

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, get_args

from psa_casadi.identification.determinacy import DETERMINED_WIDTH
from psa_casadi.identification.identify import StackIdentification
from psa_casadi.identification.result import Identification
from psa_casadi.model.compose import Model
from psa_casadi.model.variables import NORMAL_95

Degree = Literal["determined", "weak", "undetermined", "on its bound", "fixed"]
DEGREES: tuple[Degree, ...] = get_args(Degree)

#: A relative standard error above this is weak.
WEAK_ERROR = 0.1
#: Two parameters whose estimates correlate by more than this are known only together.
STRONG_CORRELATION = 0.95


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


def grades(identification: Identification) -> tuple[Grade, ...]:
    """Return a grade for every parameter of the identified model, in the model's order."""
    return tuple(grade(identification, p.name) for p in identification.model.structure.parameters)


def grade(identification: Identification, name: str) -> Grade:
    """Return the grade of one parameter."""
    values, errors = identification.model.values, identification.errors
    if name not in errors:
        return Grade(name, float("nan"), "fixed")
    parameter = identification.model.parameter(name)
    size = abs(values[name]) if parameter.log else parameter.typical(values)
    error = errors[name] / size if size > 0 else float("inf")
    degree: Degree = "weak" if error > WEAK_ERROR else "determined"
    if name in identification.determinacy.on_bound:
        degree = "on its bound"
    elif name in identification.undetermined:
        degree = "undetermined"
    return Grade(name, error, degree, by_change=not parameter.log)


def determined(model: Model, identification: StackIdentification | None = None) -> frozenset[str]:
    """Return the parameters that the records determine, if only weakly.

    Without an identification they are those whose 95 % interval is that of a
    standard error below `DETERMINED_WIDTH`, over the value or an ordinary change.
    """
    if identification is not None:
        known = {g.name for g in grades(identification) if g.degree in ("determined", "weak")}
        return frozenset(known | set(identification.read_off))
    narrow = set()
    for name, interval in model.provenance.intervals.items():
        parameter = model.parameter(name)
        if parameter.log:
            width = math.log(interval.high / interval.low) if interval.low > 0.0 else math.inf
        else:
            size = max(parameter.typical(model.values), abs(model.values[name]))
            width = (interval.high - interval.low) / size
        if width <= 2.0 * NORMAL_95 * DETERMINED_WIDTH:
            narrow.add(name)
    return frozenset(narrow)


def named(graded: tuple[Grade, ...], degree: Degree) -> list[str]:
    """Return the names of the parameters of one degree."""
    return [g.name for g in graded if g.degree == degree]


def strong_pairs(identification: Identification) -> list[tuple[str, str, float]]:
    """Return the pairs of parameters that are known only together, the strongest first."""
    names, matrix = identification.determinacy.names, identification.determinacy.correlations
    places = combinations(range(len(names)), 2)
    strong = [(i, k) for i, k in places if abs(matrix[i, k]) >= STRONG_CORRELATION]
    pairs = [(names[i], names[k], float(matrix[i, k])) for i, k in strong]
    return sorted(pairs, key=lambda pair: -abs(pair[2]))
