"""What `identify` finds, against independent plants, the reference, and a real instrument."""

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.identification import refitting
from psa_casadi.identification.refitting import refit_or_keep
from psa_casadi.records import multisine, time_grid
from psa_casadi.simulation.stepper import SimulationError
from tests.identification.identified_plants import combinations, identified, noise, plant
from tests.model.stack_models import values_of
from tests.tiers import slow, slow_but

SEEDS = (2, 3, 4)
#: Largest relative error of each combination; the asymmetry is a small part of these loops.
TOLERANCE = {"slope": 2e-3, "width": 5e-3, "asymmetry": 0.5, "n": 1e-2, "lag": 1e-2}

pytestmark = pytest.mark.xdist_group("identification")


@pytest.mark.parametrize("seed", slow_but(SEEDS[:1], SEEDS))
def test_the_plant_is_recovered_up_to_the_scale_of_force(seed: int) -> None:
    truth, result = plant(seed)[0], identified(seed)
    assert result.fit.converged
    assert result.determinacy.on_bound == ()
    assert result.fit.rms == pytest.approx(noise(truth), rel=0.05)
    assert result.fit.sigma[0] == pytest.approx(noise(truth), rel=0.05)
    clean = result.fit.predicted()[0] - truth.displacement
    assert np.std(clean) < 0.12 * noise(truth)
    true = combinations(values_of(truth.stack))
    rated = {"u_rated": truth.stack.u_rated}
    for name, value in combinations({**result.model.values, **rated}).items():
        assert value == pytest.approx(true[name], rel=TOLERANCE[name]), name


@pytest.mark.parametrize("seed", slow_but(SEEDS[:1], SEEDS))
def test_what_is_not_determined_is_listed(seed: int) -> None:
    """Lags are short and similar: not all of them are determined."""
    result = identified(seed).determinacy
    assert {"tau", "R_s", "c_P", "c_B"} & set(result.undetermined)
    assert not {"k_L", "A", "n"} & set(result.undetermined)
    text = " ".join(w for w in identified(seed).warnings if "these records" in w)
    assert all(f"'{name}'" in text for name in result.undetermined)
    assert np.all(np.abs(result.correlations) < 1.0 + 1e-9)
    np.testing.assert_allclose(np.diag(result.correlations), 1.0)
    for name, interval in result.intervals.items():
        assert interval.low < identified(seed).model.values[name] < interval.high


@slow
def test_a_known_stiffness_scales_the_forces() -> None:
    record = plant(2)[1].slice(0, 2500)
    assumed, inputs = psa.identify([record]), psa.identify([record], stiffness=1e7)
    assert assumed.model.provenance.force_scale == "assumed"
    assert "Force scale assumed" in assumed.model.provenance.notes[0]
    assert inputs.model.provenance.force_scale == "given"
    assert inputs.model.provenance.notes == ()
    p = inputs.model.values
    assert p["k_B"] == 1e7  # what a load on the output meets
    for name in ("k_L", "A"):
        assert p[name] == pytest.approx(assumed.model.values[name] / 5.0, rel=1e-2)
    pair = [combinations(f.model.values) for f in (assumed, inputs)]
    assert pair[1]["slope"] == pytest.approx(pair[0]["slope"], rel=1e-3)
    assert inputs.fit.rms == pytest.approx(assumed.fit.rms, rel=1e-3)


def reference_record(p: dict[str, float], sigma: float) -> psa.Record:
    """Return a record of the reference from rest, with white noise (a share of the range)."""
    time = time_grid(0.8, 2e-3)
    swing = multisine(time, -0.45 * p["u_rated"], 0.45 * p["u_rated"], (4.0, 60.0), seed=3)
    voltage = 0.5 * p["u_rated"] + swing * np.minimum(time / 0.1, 1.0)
    drive = reference.from_samples(time, voltage)
    force = p["k_L"] * float(voltage[0])
    start = {"u": float(voltage[0]), "f_out": force, "y": force / p["k_P"]}
    start["x"] = start["y"] + force / p["k_B"]
    x = reference.simulate(
        p, drive, time, initial=start, breakpoints=list(time[1:-1]), rtol=1e-8
    ).displacement
    white = np.random.default_rng(5).standard_normal(len(x))
    return psa.Record(
        name="reference", time=time, voltage=voltage, displacement=x + sigma * np.ptp(x) * white
    )


def start_model(p: dict[str, float]) -> psa.Model:
    """Return a model with the right mechanics and a loop and lag that are far off."""
    wrong = {"k_L": 1.3 * p["k_L"], "A": 0.6 * p["A"], "beta": 0.0, "gamma": 0.0}
    return psa.compose(psa.BASE, {**p, **wrong, "n": 1.2, "tau": 0.4 * p["tau"], "delta": 0.0})


@slow
def test_intervals_cover_the_reference_where_the_mechanics_are_known() -> None:
    """With stiffness and masses right, every parameter is in its interval, the lag tau too."""
    p = {name: f.value for name, f in psa.STACKS["P-885.51"].values.items()} | {"tau": 3e-3}
    record = reference_record(p, 3e-4)
    result = psa.identify([record], model=start_model(p))
    assert result.fit.converged
    assert result.fit.rms == pytest.approx(3e-4 * record.range_m, rel=0.12)
    for name in ("k_L", "A", "beta", "gamma", "delta", "n", "tau"):
        error = result.determinacy.standard_errors[name]
        assert abs(result.model.values[name] - p[name]) < 3.0 * error, name
    assert result.model.values["tau"] == pytest.approx(p["tau"], rel=0.02)


@slow
def test_a_loop_sharper_than_any_allowed_sits_on_its_bound() -> None:
    """The model's exponent is at least 1; the reference bends with 0.6."""
    p = {name: f.value for name, f in psa.STACKS["P-885.51"].values.items()} | {"tau": 3e-3}
    result = psa.identify([reference_record({**p, "n": 0.6}, 1e-4)], model=start_model(p))
    assert result.model.values["n"] == 1.0
    assert "n" in result.determinacy.on_bound
    assert "'n' sits on a bound of its range; its interval means nothing." in result.warnings


def test_a_fit_that_is_cut_off_is_not_called_final(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not any("cut off" in w for w in identified(2).warnings)
    record = plant(2)[1].slice(0, 600)
    monkeypatch.setattr("psa_casadi.identification.refitting.POLISH", 1)
    monkeypatch.setattr("psa_casadi.identification.mechanics._LAST", 1)
    result = psa.identify([record])
    assert result.warnings[0].startswith("The fit was cut off before it converged")


def test_a_fit_that_ends_where_nothing_can_be_simulated_stays_where_it_began(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise SimulationError("the step size became too small")

    stack_identification = identified(2)
    first = stack_identification.fit
    monkeypatch.setattr(refitting, "fit", fails)
    assert refit_or_keep(first, sigma=first.sigma) is first
