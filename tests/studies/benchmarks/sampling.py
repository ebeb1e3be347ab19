"""Effective samples per second against the published way, a differential equation in PyMC.

`pymc.ode.DifferentialEquation` integrates the equation and its sensitivities by LSODA and calls the
right hand side in Python. Both ways sample one density (the same record, priors and coordinates,
whitened by the fit), so that only the solution and its gradient differ. What PyMC gets is easier:
the record is slow, so that of the stack's seven states the hysteresis force alone is integrated.
"""

import time
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.posterior.chains import chains_of, sampler_and_arviz
from psa_casadi.posterior.task import Task
from psa_casadi.report.words.phrases import number
from psa_casadi.simulation.side_by_side import one_thread
from tests.studies.benchmarks.posterior import task_for
from tests.studies.benchmarks.records import noisy
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

STACK, NOISE, SAMPLES = "P-885.51", 3e-3, 200
#: Parameters that are sampled, with the widths of their priors.
WIDTHS = {"k_L": 0.2, "A": 0.2, "delta": 0.5, "n": 0.2}
#: Legs of the voltage, each so long [s]: up and down to these peaks [V].
LEG, PEAKS = 10.0, (60.0, 120.0)
#: Draws of both ways after those that tune, in one chain; draws of PyMC, and the quick ones.
OURS, TUNE, THEIRS, QUICK = 4000, 500, 400, 100
SEED, ACCEPT = 3, 0.9


@dataclass(frozen=True, eq=False)
class Drawn:
    """Draws (n, size) of theta, and their processor time [s] with tuning."""

    way: str
    theta: FloatArray
    seconds: float

    @property
    def effective(self) -> float:
        """The smallest bulk effective sample size of all unknowns."""
        return min(_size(t, "bulk") for t in self.theta.T)


def _size(draws: FloatArray, method: str) -> float:
    """Return the effective sample size of one chain (n,)."""
    return float(sampler_and_arviz()[1].ess(draws[None, :], method=method))


