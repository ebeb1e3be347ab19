"""What an unnamed correction adds to the prediction, over what it depends on."""

import numpy as np
import plotly.graph_objects as go

from psa_casadi.any_model.result import FreeFunction
from psa_casadi.diagnosis.patch import Patch
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.report.plots.theme import Plot, styled
from psa_casadi.report.words.phrases import in_brackets, length_scale, prefixed_scale
from psa_casadi.report.words.series import EXTENDED_COLOUR, FloatArray, compact

#: Samples that are drawn, and the height.
_SAMPLES, _HEIGHT = 3000, 320


def patch_plot(d: Diagnosis, patch: Patch) -> tuple[str, Plot]:
    """Return the coordinate's name and the plot for the record to which most is added."""
    k = max(range(len(patch.added)), key=lambda i: float(np.std(patch.added[i])))
    e, added = d.experiments[k], patch.added[k] - np.mean(patch.added[k])
    counts = e.record.displacement_unit == "counts"
    scale = length_scale(float(np.max(np.abs(added), initial=1e-12)), counts=counts)
    x, name, unit = _coordinate(d, patch, k)
    step = max(1, len(x) // _SAMPLES)
    loop = patch.kind in ("curve", "direction", "memory")
    plot = go.Figure()
    plot.add_scatter(
        x=compact(x[::step]), y=compact(scale.factor * added[::step]),
        mode="markers" if loop else "lines", showlegend=False,
        marker={"color": EXTENDED_COLOUR, "size": 3},
        line={"color": EXTENDED_COLOUR, "width": 1.5},
    )  # fmt: skip
    styled(plot, _HEIGHT)
    plot.update_xaxes(title_text=f"{name} [{unit}]")
    plot.update_yaxes(title_text=f"added [{scale.unit}]")
    return name, plot


def free_plot(f: FreeFunction) -> Plot:
    """Plot what a free function of a model's port adds, over the variable that it follows most."""
    step = max(1, len(f.along) // _SAMPLES)
    x, y = f.along[::step], f.added[::step]
    seen = prefixed_scale(float(np.max(np.abs(x), initial=0.0)), f.variable_unit or "1")
    scale = prefixed_scale(float(np.max(np.abs(y), initial=0.0)), f.unit)
    plot = go.Figure()
    plot.add_scatter(
        x=compact(seen.factor * x), y=compact(scale.factor * y), mode="markers", showlegend=False,
        marker={"color": EXTENDED_COLOUR, "size": 3},
    )  # fmt: skip
    styled(plot, _HEIGHT)
    plot.update_xaxes(title_text=in_brackets(f.variable, seen.unit))
    return plot.update_yaxes(title_text=in_brackets("added", scale.unit))


def _coordinate(d: Diagnosis, patch: Patch, k: int) -> tuple[FloatArray, str, str]:
    record = d.experiments[k].record
    if patch.kind == "curve" and patch.port != "drive voltage":
        size = 1.0 if record.displacement_unit == "counts" else 1e6
        unit = "counts" if size == 1.0 else "µm"
        return size * d.extended[k], "predicted displacement", unit
    if patch.kind in ("curve", "direction", "memory"):
        return record.voltage, "voltage", "V"
    return record.time - record.time[0], "time", "s"
