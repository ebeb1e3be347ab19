"""Posteriors: a normal case whose posterior is known, exact gradients, a record whose truth is."""

import json
from functools import cache
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from typer.testing import CliRunner

import psa_casadi as psa
from build_scripts.schemas import schema_texts
from psa_casadi.cli.app import app
from psa_casadi.common.interruption import interruptible_work, raise_if_stopped
from psa_casadi.common.units import FloatArray
from psa_casadi.posterior import chains
from psa_casadi.posterior.chains import chains_of
from psa_casadi.posterior.task import Block, Density, Task, Within, task_of
from tests.model.stack_models import stack

FREE = ("k_L", "A", "n", "tau")
TRUTH = stack("P-885.51", tau=1e-3)


@cache
def record() -> psa.Record:
    time: FloatArray = np.linspace(0.0, 0.299, 300)
    voltage = 60.0 * (1.0 - np.cos(12.0 * np.pi * time)) * np.where(time > 1 / 6, 1.0, 0.5)
    x = psa.simulate(TRUTH, time, voltage).displacement
    y = x + 1e-3 * np.ptp(x) * np.random.default_rng(5).standard_normal(len(x))
    return psa.Record(name="loops", time=time, voltage=voltage, displacement=y)


@cache
def task() -> Task:
    return task_of(TRUTH, [record()], free=FREE)


