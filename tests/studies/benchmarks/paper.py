"""The paper's identification beside the prediction-error fit, against noise and window.

The records are steps of the independent reference. As the paper assumes, nothing but eq. (13) is in
them: no hysteresis, and a drive a thousand times faster than the stack. White noise is added as a
share of the step; windows count in slowest time constants.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from psa_casadi import reference
from psa_casadi.components import BASE
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.identification.paper import (
    COEFFICIENTS,
    find_loops,
    find_steps,
    hysteresis_part,
    moment_coefficients,
)
from psa_casadi.identification.refitting import noise_levels
from psa_casadi.model.compose import compose
from psa_casadi.model.stacks import STACKS
from psa_casadi.records import Record
from psa_casadi.records.split import whole
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table
from tests.identification.paper_cases import coefficients_of_values
from tests.studies.benchmarks.records import loop_voltage, response, slowest, with_noise
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

FloatArray = npt.NDArray[np.float64]

STACK_NAMES = ("PTBS200", "WYDS0808020", "P-885.51")
NOISES, WINDOW, SEEDS = (0.0, 1e-5, 1e-4, 1e-3), 40.0, 3
WINDOWS, WINDOW_NOISES = (4.0, 8.0, 20.0), (0.0, 1e-4)
METHODS = ("paper", "prediction error")
#: What is searched, and starts of the search: factors on the true values.
_FREE = ("k_L", "tau", "c_P", "c_B", "m_P", "m_B", "k_P")
_FAR = (
    (1.3, 1.3, 1.3, 1.3, 1.3, 1.3, 1.3),
    (0.7, 0.7, 0.7, 0.7, 0.7, 0.7, 0.7),
    (1.3, 0.7, 1.3, 0.7, 1.3, 0.7, 1.3),
    (1.3, 0.7, 0.7, 1.3, 1.3, 0.7, 1.3),
)
_SHORT, _LONG, _SHORT_RTOL = 15, 80, 1e-4
#: No hysteresis; R_s C_p = 13 ns.
_LINEAR = {"A": 0.0, "beta": 0.0, "gamma": 0.0, "delta": 0.0, "R_s": 8e-3}
_SAMPLES, _RTOL, _JUMP = 5000, 1e-13, 1e-10
#: Errors below this are drawn at it, and the noise 0 is drawn here.
_FLOOR, _NO_NOISE = 1e-6, 1e-6
_COLOURS = {"paper": "#c0392b", "prediction error": "#1f6fb4"}


@dataclass(frozen=True, eq=False)
class Case:
    """Median relative errors (6,) of a_1..a_5, b_1 for one stack, window, noise, method."""

    stack: str
    window: float
    noise: float
    method: str
    errors: FloatArray


def run(progress: Progress, quick: bool) -> Outcome:
    """Measure the errors of both methods; `quick` takes one window, two noise levels, one seed."""
    noises, seeds = ((0.0, 1e-4), 1) if quick else (NOISES, SEEDS)
    by_noise, by_window = [], []
    for name in STACK_NAMES:
        by_noise += _cases(name, WINDOW, noises, seeds, progress)
        for window in () if quick else WINDOWS:
            by_window += _cases(name, window, WINDOW_NOISES, 1, progress)
    progress("loops of P-885.51")
    tables = [
        TitledTable(
            f"Relative error of the coefficients of eq. (15), step of {WINDOW:g} slowest time"
            " constants, against noise",
            _table(by_noise),
            _NOTE.format(seeds),
        )
    ]
    if by_window:
        tables.append(TitledTable("The same against the window", _table(by_window), _WINDOW_NOTE))
    tables.append(TitledTable("The paper's loop, P-885.51", _loops(), _LOOP_NOTE))
    return Outcome(tuple(tables), partial(_picture, by_noise))


def step_record(values: Mapping[str, float], window: float) -> Record:
    """Return the reference's response to a jump to u_rated at time 0, held for so many of T."""
    time = np.linspace(0.0, window * slowest(values), _SAMPLES)
    top = values["u_rated"]
    x = reference.simulate(values, lambda _: top, time, rtol=_RTOL).displacement
    voltage = np.concatenate([[0.0], np.full(_SAMPLES, top)])
    instants = np.concatenate([[0.0], time + _JUMP])
    return Record(
        name="step", time=instants, voltage=voltage, displacement=np.concatenate([[0.0], x])
    )


def by_moments(record: Record) -> FloatArray:
    """Return a_1..a_5, b_1, shape (6,), as the paper finds them."""
    step = find_steps([record])[0]
    return moment_coefficients(step.time, step.g)


def by_fit(record: Record, values: Mapping[str, float]) -> FloatArray:
    """Return a_1..a_5, b_1, shape (6,), of a fit that starts 30 % from `values`.

    The best of four short fits is followed to the end.
    """
    experiments = [whole(record)]
    sigma = noise_levels(experiments)
    fits = []
    for factors in _FAR:
        start = {n: f * values[n] for n, f in zip(_FREE, factors, strict=True)}
        model = compose(BASE, {**values, **start})
        fits.append(
            fit(model, experiments, _FREE, sigma=sigma, evaluations=_SHORT, rtol=_SHORT_RTOL)
        )
    best = min(fits, key=lambda f: f.cost)
    states = [best.start(0)]
    last = fit(best.model, experiments, _FREE, sigma=sigma, start_states=states, evaluations=_LONG)
    return coefficients_of_values(last.model.values)


def _values(name: str, changes: Mapping[str, float]) -> dict[str, float]:
    return {key: figure.value for key, figure in STACKS[name].values.items()} | dict(changes)


