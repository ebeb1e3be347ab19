"""Lookup tables as formulas: splines that are printed as C, as Modelica, and as text."""

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
import scipy

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import FloatArray
from psa_casadi.model.component import Expression


def table(
    x: Expression,
    points: Sequence[float] | FloatArray,
    values: Any,
    *more: Any,
    kind: str = "cubic",
) -> Expression:
    """Return a value looked up between the points of a table, in one dimension or two.

        voltage = psa.table(charge, [0, 0.2, 0.6, 1], [3.1, 3.5, 3.7, 4.1])
        torque = psa.table(speed, [0, 100, 300], current, [0, 5, 10], values)

    `points` (n,) rise, in the unit of `x`; `values` (n,) are numbers, or expressions such as
    parameters that are fitted. In two dimensions `table(x, points, y, points_of_y, values)` has
    values (n, m). "cubic" is a spline with two continuous derivatives (de Boor, A Practical Guide
    to Splines, 2001; not-a-knot), "linear" straight lines, which kink at the points. Beyond its
    ends a table goes on straight.

    Raises InputError for points that do not rise or do not fit the values, and an unknown kind.
    """
    if kind not in ("cubic", "linear"):
        raise InputError(f"The kind of a table is '{kind}'; it is cubic or linear.")
    if not more:
        return _along(x, points, _column(values), kind)
    y, (second, grid) = values, more
    rows = np.asarray(grid, dtype=object)
    if rows.ndim != 2:
        raise InputError("The values of a table of two variables are a matrix (n, m); give rows.")
    columns = [_along(x, points, _column(column), kind) for column in rows.T]
    return _along(y, second, ca.vertcat(*columns), kind)


def _column(values: Any) -> Expression:
    return values if isinstance(values, ca.SX | ca.MX) else ca.vertcat(*values)


def _along(x: Expression, points: Any, values: Expression, kind: str) -> Expression:
    """Return the spline of values (n,), in which it is linear, at x."""
    at = np.asarray(points, dtype=float)
    if at.ndim != 1 or len(at) < 2 or not np.all(np.diff(at) > 0) or len(at) != values.numel():
        raise InputError(
            f"A table has {at.size} points and {values.numel()} values; give two or more points"
            " that rise, and a value for each."
        )
    every = np.eye(len(at))
    if kind == "cubic":
        spline = scipy.interpolate.CubicSpline(at, every)
        weights, ends = spline.c, spline(at[[0, -1]], 1)
    else:
        slopes = np.diff(every, axis=0) / np.diff(at)[:, None]
        weights, ends = np.stack([slopes, every[:-1]]), slopes[[0, -1]]
    inside = ca.fmin(ca.fmax(x, at[0]), at[-1])
    pieces = []
    for k, begin in enumerate(at[:-1]):
        piece = 0.0
        for row in weights[:, k]:
            piece = piece * (inside - begin) + ca.dot(ca.DM(row), values)
        pieces.append(piece)
    total = pieces[0]
    for begin, piece in zip(at[1:-1], pieces[1:], strict=True):
        total = ca.if_else(inside >= begin, piece, total)
    below, above = (ca.dot(ca.DM(slope), values) for slope in ends)
    return total + below * ca.fmin(x - at[0], 0.0) + above * ca.fmax(x - at[-1], 0.0)
