"""Posteriors: parameter sets of a covariance, samples against known truths, models of users."""

import json
from dataclasses import replace
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
from psa_casadi.export.common.parameter_sets import posterior_sets
from psa_casadi.model.compose import Model
from psa_casadi.model.evidence import Covariance
from psa_casadi.model.stacks import stack_model
from psa_casadi.posterior import chains
from psa_casadi.posterior.chains import chains_of
from psa_casadi.posterior.task import Block, Density, Task, Within, own_task_of, task_of
from tests.any_model import own_plants as plants
from tests.any_model.own_models import motor
from tests.contract.helpers import done, refused
from tests.model.evidence_models import evident_model
from tests.model.stack_models import stack
from tests.report.html_page import Page

NAMES = ("k_L", "tau", "A")


def spread(errors: tuple[float, ...], correlation: float, names: tuple[str, ...] = NAMES) -> Model:
    """Return a model whose values have these relative standard errors, the first two correlated."""
    model = evident_model()
    assert model.evidence is not None
    sizes = np.array([model.values[n] for n in names]) * errors
    matrix = np.outer(sizes, sizes) * np.eye(len(names))
    matrix[0, 1] = matrix[1, 0] = correlation * sizes[0] * sizes[1]
    rows = tuple(tuple(row) for row in matrix.tolist())
    return replace(model, evidence=replace(model.evidence, covariance=Covariance(names, rows)))


def coordinates(model: Model, sets: dict[str, dict[str, float]], chosen: str) -> np.ndarray:
    """Return the chosen sets (n, k), as relative changes from the mean; logarithms where these are
    spread."""
    names = list(sets["mean"])
    mean = np.array(list(sets["mean"].values()))
    rows = np.array([list(v.values()) for n, v in sets.items() if n.startswith(chosen)])
    log = [model.parameter(n).log for n in names]
    return np.array(np.where(log, np.log(rows / mean), rows / mean - 1.0))


def sets_of(model: Model, samples: int) -> dict[str, dict[str, float]]:
    return {n: dict(v) for n, v in posterior_sets(model, samples).items()}


def test_sigma_points_have_the_covariance() -> None:
    model = spread((0.02, 0.05, 0.03), 0.7)
    sets = sets_of(model, 1)
    assert sets["mean"] == {n: model.values[n] for n in NAMES}
    plus, minus = (
        coordinates(
            model, {k: v for k, v in sets.items() if k == "mean" or k.endswith(side)}, "sig"
        )
        for side in ("plus", "minus")
    )
    assert len(plus) == len(minus) == 3
    half = 0.5 * (plus - minus)
    expected = np.diag([0.02, 0.05, 0.03]) ** 2
    expected[0, 1] = expected[1, 0] = 0.7 * 0.02 * 0.05
    np.testing.assert_allclose(half.T @ half, expected, atol=1e-7)


def test_samples_have_the_covariance() -> None:
    model = spread((0.02, 0.05, 0.03), 0.7)
    rows = coordinates(model, sets_of(model, 900), "sample")
    assert len(rows) == 900
    np.testing.assert_allclose(np.std(rows, axis=0), [0.02, 0.05, 0.03], rtol=0.08)
    assert abs(np.corrcoef(rows.T)[0, 1] - 0.7) < 0.05
    assert np.max(np.abs(np.mean(rows, axis=0)) / [0.02, 0.05, 0.03]) < 0.1


def test_all_lie_within_the_bounds() -> None:
    model = spread((3.0, 40.0, 3.0), 0.9)
    for values in posterior_sets(model, 30).values():
        for name, value in values.items():
            low, high = model.parameter(name).bounds
            assert low <= value <= high
            model.with_values({name: value})


def test_a_covariance_that_overflows_gives_no_values_that_are_none() -> None:
    """A file may hold any numbers; what is not a number could not be read back."""
    model = spread((1e150, 1e150, 1e150), 0.5)
    for values in posterior_sets(model, 3).values():
        model.with_values(values)
        assert all(np.isfinite(v) for v in values.values())


def test_a_value_without_spread_stays() -> None:
    model = spread((0.02, 0.05, 0.0), 1.0)  # two that are one, and one that is known
    sets = sets_of(model, 5)
    assert all(abs(v["A"] / model.values["A"] - 1.0) < 1e-6 for v in sets.values())
    rows = coordinates(model, sets, "sample")
    np.testing.assert_allclose(rows[:, 1] / rows[:, 0], 2.5, rtol=0.1)


def test_the_same_model_gives_the_same_sets() -> None:
    model = spread((0.02, 0.05, 0.03), 0.2)
    assert sets_of(model, 12) == sets_of(model, 12)
    assert list(sets_of(model, 12).items())[:10] == list(sets_of(model, 3).items())[:10]
    assert posterior_sets(stack_model("demo"), 20) == {}


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


def test_a_normal_posterior_is_recovered() -> None:
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
    with pytest.raises(psa.InputError, match="'tau' has a prior but is not sampled"):
        psa.sample(TRUTH, record(), free=["k_L"], prior={"tau": 1.0})

    def absent(name: str) -> None:
        raise ModuleNotFoundError(name, name=name)

    monkeypatch.setattr(chains, "import_module", absent)
    with pytest.raises(psa.InputError, match=r"pip install 'psa-casadi\[sample\]'"):
        psa.sample(TRUTH, record())


MOTOR = {"R": 1.2, "k": 0.05, "J": 3e-5, "b": 2e-5}


