"""Posteriors: are they calibrated, and does evidence agree with bridge sampling.

Simulation-based calibration (Talts and others 2018): parameters are drawn from the prior, a record
is simulated with them and noise is added; the rank of the truth among the posterior's draws is then
uniform, and intervals of p % hold the truth in p %.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.special import logsumexp
from scipy.stats import binom, chi2, kstest, multivariate_normal, norm

import psa_casadi as psa
from psa_casadi.effects import EFFECTS
from psa_casadi.posterior.chains import chains_of, prior_draws
from psa_casadi.posterior.task import Block, Density, Task, task_of
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.side_by_side import one_thread
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

FloatArray = npt.NDArray[np.float64]

#: Effects that are tried, and gains in ordinary changes that the record has.
CASES = (
    ("field_dependent_gain", 0.0),
    ("field_dependent_gain", 0.03),
    ("sensor_nonlinearity", 0.0),
    ("sensor_nonlinearity", 0.03),
    ("saturation_of_strain", 0.03),
)
FREE = ("k_L", "A", "n", "tau")
EVIDENCE_NOISE = 1e-3
LONG, LONG_TUNE, CHAINS = 1000, 500, 2
#: Rounds of the bridge at most, and the change of ln Z at which they end.
_ROUNDS, _CLOSE = 200, 1e-8


@dataclass(frozen=True)
class Evidence:
    """ln Z of one model by bridge sampling, Laplace's method and Schwarz's criterion."""

    bridge: float
    error: float
    laplace: float
    schwarz: float


def evidence_table(progress: Progress, quick: bool) -> TitledTable:
    """Return ln Bayes factors of an effect over the base, by three ways, of every case."""
    rows = []
    for name, size in CASES[: 2 if quick else None]:
        progress(f"evidence: {name}, {size:g} of an ordinary size")
        record, base, wider = _case(name, size)
        one, other = (evidence(_task(m, record)) for m in (base, wider))
        error = float(np.hypot(one.error, other.error))
        rows.append(
            (
                name,
                f"{size:g}",
                f"{other.bridge - one.bridge:.2f} ± {error:.2f}",
                f"{other.laplace - one.laplace:.2f}",
                f"{other.schwarz - one.schwarz:.2f}",
            )
        )
    head = ("effect", "gain put in", "bridge sampling", "Laplace", "Schwarz")
    return TitledTable(
        "ln Bayes factor of an effect over the base",
        Table(head, tuple(rows)),
        "Gains in ordinary changes. Schwarz: -n/2 ln S - k/2 ln n, which knows no prior.",
    )


def evidence(task: Task) -> Evidence:
    """Return ln Z of a task up to the constant that models of the same record share."""
    density = _of_all_samples(task)
    with one_thread():
        found = chains_of(density, chains=CHAINS, draws=LONG, tune=LONG_TUNE, seed=1)
    flat = found.u.reshape(-1, density.size)
    # of a density in u: the Jacobian of z, and what normal priors are short of
    kept = np.isfinite(task.unknowns.prior)
    known = task.unknowns.prior[kept]
    low, high = (edge[kept] / known for edge in task.unknowns.bounds())
    constant = float(np.linalg.slogdet(density.factor)[1])
    constant -= float(np.sum(np.log(known * np.sqrt(2.0 * np.pi))))
    constant -= float(np.sum(np.log(norm.cdf(high) - norm.cdf(low))))  # cut at the bounds
    counts = sum(b.count for b in density.blocks)
    level = counts * float(np.log(task.levels[0]))  # residuals are weighted by a fit's own
    constant -= level
    bridge, error = bridge_sampled(density, flat)
    peak, _ = density(np.zeros(density.size))
    laplace = peak + 0.5 * density.size * np.log(2.0 * np.pi)
    found_rows = density.evaluate(task.theta)
    assert found_rows is not None
    fitted = sum(0.5 * b.count * np.log(_power(found_rows[0][b.rows])) for b in density.blocks)
    schwarz = -fitted - level - 0.5 * len(task.unknowns.names) * np.log(counts)
    return Evidence(bridge + constant, error, laplace + constant, schwarz)


def _of_all_samples(task: Task) -> Density:
    """Return the density with every sample counted, as two models of one record need it."""
    rows = [b.rows for b in task.density.blocks]
    return replace(task.density, blocks=tuple(Block(r, float(r.stop - r.start)) for r in rows))


def _power(values: FloatArray) -> float:
    return float(values @ values)


def bridge_sampled(density: Density, draws: FloatArray, seed: int = 0) -> tuple[float, float]:
    """Return ln of the integral of a density over u, and its standard error.

    Meng and Wong's optimal bridge (Statistica Sinica 6, 1996) to a normal distribution: one half of
    the draws gives its moments, the other half goes over the bridge.
    """
    half = len(draws) // 2
    moments, crossing = draws[::2][:half], draws[1::2][:half]
    normal = multivariate_normal(moments.mean(axis=0), np.cov(moments.T))
    rng = np.random.default_rng(seed)
    proposed = normal.rvs(len(crossing), random_state=rng)
    own = np.array([density(u)[0] for u in crossing]) - normal.logpdf(crossing)
    other = np.array([density(np.asarray(u))[0] for u in proposed]) - normal.logpdf(proposed)
    value = float(np.median(own))
    for _ in range(_ROUNDS):
        above = other - np.logaddexp(other, value)
        below = -np.logaddexp(own, value)
        new = float(logsumexp(above) - logsumexp(below))
        if abs(new - value) < _CLOSE:
            break
        value = new
    spread = _relative(np.exp(other - np.logaddexp(other, value)))
    spread += _relative(np.exp(value - np.logaddexp(own, value)))
    return value, float(np.sqrt(spread))


def _relative(terms: FloatArray) -> float:
    """Return the relative variance of a mean."""
    return float(np.var(terms) / np.mean(terms) ** 2 / len(terms))


def _case(name: str, size: float) -> tuple[psa.Record, psa.Model, psa.Model]:
    """Return a record of the stack with an effect, and the models without and with it."""
    base = psa.stack_model("P-885.51").with_values({"tau": 1e-3})
    effect = EFFECTS[name]
    gain = str(effect.gain)
    wider = base.with_effect(effect)
    ordinary = wider.parameter(gain).typical({**wider.values, gain: 0.0})
    true = wider.with_values({gain: size * ordinary})
    time: FloatArray = np.linspace(0.0, 0.399, 400)
    applied = 60.0 * (1.0 - np.cos(10.0 * np.pi * time)) * np.where(time > 0.2, 1.0, 0.5)
    x = psa.simulate(true, time, applied, rtol=1e-8).displacement
    y = x + EVIDENCE_NOISE * np.ptp(x) * np.random.default_rng(7).standard_normal(len(x))
    record = psa.Record(name="record", time=time, voltage=applied, displacement=y)
    return record, base, true if size else wider


def _task(model: psa.Model, record: psa.Record) -> Task:
    gains = tuple(str(c.gain) for c in model.effects)
    centre = {n: model.values[n] for n in FREE} | dict.fromkeys(gains, 0.0)
    widths: dict[str, float] = {"k_L": 0.2, "A": 0.2, "n": 0.2, "tau": 0.4}
    widths |= dict.fromkeys(gains, 1.0)
    return task_of(model, [record], free=(*FREE, *gains), prior=centre, widths=widths)


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
