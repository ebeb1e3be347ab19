"""Posteriors: are they calibrated, and does evidence agree with bridge sampling.

Simulation-based calibration (Talts and others 2018): parameters are drawn from the prior, a record
is simulated with them and noise is added; the rank of the truth among the posterior's draws is then
uniform, and intervals of p % hold the truth in p %.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import binom, chi2, kstest

import psa_casadi as psa
from psa_casadi.posterior.chains import chains_of, prior_draws
from psa_casadi.posterior.task import Task, task_of
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.side_by_side import one_thread
from tests.studies.benchmarks.posterior_evidence import evidence_table
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

FloatArray = npt.NDArray[np.float64]

STACK, NOISE = "P-885.51", 1e-3
#: Centres and widths of the priors: k_L and tau in ln units, others in ordinary changes.
CENTRES = {"tau": 1e-3}
WIDTHS = {"k_L": 0.2, "A": 0.2, "delta": 0.5, "n": 0.2, "tau": 0.4}
REPLICAS, QUICK_REPLICAS = 100, 8
DRAWS, TUNE, THIN = 396, 300, 4
BINS = 10
LEVELS = (0.5, 0.8, 0.94)


@dataclass(frozen=True, eq=False)
class Replica:
    """One draw of the prior: rank of the truth for every unknown, in which intervals it lies."""

    ranks: tuple[int, ...]
    inside: tuple[tuple[bool, ...], ...]
    divergences: int
    inflation: float


def run(progress: Progress, quick: bool) -> Outcome:
    """Print the tables of calibration and evidence."""
    count = QUICK_REPLICAS if quick else REPLICAS
    calibration = _calibration(progress, count)
    return Outcome((*calibration, evidence_table(progress, quick)))


def run_sized(progress: Progress, count: int) -> Outcome:
    """Print the calibration of so many replicas alone."""
    return Outcome(_calibration(progress, count))


def voltage() -> tuple[FloatArray, FloatArray]:
    """Return time [s] and voltage [V] of two loops from rest, the second higher."""
    time: FloatArray = np.linspace(0.0, 0.399, 400)
    applied: FloatArray = 60.0 * (1.0 - np.cos(10.0 * np.pi * time))
    return time, applied * np.where(time > 0.2, 1.0, 0.5)


def centred_model() -> psa.Model:
    """Return the stack with the values that the priors are centred at."""
    return psa.stack_model(STACK).with_values(CENTRES)


def recorded(model: psa.Model, memory: float, noise: float, rng: np.random.Generator) -> psa.Record:
    """Return a record of a model that starts with a hysteresis force [N], with noise [m]."""
    time, applied = voltage()
    x = psa.simulate(model, time, applied, memory={"f_H": memory}, rtol=1e-8).displacement
    y = x + noise * rng.standard_normal(len(x))
    return psa.Record(name="record", time=time, voltage=applied, displacement=y)


def task_for(record: psa.Record) -> Task:
    """Return the posterior of the sampled parameters, from where a user would begin."""
    model = centred_model()
    centre = {n: model.values[n] for n in WIDTHS}
    return task_of(model, [record], free=tuple(WIDTHS), prior=centre, widths=WIDTHS)


def _calibration(progress: Progress, count: int) -> tuple[TitledTable, TitledTable]:
    rng = np.random.default_rng(20261125)
    clean = recorded(centred_model(), 0.0, 0.0, rng)
    noise = NOISE * clean.range_m
    before = task_for(recorded(centred_model(), 0.0, noise, rng))
    truths = prior_draws(before, count, rng)
    found: list[Replica] = []
    for k, truth in enumerate(truths):
        progress(f"calibration: {k + 1} of {count}")
        found.append(_replica(before, truth, noise, k))
    names = (*WIDTHS, "f_H at the start")
    return _ranks(found, names), _coverage(found, names)


def _replica(before: Task, truth: FloatArray, noise: float, seed: int) -> Replica:
    u, rng = before.unknowns, np.random.default_rng(seed)
    model = before.model.with_values(u.values(truth))
    task = task_for(recorded(model, u.start(truth, 0)["f_H"], noise, rng))
    with one_thread():
        chains = chains_of(task.density, chains=1, draws=DRAWS, tune=TUNE, seed=seed, cores=1)
    draws = np.array([task.density.theta(x) for x in chains.u[0]])
    kept = [k for k in range(u.size) if np.isfinite(u.prior[k])]
    ranks = [int((draws[::THIN, k] < truth[k]).sum()) for k in kept]
    shares = [float((draws[:, k] < truth[k]).mean()) for k in kept]
    inside = [tuple(abs(s - 0.5) <= 0.5 * level for level in LEVELS) for s in shares]
    return Replica(tuple(ranks), tuple(inside), chains.divergences, task.inflation[0])


def _ranks(found: Sequence[Replica], names: Sequence[str]) -> TitledTable:
    """Return chi-square and Kolmogorov's test of the ranks, each by parameter."""
    possible = DRAWS // THIN + 1
    rows = []
    for k, name in enumerate(names):
        ranks = np.array([r.ranks[k] for r in found])
        counts = np.bincount(ranks * BINS // possible, minlength=BINS)
        expected = len(found) / BINS
        power = float(np.sum((counts - expected) ** 2) / expected)
        p = float(chi2.sf(power, BINS - 1))
        distance = kstest((ranks + 0.5) / possible, "uniform")
        shown = " ".join(str(c) for c in counts)
        rows.append((name, shown, f"{power:.1f}", f"{p:.2f}", f"{distance.pvalue:.2f}"))
    worth = float(np.median([r.inflation for r in found]))
    return TitledTable(
        f"Ranks of the truth among {possible - 1} draws, {len(found)} replicas",
        Table(("unknown", f"in {BINS} bins", "chi-square", "p", "p (Kolmogorov)"), tuple(rows)),
        f"{sum(r.divergences for r in found)} of {len(found) * DRAWS} transitions diverged;"
        f" {worth:.2f} samples count as one (median).",
    )


def _coverage(found: Sequence[Replica], names: Sequence[str]) -> TitledTable:
    rows = []
    for k, name in enumerate(names):
        shares = [np.mean([r.inside[k][j] for r in found]) for j in range(len(LEVELS))]
        rows.append((name, *(f"{100.0 * s:.0f} %" for s in shares)))
    every = [[r.inside[k][j] for r in found for k in range(len(names))] for j in range(len(LEVELS))]
    rows.append(("all", *(f"{100.0 * np.mean(e):.1f} %" for e in every)))
    bands = [binom.interval(0.95, len(found), level) for level in LEVELS]
    ends = ", ".join(
        f"{100 * a / len(found):.0f} to {100 * b / len(found):.0f} %" for a, b in bands
    )
    head = ("unknown", *(f"in the {100 * level:.0f} % interval" for level in LEVELS))
    return TitledTable(
        "Truth in central intervals",
        Table(head, tuple(rows)),
        f"Of one unknown, 95 % of such tables lie within {ends}.",
    )
