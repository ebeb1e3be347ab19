"""The parameters of a model as sets that system tools read (SSV): values, and their uncertainty.

The uncertainty is the mean, pairs of sigma points and random samples. A parameter that spans
decades is spread in its logarithm, as its interval is. With C the covariance in these coordinates
and L L^T = C (Cholesky), a pair of sigma points is the mean plus and minus one column of L: the
variance of anything smooth that a model says is the sum, over the pairs, of the squared half
differences. The samples are the mean plus L z, z standard normal.

Source: SSP 1.0, section 6 (system structure parameter values).
"""

import math
import random
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from xml.etree import ElementTree as ET

import numpy as np
import numpy.typing as npt

from psa_casadi.export.common.markup import base_unit, generation_tool, number, xml_text
from psa_casadi.model.compose import Model
from psa_casadi.units import parse_unit

_VALUES = "http://ssp-standard.org/SSP1/SystemStructureParameterValues"
_COMMON = "http://ssp-standard.org/SSP1/SystemStructureCommon"


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
    ET.register_namespace("ssv", _VALUES)
    ET.register_namespace("ssc", _COMMON)
    attributes = {"version": "1.0", "name": name or model.name, "generationTool": generation_tool()}
    root = ET.Element(f"{{{_VALUES}}}ParameterSet", attributes)
    listed = ET.SubElement(root, f"{{{_VALUES}}}Parameters")
    intervals = model.provenance.intervals
    chosen = model.values if values is None else values
    used: set[str] = set()
    for p in model.structure.parameters:
        if p.name not in chosen:
            continue
        meaning = p.description
        if p.name in intervals and values is None:
            found = intervals[p.name]
            meaning += f"; 95 % interval {found.low:.6g} to {found.high:.6g} {p.unit}"
        _real(listed, p.name, meaning, chosen[p.name], p.unit)
        used.add(p.unit)
    for q in model.structure.states:
        if q.name in (states or {}):
            _real(listed, q.name, f"start of the {q.description}", (states or {})[q.name], q.unit)
            used.add(q.unit)
    _units(root, sorted(used))
    return xml_text(root)


def _real(listed: ET.Element, name: str, meaning: str, value: float, unit: str) -> None:
    attributes = {"name": name, "description": meaning}
    element = ET.SubElement(listed, f"{{{_VALUES}}}Parameter", attributes)
    ET.SubElement(element, f"{{{_VALUES}}}Real", {"value": number(value), "unit": unit})


def _units(root: ET.Element, names: Sequence[str]) -> None:
    units = ET.SubElement(root, f"{{{_VALUES}}}Units") if names else root
    for name in names:
        unit = ET.SubElement(units, f"{{{_COMMON}}}Unit", {"name": name})
        ET.SubElement(unit, f"{{{_COMMON}}}BaseUnit", base_unit(parse_unit(name)))


FloatArray = npt.NDArray[np.float64]
Sets = Mapping[str, Mapping[str, float]]

#: Random samples unless told otherwise, and the most.
SAMPLES, MOST_SAMPLES = 20, 999
#: Draws for one sample until it lies within the bounds; the last one is put on them.
_DRAWS = 200
#: Digits of the values: those below differ from machine to machine.
_DIGITS = 7
_LARGEST = 500.0


def posterior_sets(model: Model, samples: int = SAMPLES) -> Sets:
    """Return sets of the parameters that were found together, by name; values in SI units.

    `mean`, the pairs `sigma_01_plus`, `sigma_01_minus`, ... and `sample_01`, ... as many as asked
    for, all within the bounds. Empty for a model without a covariance. The same model gives the
    same sets.
    """
    names = model.evidence.covariance.names if model.evidence else ()
    if not names:
        return {}
    mean = np.array([model.values[n] for n in names])
    log = np.array([model.parameter(n).log for n in names])
    factor = _factor(model, mean, log)
    found = {"mean": dict(zip(names, mean.tolist(), strict=True))}
    for k, column in enumerate(factor.T, start=1):
        for side, sign in (("plus", 1.0), ("minus", -1.0)):
            moved = _moved(mean, log, sign * column)
            found[f"sigma_{k:02d}_{side}"] = _within(model, names, moved)
    draws = random.Random(len(names))
    for k in range(1, samples + 1):
        found[f"sample_{k:02d}"] = _sample(model, names, mean, log, factor, draws)
    return found


def _factor(model: Model, mean: FloatArray, log: npt.NDArray[np.bool_]) -> FloatArray:
    """Return L with L L^T = C, C positive semidefinite: a direction without spread is 0."""
    evidence = model.evidence
    given = np.array(evidence.covariance.matrix if evidence else (), dtype=float)
    scale = np.where(log, mean, 1.0)
    left = given / np.outer(scale, scale)
    least = 1e-12 * np.diag(left)
    factor = np.zeros_like(left)
    for k in range(len(mean)):
        if left[k, k] > least[k]:
            factor[k:, k] = left[k:, k] / math.sqrt(left[k, k])
            left[k:, k:] -= np.outer(factor[k:, k], factor[k:, k])
    return np.asarray(factor, dtype=float)


def _moved(mean: FloatArray, log: npt.NDArray[np.bool_], by: FloatArray) -> FloatArray:
    factors = np.exp(np.clip(np.where(log, by, 0.0), -_LARGEST, _LARGEST))
    return np.asarray(np.where(log, mean * factors, mean + by), dtype=float)


def _sample(
    model: Model,
    names: Sequence[str],
    mean: FloatArray,
    log: npt.NDArray[np.bool_],
    factor: FloatArray,
    draws: random.Random,
) -> dict[str, float]:
    """Return one sample; the draws that leave the bounds do not count."""
    normal = NormalDist()
    bounds = np.array([model.parameter(n).bounds for n in names])
    for _ in range(_DRAWS):
        z = [normal.inv_cdf(min(max(draws.random(), 1e-16), 1.0 - 1e-16)) for _ in names]
        moved = _moved(mean, log, factor @ np.array(z))
        if np.all((bounds[:, 0] <= moved) & (moved <= bounds[:, 1])):
            break
    return _within(model, names, moved)


def _within(model: Model, names: Sequence[str], values: FloatArray) -> dict[str, float]:
    """Return values with so many digits, put on the bounds where they leave them.

    What has overflowed to no number at all stays at the mean.
    """
    found = {}
    for name, value in zip(names, values.tolist(), strict=True):
        low, high = model.parameter(name).bounds
        digits = model.values[name] if math.isnan(value) else float(f"{value:.{_DIGITS}g}")
        found[name] = min(max(digits, low), high)
    return found