def _cases(
    name: str, window: float, noises: Sequence[float], seeds: int, progress: Progress
) -> list[Case]:
    values = _values(name, _LINEAR)
    truth, clean = coefficients_of_values(values), step_record(values, window)
    cases = []
    for noise in noises:
        progress(f"{name}: window {window:g}, noise {noise:g}")
        found: dict[str, list[FloatArray]] = {method: [] for method in METHODS}
        for seed in range(seeds if noise else 1):
            record = _noisy(clean, noise, seed)
            found["paper"].append(by_moments(record))
            found["prediction error"].append(by_fit(record, values))
        for method, estimates in found.items():
            errors = np.median(np.abs(np.array(estimates) / truth - 1.0), axis=0)
            cases.append(Case(name, window, noise, method, errors))
    return cases


def _noisy(record: Record, noise: float, seed: int) -> Record:
    x = np.asarray(record.displacement)
    draw = np.random.default_rng(seed).standard_normal(record.n)
    return Record(
        name=record.name,
        time=record.time,
        voltage=record.voltage,
        displacement=x + noise * x[-1] * draw,
    )


def _table(cases: Sequence[Case]) -> Table:
    rows = [
        (
            c.stack,
            f"{c.window:g}",
            f"{c.noise:g}",
            c.method,
            *(number(float(e), 2) for e in c.errors),
        )
        for c in cases
    ]
    return Table(("stack", "window", "noise", "method", *COEFFICIENTS), tuple(rows))


def _loops() -> Table:
    """Return the errors of A, delta, n, beta + gamma and gamma - beta with two readings of k."""
    values = _values("P-885.51", {})
    time, voltage = loop_voltage(values, 1.0, 1.0)
    clean = Record(
        name="loop", time=time, voltage=voltage, displacement=response(values, time, voltage)
    )
    step = find_steps([step_record(_values("P-885.51", {"R_s": 8e-3}), WINDOW)])[0]
    compliance = static_compliance(values)
    rows = []
    for label, k in (("k_L/k_P + k_L/k_B", values["k_L"] * compliance), ("x_s of a step", step.k)):
        for noise in (0.0, 1e-4, 1e-3):
            errors = _loop_errors(with_noise([clean], noise, 0)[0], k, values, compliance)
            cells = [number(e, 2) for e in errors] or ["none found"] * 5
            rows.append((label, f"{noise:g}", *cells))
    head = ("k", "noise", "A", "delta", "n", "beta + gamma", "gamma - beta")
    return Table(head, tuple(rows))


def _loop_errors(
    record: Record, k: float, values: Mapping[str, float], compliance: float
) -> list[float]:
    found = hysteresis_part(find_loops([record]), k)
    if found.A is None or found.delta is None or found.bends is None:
        return []
    n, beta, gamma = found.bends.n, found.bends.beta, found.bends.gamma
    unit = compliance ** (n - 1.0) * values["h_ref"] ** n
    pairs = [
        (found.A / compliance, values["A"]),
        (found.delta / compliance, values["delta"]),
        (n, values["n"]),
        ((beta + gamma) * unit, values["beta"] + values["gamma"]),
        ((gamma - beta) * unit, values["gamma"] - values["beta"]),
    ]
    return [abs(estimate / true - 1.0) for estimate, true in pairs]


def _picture(cases: Sequence[Case]) -> Figure:
    """Draw the errors against noise, one panel a stack: median and range over the coefficients."""
    figure = Figure(figsize=(15.0, 5.0), layout="constrained")
    panels = figure.subplots(1, len(STACK_NAMES), sharey=True)
    for axes, name in zip(panels, STACK_NAMES, strict=True):
        for method in METHODS:
            chosen = [c for c in cases if c.stack == name and c.method == method]
            noise = [max(c.noise, _NO_NOISE) for c in chosen]
            errors = np.maximum(np.array([c.errors for c in chosen]), _FLOOR)
            colour = _COLOURS[method]
            axes.fill_between(
                noise, errors.min(axis=1), errors.max(axis=1), color=colour, alpha=0.2
            )
            axes.plot(noise, np.median(errors, axis=1), color=colour, marker="o", label=method)
        axes.axhline(1.0, color="black", linewidth=1.0, linestyle="--")
        axes.set(xscale="log", yscale="log", xlabel="noise over the step", title=name)
        ticks = [_NO_NOISE, *(n for n in NOISES if n)]
        axes.set_xticks(ticks, ["0", *(f"{n:g}" for n in ticks[1:])])
        axes.grid(visible=True, color="#dddddd")
    panels[0].set_ylabel("relative error of $a_1$ to $a_5$, $b_1$")
    panels[0].legend(title="median, and range over the six")
    figure.suptitle(f"Coefficients of eq. (15) from a step of {WINDOW:g} slowest time constants")
    return figure


_NOTE = (
    "Errors are |estimate/truth - 1|, the median over {} seed(s); 1 is 100 %. Records: 5000 samples"
    " of the independent reference, no hysteresis, drive of 13 ns. 'prediction error' fits k_L,"
    " tau, both masses and dampings and k_P, the best of four starts each 30 % off the truth; both"
    " methods see the same records. Noise 0 still holds the reference's tolerance, 1e-13."
)
_WINDOW_NOTE = (
    "The window counts in slowest time constants. What the window truncates returns multiplied by"
    " its length at each integration, and so does noise: a longer window trades one for"
    " the other."
)
_LOOP_NOTE = (
    "Errors as above, from two periods at 1 Hz and full voltage of the whole reference (hysteresis,"
    " drive). With k from a step to u_rated, as eq. (23) has it, k holds what the hysteresis adds,"
    " and the zero crossings of x - k u move."
)
