"""Posteriors of any model: several records and outputs, truths that are known."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.posterior.task import Task, own_task_of
from tests.any_model import own_plants as plants
from tests.any_model.own_models import motor
from tests.contract.helpers import done, refused
from tests.report.html_page import Page

TRUTH = {"R": 1.2, "k": 0.05, "J": 3e-5, "b": 2e-5}


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
def task() -> Task:
    return own_task_of(motor(), records(1), starts=1, zeros=("i",))


def test_every_output_of_every_record_has_a_noise_level_of_its_own() -> None:
    blocks = task().density.blocks
    assert [(b.record, task().channel(b).column) for b in blocks] == [(0, "w"), (1, "w"), (0, "i")]
    assert [b.count for b in blocks] == [600.0, 600.0, 599.0]  # the zero of i is integrated out
    np.testing.assert_allclose([b.level for b in blocks], [0.3, 1.2, 0.005], rtol=0.1)
    assert task().density.size == 4 + 2 * 2  # parameters, both states of both records: no offset


def test_the_gradient_is_that_of_the_density() -> None:
    density = task().density
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
            held.append(low < TRUTH[f.name] < high)
            assert abs(f.mean - TRUTH[f.name]) < 4.0 * f.sd
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
        "The posterior of motor, given 2 records: 2 chains of 250 draws, 0 divergent." in page.text
    )
    assert "run_2 w" in page.text
    assert page.loaded == []
    assert list(result.to_frame()["name"]) == list(TRUTH)
    assert "run_2" in result.plot()._suptitle.get_text()  # type: ignore[attr-defined]


def test_what_a_model_of_ones_own_does_not_take_is_refused() -> None:
    with pytest.raises(psa.InputError, match="'hysteresis' is not among the arguments"):
        psa.sample(motor(), records(1), hysteresis="friction")
    with pytest.raises(psa.InputError, match="'starts' is not among the arguments for"):
        psa.sample(psa.stack_model("demo"), "record.csv", starts=3)
    with pytest.raises(psa.InputError, match="'tau' was given, which is not sampled"):
        psa.sample(motor(), records(1), prior={"tau": 1.0})
    empty = replace(records(1)[0], columns={"voltage": records(1)[0].columns["voltage"]}, sha256="")
    with pytest.raises(psa.InputError, match="no output of the model 'motor'"):
        psa.sample(motor(), empty)


def test_the_command_samples_a_model_of_ones_own(tmp_path: Path) -> None:
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
    assert "--known-start is said of a model of your own; add --model" in output
