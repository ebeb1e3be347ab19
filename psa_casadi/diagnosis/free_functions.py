"""Free functions and formulas at the ports of a model: what no effect of the table has to be.

    Q gains sum_k c_k m_k(x, u)

The terms m_k of a free function are the monomials up to the third power of what the port sees (the
states and inputs of a rate), or up to the fifth of a signal. They have no memory and no time.

Those of a formula are the few of a library that explain what a free function does: products of up
to three of what the port sees, q |q|, sines and cosines of angles, and products over 1 + h |r|, r
one of their factors. Which set of up to three terms explains most is chosen from all of them (best
subset selection: Miller, Subset Selection in Regression, 2002), by what each term changes of the
outputs along the model's course; the set is fitted in full, and chosen again along the new course
until it stays.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations, combinations_with_replacement
from math import prod

import casadi as ca
import numpy as np

from psa_casadi.common.errors import PsaError
from psa_casadi.common.units import FloatArray, per
from psa_casadi.diagnosis import screening
from psa_casadi.diagnosis.corrections import FreeFunction, estimates
from psa_casadi.diagnosis.generic import LARGEST, ORDINARY, Attached, extended, size_at
from psa_casadi.diagnosis.pack import Task
from psa_casadi.diagnosis.probes import changes, tangents
from psa_casadi.diagnosis.search.hypothesis import Hypothesis, Scale, View, hypothesis
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.own_model import fit_longer_parts, follows
from psa_casadi.identification.refitting import refit
from psa_casadi.identification.result import with_origin
from psa_casadi.model.component import Component, Equations, Expression, Symbols
from psa_casadi.model.compose import Model
from psa_casadi.model.ports import Port, is_place, ports_of, true_sum, unit_of, variables_at
from psa_casadi.model.variables import Parameter
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.simulate import record_inputs
from psa_casadi.simulation.sizes import Sizes, sizes_of, states_of

#: Factors of a product, terms of a formula, variables that it may have.
_FACTORS, _TERMS, _VARIABLES = 3, 3, 4
#: The highest power of a signal in a free function, and the variables of others.
_OF_SIGNAL, _OF_STATES = 5, 3
#: What h |r| is at the largest r, as it is looked for.
_STEEP = (0.3, 1.0, 3.0)
#: A column of which the fitted parameters leave no more than this share adds nothing new.
_LEFT = 1e-3
#: Courses along which terms are chosen, evaluations of every fit.
_ROUNDS, _EVALUATIONS = 3, 25


@dataclass(frozen=True)
class Term:
    """One term of a formula: a product of factors, its `form`, and what its denominator is of.

    The form is "", "abs" (q |q|), "sin", "cos", or "less": what q loses by the denominator.
    """

    factors: tuple[str, ...]
    form: str = ""
    over: str = ""

    def of(self, values: Mapping[str, Expression], h: Expression = 0.0) -> Expression:
        """Return the term of its variables' values, and h."""
        product = prod((values[n] for n in self.factors), start=1.0)
        if self.form == "abs":
            return product * ca.fabs(product)
        if self.over:
            divided = 1.0 / (1.0 + h * ca.fabs(values[self.over]))
            return product * (divided - 1.0 if self.form else divided)
        return getattr(ca, self.form)(product) if self.form else product

    @property
    def whole(self) -> bool:
        """Whether its factor is 1: h alone determines its size."""
        return self.form == "less"

    @property
    def parameters(self) -> int:
        """How many parameters are fitted."""
        return (not self.whole) + bool(self.over)

    @property
    def text(self) -> str:
        """The term as an equation has it."""
        product = " ".join(self.factors)
        if self.form == "abs":
            return f"{product} |{product}|"
        if self.over:
            under = f"(1 + h |{self.over}|)"
            return f"{product} (1/{under} - 1)" if self.form else f"{product}/{under}"
        return f"{self.form}({product})" if self.form else product


