"""One quantity of a result over time, on axes of the user's or of its own."""

from collections.abc import Collection

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure

from psa_casadi.any_model.identify import OdeIdentification
from psa_casadi.any_model.result import OdeDiagnosis
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.errors import InputError
from psa_casadi.identification.identify import Identification
from psa_casadi.posterior.sample import Posterior
from psa_casadi.records.record import Record
from psa_casadi.report.plots.figure import draw_residual, draw_time, style
from psa_casadi.report.plots.posterior_figure import draw_parameter
from psa_casadi.report.words.own_words import own_fit_series, own_series
from psa_casadi.report.words.phrases import handy_scale, in_brackets, prefixed_scale
from psa_casadi.report.words.series import (
    EXTENDED_COLOUR,
    FloatArray,
    Series,
    most_telling,
    series_of,
    series_of_fit,
)
from psa_casadi.simulation.simulate import Trajectory

_INCHES = (9.0, 4.5)

Plotted = (
    Diagnosis | Identification | OdeDiagnosis | OdeIdentification | Trajectory | Posterior | Record
)


def one_output(result: Plotted, axes: Axes | None, output: str | None) -> Figure:
    """Return the figure of the axes on which one quantity of a result was drawn.

    Without an `output` it is the main one. Raises InputError for one that the result does not have.
    """
    if axes is None:
        figure = Figure(figsize=_INCHES, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
    if isinstance(result, Trajectory):
        columns = {"voltage": result.voltage, **result.states, **result.outputs}
        name = _chosen(output, columns, result.shown)
        _curve(axes, result.time, columns[name], name, result.units.get(name, ""))
    elif isinstance(result, Record):
        name = _chosen(output, result.recorded, result.shown)
        _curve(axes, result.time, result.recorded[name], name, result.units[name])
    elif isinstance(result, Posterior):
        by_name = {f.name: f for f in result.figures}
        draw_parameter(axes, result, by_name[_chosen(output, by_name, next(iter(by_name)))])
    else:
        _compared(axes, result, output)
    found: Figure | SubFigure = axes.figure
    return found if isinstance(found, Figure) else found.figure


def _compared(
    axes: Axes,
    result: Diagnosis | Identification | OdeDiagnosis | OdeIdentification,
    output: str | None,
) -> None:
    """Draw what was measured beside the models; "residual" is what these leave."""
    series = _series(result)
    quantities = dict.fromkeys(s.quantity for s in series)
    name = _chosen(output, [*quantities, "residual"], most_telling(series).quantity)
    if name == "residual":
        draw_residual(axes, most_telling(series), "measured")
        return
    shown = most_telling([s for s in series if s.quantity == name])
    draw_time(axes, shown, slice(None), "measured", None)


def _series(
    result: Diagnosis | Identification | OdeDiagnosis | OdeIdentification,
) -> tuple[Series, ...]:
    if isinstance(result, Diagnosis):
        return series_of(result)
    if isinstance(result, Identification):
        return series_of_fit(result)
    return own_series(result) if isinstance(result, OdeDiagnosis) else own_fit_series(result)


def _chosen(output: str | None, there: Collection[str], usual: str) -> str:
    if output is None:
        return usual
    if output not in there:
        raise InputError(f"There is no output '{output}' to plot; there are {', '.join(there)}.")
    return output


def _curve(axes: Axes, time: FloatArray, values: FloatArray, name: str, unit: str) -> None:
    """Draw values in their SI unit over time, in a handy one."""
    size = float(np.nanmax(np.abs(values), initial=0.0))
    scale = handy_scale(size) if unit == "m" else prefixed_scale(size, unit or "1")
    axes.plot(time, scale.factor * values, color=EXTENDED_COLOUR, linewidth=1.2, label=name)
    style(axes, "", "time [s]", in_brackets(name, scale.unit))
