"""Posteriors: are they calibrated?

Simulation-based calibration (Talts and others 2018): parameters are drawn from the prior, a record
is simulated with them and noise is added; the rank of the truth among the posterior's draws is then
uniform, and intervals of p % hold the truth in p %.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.posterior.chains import chains_of, prior_draws
from psa_casadi.posterior.task import Task, task_of
from psa_casadi.simulation.side_by_side import one_thread
from tests.studies.benchmarks.records import noisy
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

STACK, NOISE = "P-885.51", 1e-3
#: Centres and widths of the priors: k_L and tau in ln units, others in ordinary changes.
CENTRES = {"tau": 1e-3}
WIDTHS = {"k_L": 0.2, "A": 0.2, "delta": 0.5, "n": 0.2, "tau": 0.4}
REPLICAS, QUICK_REPLICAS = 100, 8
DRAWS, TUNE, THIN = 396, 300, 4
BINS = 10
LEVELS = (0.5, 0.8, 0.94)


class Replica(NamedTuple):
    """One draw of the prior: rank of every true value, and the intervals that contain it."""

    ranks: tuple[int, ...]
    inside: tuple[tuple[bool, ...], ...]
    divergences: int


def run(progress: Progress, quick: bool, size: int = REPLICAS) -> Outcome:
    """Measure the calibration over `size` draws of the prior."""
    return Outcome([_calibration(progress, QUICK_REPLICAS if quick else size)])


def centred_model() -> psa.Model:
    """Return the stack with the values that the priors are centred at."""
    return psa.stack_model(STACK).with_values(CENTRES)


def recorded(model: psa.Model, **memory: float) -> psa.Record:
    """Return a record of two loops, the second higher, from a hysteresis force [N], no noise."""
    time = np.linspace(0.0, 0.399, 400)
    applied = 60.0 * (1.0 - np.cos(10.0 * np.pi * time)) * np.where(time > 0.2, 1.0, 0.5)
    x = psa.simulate(model, time, applied, memory=memory or None, rtol=1e-8).displacement
    return psa.Record(name="record", time=time, voltage=applied, displacement=x)


def task_for(record: psa.Record, model: psa.Model, widths: Mapping[str, float]) -> Task:
    """Return the posterior of the sampled parameters, from where a user would begin."""
    centre = {n: model.values[n] for n in widths}
    return task_of(model, [record], free=tuple(widths), prior=centre, widths=dict(widths))


def _calibration(progress: Progress, count: int) -> TitledTable:
    rng, model = np.random.default_rng(20261125), centred_model()
    clean = recorded(model, f_H=0.0)
    noise = NOISE * clean.range_m
    rng.standard_normal(clean.n)  # of a first record, which is not used
    before = task_for(noisy(clean, noise, rng), model, WIDTHS)
    replicas: list[Replica] = []
    for k, truth in enumerate(prior_draws(before, count, rng)):
        progress(f"calibration: {k + 1} of {count}")
        replicas.append(_replica(before, truth, noise, k))
    return _ranks(replicas)


def _replica(before: Task, truth: FloatArray, noise: float, seed: int) -> Replica:
    u, model = before.unknowns, before.model.with_values(before.unknowns.values(truth))
    clean = recorded(model, f_H=u.start(truth, 0)["f_H"])
    task = task_for(noisy(clean, noise, np.random.default_rng(seed)), centred_model(), WIDTHS)
    with one_thread():
        chains = chains_of(task.density, chains=1, draws=DRAWS, tune=TUNE, seed=seed, cores=1)
    draws = np.array([task.density.theta(x) for x in chains.u[0]])
    below = (draws < truth)[:, np.isfinite(u.prior)]
    apart = np.abs(below.mean(axis=0) - 0.5)
    inside = tuple(tuple(bool(a <= 0.5 * level) for level in LEVELS) for a in apart)
    ranks = tuple(below[::THIN].sum(axis=0).tolist())
    return Replica(ranks, inside, chains.divergences)


def _ranks(replicas: Sequence[Replica]) -> TitledTable:
    """Return the chi-square test of the ranks, and the intervals, by parameter."""
    possible, expected, rows = DRAWS // THIN + 1, len(replicas) / BINS, []
    ranks = np.array([r.ranks for r in replicas])
    inside = 100.0 * np.array([r.inside for r in replicas]).mean(axis=0)  # (unknowns, levels)
    heads = [f"in the {100 * level:.0f} % interval" for level in LEVELS]
    for k, name in enumerate((*WIDTHS, "f_H at the start")):
        counts = np.bincount(ranks[:, k] * BINS // possible, minlength=BINS)
        power = float(np.sum((counts - expected) ** 2) / expected)
        shares = {h: f"{share:.0f} %" for h, share in zip(heads, inside[k], strict=True)}
        p = f"{chi2.sf(power, BINS - 1):.2f}"
        rows.append({"unknown": name, "p of uniform ranks": p, **shares})
    every = {h: f"{share:.1f} %" for h, share in zip(heads, inside.mean(axis=0), strict=True)}
    rows.append({"unknown": "all", "p of uniform ranks": "", **every})
    return TitledTable(
        f"Ranks of the truth among {possible - 1} draws, {len(replicas)} replicas; its intervals",
        rows,
        f"{sum(r.divergences for r in replicas)} of {len(replicas) * DRAWS} transitions diverged.",
    )