@dataclass(frozen=True)
class Place:
    """A port, its variables `names`, and the symbols, sizes and units of what a term may have.

    Those are the variables and, at an intermediate, the value of its equation.
    """

    port: Port
    names: tuple[str, ...]
    symbols: dict[str, str]
    sizes: dict[str, float]
    units: dict[str, str]
    size: float

    @property
    def name(self) -> str:
        """Name of a component that adds a formula."""
        return f"law_in_{self.port.kind}_{self.port.variable}"

    def polynomial(self) -> list[Term]:
        """Return the terms of a free function; of a signal without the linear one, its gain."""
        powers = range(2, _OF_SIGNAL + 1) if self.of_signal else range(1, _FACTORS + 1)
        few = self.names[:_OF_STATES]
        return [Term(t) for p in powers for t in combinations_with_replacement(few, p)]

    @property
    def of_signal(self) -> bool:
        """Whether it is an input or an output, whose value is the only variable."""
        return self.port.kind in ("input", "output")

    def library(self) -> Iterator[Term]:
        """Return every term that is tried; those of a signal's gain are no formula."""
        for count in range(2 if self.of_signal else 0, _FACTORS + 1):
            for factors in combinations_with_replacement(self.names, count):
                yield Term(factors)
                if 0 < count < _FACTORS:
                    yield from (Term(factors, over=n) for n in dict.fromkeys(factors))
        for n in self.names:
            yield Term((n,), "abs")
            if self.units[n] == "rad":
                yield from (Term((n,), form) for form in ("sin", "cos"))
            if self.port.kind == "intermediate":
                yield Term((self.port.variable,), "less", n)

    def component(self, name: str, terms: Sequence[Term], steep: Sequence[float] = ()) -> Component:
        """Return the component that adds terms, of which those with a denominator have these h."""
        parameters = []
        for k, (term, h) in enumerate(zip(terms, steep or [0.0] * len(terms), strict=True), 1):
            power = term.factors * (2 if term.form == "abs" else 1)
            power = () if term.form in ("sin", "cos") else power
            size = self.size / prod(self.sizes[n] for n in power)
            unit = per(self.port.unit, [self.units[n] for n in power])
            parameters.append(Parameter(
                f"{name}_c{k}", 0.0, unit, (-LARGEST * size, LARGEST * size),
                f"factor of {term.text}", scale=ORDINARY * size, fitted=not term.whole,
            ))  # fmt: skip
            if term.over:
                whole, unit = 1.0 / self.sizes[term.over], per("1", [self.units[term.over]])
                parameters.append(Parameter(
                    f"{name}_h{k}", h, unit, (0.01 * whole, 100.0 * whole),
                    f"h of {term.text}", log=True,
                ))  # fmt: skip

        def equations(s: Symbols) -> Equations:
            values = {n: getattr(s, symbol) for n, symbol in self.symbols.items()}
            total = sum(
                getattr(s, f"{name}_c{k}")
                * t.of(values, getattr(s, f"{name}_h{k}") if t.over else 0)
                for k, t in enumerate(terms, 1)
            )
            return Equations(add={self.port.balance: total})

        return Component(
            name=name,
            description=f"{self.port.words}: {' and '.join(t.text for t in terms)}",
            source="the few terms of a library that explain most",
            equations=equations,
            parameters=tuple(parameters),
            gain=f"{name}_c1",
        )


def place_of(model: Model, port: Port, sizes: Sizes) -> Place:
    """Return a port with what a formula at it may be of."""
    names = variables_at(model, port)[:_VARIABLES]
    itself = (port.variable,) if port.kind in ("output", "intermediate") else ()
    every = (*names, *itself)
    symbols = {n: true_sum(n) if n in itself else n for n in every}
    units = {n: port.unit if n in itself else unit_of(model, n) for n in every}
    magnitudes = {n: sizes.signals[n] for n in every}
    return Place(port, names, symbols, magnitudes, units, size_at(port, sizes))


#: A term, the h in it, and its factor.
_Choice = tuple[Term, float, float]


@dataclass(frozen=True, eq=False)
class Formula:
    """A hypothesis whose last component adds a sum of terms."""

    hypothesis: Hypothesis
    component: Component
    terms: tuple[Term, ...]

    def choices(self, values: Mapping[str, float]) -> list[_Choice]:
        """Return its terms, with the numbers in them at these values."""
        name = self.component.name
        return [
            (t, values[f"{name}_h{k}"] if t.over else 0.0, values[f"{name}_c{k}"])
            for k, t in enumerate(self.terms, 1)
        ]

    def equation(self, sums: str, values: Mapping[str, float]) -> str:
        """Return what a port's sum gains, with numbers in SI units."""
        gains, divided = [], []
        for term, h, factor in self.choices(values):
            if term.whole:
                divided.append(f"{sums} is divided by 1 + {h:.4g} |{term.over}|")
            else:
                gains.append(f"{factor:.4g} {term.text}".replace("h |", f"{h:.4g} |").strip())
        gained = [f"{sums} gains {' + '.join(gains)}".replace("+ -", "- ")] if gains else []
        return " and ".join((*divided, *gained))

    @property
    def parameters(self) -> int:
        """How many parameters it has."""
        return sum(t.parameters for t in self.terms)


