"""Evidence of effects: Schwarz's approximation beside bridge sampling on the same density."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

import psa_casadi as psa
from psa_casadi.effects import EFFECTS
from psa_casadi.posterior.chains import chains_of
from psa_casadi.posterior.task import Block, Density, Task, task_of
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.side_by_side import one_thread
from tests.studies.benchmarks.table import Progress, TitledTable

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
NOISE = 1e-3
DRAWS, TUNE, CHAINS = 1000, 500, 2
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
        found = chains_of(density, chains=CHAINS, draws=DRAWS, tune=TUNE, seed=1)
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
    y = x + NOISE * np.ptp(x) * np.random.default_rng(7).standard_normal(len(x))
    record = psa.Record(name="record", time=time, voltage=applied, displacement=y)
    return record, base, true if size else wider


def _task(model: psa.Model, record: psa.Record) -> Task:
    gains = tuple(str(c.gain) for c in model.effects)
    centre = {n: model.values[n] for n in FREE} | dict.fromkeys(gains, 0.0)
    widths: dict[str, float] = {"k_L": 0.2, "A": 0.2, "n": 0.2, "tau": 0.4}
    widths |= dict.fromkeys(gains, 1.0)
    return task_of(model, [record], free=(*FREE, *gains), prior=centre, widths=widths)
