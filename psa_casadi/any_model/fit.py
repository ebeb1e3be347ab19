"""Prediction-error fit of any model with exact sensitivities, and how sure its values are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from psa_casadi.any_model.predict import STEP_RTOL, coordinates_of, output_of, shown_by
from psa_casadi.any_model.runs import Run, measured_spans
from psa_casadi.errors import InputError, PsaError
from psa_casadi.identification.fitting.levenberg_marquardt import FIRST_RADIUS, Minimum, minimise
from psa_casadi.identification.fitting.unknowns import Unknowns
from psa_casadi.model.compose import Model
from psa_casadi.records.noise import filtered
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.stepper import SimulationError
from psa_casadi.variables import Interval

FloatArray = npt.NDArray[np.float64]

#: How far the start is sought in the first tenth.
_EVALUATIONS, _TOLERANCE = 30, 1e-5


#: Share of an output's range below which no difference between a device and a model is told.
STRAIGHT = 2e-5


@dataclass(frozen=True, eq=False)
class FittedOutput:
    """The fit of one output: the used samples of all experiments that measured it, stacked.

    `residuals` (n,) are measured minus predicted, `jacobian` (n, size) d prediction / d theta,
    both over the experiments' shares of noise (`Run.noise`); `level` weighted them, `straight` is
    the rms below which they tell nothing, all in the output's unit. `lengths` are the samples of
    each of the `runs` that have some; `basis` has no columns.
    """

    column: str
    index: int
    level: float
    straight: float
    residuals: FloatArray
    jacobian: FloatArray
    lengths: tuple[int, ...]
    runs: tuple[int, ...]

    @property
    def basis(self) -> FloatArray:
        """What is projected out beside theta: nothing (n, 0)."""
        return np.zeros((len(self.residuals), 0))

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def parts(self) -> list[FloatArray]:
        """The residuals of each of the `runs`."""
        return np.split(self.residuals, np.cumsum(self.lengths)[:-1])


@dataclass(frozen=True, eq=False, repr=False)
class OdeFit:
    """The result of a fit; `outputs` are those that were measured, the first one foremost.

    `model` carries the estimates, `theta` are the coordinates of `unknowns` (parameters, then per
    experiment the initial states), `cost` is the weighted sum of squares with the priors.
    """

    model: Model
    unknowns: Unknowns
    theta: FloatArray
    outputs: tuple[FittedOutput, ...]
    cost: float
    converged: bool
    interrupted: bool
    evaluations: int
    rtol: float
    zeros: tuple[str, ...] = ()
    known_start: bool = False

    def __repr__(self) -> str:
        """Return what was fitted and what it leaves, in one line."""
        left = ", ".join(f"{o.column} {o.rms:.3g}" for o in self.outputs)
        return f"<Fit of {', '.join(self.unknowns.names)}: residual rms {left}>"

    @property
    def residuals(self) -> FloatArray:
        """Residuals of the first output."""
        return self.outputs[0].residuals

    @property
    def jacobian(self) -> FloatArray:
        """Derivatives of the first output by theta."""
        return self.outputs[0].jacobian

    @property
    def further(self) -> tuple[FittedOutput, ...]:
        """The outputs beside the first."""
        return self.outputs[1:]

    @property
    def levels(self) -> tuple[float, ...]:
        """The noise level that weighted every output."""
        return tuple(o.level for o in self.outputs)

    def starts(self) -> list[dict[str, float]]:
        """Deviations of every experiment's initial state from the declared starts."""
        return [self.unknowns.start(self.theta, r) for r in range(self.unknowns.records)]

    @cached_property
    def places(self) -> tuple[int, ...]:
        """The measured outputs' places among the model's."""
        return tuple(o.index for o in self.outputs)

    def predicted(self, runs: Sequence[Run]) -> list[FloatArray]:
        """Predict whole experiments (n, ny), held-out samples included. Raises PsaError."""
        return side_by_side(
            lambda k: shown_by(
                self.model, runs[k], self.starts()[k], runs[k].signals.n, self.rtol, self.zeros
            ),
            range(len(runs)),
        )