def fitted(
    of: Hypothesis, begin: Fit, component: Component, terms: Sequence[Term],
    start: Mapping[str, float] | None = None,
) -> Formula | None:  # fmt: skip
    """Return a sum of terms added to a hypothesis, all free, from the values of a fit.

    Raises PsaError.
    """
    values = begin.model.values
    kept = {n: v for n, v in values.items() if n in of.fit.model.values}
    model = of.fit.model.with_values(kept).with_effect(component, start)
    fit = refit(
        replace(begin, model=model), [*of.fit.unknowns.names, *component.fitted],
        others=of.experiments, sigma=of.fit.sigma, evaluations=_EVALUATIONS, tolerance=1e-4,
    )  # fmt: skip
    result = hypothesis((*of.causes, component), fit)
    return None if result is None else Formula(result, component, tuple(terms))


def formula(of: Hypothesis, free: Formula, place: Place, scale: Scale) -> Formula | None:
    """Return the formula that explains most added to a hypothesis, less its price; None of none.

    It is looked for first along the course of the model with a free function there, which is near
    the truth's.
    """
    formulas: list[Formula] = []
    tried, now, price = set[frozenset[Term]](), free, scale.limits.price

    def score(f: Formula) -> float:
        return scale.evidence(f.hypothesis) - price * f.parameters

    for _ in range(_ROUNDS):
        with suppress(PsaError):
            for chosen in _chosen(now, place, price):
                terms = tuple(t for t, _, _ in chosen)
                if frozenset(terms) not in tried:
                    tried.add(frozenset(terms))
                    formulas += _both(of, now.hypothesis.fit, place, chosen)
        if not formulas or (best := max(formulas, key=score)) is now:
            break
        now = best
    return max(formulas, key=score, default=None)


def _both(of: Hypothesis, begin: Fit, place: Place, chosen: Sequence[_Choice]) -> list[Formula]:
    """Return a set of terms, fitted from what it promises; from nothing where that fails."""
    terms = tuple(t for t, _, _ in chosen)
    if any(t.whole and c <= 0.0 for t, _, c in chosen):
        return []
    component = place.component(place.name, terms, [h for _, h, _ in chosen])
    bounds = {p.name: p.bounds for p in component.parameters}
    promised, nothing = dict[str, float](), dict[str, float]()
    for k, (t, h, c) in enumerate(chosen, 1):
        promised[f"{place.name}_c{k}"] = 1.0 if t.whole else c
        if t.whole:
            promised[f"{place.name}_h{k}"], nothing[f"{place.name}_c{k}"] = c * h, 1.0
    promised = {n: float(np.clip(v, *bounds[n])) for n, v in promised.items()}
    for start in (promised, nothing):
        with suppress(PsaError):
            result = fitted(of, begin, component, terms, start)
            return [] if result is None else [result]
    return []


def _chosen(now: Formula, place: Place, price: float) -> list[list[_Choice]]:
    """Return of every size the set of terms that explains most along the course of a model."""
    fit, added = now.hypothesis.fit, {*now.component.fitted}
    known = {(t, h): c for t, h, c in now.choices(fit.model.values)}
    library = [t for t in place.library() if not t.over]
    ratios = [t for t in place.library() if t.over]
    steep = [(t, h / place.sizes[t.over]) for t in ratios for h in _STEEP]
    trials = [*dict.fromkeys([*((t, 0.0) for t in library), *steep, *known])]
    effects = [place.component(f"trial{k}", [t], [h]) for k, (t, h) in enumerate(trials)]
    columns = tangents(fit, effects)
    at = [k for k, e in enumerate(effects) if e.name in columns]
    sizes = np.array([effects[k].parameters[0].typical(fit.model.values) for k in at])
    colour = now.hypothesis.colour
    every = zip(*(columns[effects[k].name] for k in at), strict=True)
    white = colour.whiten_all([np.column_stack(part) for part in every])
    factors = np.array([known.get(trials[k], 0.0) for k in at])
    target = screening.whitened_residuals(fit, colour) + white @ (factors / sizes)
    kept = [n not in added for n in fit.unknowns.names]
    kept += [True] * (fit.unknowns.size - len(kept))
    basis = screening.independent(screening.whitened_jacobian(fit, colour)[:, kept])
    left, target = screening.without(white, basis), screening.without(target, basis)
    new = np.linalg.norm(left, axis=0) > _LEFT * np.linalg.norm(white, axis=0)
    significant = [trials[k] for k, q in zip(at, new, strict=True) if q]
    left, sizes = left[:, new], sizes[new]
    return [
        [(*significant[k], float(c * sizes[k])) for k, c in zip(rows, gains, strict=True)]
        for rows, gains in _best_subsets(left, target, [t for t, _ in significant], price)
    ]


