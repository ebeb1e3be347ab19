"""Free functions at the ports of a model: what no effect of the table has to be.

    Q gains sum_k c_k m_k(r)

m_k are the monomials up to the third power of what the port sees (the states and inputs of a rate),
or up to the fifth of a signal. They have no memory and no time.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import casadi as ca
import numpy as np

from psa_casadi.common.errors import PsaError
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis import screening
from psa_casadi.diagnosis.corrections import FreeFunction, estimates
from psa_casadi.diagnosis.formulas import Formula, Place, fitted, formula, place_of
from psa_casadi.diagnosis.generic.attached import Attached, extended
from psa_casadi.diagnosis.pack import Task
from psa_casadi.diagnosis.probes import changes
from psa_casadi.diagnosis.search.hypothesis import Hypothesis, Scale, View
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.own_model import fit_longer_parts, follows
from psa_casadi.identification.result import with_origin
from psa_casadi.model.component import Component, Expression, Symbols
from psa_casadi.model.compose import Model
from psa_casadi.model.ports import is_place, ports_of
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.simulate import record_inputs
from psa_casadi.simulation.sizes import Sizes, sizes_of, states_of

#: Number of ports that are fitted.
_FITTED = 2
#: Largest ratio of the error of a formula to that of the free function that it replaces.
_AS_WELL = 1.1
#: Powers of a variable that what is added is compared with.
_POWERS = 5


def model_of(
    base: Model,
    fit: Fit,
    effects: Sequence[Attached],
    experiments: Sequence[Experiment],
    *,
    interrupted: bool = False,
) -> Model:
    """Return the model of a fit, open at the ports of its effects alone, with how sure it is."""
    model = extended(base, effects)
    values = {n: v for n, v in fit.model.values.items() if n in model.values}
    sure, inputs = determinacy(fit), [e.record for e in experiments]
    return with_origin(
        model.with_values(values), inputs, sure.names, sure.intervals, force_scale="given",
        interrupted=interrupted,
    )  # fmt: skip


def fit_free_functions(
    view: View, task: Task, base: Model, effects: Sequence[Attached], scale: Scale
) -> list[FreeFunction]:
    """Fit the most significant free functions added to a hypothesis; return them, the best first.

    `base` is the model before its ports were opened, `effects` are the hypothesis' causes.
    """
    of, sizes = view.of, _sizes(base, view.of)
    scored: list[tuple[float, Place, Component]] = []
    for port in ports_of(base):
        if port.kind != "intermediate" or is_place(base, port):
            place = place_of(base, port, sizes)
            component = place.component(f"free_in_{port.kind}_{port.variable}", place.polynomial())
            with suppress(PsaError):
                scored.append((_decrease(view, component), place, component))
    scored.sort(key=lambda s: -s[0])
    free_functions = []
    for _, place, component in scored[:_FITTED]:
        task.progress(f"a free function in {place.port.words}")
        with suppress(PsaError):
            free = fitted(of, of.fit, component, place.polynomial())
            if free is not None:
                free_functions.append(_added(free, of, place, base, effects, scale))
    return sorted(free_functions, key=lambda f: -f.evidence)


def formula_of(
    free_function: FreeFunction,
    of: Hypothesis,
    task: Task,
    base: Model,
    effects: Sequence[Attached],
    scale: Scale,
    whole: Sequence[Experiment],
) -> FreeFunction | None:
    """Return the formula in the place of a free function; None where it predicts less.

    Its numbers are those of the `whole` records where the model with it follows these.
    """
    port = next(p for p in ports_of(base) if p.words == free_function.port)
    place = place_of(base, port, _sizes(base, of))
    task.progress(f"a formula in {port.words}")
    result = formula(of, free_function.fitted, place, scale)
    if result is None:
        return None
    rows = zip(result.hypothesis.errors, free_function.held, strict=True)
    if any(error > _AS_WELL * before for error, before in rows):
        return None
    function = _added(result, of, place, base, effects, scale)
    model = function.model
    if len(whole) < len(of.experiments):
        with suppress(PsaError):
            fit = fit_longer_parts(result.hypothesis.fit, whole)
            if follows(fit):
                model = model_of(base, fit, [*effects, Attached(result.component, port)], whole)
    equation = result.equation(port.balance, model.values)
    parameters = estimates(result.component, model)
    return replace(function, model=model, equation=equation, parameters=parameters)


def _added(
    result: Formula, of: Hypothesis, place: Place, base: Model, effects: Sequence[Attached],
    scale: Scale,
) -> FreeFunction:  # fmt: skip
    """Return a fitted function, and what it adds, with the variable that it follows most."""
    h, port, experiments = result.hypothesis, place.port, of.experiments
    s = h.fit.model.structure
    term = result.component.equations(Symbols(s.symbols)).add[port.balance]
    variables = [s.symbols[place.symbols[n]] for n in place.names]
    *rows, added = _along(h.fit, experiments, [*variables, term])
    values = dict(zip(place.names, rows, strict=True))

    def scatter(name: str) -> float:
        """What a polynomial of one variable leaves of what is added (sum of squares)."""
        along = values[name] / max(float(np.max(np.abs(values[name]))), 1e-300)
        powers = np.vander(along, _POWERS + 1)
        rest = added - powers @ np.linalg.lstsq(powers, added, rcond=None)[0]
        return float(rest @ rest)

    name = min(values, key=scatter)
    seen = {n for t in result.terms for n in (*t.factors, t.over)}
    return FreeFunction(
        port=port.words,
        evidence=scale.evidence(h) - scale.evidence(of),
        held=h.errors,
        predicted=h.predictions,
        of=" and ".join(n for n in place.names if n in seen),
        unit=port.unit,
        variable=name,
        variable_unit=place.units[name],
        along=values[name],
        added=added,
        model=model_of(base, h.fit, [*effects, Attached(result.component, port)], experiments),
        fitted=result,
    )


def _along(
    fit: Fit, experiments: Sequence[Experiment], expressions: Sequence[Expression]
) -> FloatArray:
    """Return expressions in a model's symbols along all records (expressions, n)."""
    model, theta, result = fit.model, fit.placed(), []
    s, p = model.structure, model.parameter_vector()
    sums = ca.vertcat(*(s.symbols[n] for n in s.sums)), ca.vertcat(*s.sums.values())
    f = ca.Function("along", s.arguments, [ca.substitute(ca.vertcat(*expressions), *sums)])
    for r, e in enumerate(experiments):
        x = states_of(model, e, fit.unknowns.start(theta, r), fit.way.step_rtol)
        time, u = e.record.time - e.record.time[0], record_inputs(model, e.record, e.record.n)
        result.append(np.array(f.map(len(x))(time, x.T, u.T, np.tile(p[:, None], len(x)))))
    return np.hstack(result)


def _sizes(base: Model, of: Hypothesis) -> Sizes:
    starts = [{n: v for n, v in s.items() if n in base.state_names} for s in of.fit.starts()]
    return sizes_of(base, of.experiments, starts)


def _decrease(view: View, component: Component) -> float:
    """Return the decrease of the whitened sum of squares that the coefficients promise together."""
    fit, colour = view.of.fit, view.screening.colour
    model = fit.model.with_effect(component)
    moved = {p.name: p.typical(fit.model.values) for p in component.parameters}
    starts = tuple(fit.starts())
    columns, further = changes(fit, view.of.experiments, model, moved, starts, 0.0)
    basis = screening.independent(screening.whitened_jacobian(fit, colour))
    free = screening.independent(screening.without(colour.whiten_all(columns, further), basis))
    residual = screening.without(screening.whitened_residuals(fit, colour), basis)
    return float(np.sum((free.T @ residual) ** 2))
