"""The paper's identification beside the prediction-error fit, against noise and window.

The records are steps of the independent reference. As the paper assumes, nothing but eq. (13) is in
them: no hysteresis, and a drive a thousand times faster than the stack. White noise is added as a
share of the step; windows count in slowest time constants.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from psa_casadi import reference
from psa_casadi.components import BASE
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.identification.paper import (
    COEFFICIENTS,
    find_steps,
    moment_coefficients,
)
from psa_casadi.identification.refitting import noise_levels
from psa_casadi.model.compose import compose
from psa_casadi.model.stacks import STACKS
from psa_casadi.records import Record
from psa_casadi.records.split import whole
from psa_casadi.report.words.phrases import number
from tests.identification.paper_cases import coefficients_of_values
from tests.studies.benchmarks.records import slowest
from tests.studies.benchmarks.table import Outcome, Progress, table_of

FloatArray = npt.NDArray[np.float64]

STACK_NAMES = ("PTBS200", "WYDS0808020", "P-885.51")
NOISES, WINDOW, SEEDS = (0.0, 1e-5, 1e-4, 1e-3), 40.0, 3
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
    """Median relative errors (6,) of a_1..a_5, b_1 for one stack, noise, method."""

    stack: str
    noise: float
    method: str
    errors: FloatArray


def run(progress: Progress, quick: bool) -> Outcome:
    """Measure the errors of both methods; `quick` takes two noise levels and one seed."""
    noises, seeds = ((0.0, 1e-4), 1) if quick else (NOISES, SEEDS)
    found = [c for name in STACK_NAMES for c in _cases(name, noises, seeds, progress)]
    table = table_of(
        f"Relative error of the coefficients of eq. (15), step of {WINDOW:g} slowest time"
        " constants, against noise",
        found,
        {
            "stack": lambda c: c.stack,
            "noise": lambda c: f"{c.noise:g}",
            "method": lambda c: c.method,
            **{n: partial(_shown, k) for k, n in enumerate(COEFFICIENTS)},
        },
        f"Errors are |estimate/truth - 1|, the median over {seeds} seed(s); 1 is 100 %. Records:"
        " 5000 samples of the independent reference, no hysteresis, drive of 13 ns. 'prediction"
        " error' fits k_L, tau, both masses and dampings and k_P, the best of four starts each 30 %"
        " off the truth; both methods see the same records. Noise 0 still holds the reference's"
        " tolerance, 1e-13.",
    )
    return Outcome([table], partial(_picture, found))


def step_record(values: Mapping[str, float]) -> Record:
    """Return the reference's response to a jump to u_rated at time 0, held for `WINDOW` of T."""
    time, top = np.linspace(0.0, WINDOW * slowest(values), _SAMPLES), values["u_rated"]
    x = reference.simulate(values, lambda _: top, time, rtol=_RTOL).displacement
    voltage = np.concatenate([[0.0], np.full(_SAMPLES, top)])
    instants, x = np.concatenate([[0.0], time + _JUMP]), np.concatenate([[0.0], x])
    return Record(name="step", time=instants, voltage=voltage, displacement=x)


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
    short: Any = {"sigma": sigma, "evaluations": _SHORT, "rtol": _SHORT_RTOL}
    fits = []
    for factors in _FAR:
        start = {n: f * values[n] for n, f in zip(_FREE, factors, strict=True)}
        fits.append(fit(compose(BASE, {**values, **start}), experiments, _FREE, **short))
    best = min(fits, key=lambda f: f.cost)
    states = [best.start(0)]
    last = fit(best.model, experiments, _FREE, sigma=sigma, start_states=states, evaluations=_LONG)
    return coefficients_of_values(last.model.values)


def _cases(name: str, noises: Sequence[float], seeds: int, progress: Progress) -> list[Case]:
    values = {key: figure.value for key, figure in STACKS[name].values.items()} | _LINEAR
    truth, clean, cases = coefficients_of_values(values), step_record(values), []
    x = np.asarray(clean.displacement)
    for noise in noises:
        progress(f"{name}: noise {noise:g}")
        found: dict[str, list[FloatArray]] = {method: [] for method in METHODS}
        for seed in range(seeds if noise else 1):
            draw = np.random.default_rng(seed).standard_normal(clean.n)
            record = replace(clean, displacement=x + noise * x[-1] * draw)
            found["paper"].append(by_moments(record))
            found["prediction error"].append(by_fit(record, values))
        for method, estimates in found.items():
            errors = np.median(np.abs(np.array(estimates) / truth - 1.0), axis=0)
            cases.append(Case(name, noise, method, errors))
    return cases


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


def _shown(k: int, c: Case) -> str:
    return number(float(c.errors[k]), 2)
