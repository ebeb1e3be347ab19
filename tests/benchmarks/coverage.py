"""Identification from scratch, many times: parameters and intervals against the truth.

Records come from the independent reference with white noise of 0.1 % of the largest range: a step,
loops at three amplitudes and two frequencies, a multisine. `identify` gets the records and the
stiffness k_B, nothing else. What is compared is what voltage and displacement determine: forces
over the stack's stiffness, lags, and masses over stiffnesses, each with the interval that the
covariance of the fit gives it.
"""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.noise.residual_tests import whiteness
from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.identification.identify import Identification, identify
from psa_casadi.model.stacks import STACKS
from psa_casadi.report.words.tables import Table
from tests.benchmarks.outcome import Outcome, Progress, TitledTable
from tests.benchmarks.records import Values, clean_set, with_noise

FloatArray = npt.NDArray[np.float64]

NOISE, SEEDS, QUICK_SEEDS = 1e-3, 50, 2
QUICK_STACKS = ("P-885.51", "PTBS200")
_NORMAL_95 = 1.96
#: A quantity with a larger relative standard error counts as weakly determined, and is left out.
_WEAK = 0.1
#: Residuals with a smaller p-value of the portmanteau test do not count as white.
_WHITE = 0.01


@dataclass(frozen=True)
class Found:
    """One quantity of one run: its truth, estimate, standard error, and whether it is told."""

    name: str
    truth: float
    value: float
    error: float
    determined: bool

    @property
    def covered(self) -> bool:
        """Whether the truth lies in the 95 % interval."""
        return abs(self.value - self.truth) <= _NORMAL_95 * self.error

    @property
    def relative(self) -> float:
        """Relative error of the estimate."""
        return abs(self.value / self.truth - 1.0)


@dataclass(frozen=True)
class Run:
    """One identification: what was found, rms over the noise put in, white records, warnings."""

    stack: str
    seed: int
    found: tuple[Found, ...]
    rms_ratio: float
    white: tuple[bool, ...]
    converged: bool


def run(progress: Progress, quick: bool) -> Outcome:
    """Identify every named stack from `SEEDS` sets of records, on all cores."""
    names = QUICK_STACKS if quick else tuple(STACKS)
    seeds = QUICK_SEEDS if quick else SEEDS
    runs: list[Run] = []
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        for name in names:
            jobs = [pool.submit(one_run, name, seed) for seed in range(seeds)]
            for k, job in enumerate(jobs):
                runs.append(job.result())
                progress(f"{name}: {k + 1} of {seeds}")
    return Outcome((_quantities(runs), _residuals(runs)))


def one_run(name: str, seed: int) -> Run:
    """Identify one named stack from one set of noisy records, and compare with the truth."""
    truth = {key: f.value for key, f in STACKS[name].values.items()}
    clean = clean_set(truth)
    level = NOISE * max(r.range_m for r in clean)
    records = with_noise(clean, NOISE, seed)
    found = identify(records, stiffness=truth["k_B"])
    white = tuple(whiteness(r) > _WHITE for r in found.fit.residuals_of(found.experiments))
    return Run(
        stack=name,
        seed=seed,
        found=compared(found, truth),
        rms_ratio=found.fit.rms / level,
        white=white,
        converged=found.fit.converged,
    )


def compared(found: Identification, truth: Values) -> tuple[Found, ...]:
    """Return every quantity with its truth and its standard error (delta method)."""
    known, p = found.determinacy, found.model.values
    size = static_compliance(truth) * truth["h_ref"]
    true, value = quantities(truth, size), quantities(p, size)
    gradients: dict[str, list[float]] = {name: [] for name in value}
    for name in known.names:
        step = 1e-5 * max(abs(p[name]), 1e-300)
        up, down = (quantities({**p, name: p[name] + h}, size) for h in (step, -step))
        for key, gradient in gradients.items():
            gradient.append((up[key] - down[key]) / (2.0 * step))
    open_ones = {*known.undetermined, *known.on_bound}
    results = []
    for key, parts in gradients.items():
        g: FloatArray = np.array(parts)
        error = float(np.sqrt(g @ known.covariance @ g))
        told = key in known.names and key not in open_ones and error < _WEAK * abs(value[key])
        results.append(Found(key, true[key], value[key], error, told))
    return tuple(results)


