"""Records that a search could lose: odd sizes, ringing stacks, noise that is not white."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lsim

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.base_fit import from_resonances
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.refitting import quick_rtol
from psa_casadi.identification.search import fit_base
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.model.effects import EFFECTS
from psa_casadi.records.read.reading import read_record
from psa_casadi.records.split import Experiment, split
from psa_casadi.simulation.simulate import simulate_record
from tests.studies.golden.cases import ASKS
from tests.studies.plants.excitations import ExcitationKind
from tests.studies.plants.make import Truth, make_record, play_again
from tests.tiers import slow, slow_but


@slow
def test_the_order_of_the_records_does_not_matter(tmp_path: Path) -> None:
    ends = (1000, 1000)  # their lengths hold no information either
    truth = make_record("offset_drift", 3, tmp_path / "a.csv", excitation="triangle")
    play_again(truth, 4, tmp_path / "b.csv")
    pairs = zip(("a", "b"), ends, strict=True)
    records = [psa.read_record(tmp_path / f"{n}.csv").slice(0, end) for n, end in pairs]
    effects = [psa.EFFECTS["offset_drift"]]
    one, other = (psa.diagnose(r, effects=effects) for r in (records, records[::-1]))
    for mine, yours in zip(one.experiments, other.experiments, strict=True):
        np.testing.assert_array_equal(mine.record.measured, yours.record.measured)
    assert one.extended_errors == other.extended_errors
    assert one.causes == other.causes


@slow
def test_an_effect_that_the_bent_base_hides_is_detected(tmp_path: Path) -> None:
    """Four effects lead the screening, none explains the data: an amplifier of 0.9 ms does."""
    path = tmp_path / "record.csv"
    make_record("drive_lag", 52001, path, gain=9.171e-4)
    record = psa.read_record(path)
    names = ("rate_dependent_hysteresis", "voltage_saturation", "preload_loss", "load_stiffness")
    result = psa.diagnose([record], effects=[psa.EFFECTS[n] for n in (*names, "drive_lag")])
    assert result.verdict == "cause_named"
    assert [c.effect for c in result.causes] == ["drive_lag"]


@slow
def test_stuck_readings_that_the_misfit_hid_are_masked_once_the_cause_is_known(
    tmp_path: Path,
) -> None:
    """Seven standard deviations of the noise off, two of what a hum leaves of the base fit."""
    truth = make_record("mains_hum", 3, tmp_path / "a.csv", excitation="triangle", visible=3.0)
    inputs = psa.read_record(tmp_path / "a.csv").slice(0, 1200)
    counts = 0.7 * truth.sigma
    y = counts * np.round(inputs.measured / counts)
    moves = np.abs(np.diff(truth.displacement[:1200], prepend=0.0))
    stuck = []
    for k in range(100, 1100, 50):
        length = max(1, round(7.0 * truth.sigma / max(moves[k], 1e-12)))
        if length < 8:
            y[k : k + length] = y[k - 1]
            stuck.append(k + length - 1)
    assert len(stuck) > 10
    record = psa.Record(name="a", time=inputs.time, voltage=inputs.voltage, displacement=y)
    result = psa.diagnose([record], effects=[psa.EFFECTS["mains_hum"]])
    used = result.experiments[0].record.mask
    assert [c.effect for c in result.causes] == ["mains_hum"]
    assert np.mean(used[stuck]) < 0.4
    assert np.mean(used) > 0.95
    assert any("repeat the last one far from the model" in n for n in result.notes)


def _fitted(
    path: Path, kind: ExcitationKind, seed: int, samples: int | None = None
) -> tuple[Truth, tuple[Experiment, ...], Fit]:
    truth = make_record(None, seed, path, excitation=kind)
    whole = read_record(path)
    record = whole.slice(0, samples or whole.n)
    experiments = (split(record),)
    return truth, experiments, fit_base(starting_model([record], None), experiments)


def _quietly(_: str) -> None:
    pass


@slow
def test_two_resonances_within_the_band_are_fitted_to_the_noise(tmp_path: Path) -> None:
    """From the linear part's starts alone this fit ended at 1.16 times the noise."""
    truth, _, base = _fitted(tmp_path / "a.csv", "fast", 1)
    fit = from_resonances(base, _quietly)
    assert fit is not None
    assert fit.rms < 1.02 * truth.sigma
    stack, p = truth.stack, fit.model.values
    tones = sorted([np.sqrt(stack.k_p / stack.m_p), np.sqrt(stack.k_b / stack.m_b)])
    mine = sorted([np.sqrt(p["k_P"] / p["m_P"]), np.sqrt(p["k_B"] / p["m_B"])])
    assert mine[0] == pytest.approx(tones[0], rel=0.1)