def test_a_normal_posterior_is_found() -> None:
    """A straight line with known noise and normal priors: the posterior is normal, by algebra."""
    rng = np.random.default_rng(2)
    slopes, y = rng.standard_normal((30, 3)), rng.standard_normal(30)
    prior = np.array([0.5, 1.0, 2.0])

    def evaluate(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows = np.concatenate([slopes @ theta - y, theta / prior])
        return rows, np.vstack([slopes, np.diag(1.0 / prior)])

    free = np.full(3, np.inf)
    density = Density(evaluate, (), Within(-free, free), np.zeros(3), 0.3 * np.eye(3))
    result = chains_of(density, chains=2, draws=1000, tune=300, seed=3)
    theta = np.array([density.theta(u) for u in result.u.reshape(-1, 3)])
    covariance = np.linalg.inv(slopes.T @ slopes + np.diag(prior**-2.0))
    mean, spread = covariance @ slopes.T @ y, np.sqrt(np.diag(covariance))
    # five standard errors of that many independent draws; the chains have no fewer
    np.testing.assert_allclose((theta.mean(axis=0) - mean) / spread, 0.0, atol=5.0 / 1000**0.5)
    np.testing.assert_allclose(theta.std(axis=0) / spread, 1.0, atol=5.0 / 2000**0.5)
    assert result.divergences == 0


def test_an_interrupt_ends_the_chains(capfd: pytest.CaptureFixture[str]) -> None:
    """The density raises it in the sampler's threads, as a simulation does; nothing panics."""

    class Interrupted:
        size, calls = 2, 0

        def __call__(self, u: FloatArray) -> tuple[float, FloatArray]:
            self.calls += 1
            if self.calls == 300:
                work.stop()
            raise_if_stopped()
            return -0.5 * float(u @ u), -u

    with interruptible_work() as work, pytest.raises(KeyboardInterrupt):
        chains_of(Interrupted(), chains=2, draws=10**6, seed=1, cores=2)
    assert "panic" not in capfd.readouterr().err


def test_an_unknown_level_gives_students_t() -> None:
    """The mean of n samples of unknown noise: Student's t with n - 1 degrees of freedom."""
    y = np.array([1.0, 2.0, 4.0, 5.0, 9.0])
    free = np.full(1, np.inf)
    density = Density(
        lambda t: (t[0] - y, np.ones((5, 1))), (Block(slice(0, 5), 5.0),),
        Within(-free, free), np.zeros(1), np.eye(1),
    )  # fmt: skip
    at = np.linspace(-3.0, 11.0, 8)
    result = np.array([density(np.array([u]))[0] for u in at])
    t = (at - y.mean()) / np.sqrt(y.var(ddof=1) / 5.0)
    expected = -2.5 * np.log1p(t**2 / 4.0)
    np.testing.assert_allclose(result - result[0], expected - expected[0], rtol=1e-12)


def test_bounds_keep_the_density() -> None:
    """The density of z integrates to that of theta, with one bound, two, and none."""
    within = Within(np.array([0.0, -1.0, -np.inf, -np.inf]), np.array([np.inf, 3.0, 2.0, np.inf]))
    theta = np.array([0.7, 2.5, -1.5, 4.0])
    z = within.z(theta)
    back, slope, bend = within.theta(z)
    np.testing.assert_allclose(back, theta, rtol=1e-12)
    h = 1e-5
    up, down = within.theta(z + h), within.theta(z - h)
    np.testing.assert_allclose(slope, (up[0] - down[0]) / (2 * h), rtol=1e-8)
    numeric = (np.log(np.abs(up[1])) - np.log(np.abs(down[1]))) / (2 * h)
    np.testing.assert_allclose(bend, numeric, atol=1e-8)


def test_the_gradient_is_that_of_the_density() -> None:
    density = task().density
    u = 0.5 * np.random.default_rng(1).standard_normal(density.size)
    h = 1e-3
    numeric = [(density(u + h * e)[0] - density(u - h * e)[0]) / (2 * h) for e in np.eye(len(u))]
    np.testing.assert_allclose(density(u)[1], numeric, atol=1e-4)
    assert density(np.full(density.size, 1e6))[0] == -np.inf


@pytest.mark.slow
def test_the_command_finds_the_truth(tmp_path: Path) -> None:
    arviz = pytest.importorskip("arviz")
    model, csv = tmp_path / "model.json", tmp_path / "record.csv"
    psa.save_model(TRUTH, model)
    psa.write_record(csv, record())
    out, figures, picture = (tmp_path / n for n in ("p.nc", "p.json", "p.png"))
    words = [
        *("sample", model, csv, "-o", out, "--json", figures, "--figure", picture),
        *("--chains", 2, "--draws", 250, "--tune", 200, "--seed", 1),
        *(w for n in FREE for w in ("--free", n)),
    ]
    ended = CliRunner().invoke(app, [str(w) for w in words])
    assert ended.exit_code == 0, ended.output
    assert "94 % interval" in ended.output
    assert picture.read_bytes()[:4] == b"\x89PNG"
    content = json.loads(figures.read_text("utf-8"))
    jsonschema.Draft202012Validator(json.loads(schema_texts()["posterior.schema.json"])).validate(
        content
    )
    fitted = task().unknowns.values(task().fit.theta)
    for name, f in content["parameters"].items():
        assert abs(f["mean"] - TRUTH.values[name]) < 4.0 * f["sd"], name
        # the posterior is nearly normal: its mean is the fit's, but for the chains' error
        assert abs(f["mean"] - fitted[name]) < 5.0 * f["mc_error"] + 0.1 * f["sd"], name
    tree = arviz.from_netcdf(out)
    assert {"posterior", "sample_stats", "prior", "prior_predictive", "posterior_predictive"} < set(
        tree.groups()
    )
    assert tree.posterior.tau.attrs["units"] == "s"
    displayed = tree.posterior_predictive.displacement.to_numpy()[0]
    low, high = np.quantile(displayed, [0.03, 0.97], axis=0)
    y = tree.observed_data.displacement.to_numpy()
    assert 0.88 < np.mean((y > low) & (y < high)) < 0.98


def test_what_cannot_be_sampled_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(psa.InputError, match="'tau' was given, which is not sampled"):
        psa.sample(TRUTH, record(), free=["k_L"], prior={"tau": 1.0})

    def absent(name: str) -> None:
        raise ModuleNotFoundError(name, name=name)

    monkeypatch.setattr(chains, "import_module", absent)
    with pytest.raises(psa.InputError, match=r"pip install 'psa-casadi\[sample\]'"):
        psa.sample(TRUTH, record())
