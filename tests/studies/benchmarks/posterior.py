"""Posteriors: are they calibrated, and does evidence agree with bridge sampling.

Simulation-based calibration (Talts and others 2018): parameters are drawn from the prior, a record
is simulated with them and noise is added; the rank of the truth among the posterior's draws is then
uniform, and intervals of p % hold the truth in p %.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp
from scipy.stats import binom, chi2, kstest, multivariate_normal, norm

import psa_casadi as psa
from psa_casadi.posterior.chains import chains_of, prior_draws
from psa_casadi.posterior.task import Block, Density, Task, task_of
from psa_casadi.simulation.side_by_side import one_thread
from psa_casadi.units import FloatArray
from tests.studies.benchmarks.records import noisy
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

#: Effects that are tried, and gains in ordinary changes that the record has.
CASES = (
    ("field_dependent_gain", 0.0),
    ("field_dependent_gain", 0.03),
    ("sensor_nonlinearity", 0.0),
    ("sensor_nonlinearity", 0.03),
    ("saturation_of_strain", 0.03),
)
#: Widths of the priors of what is sampled beside a gain.
FREE = {"k_L": 0.2, "A": 0.2, "n": 0.2, "tau": 0.4}
LONG, LONG_TUNE, CHAINS = 1000, 500, 2
#: Rounds of the bridge at most, and the change of ln Z at which they end.
_ROUNDS, _CLOSE = 200, 1e-8


def evidence_table(progress: Progress, quick: bool) -> TitledTable:
    """Return ln Bayes factors of an effect over the base, by three ways, of every case."""
    rows = []
    for name, size in CASES[: 2 if quick else None]:
        progress(f"evidence: {name}, {size:g} of an ordinary size")
        record, *models = _case(name, size)
        (one, error), (other, further) = (evidence(task_for(record, m, FREE)) for m in models)
        over = {way: f"{other[way] - one[way]:.2f}" for way in one}
        over["bridge sampling"] += f" ± {np.hypot(error, further):.2f}"
        rows.append({"effect": name, "gain put in": f"{size:g}", **over})
    note = "Gains in ordinary changes. Schwarz: -n/2 ln S - k/2 ln n, which knows no prior."
    return TitledTable("ln Bayes factor of an effect over the base", rows, note)


def evidence(task: Task) -> tuple[dict[str, float], float]:
    """Return ln Z of a task by three ways, and the standard error of bridge sampling.

    Up to the constant that models of the same record share. Every sample counts, as two models of
    one record need it.
    """
    blocks = tuple(Block(b.rows, float(b.rows.stop - b.rows.start)) for b in task.density.blocks)
    density = replace(task.density, blocks=blocks)
    with one_thread():
        chains = chains_of(density, chains=CHAINS, draws=LONG, tune=LONG_TUNE, seed=1)
    # of a density in u: the Jacobian of z, and what normal priors are short of
    kept = np.isfinite(task.unknowns.prior)
    known = task.unknowns.prior[kept]
    low, high = (edge[kept] / known for edge in task.unknowns.bounds())
    counts = sum(b.count for b in blocks)
    level = counts * float(
        np.log(task.density.blocks[0].level)
    )  # residuals are weighted by a fit's own
    constant = float(np.linalg.slogdet(density.factor)[1]) - level
    constant -= float(np.sum(np.log(known * np.sqrt(2.0 * np.pi))))
    constant -= float(np.sum(np.log(norm.cdf(high) - norm.cdf(low))))  # cut at the bounds
    bridge, error = bridge_sampled(density, chains.u.reshape(-1, density.size))
    peak, _ = density(np.zeros(density.size))
    rows = density.evaluate(task.theta)
    assert rows is not None
    fitted = sum(0.5 * b.count * np.log(float(np.sum(rows[0][b.rows] ** 2))) for b in blocks)
    return {
        "bridge sampling": bridge + constant,
        "Laplace": peak + 0.5 * density.size * np.log(2.0 * np.pi) + constant,
        "Schwarz": -fitted - level - 0.5 * len(task.unknowns.names) * np.log(counts),
    }, error


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
    item = np.array([density(u)[0] for u in crossing]) - normal.logpdf(crossing)
    other = np.array([density(np.asarray(u))[0] for u in proposed]) - normal.logpdf(proposed)
    value = float(np.median(item))
    for _ in range(_ROUNDS):
        above = other - np.logaddexp(other, value)
        below = -np.logaddexp(item, value)
        new = float(logsumexp(above) - logsumexp(below))
        if abs(new - value) < _CLOSE:
            break
        value = new
    terms = (np.exp(other - np.logaddexp(other, value)), np.exp(value - np.logaddexp(item, value)))
    spread = sum(float(np.var(x) / np.mean(x) ** 2 / len(x)) for x in terms)  # of both means
    return value, float(np.sqrt(spread))


def _case(name: str, size: float) -> tuple[psa.Record, psa.Model, psa.Model]:
    """Return a record of the stack with an effect, and the models without and with it."""
    base, effect = centred_model(), psa.EFFECTS[name]
    gain = str(effect.gain)
    wider = base.with_effect(effect)
    ordinary = wider.parameter(gain).typical({**wider.values, gain: 0.0})
    true = wider.with_values({gain: size * ordinary})
    clean = recorded(true)
    record = noisy(clean, NOISE * clean.range_m, np.random.default_rng(7))
    return record, base, true if size else wider


STACK, NOISE = "P-885.51", 1e-3
#: Centres and widths of the priors: k_L and tau in ln units, others in ordinary changes.
CENTRES = {"tau": 1e-3}
WIDTHS = {"k_L": 0.2, "A": 0.2, "delta": 0.5, "n": 0.2, "tau": 0.4}
REPLICAS, QUICK_REPLICAS = 100, 8
DRAWS, TUNE, THIN = 396, 300, 4
BINS = 10
LEVELS = (0.5, 0.8, 0.94)


@dataclass(frozen=True)
class Replica:
    """One draw of the prior: rank of the truth for every unknown, in which intervals it lies."""

    ranks: tuple[int, ...]
    inside: tuple[tuple[bool, ...], ...]
    divergences: int
    inflation: float


def run(progress: Progress, quick: bool, size: int | None = None) -> Outcome:
    """Measure calibration and evidence; with a size the calibration of so many replicas alone."""
    calibration = _calibration(progress, size or (QUICK_REPLICAS if quick else REPLICAS))
    return Outcome([calibration] if size else [calibration, evidence_table(progress, quick)])


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
    """Return the posterior of the sampled parameters, from where a user would begin.

    Gains of effects are sampled too, from 0.
    """
    gains = tuple(str(c.gain) for c in model.effects)
    centre = {n: model.values[n] for n in widths} | dict.fromkeys(gains, 0.0)
    wide = {**widths, **dict.fromkeys(gains, 1.0)}
    return task_of(model, [record], free=tuple(wide), prior=centre, widths=wide)


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
    return Replica(ranks, inside, chains.divergences, task.density.blocks[0].correlation_time)


def _ranks(found: Sequence[Replica]) -> TitledTable:
    """Return chi-square and Kolmogorov's test of the ranks, and the intervals, by parameter."""
    possible, expected, rows = DRAWS // THIN + 1, len(found) / BINS, []
    ranks = np.array([r.ranks for r in found])
    inside = 100.0 * np.array([r.inside for r in found]).mean(axis=0)  # (unknowns, levels)
    heads = [f"in the {100 * level:.0f} % interval" for level in LEVELS]
    for k, name in enumerate((*WIDTHS, "f_H at the start")):
        counts = np.bincount(ranks[:, k] * BINS // possible, minlength=BINS)
        power = float(np.sum((counts - expected) ** 2) / expected)
        rows.append({
            "unknown": name, f"in {BINS} bins": " ".join(map(str, counts)),
            "chi-square": f"{power:.1f}", "p": f"{chi2.sf(power, BINS - 1):.2f}",
            "p (Kolmogorov)": f"{kstest((ranks[:, k] + 0.5) / possible, 'uniform').pvalue:.2f}",
            **{h: f"{share:.0f} %" for h, share in zip(heads, inside[k], strict=True)},
        })  # fmt: skip
    every = {h: f"{share:.1f} %" for h, share in zip(heads, inside.mean(axis=0), strict=True)}
    rows.append(dict.fromkeys(rows[0], "") | {"unknown": "all", **every})
    gain = float(np.median([r.inflation for r in found]))
    bands = [np.array(binom.interval(0.95, len(found), q)) / len(found) for q in LEVELS]
    ends = ", ".join(f"{100 * a:.0f} to {100 * b:.0f} %" for a, b in bands)
    return TitledTable(
        f"Ranks of the truth among {possible - 1} draws, {len(found)} replicas; its intervals",
        rows,
        f"{sum(r.divergences for r in found)} of {len(found) * DRAWS} transitions diverged;"
        f" {gain:.2f} samples count as one (median). Of one unknown, 95 % of such tables have"
        f" {ends} of the truths in the intervals.",
    )