def fit_ode(
    model: Model,
    runs: Sequence[Run],
    free: Sequence[str],
    *,
    levels: Sequence[float],
    starts: Sequence[Mapping[str, float]] | None = None,
    evaluations: int = 60,
    tolerance: float = 1e-6,
    rtol: float = STEP_RTOL,
    zeros: tuple[str, ...] = (),
    known_start: bool = False,
) -> OdeFit:
    """Fit the free parameters and every experiment's initial state to the used samples.

    Minimises sum(((measured - predicted)/(level share))^2) + sum((theta/prior)^2) over all measured
    outputs, each with its level, and experiments, each with its share of the noise (`Run.noise`),
    by Levenberg and Marquardt's method within the parameters' bounds. `starts` are deviations of
    the initial states to begin from; with `known_start` they stay at the declared ones. `zeros` are
    outputs whose zero is unknown in each experiment. Raises SimulationError where the start cannot
    be simulated.
    """
    unknowns = coordinates_of(model, free, runs, zeros, known_start=known_start)
    theta = np.zeros(unknowns.size)
    for r, given in enumerate(starts or ()):
        unknowns.place(theta, r, given, 0.0)
    problem = _Problem(model, tuple(runs), unknowns, tuple(levels), measured_outputs(runs), rtol)
    found = minimise(
        problem.evaluate,
        theta,
        unknowns.bounds(),
        tolerance=tolerance,
        evaluations=evaluations,
        radius=FIRST_RADIUS,
    )
    if found is None:
        raise SimulationError(
            f"The model '{model.name}' cannot be simulated at the start of the fit; start from"
            " other values, or check the units of inputs and states."
        )
    return problem.fit(found, zeros, known_start)


def measured_outputs(runs: Sequence[Run]) -> tuple[int, ...]:
    """Return the outputs that move in what was measured, by their place in the model."""
    return tuple(int(k) for k in np.flatnonzero(measured_spans(runs) > 0))