def _best_subsets(
    columns: FloatArray, target: FloatArray, terms: Sequence[Term], price: float
) -> list[tuple[list[int], FloatArray]]:
    """Return of every size which columns explain a target best, and their factors.

    n/2 ln(S_0/S) - (price + ln K) parameters, S of n samples, K columns; those above 0.
    """
    norms = np.linalg.norm(columns, axis=0)
    unit, n, total = columns / norms, len(target), float(target @ target)
    gram, along = unit.T @ unit + 1e-9 * np.eye(len(norms)), unit.T @ target
    costs = (price + np.log(len(norms))) * np.array([t.parameters for t in terms])
    subsets = []
    for count in range(1, min(_TERMS, len(norms)) + 1):
        sets = np.array([*combinations(range(len(norms)), count)])
        g, b = gram[sets[:, :, None], sets[:, None, :]], along[sets]
        gains = np.linalg.solve(g, b[:, :, None])[:, :, 0]
        left = np.maximum(total - np.sum(gains * b, axis=1), 1e-12 * total)
        scores = 0.5 * n * np.log(total / left) - costs[sets].sum(axis=1)
        scores[[len({terms[j] for j in one}) < count for one in sets]] = -np.inf
        k = int(np.argmax(scores))
        if scores[k] > 0.0:
            subsets.append((sets[k].tolist(), gains[k] / norms[sets[k]]))
    return subsets


#: Number of ports that are fitted.
_FITTED = 2
#: Largest ratio of the error of a formula to that of the free function that it replaces.
_AS_WELL = 1.1
#: Powers of a variable that what is added is compared with.
_POWERS = 5


def model_of(
    base: Model, fit: Fit, effects: Sequence[Attached], *, interrupted: bool = False
) -> Model:
    """Return the model of a fit, open at the ports of its effects alone, with how sure it is."""
    model = extended(base, effects)
    values = {n: v for n, v in fit.model.values.items() if n in model.values}
    sure, inputs = determinacy(fit), [e.record for e in fit.experiments]
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
                model = model_of(base, fit, [*effects, Attached(result.component, port)])
    equation = result.equation(port.balance, model.values)
    parameters = estimates(result.component, model)
    return replace(function, model=model, equation=equation, parameters=parameters)


def _added(
    result: Formula, of: Hypothesis, place: Place, base: Model, effects: Sequence[Attached],
    scale: Scale,
) -> FreeFunction:  # fmt: skip
    """Return a fitted function, and what it adds, with the variable that it follows most."""
    h, port = result.hypothesis, place.port
    s = h.fit.model.structure
    term = result.component.equations(Symbols(s.symbols)).add[port.balance]
    variables = [s.symbols[place.symbols[n]] for n in place.names]
    *rows, added = _along(h.fit, [*variables, term])
    values = dict(zip(place.names, rows, strict=True))

    def scatter(name: str) -> float:
        """What a polynomial of one variable leaves of what is added (sum of squares)."""
        along = values[name] / max(float(np.max(np.abs(values[name]))), 1e-300)
        powers = np.vander(along, _POWERS + 1)
        rest = added - powers @ np.linalg.lstsq(powers, added, rcond=None)[0]
        return float(rest @ rest)

    name = min(values, key=scatter)
    used = {n for t in result.terms for n in (*t.factors, t.over)}
    return FreeFunction(
        port=port.words,
        evidence=scale.evidence(h) - scale.evidence(of),
        held=h.errors,
        predicted=h.predictions,
        of=" and ".join(n for n in place.names if n in used),
        unit=port.unit,
        variable=name,
        variable_unit=place.units[name],
        along=values[name],
        added=added,
        model=model_of(base, h.fit, [*effects, Attached(result.component, port)]),
        fitted=result,
    )


def _along(fit: Fit, expressions: Sequence[Expression]) -> FloatArray:
    """Return expressions in a model's symbols along all records (expressions, n)."""
    model, theta, result = fit.model, fit.placed(), []
    s, p = model.structure, model.parameter_vector()
    sums = ca.vertcat(*(s.symbols[n] for n in s.sums)), ca.vertcat(*s.sums.values())
    f = ca.Function("along", s.arguments, [ca.substitute(ca.vertcat(*expressions), *sums)])
    for r, e in enumerate(fit.experiments):
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
    columns, _ = changes(fit, model, moved, starts, 0.0)
    basis = screening.independent(screening.whitened_jacobian(fit, colour))
    free = screening.independent(screening.without(colour.whiten_all(columns), basis))
    residual = screening.without(screening.whitened_residuals(fit, colour), basis)
    return float(np.sum((free.T @ residual) ** 2))
