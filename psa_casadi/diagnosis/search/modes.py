"""Several modes at once where one is not enough: read off the residual, then fitted together."""

from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.search.fits import exchanged, to_end
from psa_casadi.diagnosis.search.hypothesis import Hypothesis, hypothesis
from psa_casadi.diagnosis.search.quick_fits import Start, fit_with_all
from psa_casadi.effects.modal_series import FEWEST, MODAL_SERIES, MOST
from psa_casadi.effects.structural_mode import STRUCTURAL_MODE
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.identification.start.linear_response import MOST_DAMPED, Mode, Shaken, modes_of
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment
from psa_casadi.scales import stiffness_scale
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.simulate import record_inputs
from psa_casadi.simulation.start import start_on
from psa_casadi.simulation.ways import accurate

FloatArray = npt.NDArray[np.float64]

#: Samples of all records from which modes are read off; evaluations of the fit.
_ENOUGH, _EVALUATIONS = 20_000, 20
#: To what share of the rms each mode must bring the residual. The seven largest of a mirror's axis
#: do, the next one does not; noise has no mode that does.
_LOWERED = 0.95
#: So many fits of one mode in the place of several go to their end.
_ALONE = 3
_RTOL = 1e-4


def with_modes(before: Hypothesis, experiments: Sequence[Experiment]) -> Hypothesis | None:
    """Fit with a series of modes; None where the residual shows fewer than two, or no fit works.

    Modes that a fit damps until they ring no more are left out: they stand for something else.
    """
    if "wafer_force" not in before.fit.model.structure.balances:
        return None
    even = [k for k, e in enumerate(experiments) if not e.held_out_whole and _even(e.record.time)]
    most = _ENOUGH // max(1, len(even))
    shaken, free = [], []
    for k in even:
        e = experiments[k]
        part = _moving(e, most)
        first, last = (int(e.used[:end].sum()) for end in (part.start, part.stop))
        try:
            drive = _at_rest(before.fit.model, e.record, e.stop)
        except PsaError:
            return None
        left = measured(e.record)[part] - before.predicted[k][part]
        shaken.append(Shaken(drive[part], left, e.used[part], e.record.sample_time))
        free.append(before.fit.jacobian[before.fit.of_record(experiments, k)][first:last])
    modes = modes_of(shaken, np.vstack(free), most=MOST, better=_LOWERED) if shaken else []
    fit, states = before.fit, tuple(before.fit.starts())
    while len(modes) >= FEWEST:
        effect = MODAL_SERIES[len(modes)]
        added = [(effect, _values(modes), 1.0)]
        found = fit_with_all(fit, experiments, added, states, {}, _EVALUATIONS)
        if found is None:
            return None
        ringing = [m for m in _modes(found, len(modes)) if m.damping < MOST_DAMPED]
        if len(ringing) == len(modes):
            return hypothesis((*before.causes, effect), found, experiments)
        base = found.model.without([effect.name])
        modes, states = ringing, tuple(found.starts())
        fit = replace(before.fit, model=base)
    return None


def one_mode(
    series: Hypothesis, less: Hypothesis, experiments: Sequence[Experiment]
) -> list[Hypothesis]:
    """Fit one mode in the place of a series, from each of those, and the best to the end.

    The series is the last cause; `less` is the hypothesis without it. The base begins where the
    series has led it: modes may stand for what the base without them had bent itself to.
    """
    fit = series.fit
    states = tuple(fit.starts())
    starts = [_alone(mode, states) for mode in _modes(fit, series.causes[-1].count)]
    found = side_by_side(
        lambda s: exchanged(series, less, STRUCTURAL_MODE, s, fit, experiments), starts
    )
    best = sorted((h for h in found if h is not None), key=lambda h: h.fit.cost)[:_ALONE]
    return side_by_side(lambda h: to_end(h, experiments), best)


def _alone(mode: Mode, states: tuple[dict[str, float], ...]) -> Start:
    """Return where a single mode begins that stands for one of a series."""
    low, high = next(p.bounds for p in STRUCTURAL_MODE.parameters if p.name == "mode_lead")
    lead = np.clip(mode.ahead / (mode.share or 1e-300), low, high)
    form = {
        "mode_frequency": mode.frequency, "mode_damping": mode.damping, "mode_lead": float(lead)
    }  # fmt: skip
    return form, mode.share, states


def _even(time: FloatArray) -> bool:
    """Whether times (n,) lie on an even grid but for a tenth of a step."""
    grid = np.linspace(time[0], time[-1], time.size)
    return bool(np.max(np.abs(time - grid)) < 0.1 * (time[-1] - time[0]) / (time.size - 1))


def _moving(e: Experiment, most: int) -> slice:
    """Return so many samples at most, from where the voltage begins to move."""
    v = e.record.voltage[: e.stop]
    moves = np.flatnonzero(v != v[0])
    begin = max(0, int(moves[0]) - 1) if moves.size else 0
    return slice(begin, min(e.stop, begin + most))


def _modes(fit: Fit, count: int) -> list[Mode]:
    """Return the modes of a fit."""
    names = ("frequency", "damping", "share", "ahead")
    values = fit.model.values
    return [Mode(*(values[f"series_{name}_{k}"] for name in names)) for k in range(1, count + 1)]


def _values(modes: Sequence[Mode]) -> dict[str, float]:
    return {
        f"series_{name}_{k}": value
        for k, mode in enumerate(modes, 1)
        for name, value in asdict(mode).items()
    }


def _at_rest(model: Model, record: Record, count: int) -> FloatArray:
    """Return the displacement that the wafers' force has at rest [m], at the first samples."""
    t, u = record.time[:count] - record.time[0], record_inputs(model, record, count)
    steps, _ = accurate(model, t, u, start_on(model, t, u).x, rtol=_RTOL, hold="linear")
    values = model.structure.balance("wafer_force").map(count)
    p = np.tile(model.parameter_vector()[:, None], count)
    found: FloatArray = values(t[None], steps.x.T, u.T, p).full().ravel()
    return found / stiffness_scale(model.values)
