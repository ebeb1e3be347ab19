"""Identification from scratch, many times: parameters and intervals against the truth.

Records come from the independent reference with white noise of 0.1 % of the largest range: a step,
loops at three amplitudes and two frequencies, a multisine. `identify` gets the records and the
stiffness k_B, nothing else. What is compared is what voltage and displacement determine: forces
over the stack's stiffness, lags, and masses over stiffnesses, each with the interval that the
covariance of the fit gives it. Every stack has other draws.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.noise import whiteness
from psa_casadi.identification.fitting.unknowns import static_compliance
from tests.studies.benchmarks.records import Values, clean_set, with_noise
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, on_all_cores

NOISE, SEEDS, QUICK_SEEDS = 1e-3, 50, 2
QUICK_STACKS = ("P-885.51", "PTBS200")
_NORMAL_95 = 1.96
#: A quantity with a larger relative standard error counts as weakly determined, and is left out.
_WEAK = 0.1
#: Residuals with a smaller p-value of the portmanteau test do not count as white.
_WHITE = 0.01
_STEP = 1e-5


def gradients(values: Values, names: Sequence[str], size: float) -> FloatArray:
    """Return d quantity / d parameter (quantities, k), by central differences."""
    columns = []
    for name in names:
        h = _STEP * max(abs(values[name]), 1e-300)
        up, down = (quantities({**values, name: values[name] + s}, size) for s in (h, -h))
        columns.append([(up[q] - down[q]) / (2.0 * h) for q in up])
    return np.array(columns).T


class Quantity(NamedTuple):
    """One quantity of one run: truth, estimate, standard error, and whether it is determined."""

    name: str
    truth: float
    value: float
    error: float
    determined: bool

    @property
    def errors_off(self) -> float:
        """Distance from the truth in standard errors."""
        return abs(self.value - self.truth) / self.error

    @property
    def covered(self) -> bool:
        """Whether the truth is in the 95 % interval."""
        return abs(self.value - self.truth) <= _NORMAL_95 * self.error


class Run(NamedTuple):
    """One identification: its quantities, and the rms of the residual over the noise."""

    stack: str
    quantities: tuple[Quantity, ...]
    rms_ratio: float
    white: tuple[bool, ...]
    converged: bool

    @property
    def determined(self) -> list[Quantity]:
        """What the records determine."""
        return [q for q in self.quantities if q.determined]


def run(progress: Progress, quick: bool, size: int = SEEDS) -> Outcome:
    """Identify every named stack from `size` sets of records, or two of them from two."""
    seeds = range(QUICK_SEEDS if quick else size)
    jobs = [(n, seed) for n in (QUICK_STACKS if quick else psa.STACKS) for seed in seeds]
    return Outcome([by_stack(on_all_cores(one_run, jobs, progress, lambda r: r.stack))])


def one_run(name: str, seed: int) -> Run:
    """Identify one named stack from one set of noisy records, and compare with the truth."""
    model = psa.stack_model(name)
    truth = model.values
    clean = clean_set(truth)
    level = NOISE * max(r.range_m for r in clean)
    records = with_noise(clean, NOISE, (tuple(psa.STACKS).index(name), seed))
    result = psa.identify(records, stiffness=truth["k_B"])
    white = tuple(whiteness(r)[0] > _WHITE for r in result.fit.record_residuals)
    return Run(name, compared(result, truth), result.fit.rms / level, white, result.fit.converged)


def compared(result: psa.Identification, truth: Values) -> tuple[Quantity, ...]:
    """Return every quantity with its truth and its standard error (delta method)."""
    known, p = result.determinacy, result.model.values
    size = static_compliance(truth) * truth["h_ref"]
    true, value = quantities(truth, size), quantities(p, size)
    slopes = gradients(p, known.names, size)
    errors = np.sqrt(np.einsum("qk,kl,ql->q", slopes, known.covariance, slopes))
    weak = {*known.undetermined, *known.on_bound}
    return tuple(
        Quantity(n, true[n], value[n], error,
                 n in known.names and n not in weak and error < _WEAK * abs(value[n]))
        for n, error in zip(value, errors.tolist(), strict=True)
    )  # fmt: skip


def quantities(p: Values, size: float) -> dict[str, float]:
    """Return what voltage and displacement determine, by parameter.

    k, A, beta, gamma [m/V] and delta [m/(V.s)] as in eqs. (25), (26), beta and gamma at a
    hysteresis of `size` [m]; n; lags [s]; masses over stiffnesses [s^2].
    """
    c = static_compliance(p)
    bend = c * (size / (c * p["h_ref"])) ** p["n"]
    factors = {"k_L": c, "A": c, "beta": bend, "gamma": bend, "delta": c, "n": 1.0, "tau": 1.0}
    table = {name: factor * p[name] for name, factor in factors.items()}
    table["R_s"] = p["R_s"] * p["C_p"]
    return table | {f"{q}_{part}": p[f"{q}_{part}"] / p[f"k_{part}"] for part in "PB" for q in "cm"}


def share_sentence(runs: Sequence[Run]) -> str:
    """Return how many intervals hold the truth, with the standard error of that share.

    Quantities of one run depend on each other, so the error is that of a mean over runs.
    """
    every = [q for r in runs for q in r.determined]
    held = sum(q.covered for q in every)
    over = [sum(q.covered - held / len(every) for q in r.determined) for r in runs]
    error = float(np.sqrt(np.sum(np.square(over)))) / len(every)
    return (
        f"Of {len(every)} intervals {held} hold the truth, {100.0 * held / len(every):.1f} %"
        f" (standard error {100.0 * error:.1f} %)."
    )


def by_stack(runs: Sequence[Run]) -> TitledTable:
    """Return how many intervals of each stack hold the truth, and the worst one."""
    rows = []
    for name in dict.fromkeys(r.stack for r in runs):
        of = [q for r in runs if r.stack == name for q in r.determined]
        worst = max(of, key=lambda q: q.errors_off)
        held, ratios = sum(q.covered for q in of), [r.rms_ratio for r in runs if r.stack == name]
        rows.append({
            "stack": name,
            "intervals that hold the truth": f"{held} of {len(of)}, {100.0 * held / len(of):.1f} %",
            "farthest, in standard errors": f"{worst.name} {worst.errors_off:.1f}",
            "residual over noise": f"{min(ratios):.3f} to {max(ratios):.3f}",
        })  # fmt: skip
    return TitledTable("Identified from scratch, against the truth", rows, share_sentence(runs))
