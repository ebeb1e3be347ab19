"""The parameters of a model as sets that system tools read (SSV): values, and their uncertainty.

The uncertainty is the mean, pairs of sigma points and random samples. A parameter that spans
decades is spread in its logarithm, as its interval is. With C the covariance in these coordinates
and L L^T = C (Cholesky), a pair of sigma points is the mean plus and minus one column of L: the
variance of any smooth result of a model is the sum, over the pairs, of the squared half
differences. The samples are the mean plus L z, z standard normal.

Source: SSP 1.0, section 6 (system structure parameter values).
"""

import math
import random
from collections.abc import Mapping, Sequence
from statistics import NormalDist

import numpy as np

from psa_casadi.common.units import FloatArray, parse_unit
from psa_casadi.export.common.markup import base_unit, generation_tool, number, xml_text
from psa_casadi.model.compose import Model

#: Name, meaning, value and unit of a parameter.
Row = tuple[str, str, float, str]


def parameter_set(
    model: Model,
    values: Mapping[str, float] | None = None,
    *,
    name: str | None = None,
    states: Mapping[str, float] | None = None,
) -> str:
    """Return the values of all parameters in SI units, with their 95 % intervals where known.

    With `values`, those of these parameters only, which stand in the set of that `name`. `states`
    are start values of states to add.
    """
    starts = states or {}
    rows = [
        (q.name, f"start of the {q.description}", starts[q.name], q.unit)
        for q in model.structure.states
        if q.name in starts
    ]
    return set_text(name or model.name, [*parameter_rows(model, values), *rows])


def parameter_rows(model: Model, values: Mapping[str, float] | None = None) -> list[Row]:
    """Return all parameters, with their 95 % intervals where known, or those with `values`."""
    intervals = model.provenance.intervals if values is None else {}
    chosen, rows = model.values if values is None else values, []
    for p in (p for p in model.structure.parameters if p.name in chosen):
        result, meaning = intervals.get(p.name), p.description
        if result:
            meaning += f"; 95 % interval {result.low:.6g} to {result.high:.6g} {p.unit}"
        rows.append((p.name, meaning, chosen[p.name], p.unit))
    return rows


def set_text(name: str, rows: Sequence[Row], kinds: Mapping[str, str] | None = None) -> str:
    """Return a parameter set (SSV), with the definitions of its units; a row may have none, "".

    `kinds` are the types of parameters of an FMU that are no real numbers.
    """
    words = {"Boolean": ("false", "true")}

    def typed(title: str, value: float) -> tuple[str, str]:
        """Return the element of SSV, and the value as it has it."""
        kind = (kinds or {}).get(title)
        if kind is None:
            return "Real", number(value)
        element = kind if kind in words else "Integer"
        return element, words[kind][round(value)] if kind in words else str(round(value))

    return xml_text(
        "parameters.xml",
        name=name,
        tool=generation_tool(),
        rows=[(n, meaning, *typed(n, value), unit or None) for n, meaning, value, unit in rows],
        units={u: base_unit(parse_unit(u)) for u in sorted({unit for *_, unit in rows if unit})},
    )


Sets = Mapping[str, Mapping[str, float]]

#: Random samples by default, and the most.
SAMPLES, MOST_SAMPLES = 20, 999
#: Draws for one sample until it lies within the bounds; the last one is put on them.
_DRAWS = 200
#: Digits of the values: those below differ from machine to machine.
_DIGITS = 7
_LARGEST = 500.0


def posterior_sets(model: Model, samples: int = SAMPLES) -> Sets:
    """Return sets of the parameters that have a covariance, by name; values in SI units.

    `mean`, the pairs `sigma_01_plus`, `sigma_01_minus`, ... and `sample_01`, ... up to the
    number of samples, all within the bounds. Empty for a model without a covariance. The same model
    gives the same sets.
    """
    covariance = model.evidence.covariance if model.evidence else None
    if covariance is None or not covariance.names:
        return {}
    names = covariance.names
    mean = np.array([model.values[n] for n in names])
    log = np.array([model.parameter(n).log for n in names])
    low, high = np.array([model.parameter(n).bounds for n in names]).T
    scale = np.where(log, mean, 1.0)
    factor = _factor(np.array(covariance.matrix) / np.outer(scale, scale))

    def moved(by: FloatArray) -> FloatArray:
        factors = np.exp(np.clip(np.where(log, by, 0.0), -_LARGEST, _LARGEST))
        return np.asarray(np.where(log, mean * factors, mean + by), dtype=float)

    def within(values: FloatArray) -> dict[str, float]:
        """Return values of `_DIGITS` digits within the bounds; nan (an overflow) is the mean."""
        digits = [float(f"{v:.{_DIGITS}g}") for v in values.tolist()]
        kept = np.clip(np.where(np.isnan(digits), mean, digits), low, high)
        return dict(zip(names, kept.tolist(), strict=True))

    table = {"mean": dict(zip(names, mean.tolist(), strict=True))}
    for k, column in enumerate(factor.T, start=1):
        table[f"sigma_{k:02d}_plus"] = within(moved(column))
        table[f"sigma_{k:02d}_minus"] = within(moved(-column))
    normal, draws = NormalDist(), random.Random(len(names))
    for k in range(1, samples + 1):
        for _ in range(_DRAWS):
            z = [normal.inv_cdf(min(max(draws.random(), 1e-16), 1.0 - 1e-16)) for _ in names]
            drawn = moved(factor @ np.array(z))
            if np.all((low <= drawn) & (drawn <= high)):
                break
        table[f"sample_{k:02d}"] = within(drawn)
    return table


def _factor(covariance: FloatArray) -> FloatArray:
    """Return L with L L^T = C, C positive semidefinite: a direction without spread is 0."""
    left = covariance.copy()
    least = 1e-12 * np.diag(covariance)
    factor = np.zeros_like(left)
    for k in range(len(left)):
        if left[k, k] > least[k]:
            factor[k:, k] = left[k:, k] / math.sqrt(left[k, k])
            left[k:, k:] -= np.outer(factor[k:, k], factor[k:, k])
    return factor
