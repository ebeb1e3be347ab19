"""Several modes at once: read off a residual, fitted beside the base, exported like any effect."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lsim

import psa_casadi as psa
from psa_casadi.effects.mechanics import MODAL_SERIES
from psa_casadi.identification.start.linear_response import Shaken, modes_of
from psa_casadi.records import multisine
from tests.studies.plants.base import simulate_base
from tests.studies.plants.mechanics import structural_mode
from tests.studies.plants.stack import draw_stack
from tests.tiers import slow

FloatArray = NDArray[np.float64]

#: Frequency [Hz], damping ratio and static share of the modes that are hidden.
HIDDEN = ((212.0, 0.012, 0.06), (487.0, 0.02, 0.11), (905.0, 0.015, 0.05), (1330.0, 0.01, 0.09))
RATE, COUNT = 5000.0, 4000


def response(frequency: float, damping: float, drive: FloatArray, time: FloatArray) -> FloatArray:
    """Displacement q of a mode, q'' + 2 zeta w q' + w^2 q = w^2 drive, by SciPy."""
    omega = 2.0 * np.pi * frequency
    system = ([omega**2], [1.0, 2.0 * damping * omega, omega**2])
    return np.asarray(lsim(system, drive, time)[1])


def noise(count: int, seed: int) -> FloatArray:
    return np.random.default_rng(seed).standard_normal(count)


def drive_and_time(seed: int = 1) -> tuple[FloatArray, FloatArray]:
    time = np.arange(COUNT) / RATE
    drive = np.cumsum(noise(COUNT, seed)) * 1e-8
    return drive - drive[0], time


def test_modes_are_read_off_a_residual() -> None:
    drive, time = drive_and_time()
    left = sum(share * response(f, z, drive, time) for f, z, share in HIDDEN)
    left = left + 1e-3 * np.std(left) * noise(COUNT, 2)
    shaken = Shaken(drive, left, np.ones(COUNT, bool), 1.0 / RATE)
    found = sorted(
        modes_of([shaken], np.ones((COUNT, 1)), most=9, better=0.95), key=lambda m: m.frequency
    )
    assert len(found) == len(HIDDEN)
    for mode, (frequency, damping, share) in zip(found, HIDDEN, strict=True):
        assert mode.frequency == pytest.approx(frequency, rel=1e-3)
        assert mode.damping == pytest.approx(damping, rel=0.03)
        assert mode.share == pytest.approx(share, rel=0.03)
        assert abs(mode.ahead) < 0.03 * share


def test_noise_has_no_modes() -> None:
    drive, _ = drive_and_time()
    shaken = Shaken(drive, noise(COUNT, 3), np.ones(COUNT, bool), 1.0 / RATE)
    assert modes_of([shaken], np.ones((COUNT, 1)), most=9, better=0.95) == []


def with_two_modes() -> psa.Model:
    values = {"series_gain": 1.0}
    for k, (frequency, damping, share) in enumerate(HIDDEN[:2], 1):
        values |= {
            f"series_frequency_{k}": frequency,
            f"series_damping_{k}": damping,
            f"series_share_{k}": share,
        }
    return psa.stack_model("P-885.51").with_effect(MODAL_SERIES[2], values)


def test_its_equations_are_those_of_modal_superposition() -> None:
    model, time = with_two_modes(), np.arange(4000) / 20_000.0
    voltage = multisine(time, 0.0, 80.0, (20.0, 1500.0), seed=3)
    voltage *= np.clip((time - 0.002) / 0.01, 0.0, 1.0)  # it begins at rest
    base = psa.simulate(psa.stack_model("P-885.51"), time, voltage, rtol=1e-6)
    own = psa.simulate(model, time, voltage, rtol=1e-6)
    k = model.values
    rest = base.states["f_out"] * (1.0 / k["k_P"] + 1.0 / k["k_B"])
    added = sum(share * response(f, z, rest, time) for f, z, share in HIDDEN[:2])
    size = np.ptp(added)
    np.testing.assert_allclose(own.displacement - base.displacement, added, atol=2e-3 * size)


def shaken_stack(seed: int, modes: Sequence[tuple[float, float, float]] = HIDDEN) -> psa.Record:
    """Return a record of a stack in a structure with modes, plain NumPy and SciPy."""
    rng = np.random.default_rng(seed)
    stack, time = draw_stack(rng), np.arange(COUNT) / RATE
    wave = multisine(time, 0.0, 1.0, (5.0, 1800.0), seed=seed)
    command = stack.u_rated * wave * np.clip((time - 0.01) / 0.05, 0.0, 1.0)
    run = simulate_base(stack, time, command)
    x = run.displacement + sum(
        structural_mode.contribution(run, {"frequency": f, "zeta": z}, share)
        for f, z, share in modes
    )
    x = x + 1e-3 * np.ptp(x) * rng.standard_normal(COUNT)
    return psa.Record(name="shaken", time=time, voltage=command, displacement=x)


@slow
def test_several_modes_are_found_together_and_again_from_what_was_found() -> None:
    like = [psa.EFFECTS[n] for n in ("structural_mode", "drive_lag", "sensor_delay")]
    more = [psa.EFFECTS[n] for n in ("hysteresis_memory", "slow_creep", "load_stiffness")]
    found = psa.diagnose([shaken_stack(11)], effects=[*like, *more])
    (cause,) = found.causes
    assert cause.effect.startswith("modal_series")
    assert found.base_errors.holdout_nrmse_percent > 1.0
    assert found.extended_errors.holdout_nrmse_percent < 0.12  # the noise is 0.1
    values = found.extended_fit.model.values
    tones = np.array([v for n, v in values.items() if n.startswith("series_frequency")])
    for frequency, _, _ in HIDDEN:
        assert np.min(np.abs(tones / frequency - 1.0)) < 2e-3
    again = psa.diagnose([shaken_stack(11)], model=found.model, effects=like)
    assert again.base_errors.holdout_nrmse_percent > 1.0
    assert [c.effect.startswith("modal_series") for c in again.causes] == [True]


@slow
def test_a_fast_record_without_modes_has_none() -> None:
    effects = [psa.EFFECTS[n] for n in ("structural_mode", "drive_lag", "sensor_delay", "backlash")]
    assert psa.diagnose([shaken_stack(14, ())], effects=effects).verdict == "adequate"


@slow
@pytest.mark.usefixtures("code_runs_here")
def test_a_model_with_modes_becomes_an_fmu(tmp_path: Path) -> None:
    path = tmp_path / "modes.fmu"
    psa.export_fmu(with_two_modes(), path)
    assert psa.check_fmu(path, with_two_modes()).passed