@slow
@pytest.mark.parametrize("samples", [60, 150, 250])
def test_the_noise_of_a_short_record_is_as_large_as_it_is(samples: int, tmp_path: Path) -> None:
    """All trial directions of the effects together explain most of so few samples."""
    truth = make_record(None, 2, tmp_path / "a.csv", excitation="triangle")
    result = psa.diagnose(psa.read_record(tmp_path / "a.csv").slice(0, samples))
    assert result.verdict == "adequate"
    assert result.noise_floor_rms_m == pytest.approx(truth.sigma, rel=0.15)


@slow
def test_a_tone_at_an_image_of_the_stack_resonance_is_no_cause(tmp_path: Path) -> None:
    """1.69 kHz sampled at 2 kHz, aliased to 0.33 kHz, where it decays as fast in time."""
    make_record(None, 19, tmp_path / "a.csv", excitation="short")
    result = diagnose([read_record(tmp_path / "a.csv")], effects=[EFFECTS["structural_mode"]])
    assert result.verdict == "adequate"


@slow
def test_an_undetected_resonance_is_no_cause(tmp_path: Path) -> None:
    """Without a search for its ringing, this clean record has the verdict unexplained."""
    make_record(None, 118254, tmp_path / "a.csv", noise="ar")
    effects = [EFFECTS[n] for n in ("structural_mode", "sensor_delay", "sensor_lag", "drive_lag")]
    assert diagnose([read_record(tmp_path / "a.csv")], effects=effects).verdict == "adequate"


#: Instants per sample of the stage, and the largest change of voltage in a step of its loop [V].
_FINE, _SMALL = 16, 0.25


def _stage(frequency: float, damping: float, seed: int) -> psa.Record:
    """A loaded stage at 1 kHz: a Bouc-Wen loop, an amplifier of 0.8 ms and a resonance."""
    rng, t = np.random.default_rng(seed), np.arange(500) / 1e3
    loops = ((2, 60.0), (4, 40.0), (10, 30.0), (20, 20.0))
    sines = [a * (1.0 - np.cos(2 * np.pi * f * t)) for f, a in loops]
    steps = np.repeat(rng.choice([0.0, 20.0, 40.0, 80.0, 100.0], 8), 250)
    voltage = np.concatenate([*sines, steps])
    u = np.interp(np.arange(_FINE * voltage.size) / _FINE, np.arange(voltage.size), voltage)
    h, force = 0.0, [0.0]
    for change in np.diff(u).tolist():
        count = int(abs(change) / _SMALL) + 1
        e = change / count
        for _ in range(count):  # the midpoint rule for h' = a u' - beta |u'| h - gamma u' |h|
            q = h + 0.5 * (0.25 * e - 0.012 * abs(e) * h - 0.008 * e * abs(h))
            h += 0.25 * e - 0.012 * abs(e) * q - 0.008 * e * abs(q)
        force.append(h)
    y, w = 0.2e-6 * (u - force), 2 * np.pi * frequency
    for top, bottom in (([1.0], [8e-4, 1.0]), ([w * w], [1.0, 2 * damping * w, w * w])):
        _, y, _ = lsim((top, bottom), y, 1e-3 / _FINE * np.arange(y.size))
    y = y[::_FINE] + 5e-4 * np.ptp(y) * rng.standard_normal(voltage.size)
    return psa.Record(
        name="stage", time=np.arange(voltage.size) / 1e3, voltage=voltage, displacement=y
    )


