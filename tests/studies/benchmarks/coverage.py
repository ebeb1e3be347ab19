"""Identification from scratch, many times: parameters and intervals against the truth.

Records come from the independent reference with white noise of 0.1 % of the largest range: a step,
loops at three amplitudes and two frequencies, a multisine. `identify` gets the records and the
stiffness k_B, nothing else. What is compared is what voltage and displacement determine: forces
over the stack's stiffness, lags, and masses over stiffnesses, each with the interval that the
covariance of the fit gives it. Every stack has its own draws. Beside the share that is covered
stands what these draws alone give (`coverage_control`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import psa_casadi as psa
from psa_casadi.diagnosis.omnibus import whiteness
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.records.split import whole
from psa_casadi.units import FloatArray
from tests.studies.benchmarks.records import Values, clean_set, with_noise
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, on_all_cores

NOISE, SEEDS, QUICK_SEEDS = 1e-3, 50, 2
QUICK_STACKS = ("P-885.51", "PTBS200")
_NORMAL_95 = 1.96
#: A quantity with a larger relative standard error counts as weakly determined, and is left out.
_WEAK = 0.1
#: Residuals with a smaller p-value of the portmanteau test do not count as white.
_WHITE = 0.01
_STEP, _RTOL = 1e-5, 1e-8


def drawn_scores(
    model: psa.Model, clean: Sequence[psa.Record], noisy: Sequence[psa.Record],
    names: Sequence[str], level: float, size: float,
) -> dict[str, float]:  # fmt: skip
    """Return by how many standard errors the draws move each quantity, at the truth.

    `model` carries the truth, `names` are the parameters that are fitted, `level` [m] is the
    noise's, `size` [m] that of `quantities`.
    """
    experiments = [whole(r) for r in clean]
    at = fit(model, experiments, names, sigma=[level] * len(clean), evaluations=1, rtol=_RTOL)
    noise = np.concatenate([measured(n) - measured(c) for n, c in zip(noisy, clean, strict=True)])
    scaled, count = at.jacobian / level, len(names)
    precision = scaled.T @ scaled + np.diag(1.0 / at.unknowns.prior**2)
    covariance = np.linalg.pinv(precision, hermitian=True)
    moved = covariance @ (scaled.T @ (noise / level))
    slopes = gradients(model.values, names, size) @ at.unknowns.slopes(at.theta)
    errors = np.sqrt(np.einsum("qk,kl,ql->q", slopes, covariance[:count, :count], slopes))
    scores = slopes @ moved[:count] / errors
    return dict(zip(quantities(model.values, size), scores.tolist(), strict=True))


def gradients(values: Values, names: Sequence[str], size: float) -> FloatArray:
    """Return d quantity / d parameter (quantities, k), by central differences."""
    columns = []
    for name in names:
        h = _STEP * max(abs(values[name]), 1e-300)
        up, down = (quantities({**values, name: values[name] + s}, size) for s in (h, -h))
        columns.append([(up[q] - down[q]) / (2.0 * h) for q in up])
    return np.array(columns).T


@dataclass(frozen=True)
class Found:
    """One quantity of one run: its truth, estimate, standard error, and whether it is told.

    `drawn` is by how many standard errors the draws of the noise move it in linear theory.
    """

    name: str
    truth: float
    value: float
    error: float
    determined: bool
    drawn: float

    @property
    def covered(self) -> bool:
        """Whether the truth lies in the 95 % interval."""
        return abs(self.value - self.truth) <= _NORMAL_95 * self.error

    @property
    def covered_by_draws(self) -> bool:
        """Whether it would lie there in linear theory at the truth."""
        return abs(self.drawn) <= _NORMAL_95

    @property
    def relative(self) -> float:
        """Relative error of the estimate."""
        return abs(self.value / self.truth - 1.0)


@dataclass(frozen=True)
class Run:
    """One identification: what was found, rms over the noise put in, white records."""

    stack: str
    found: tuple[Found, ...]
    rms_ratio: float
    white: tuple[bool, ...]
    converged: bool

    @property
    def told(self) -> list[Found]:
        """What the records determine."""
        return [f for f in self.found if f.determined]


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
    size = static_compliance(truth) * truth["h_ref"]
    output = result.determinacy.names
    drawn = drawn_scores(model, clean, records, output, level, size)
    white = tuple(whiteness(r)[0] > _WHITE for r in result.fit.residuals_of(result.experiments))
    quality = (result.fit.rms / level, white, result.fit.converged)
    return Run(name, compared(result, truth, drawn), *quality)


def compared(found: psa.Identification, truth: Values, drawn: Values) -> tuple[Found, ...]:
    """Return every quantity with its truth and its standard error (delta method)."""
    known, p = found.determinacy, found.model.values
    size = static_compliance(truth) * truth["h_ref"]
    true, value = quantities(truth, size), quantities(p, size)
    slopes = gradients(p, known.names, size)
    errors = np.sqrt(np.einsum("qk,kl,ql->q", slopes, known.covariance, slopes))
    open_ones = {*known.undetermined, *known.on_bound}
    results = []
    for key, error in zip(value, errors.tolist(), strict=True):
        output = key in known.names and key not in open_ones and error < _WEAK * abs(value[key])
        results.append(Found(key, true[key], value[key], error, output, drawn[key]))
    return tuple(results)


def quantities(p: Values, size: float) -> dict[str, float]:
    """Return what voltage and displacement determine, by the parameter that it stands for.

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
    """Say how many intervals hold the truth, with the error of that share.

    Quantities of one run depend on each other, so the error is that of a mean over runs.
    """
    items = [f for r in runs for f in r.told]
    held = sum(f.covered for f in items)
    share, drawn = held / len(items), float(np.mean([f.covered_by_draws for f in items]))
    over = [sum(f.covered for f in r.told) - share * len(r.told) for r in runs]
    error = float(np.sqrt(np.sum(np.square(over)))) / len(items)
    return (
        f"Of {len(items)} intervals {held} hold the truth, {100.0 * share:.1f} % (standard error"
        f" {100.0 * error:.1f} %). By these draws alone it would be {100.0 * drawn:.1f} %."
    )


def by_stack(runs: Sequence[Run]) -> TitledTable:
    """Return how many intervals of each stack hold the truth, and what the fits leave."""
    rows = []
    for name in dict.fromkeys(r.stack for r in runs):
        of = [r for r in runs if r.stack == name]
        held = [(f.covered, f.covered_by_draws) for r in of for f in r.told]
        inside, drawn = 100.0 * np.mean(held, axis=0)
        ratios, white = [r.rms_ratio for r in of], [w for r in of for w in r.white]
        rows.append({
            "stack": name,
            "intervals that hold the truth": f"{sum(h for h, _ in held)} of {len(held)},"
            f" {inside:.1f} %",
            "by the draws alone": f"{drawn:.1f} %",
            "residual over noise": f"{min(ratios):.3f} to {max(ratios):.3f}",
            "white records": f"{sum(white)} of {len(white)}",
        })  # fmt: skip
    note = " White: portmanteau test of 25 lags with p above 1 %, so that 99 % of pure noise pass."
    title = "Identified from scratch, against the truth"
    return TitledTable(title, rows, share_sentence(runs) + note)