def quantities(p: Values, size: float) -> dict[str, float]:
    """Return what voltage and displacement determine, by the parameter that it stands for.

    k, A, beta, gamma [m/V] and delta [m/(V.s)] as in eqs. (25), (26), beta and gamma at a
    hysteresis of `size` [m]; n; lags [s]; masses over stiffnesses [s^2].
    """
    c = static_compliance(p)
    bend = c * (size / (c * p["h_ref"])) ** p["n"]
    return {
        "k_L": c * p["k_L"],
        "A": c * p["A"],
        "beta": bend * p["beta"],
        "gamma": bend * p["gamma"],
        "delta": c * p["delta"],
        "n": p["n"],
        "tau": p["tau"],
        "R_s": p["R_s"] * p["C_p"],
        "c_P": p["c_P"] / p["k_P"],
        "m_P": p["m_P"] / p["k_P"],
        "c_B": p["c_B"] / p["k_B"],
        "m_B": p["m_B"] / p["k_B"],
    }


SHOWN: Mapping[str, str] = {
    "k_L": "k", "A": "A", "beta": "beta", "gamma": "gamma", "delta": "delta", "n": "n",
    "tau": "tau", "R_s": "R_s C_p", "c_P": "c_P/k_P", "m_P": "m_P/k_P", "c_B": "c_B/k_B",
    "m_B": "m_B/k_B",
}  # fmt: skip


def _quantities(runs: Sequence[Run]) -> TitledTable:
    rows = []
    for stack in dict.fromkeys(r.stack for r in runs):
        own = [r for r in runs if r.stack == stack]
        for name, shown in SHOWN.items():
            all_found = [f for r in own for f in r.found if f.name == name]
            told = [f for f in all_found if f.determined]
            if not told:
                rows.append((stack, shown, f"0 of {len(all_found)}", "", "", "", ""))
                continue
            errors = 100.0 * np.array([f.relative for f in told])
            limit = 5.0 if name in ("n", "beta", "gamma") else 1.0
            rows.append(
                (
                    stack,
                    shown,
                    f"{len(told)} of {len(all_found)}",
                    f"{100.0 * np.mean([f.covered for f in told]):.0f} %",
                    f"{np.median([100.0 * f.error / abs(f.value) for f in told]):.2g} %",
                    f"{np.median(errors):.2g} %",
                    f"{100.0 * np.mean(errors < limit):.0f} % within {limit:g} %",
                )
            )
    told = [f for r in runs for f in r.found if f.determined]
    share = 100.0 * float(np.mean([f.covered for f in told]))
    head = (
        "stack", "quantity", "determined in", "truth in its 95 % interval",
        "standard error, median", "error, median", "close to the truth",
    )  # fmt: skip
    return TitledTable(
        "Identified from scratch, against the truth",
        Table(head, tuple(rows)),
        f"Of {len(told)} intervals {share:.1f} % hold the truth.",
    )


def _residuals(runs: Sequence[Run]) -> TitledTable:
    rows = []
    for stack in dict.fromkeys(r.stack for r in runs):
        own = [r for r in runs if r.stack == stack]
        ratios = np.array([r.rms_ratio for r in own])
        white = [w for r in own for w in r.white]
        rows.append(
            (
                stack,
                f"{len(own)}",
                f"{np.median(ratios):.3f}",
                f"{ratios.min():.3f} to {ratios.max():.3f}",
                f"{100.0 * np.mean(white):.1f} %",
                f"{sum(r.converged for r in own)}",
            )
        )
    head = (
        "stack", "fits", "residual over noise, median", "least to most",
        "records with white residual", "converged",
    )  # fmt: skip
    return TitledTable(
        "What the fits leave",
        Table(head, tuple(rows)),
        "White: portmanteau test of 25 lags with p above 1 %, so that 99 % of pure noise pass.",
    )