@dataclass(frozen=True, eq=False)
class _Problem:
    """The objective of one fit."""

    model: Model
    runs: tuple[Run, ...]
    unknowns: Unknowns
    levels: tuple[float, ...]
    places: tuple[int, ...]
    rtol: float

    @cached_property
    def tasks(self) -> list[tuple[int, int]]:
        """Which output of which run, in the order of the stacked residuals."""
        return [(j, k) for j in self.places for k, r in enumerate(self.runs) if r.fitted(j).any()]

    def part(self, theta: FloatArray, j: int, k: int, run: Run) -> tuple[FloatArray, FloatArray]:
        """Return residuals (predicted - measured) and Jacobian of an output of a run, over noise.

        Raises PsaError.
        """
        used = run.fitted(j)
        shown, slopes = output_of(self.model, run, self.unknowns, theta, k, j, self.rtol)
        own, share = used[: run.stop], run.noise[j]
        weight = 1.0 / self.levels[self.places.index(j)]
        residual = (shown[own] - run.outputs[used, j]) / share * weight
        return residual, slopes[own] / share * weight

    def evaluate(self, theta: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        try:
            parts = side_by_side(lambda t: self.part(theta, *t, self.runs[t[1]]), self.tasks)
        except PsaError:
            return None
        rows, slopes = zip(*parts, strict=True)
        prior = 1.0 / self.unknowns.prior
        residual = np.concatenate([*rows, theta * prior])
        jacobian = np.vstack([*slopes, np.diag(prior)])
        with np.errstate(over="ignore", invalid="ignore"):
            finite = np.isfinite(residual @ residual + np.vdot(jacobian, jacobian))
        return (residual, jacobian) if finite else None

    def begun(self, theta: FloatArray) -> FloatArray:
        """Return theta with starts and zeros of held-out experiments, from their first tenth.

        Where a start cannot be simulated it stays as it is.
        """
        found = theta.copy()
        judging = [k for k, r in enumerate(self.runs) if r.held_out_whole]

        def one(k: int) -> FloatArray:
            run, own = self.runs[k].of_beginning(), self.own(k)
            prior = 1.0 / self.unknowns.prior[own]
            outputs = [j for j in self.places if run.fitted(j).any()]

            def evaluate(start: FloatArray) -> tuple[FloatArray, FloatArray] | None:
                there = theta.copy()
                there[own] = start
                try:
                    parts = [self.part(there, j, k, run) for j in outputs]
                except PsaError:
                    return None
                rows = np.concatenate([start * prior, *(r for r, _ in parts)])
                return rows, np.vstack([np.diag(prior), *(d[:, own] for _, d in parts)])

            free = np.full(len(prior), np.inf)
            best = minimise(
                evaluate, theta[own], (-free, free), tolerance=_TOLERANCE, evaluations=_EVALUATIONS
            )
            return theta[own] if best is None else best.theta

        for k, start in zip(judging, side_by_side(one, judging), strict=True):
            found[self.own(k)] = start
        return found

    def own(self, k: int) -> slice:
        """Return the coordinates of a run's start."""
        return slice(self.unknowns.first(k), self.unknowns.first(k + 1))

    def fit(self, found: Minimum, zeros: tuple[str, ...], known_start: bool) -> OdeFit:
        model = self.model.with_values(self.unknowns.values(found.theta))
        spans, outputs, first = measured_spans(self.runs), [], 0
        for j, level in zip(self.places, self.levels, strict=True):
            runs = tuple(k for i, k in self.tasks if i == j)
            lengths = tuple(int(self.runs[k].fitted(j).sum()) for k in runs)
            rows = slice(first, first + sum(lengths))
            first = rows.stop
            outputs.append(
                FittedOutput(
                    column=self.model.output_names[j],
                    index=j,
                    level=level,
                    straight=STRAIGHT * float(spans[j]),
                    residuals=-found.residual[rows] * level,
                    jacobian=found.jacobian[rows] * level,
                    lengths=lengths,
                    runs=runs,
                )
            )
        return OdeFit(
            model=model,
            unknowns=self.unknowns,
            theta=self.begun(found.theta),
            outputs=tuple(outputs),
            cost=found.cost,
            converged=found.converged,
            interrupted=found.interrupted,
            evaluations=found.evaluations,
            rtol=self.rtol,
            zeros=zeros,
            known_start=known_start,
        )


def refitted(
    before: OdeFit,
    runs: Sequence[Run],
    *,
    model: Model | None = None,
    levels: Sequence[float] | None = None,
    evaluations: int = 60,
    tolerance: float = 1e-6,
) -> OdeFit:
    """Go on with a fit from where it stopped, or with another model from its values.

    What another model has of the parameters is free, and its effects' fitted parameters too.
    """
    other = model or before.model
    own = [n for n in before.unknowns.names if n in other.values]
    own += [n for c in other.effects for n in c.fitted if n not in own]
    return fit_ode(
        other, runs, own,
        levels=before.levels if levels is None else levels,
        starts=before.starts(), evaluations=evaluations, tolerance=tolerance, rtol=before.rtol,
        zeros=before.zeros, known_start=before.known_start,
    )  # fmt: skip


def refuse_unfit(model: Model) -> None:
    """Refuse a model without an output, and one with sampled states. Raises InputError."""
    if not model.output_names:
        raise InputError(f"The model '{model.name}' has no output; a fit compares with one.")
    if model.structure.sampled:
        raise InputError(
            f"The model '{model.name}' has sampled states, whose sensitivities are not computed;"
            " leave the sampled component out."
        )


#: A parameter with a larger standard error than this, over its ordinary change, is not determined.
_UNDETERMINED = 0.5
#: Half a 95 % interval over the standard error.
_NORMAL = 1.96
#: Correlations of neighbours below this count as none.
_WHITE = 0.05


@dataclass(frozen=True)
class Certainty:
    """Standard errors and 95 % intervals of the parameters by name, and what is wrong with some.

    The interval of a parameter that spans decades is that of its logarithm; none goes beyond the
    parameter's bounds. `undetermined` are not
    told by the records, `on_bound` sit on a bound of their range.
    """

    errors: dict[str, float]
    intervals: dict[str, Interval]
    undetermined: tuple[str, ...]
    on_bound: tuple[str, ...]


def certainty(fit: OdeFit) -> Certainty:
    """Return how sure a fit's parameters are.

    Cov = (sum_j J_j^T J_j / s_j^2 + prior)^-1 over outputs j, residuals and derivatives whitened by
    the correlation of the residual's neighbours, s_j the rms that is left.
    """
    information = np.diag(1.0 / fit.unknowns.prior**2)
    for output in fit.outputs:
        white = np.column_stack([output.residuals, output.jacobian])
        top = sum(float(p[1:] @ p[:-1]) for p in output.parts)
        r = min(top / max(float(output.residuals @ output.residuals), 1e-300), 0.98)
        if r >= _WHITE:  # the correlation of neighbours within the experiments
            parts = np.split(white, np.cumsum(output.lengths)[:-1])
            white = np.vstack([filtered([1.0, -r], [1.0], part)[1:] for part in parts])
        level = max(float(np.sqrt(np.mean(white[:, 0] ** 2))), 1e-300)
        information = information + white[:, 1:].T @ white[:, 1:] / level**2
    names = fit.unknowns.names
    spread = np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True)))[: len(names)]
    slopes = np.diag(fit.unknowns.slopes(fit.theta))
    errors, intervals, on_bound = {}, {}, []
    for k, name in enumerate(names):
        value, error = fit.model.values[name], float(spread[k] * abs(slopes[k]))
        errors[name] = error
        factor = float(np.exp(min(_NORMAL * spread[k], 300.0)))
        half = _NORMAL * error
        low, high = float(fit.unknowns.low[k]), float(fit.unknowns.high[k])
        least, most = value - half, value + half
        if fit.unknowns.log[k]:
            least, most = value / factor, value * factor
        intervals[name] = Interval(max(least, low), min(most, high))
        edge = 1e-6 * (high - low) if np.isfinite(high - low) else 0.0
        if value <= low + edge or value >= high - edge:
            on_bound.append(name)
    undetermined = [n for n, s in zip(names, spread, strict=True) if s > _UNDETERMINED]
    return Certainty(errors, intervals, tuple(undetermined), tuple(on_bound))
