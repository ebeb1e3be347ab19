"""The paper's identification against the prediction-error fit, against noise and window.

The records are steps of the independent reference. As the paper assumes, nothing but eq. (13) is in
them: no hysteresis, and a drive a thousand times faster than the stack. White noise is added as a
share of the step; windows count in slowest time constants.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.identification.paper import COEFFICIENTS, find_steps, moment_coefficients
from psa_casadi.identification.refitting import noise_levels
from psa_casadi.records.split import whole
from psa_casadi.report.words.phrases import number
from tests.identification.paper_cases import coefficients_of_values
from tests.studies.benchmarks.records import Values, noisy, slowest
from tests.studies.benchmarks.table import Outcome, Progress, Row, TitledTable

STACK_NAMES = ("PTBS200", "WYDS0808020", "P-885.51")
NOISES, WINDOW, SEEDS = (0.0, 1e-5, 1e-4, 1e-3), 40.0, 3
#: What is searched, and starts of the search: factors on the true values, + is 1.3 and - is 0.7.
_FREE = ("k_L", "tau", "c_P", "c_B", "m_P", "m_B", "k_P")
_FAR = ("+++++++", "-------", "+-+-+-+", "+--++-+")
_SHORT, _LONG, _SHORT_RTOL = 15, 80, 1e-4
#: No hysteresis; R_s C_p = 13 ns.
_LINEAR = {"A": 0.0, "beta": 0.0, "gamma": 0.0, "delta": 0.0, "R_s": 8e-3}
_SAMPLES, _RTOL, _JUMP = 5000, 1e-13, 1e-10


def run(progress: Progress, quick: bool) -> Outcome:
    """Measure the errors of both methods; `quick` takes two noise levels and one seed."""
    noises, seeds = ((0.0, 1e-4), 1) if quick else (NOISES, SEEDS)
    rows = [row for name in STACK_NAMES for row in _rows(name, noises, seeds, progress)]
    table = TitledTable(
        f"Relative error of the coefficients of eq. (15), step of {WINDOW:g} slowest time"
        " constants, against noise",
        rows,
        f"Errors are |estimate/truth - 1|, the median over {seeds} seed(s); 1 is 100 %. Records:"
        " 5000 samples of the independent reference, no hysteresis, drive of 13 ns. 'prediction"
        " error' fits k_L, tau, both masses and dampings and k_P, the best of four starts each 30 %"
        " off the truth; both methods see the same records. Noise 0 still holds the reference's"
        " tolerance, 1e-13.",
    )
    return Outcome([table])


def step_record(values: Values) -> psa.Record:
    """Return the reference's response to a jump to u_rated at time 0, held for `WINDOW` of T."""
    time, top = np.linspace(0.0, WINDOW * slowest(values), _SAMPLES), values["u_rated"]
    x = reference.simulate(values, lambda _: top, time, rtol=_RTOL).displacement
    voltage = np.concatenate([[0.0], np.full(_SAMPLES, top)])
    instants, x = np.concatenate([[0.0], time + _JUMP]), np.concatenate([[0.0], x])
    return psa.Record(name="step", time=instants, voltage=voltage, displacement=x)


def by_moments(record: psa.Record) -> FloatArray:
    """Return a_1..a_5, b_1, shape (6,), as the paper finds them."""
    step = find_steps([record])[0]
    return moment_coefficients(step.time, step.g)


def by_fit(record: psa.Record, values: Values) -> FloatArray:
    """Return a_1..a_5, b_1, shape (6,), of a fit that starts 30 % from `values`.

    The best of four short fits is followed to the end.
    """
    experiments = [whole(record)]
    sigma = noise_levels(experiments)
    short: Any = {"sigma": sigma, "evaluations": _SHORT, "rtol": _SHORT_RTOL}
    fits = []
    for signs in _FAR:
        start = {
            n: (1.3 if s == "+" else 0.7) * values[n] for n, s in zip(_FREE, signs, strict=True)
        }
        fits.append(fit(psa.compose(psa.BASE, {**values, **start}), experiments, _FREE, **short))
    best = min(fits, key=lambda f: f.cost)
    states = [best.start(0)]
    last = fit(best.model, experiments, _FREE, sigma=sigma, start_states=states, evaluations=_LONG)
    return coefficients_of_values(last.model.values)


def _rows(name: str, noises: Sequence[float], seeds: int, progress: Progress) -> Iterator[Row]:
    """Yield the median relative errors of both methods at every noise."""
    values = {**psa.stack_model(name).values, **_LINEAR}
    truth, clean = coefficients_of_values(values), step_record(values)
    end = float(np.asarray(clean.displacement)[-1])
    for noise in noises:
        progress(f"{name}: noise {noise:g}")
        draws = range(seeds if noise else 1)
        records = [noisy(clean, noise * end, np.random.default_rng(seed)) for seed in draws]
        by = {"paper": map(by_moments, records),
              "prediction error": (by_fit(r, values) for r in records)}  # fmt: skip
        for method, estimates in by.items():
            errors = np.median(np.abs(np.array(list(estimates)) / truth - 1.0), axis=0).tolist()
            figures = {n: number(e, 2) for n, e in zip(COEFFICIENTS, errors, strict=True)}
            yield {"stack": name, "noise": f"{noise:g}", "method": method, **figures}