@pytest.mark.parametrize(
    ("frequency", "damping"),
    slow_but([(320.0, 0.2)], [(140.0, 0.3), (180.0, 0.06), (250.0, 0.7), (320.0, 0.2)]),
)
def test_a_stage_that_rings_within_the_band_of_a_slow_record_is_clean(
    frequency: float, damping: float
) -> None:
    d = psa.diagnose(_stage(frequency, damping, 1))
    assert d.verdict == "adequate"
    assert d.base_errors.holdout_rms_m < 1.05 * d.noise_floor_rms_m


def test_quick_fits_integrate_below_the_noise(tmp_path: Path) -> None:
    """A sensor with a noise of 2e-4 of the range: at 1e-4 the stepper's error was larger."""
    path = tmp_path / "a.csv"
    make_record(None, 3, path, excitation="sines")
    record = read_record(path).slice(0, 3000)
    experiments = (split(record),)
    model = starting_model([record], None)
    range_ = float(np.ptp(np.asarray(record.displacement)))
    noise = 2e-4 * range_
    rtol = quick_rtol([noise], experiments)
    exact = simulate_record(model, record, rtol=1e-9).outputs["displacement"]
    quick = simulate_record(model, record, rtol=rtol).outputs["displacement"]
    assert float(np.std(quick - exact)) < 0.3 * noise * float(np.ptp(exact)) / range_
    assert quick_rtol([1e6 * noise], experiments) > 5.0 * rtol


@slow
@pytest.mark.parametrize(
    ("case", "draw", "cause"),
    [
        ("exam/k06", 2, "charge_leakage"),  # an ordinary base began with the bent one's states
        ("exam/k29", 2, "hysteresis_memory"),  # its loop saturates sooner than an ordinary one
        ("exam/k04", 2, "backlash"),  # so small that no derivative promises it
    ],
)
def test_a_cause_is_named_on_another_draw(case: str, draw: int, cause: str, tmp_path: Path) -> None:
    _, path = ASKS[case](tmp_path, draw)
    assert [c.effect for c in psa.diagnose(path).causes] == [cause]


def _pink(y: FloatArray, rng: np.random.Generator) -> FloatArray:
    lines = np.fft.rfft(rng.standard_normal(y.size)) / np.sqrt(
        np.maximum(np.arange(y.size // 2 + 1), 1)
    )
    return _of_size_one(np.fft.irfft(lines, y.size))


def _telegraph(y: FloatArray, rng: np.random.Generator) -> FloatArray:
    return _of_size_one(np.cumsum(rng.random(y.size) < 0.01) % 2.0)


def _walk(y: FloatArray, rng: np.random.Generator) -> FloatArray:
    return _of_size_one(np.cumsum(rng.standard_normal(y.size)))


def _jitter(y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """The reading is taken a little before or after its time."""
    return _of_size_one(np.gradient(gaussian_filter1d(y, 4.0)) * rng.standard_normal(y.size))


def _of_size_one(noise: NDArray[Any]) -> FloatArray:
    return np.asarray((noise - np.mean(noise)) / np.std(noise), dtype=np.float64)


NOISES = [_pink, _telegraph, _walk, _jitter]


@pytest.mark.parametrize(("number", "made"), slow_but([(1, _telegraph)], list(enumerate(NOISES))))
def test_noise_of_any_colour_is_noise(
    number: int, made: Callable[[FloatArray, np.random.Generator], FloatArray], tmp_path: Path
) -> None:
    """Three times as large as the white noise in the record."""
    path, rng = tmp_path / "clean.csv", np.random.default_rng(number)
    make_record(None, 4430 + number, path)
    time, voltage, displayed = np.loadtxt(path, delimiter=",", skiprows=1).T
    white = float(np.std(np.diff(displayed, 3))) / np.sqrt(20.0)
    noisy = {
        "time [s]": time,
        "voltage [V]": voltage,
        "displacement [um]": displayed + 3.0 * white * made(displayed, rng),
    }
    result = psa.diagnose(noisy)
    assert (result.verdict, result.causes) == ("adequate", ())