def run(progress: Progress, quick: bool, size: int | None = None) -> Outcome:
    """Return both ways on one record for `size` draws of PyMC, and whether they agree."""
    if find_spec("pymc") is None:
        missing = "PyMC is not installed: `pip install --group sampling`."
        return Outcome((TitledTable("Compared with PyMC", (), missing),))
    count = size or (QUICK if quick else THEIRS)
    task = task_for(record(), stack(), WIDTHS)
    progress("psa.sample's way")
    ours = drawn_by_psa(task, OURS, TUNE)
    progress("PyMC")
    theirs = drawn_by_pymc(task, count, count // 2)
    return Outcome((speed([ours, theirs]), _agreement(task, ours, theirs)))


def stack() -> psa.Model:
    """Return the stack with a lag too short to be visible at the record's rates."""
    return psa.stack_model(STACK).with_values({"tau": 1e-5})


def record() -> psa.Record:
    """Return a simulated record of two slow triangles of the voltage, with noise."""
    times = np.arange(SAMPLES, dtype=np.float64) * (2 * len(PEAKS) * LEG / SAMPLES)
    corners = np.concatenate([[0.0], *([p, 0.0] for p in PEAKS)])
    applied = np.interp(times, LEG * np.arange(len(corners)), corners)
    x = psa.simulate(stack(), times, applied, rtol=1e-8).displacement
    clean = psa.Record(name="triangles", time=times, voltage=applied, displacement=x)
    return noisy(clean, NOISE * clean.range_m, np.random.default_rng(SEED))


def drawn_by_psa(task: Task, draws: int, tune: int) -> Drawn:
    """Return draws by the sampler of `psa.sample`, in one chain."""
    began = time.process_time()
    with one_thread():
        chains = chains_of(task.density, chains=1, draws=draws, tune=tune, seed=SEED, cores=1)
    spent = time.process_time() - began
    theta = np.array([task.density.theta(u) for u in chains.u[0]])
    return Drawn("psa.sample", theta, spent)


def drawn_by_pymc(task: Task, draws: int, tune: int) -> Drawn:
    """Return draws by PyMC's sampler with PyMC's solution of the equation, in one chain."""
    pm, pt = import_module("pymc"), import_module("pytensor.tensor")
    factor = np.linalg.cholesky(task.covariance)
    with pm.Model():
        u = pm.Flat("u", shape=len(task.fit.theta), initval=np.zeros(len(task.fit.theta)))
        theta = pt.as_tensor(task.fit.theta) + pt.dot(pt.as_tensor(factor), u)
        pm.Potential("density", log_density(task, theta, pm, pt))
        step = pm.NUTS(target_accept=ACCEPT)  # compiles
        began = time.process_time()
        result = pm.sample(
            draws=draws, tune=tune, chains=1, cores=1, step=step, random_seed=SEED,
            progressbar=False, compute_convergence_checks=False,
        )  # fmt: skip
        spent = time.process_time() - began
    moved = result.posterior["u"].to_numpy()[0]
    return Drawn("PyMC, DifferentialEquation", task.fit.theta + moved @ factor.T, spent)


def log_density(task: Task, theta: Any, pm: Any, pt: Any) -> Any:
    """Return `psa_casadi.posterior.task`'s ln p of theta, with PyMC's solution.

    x = C (k_L u + f_H) + x_0 at rest of the mechanics, with C = 1/k_P + 1/k_B; f_H by its equation.
    """
    values, unknowns = task.model.values, task.unknowns
    names = unknowns.names
    drawn_values = {
        n: float(unknowns.reference[k]) * (pt.exp(theta[k]) if unknowns.log[k] else 1.0)
        + (0.0 if unknowns.log[k] else theta[k] * float(unknowns.scale[k]))
        for k, n in enumerate(names)
    }
    first = unknowns.first(0)
    (scale,) = unknowns.start_scale[0]
    (experiment,) = task.experiments
    inputs = experiment.record
    solve = import_module("pymc.ode").DifferentialEquation(
        func=lambda y, t, p: [hysteresis_rate(y[0], t, p, values, pt)],
        times=inputs.time[1:], n_states=1, n_theta=3, t0=float(inputs.time[0]),
    )  # fmt: skip
    start = theta[first] * float(scale)
    force = solve(y0=[start], theta=[drawn_values["A"], drawn_values["delta"], drawn_values["n"]])[
        :, 0
    ]
    whole = pt.concatenate([pt.stack([start]), force])
    compliance = 1.0 / values["k_P"] + 1.0 / values["k_B"]
    predicted = compliance * (drawn_values["k_L"] * pt.as_tensor(inputs.voltage) + whole)
    errors = (
        predicted + theta[first + 1] * unknowns.offset_scale - pt.as_tensor(inputs.displacement)
    )
    (block,) = task.density.blocks
    known = np.isfinite(unknowns.prior)
    prior = pt.sum((theta[known] / pt.as_tensor(unknowns.prior[known])) ** 2)
    return -0.5 * block.count * pt.log(pt.sum(errors**2)) - 0.5 * prior


def hysteresis_rate(force: Any, t: Any, p: Any, values: Any, pt: Any) -> Any:
    """Return the rate [N/s] of the Bouc-Wen force along the triangles, with p = A, delta, n."""
    legs = pt.floor(t / LEG)
    up = pt.eq(pt.mod(legs, 2.0), 0.0)
    peak = pt.switch(pt.lt(legs, 2.0), PEAKS[0], PEAKS[1])
    part = t / LEG - legs
    voltage = peak * pt.switch(up, part, 1.0 - part)
    rate = pt.switch(up, peak, -peak) / LEG
    size = pt.sqrt(rate**2 + values["hold_rate"] ** 2)
    over = force / values["h_ref"]
    power = over**2 + 1e-24
    a, delta, n = p[0], p[1], p[2]
    return (
        a * rate
        - values["beta"] * rate**2 / size * over * power ** ((n - 1.0) / 2.0)
        - values["gamma"] * rate * power ** (n / 2.0)
        + delta * voltage * rate / size
    )


def speed(drawn: list[Drawn]) -> TitledTable:
    """Return effective samples and processor time of each way, and their ratio."""
    sizes = [f.effective for f in drawn]
    each = [size / f.seconds for size, f in zip(sizes, drawn, strict=True)]
    rows = [
        {"way": f.way, "draws": len(f.theta), "smallest bulk ESS": f"{size:.0f}",
         "processor [s]": number(f.seconds), "ESS per second": number(rate)}
        for f, size, rate in zip(drawn, sizes, each, strict=True)
    ]  # fmt: skip
    return TitledTable(
        f"One posterior of {drawn[0].theta.shape[1]} unknowns and {SAMPLES} samples, two ways",
        rows,
        f"psa.sample has {each[0] / each[1]:.0f} times the effective samples per second. Processor"
        " times hold tuning and drawing, and no compiling; one chain each.",
    )


def _agreement(task: Task, ours: Drawn, theirs: Drawn) -> TitledTable:
    """Return the differences of both posteriors' means over their Monte Carlo errors."""
    names = (*task.unknowns.names, "f_H at the start", "offset")
    rows = []
    for name, a, b in zip(names, ours.theta.T, theirs.theta.T, strict=True):
        error = np.hypot(*(np.std(x) / _size(x, "mean") ** 0.5 for x in (a, b)))
        gap = np.mean(b) - np.mean(a)
        rows.append({
            "unknown": name, "difference of means [sd]": f"{gap / np.std(a):.2f}",
            "over its Monte Carlo error": f"{gap / error:.1f}",
            "ratio of sd": f"{np.std(b) / np.std(a):.2f}",
        })  # fmt: skip
    return TitledTable("Do both posteriors agree?", rows)
