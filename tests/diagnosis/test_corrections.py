"""Unnamed corrections find the right kind and port, keep silent on noise, and weigh on names."""

from collections.abc import Callable

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.colour import Colour
from psa_casadi.diagnosis.corrections import Patch, best_of, corrections, with_patch
from psa_casadi.diagnosis.held_out import Compared, Removed, held_out_rms
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.model.model_file import dumps, loads
from psa_casadi.records.split import Experiment, split
from tests.tiers import slow_but

TIME: FloatArray = np.linspace(0.0, 4.0, 2001)
#: Loops of several sizes about several places, so that voltage, displacement and time differ.
VOLTAGE = 50.0 + 25.0 * np.sin(2 * np.pi * TIME) + 20.0 * np.sin(2 * np.pi * 0.37 * TIME + 1.0)
NOISE = 2e-9


def _fitted(y: FloatArray) -> tuple[Fit, tuple[Experiment, ...], Colour]:
    experiments = (split(psa.Record(name="r", time=TIME, voltage=VOLTAGE, displacement=y)),)
    result = fit(psa.compose(psa.BASE), experiments, ["k_L", "A", "beta", "gamma"], sigma=[NOISE])
    return result, experiments, Colour((np.zeros(0),), NOISE, (len(result.residuals),))


def _held(fit: Fit, experiments: tuple[Experiment, ...]) -> float:
    return held_out_rms(experiments, fit.predicted())


@pytest.fixture(scope="module")
def clean() -> FloatArray:
    return psa.simulate(psa.compose(psa.BASE), TIME, VOLTAGE).displacement


def _measured(clean: FloatArray, added: FloatArray) -> FloatArray:
    size = 40.0 * NOISE / float(np.ptp(added))
    noise = NOISE * np.random.default_rng(8).standard_normal(TIME.size)
    y: FloatArray = clean + size * added + noise
    return y


def _play(v: FloatArray, radius: float) -> FloatArray:
    values, state = np.empty_like(v), float(v[0])
    for k, value in enumerate(v.tolist()):
        state = min(max(state, value - radius), value + radius)
        values[k] = state
    return values


def _relaxed(x: FloatArray, tau: float) -> FloatArray:
    step, z = TIME[1] - TIME[0], np.empty_like(x)
    z[0] = x[0]
    for k in range(1, len(x)):
        z[k] = z[k - 1] + (x[k] - z[k - 1]) * (1.0 - np.exp(-step / tau))
    return z


HIDDEN: dict[str, Callable[[FloatArray], FloatArray]] = {
    "curve at the reading": lambda x: np.arctan(6.0 * (x - np.mean(x)) / np.ptp(x)),
    "curve at the drive voltage": lambda _: np.tanh((VOLTAGE - 60.0) / 12.0),
    "direction at the force": lambda _: (VOLTAGE - _play(VOLTAGE, 0.4)) * VOLTAGE,
    "memory at the force": lambda _: _play(VOLTAGE, 9.0),
    "relaxation at the force": lambda x: _relaxed(x, 0.35),
    "time at the reading": lambda _: np.sin(2 * np.pi * 0.3 * TIME),
    "gain in time at the force": lambda x: x * np.exp(-TIME / 2.0),
}


@pytest.mark.parametrize("hidden", HIDDEN)
def test_what_is_hidden_is_detected_at_its_port(hidden: str, clean: FloatArray) -> None:
    y = _measured(clean, HIDDEN[hidden](clean))
    result, experiments, colour = _fitted(y)
    observed = corrections(result, colour)
    base = (np.asarray(result.predicted()[0]),)
    patch = best_of(observed, experiments, [_held(result, experiments)], colour)
    assert patch is not None
    assert hidden in (patch.name, *patch.open_to)
    removed = Removed(experiments, base, [NOISE])
    spent = removed.budget(base, [], (patch.name, patch.predicted))
    assert spent.unnamed is not None
    assert spent.unnamed.share > 0.7
    assert spent.unnamed.interval[0] > 0.0


@pytest.mark.parametrize("hidden", slow_but(["memory at the force"], HIDDEN))
def test_the_patch_is_fitted_as_a_component_and_saved(hidden: str, clean: FloatArray) -> None:
    """In the model it does what the linear estimate promises; the file reads back the same."""
    result, experiments, colour = _fitted(_measured(clean, HIDDEN[hidden](clean)))
    predicted = result.predicted()
    held = held_out_rms(experiments, predicted)
    kind, port = hidden.split(" at the ")
    items = [c for c in corrections(result, colour) if c.kind == kind]
    items = [c for c in items if c.port == port]
    patch = best_of(items, experiments, [held], colour)
    assert isinstance(patch, Patch)
    again = with_patch(result, patch, predicted)
    after = held_out_rms(experiments, again.predicted())
    assert after**2 - NOISE**2 < 0.3 * (held**2 - NOISE**2)
    model = loads(dumps(again.model))
    assert model.values == again.model.values
    assert "unnamed correction" in model.effects[-1].description
    assert model.without([model.effects[-1].name]).effects == ()


def test_resonances_have_no_separate_component(clean: FloatArray) -> None:
    result, experiments, colour = _fitted(_measured(clean, HIDDEN["memory at the force"](clean)))
    modes = [c for c in corrections(result, colour) if c.kind == "modes"]
    patch = best_of(modes, experiments, [1.0], colour)
    assert isinstance(patch, Patch)
    with pytest.raises(psa.InputError, match="no form that a model could hold"):
        with_patch(result, patch, result.predicted())


def test_noise_gets_no_correction(clean: FloatArray) -> None:
    noise = NOISE * np.random.default_rng(3).standard_normal(TIME.size)
    result, experiments, colour = _fitted(clean + noise)
    observed = corrections(result, colour)
    assert max(c.evidence for c in observed) < 3.0
    assert best_of(observed, experiments, [_held(result, experiments)], colour) is None


def test_shares_of_the_budget_are_of_the_power_above_the_noise() -> None:
    """Two causes of 3 and 4 times the noise: 9/25 and 16/25 of what is above it."""
    rng = np.random.default_rng(6)
    truth = np.zeros(4000)
    held = np.arange(4000) % 2 == 1
    noise = NOISE * rng.standard_normal(4000)
    time: FloatArray = np.arange(4000, dtype=float) * 1e-3
    experiments = (
        Experiment(
            psa.Record(name="r", time=time, voltage=time, displacement=truth + noise), ~held, held
        ),
    )
    one, other = (NOISE * s * rng.standard_normal(4000) for s in (3.0, 4.0))
    without = [("one", (truth + one,)), ("other", (truth + other,))]
    base, extended = (truth + one + other,), (truth,)
    result = Removed(experiments, base, [NOISE]).budget(extended, without, None)
    spent = Compared(experiments, base, extended).in_lengths(result, NOISE)
    assert spent.excess_rms_m == pytest.approx(5.0 * NOISE, rel=0.05)
    assert [s.share for s in spent.causes] == pytest.approx([9 / 25, 16 / 25], abs=0.04)
    assert spent.together.share == pytest.approx(1.0, abs=0.02)
    for s in (*spent.causes, spent.together):
        assert s.interval[0] < s.share < s.interval[1]
    assert spent.remains_rms_m < 0.3 * NOISE