@cache
def records(seed: int) -> tuple[psa.Signals, ...]:
    """Return two records of a motor: speed and current, and the speed with four times the noise."""
    items = []
    for k, (noise, names) in enumerate(((1.0, ("voltage", "w", "i")), (4.0, ("voltage", "w")))):
        whole = plants.motor(seed + k, friction=0.0, noise=noise)
        columns = {n: whole.columns[n][:600] for n in names}
        items.append(psa.Signals(name=f"run_{k + 1}", time=whole.time[:600], columns=columns))
    return tuple(items)


@cache
def user_task() -> Task:
    return own_task_of(motor(), records(1), starts=1, zeros=("i",))


def test_every_output_of_every_record_has_a_separate_noise_level() -> None:
    blocks = user_task().density.blocks
    assert [(b.record, user_task().channel(b).column) for b in blocks] == [
        (0, "w"),
        (1, "w"),
        (0, "i"),
    ]
    assert [b.count for b in blocks] == [600.0, 600.0, 599.0]  # the zero of i is integrated out
    np.testing.assert_allclose([b.level for b in blocks], [0.3, 1.2, 0.005], rtol=0.1)
    assert (
        user_task().density.size == 4 + 2 * 2
    )  # parameters, both states of both records: no offset


def test_the_gradient_of_any_model_is_that_of_its_density() -> None:
    density = user_task().density
    u, h = 0.5 * np.random.default_rng(1).standard_normal(density.size), 1e-3
    numeric = [(density(u + h * e)[0] - density(u - h * e)[0]) / (2 * h) for e in np.eye(len(u))]
    np.testing.assert_allclose(density(u)[1], numeric, atol=1e-4)


@pytest.mark.slow
def test_intervals_hold_the_truth_and_agree_with_standard_errors(tmp_path: Path) -> None:
    """With so much data the posterior is nearly normal."""
    arviz = pytest.importorskip("arviz")
    held = []
    for seed in (1, 3):
        result = psa.sample(
            motor(), records(seed), starts=1, chains=2, draws=250, tune=200, seed=seed
        )
        fitted = psa.identify(motor(), records(seed), starts=1)
        for f in result.figures:
            draws = result.tree.posterior[f.name].to_numpy()
            low, high = np.quantile(draws, [0.05, 0.95])
            held.append(low < MOTOR[f.name] < high)
            assert abs(f.mean - MOTOR[f.name]) < 4.0 * f.sd
            assert f.sd == pytest.approx(fitted.errors[f.name], rel=0.2)
        assert not result.divergences
    assert sum(held) >= 5  # of 8 that hold it with 90 %: fewer in 0.5 % of all data
    result.save(tmp_path / "posterior.nc")
    tree = arviz.from_netcdf(tmp_path / "posterior.nc")
    displayed = tree.posterior_predictive.i_1.to_numpy()[0]
    low, high = np.quantile(displayed, [0.03, 0.97], axis=0)
    y = tree.observed_data.i_1.to_numpy()
    assert 0.88 < np.mean((y > low) & (y < high)) < 0.98
    assert tree.posterior_predictive.w_2.attrs["units"] == "rad/s"
    levels = tree.posterior_predictive.noise_w.to_numpy().mean(axis=(0, 1))
    np.testing.assert_allclose(levels, [0.3, 1.2], rtol=0.1)
    result.report(tmp_path / "page.html")
    page = Page((tmp_path / "page.html").read_text("utf-8"))
    assert (
        "The posterior of motor, from 2 records: 2 chains of 250 draws, 0 divergent." in page.text
    )
    assert "run_2 w" in page.text
    assert page.loaded == []
    assert list(result.to_frame()["name"]) == list(MOTOR)
    assert "run_2" in result.plot()._suptitle.get_text()  # type: ignore[attr-defined]


def test_what_a_user_model_does_not_take_is_refused() -> None:
    with pytest.raises(psa.InputError, match="'hysteresis' is not among the arguments"):
        psa.sample(motor(), records(1), hysteresis="friction")
    with pytest.raises(psa.InputError, match="'starts' is not among the arguments for"):
        psa.sample(psa.stack_model("demo"), "record.csv", starts=3)
    with pytest.raises(psa.InputError, match="'tau' has a prior but is not sampled"):
        psa.sample(motor(), records(1), prior={"tau": 1.0})
    empty = replace(records(1)[0], columns={"voltage": records(1)[0].columns["voltage"]}, sha256="")
    with pytest.raises(psa.InputError, match="no output of the model 'motor'"):
        psa.sample(motor(), empty)


def test_the_command_samples_a_user_model(tmp_path: Path) -> None:
    pytest.importorskip("nutpie")
    psa.save_model(motor(), tmp_path / "motor.json")
    records(1)[0].to_frame().to_csv(tmp_path / "run.csv", index=False)
    files = [tmp_path / name for name in ("draws.nc", "figures.json", "p.html")]
    done(
        "sample", tmp_path / "run.csv", "--model", tmp_path / "motor.json", "--free", "R", "--free",
        "k", "--zeros", "i", "--known-start", "--chains", "1", "--draws", "4", "--tune", "4",
        "-o", files[0], "--json", files[1], "--report", files[2],
    )  # fmt: skip
    assert list(json.loads(files[1].read_text("utf-8"))["parameters"]) == ["R", "k"]
    assert all(file.stat().st_size for file in files)
    output = refused("sample", tmp_path / "run.csv", "--known-start", "--free", "R")
    assert "--known-start applies to your model; add --model" in output
