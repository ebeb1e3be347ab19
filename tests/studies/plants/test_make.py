"""Noise, voltages, strengths and second effects of the records."""

from pathlib import Path

import numpy as np
import pytest

from tests.studies.plants.base import first_order, follow, simulate_base
from tests.studies.plants.excitations import EXCITATIONS, ExcitationKind
from tests.studies.plants.make import HEADER, THERMOMETER, make_record
from tests.studies.plants.stack import FloatArray
from tests.studies.plants.visibility import base_directions, refitted_ratio, visible_ratio
from tests.tiers import slow, slow_but


def column(path: Path, number: int) -> FloatArray:
    return np.genfromtxt(path, delimiter=",", skip_header=1)[:, number]


def test_autoregressive_record(tmp_path: Path) -> None:
    truth = make_record(None, 1, tmp_path / "a.csv", noise="ar")
    noise = column(tmp_path / "a.csv", 2) * 1e-6 - truth.displacement
    assert 0.4 <= truth.noise.correlation <= 0.8
    found = np.corrcoef(noise[1:], noise[:-1])[0, 1]
    assert found == pytest.approx(truth.noise.correlation, abs=0.05)
    assert np.std(noise) == pytest.approx(truth.sigma, rel=0.08)


def test_quantised_record(tmp_path: Path) -> None:
    truth = make_record(None, 1, tmp_path / "a.csv", noise="quantised")
    counts = column(tmp_path / "a.csv", 2) * 1e-6 / truth.quantum
    assert np.allclose(counts, np.round(counts), atol=1e-3)
    assert 1.0 <= truth.quantum / truth.noise.white <= 3.0
    noise = counts * truth.quantum - truth.displacement
    assert np.std(noise) == pytest.approx(truth.sigma, rel=0.08)


@pytest.mark.parametrize("stuck", [False, True])
def test_record_with_drop_outs(stuck: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    seeds = iter(range(20))
    truth = make_record(None, next(seeds), path, noise="drop-outs")
    while truth.noise.stuck != stuck:
        truth = make_record(None, next(seeds), path, noise="drop-outs")
    assert 0.005 <= np.mean(truth.lost) <= 0.021
    read = column(path, 2)
    if stuck:
        assert np.all(np.isfinite(read))
        assert np.all(np.diff(read)[truth.lost[1:]] == 0.0)
    else:
        assert np.array_equal(np.isnan(read), truth.lost)
    kept = (read * 1e-6 - truth.displacement)[~truth.lost]
    assert np.std(kept) == pytest.approx(truth.sigma, rel=0.05)


@pytest.mark.parametrize("kind", slow_but(["rich", "bipolar", "small"], EXCITATIONS))
def test_every_voltage_starts_at_rest_and_stays_in_its_span(
    kind: ExcitationKind, tmp_path: Path
) -> None:
    truth = make_record(None, 2, tmp_path / "a.csv", excitation=kind)
    rich = make_record(None, 2, tmp_path / "b.csv")
    assert truth.stack == rich.stack
    assert truth.voltage[0] == truth.voltage[1] == 0.0
    span, top = truth.stack.u_rated, truth.voltage.max()
    assert -span <= truth.voltage.min() <= (-0.1 * span if kind == "bipolar" else 0.0)
    least, most = (0.03, 0.4) if kind == "small" else (0.55, 1.0)
    assert least * span < top <= most * span
    assert np.all(np.isfinite(truth.displacement))
    assert (truth.times[-1] > 240.0) == (kind == "slow")
    assert (np.array_equal(truth.voltage, rich.voltage)) == (kind == "rich")


@pytest.mark.parametrize("effect", slow_but(["slow_creep"], ["slow_creep", "backlash"]))
def test_visible_ratio_is_what_was_asked_for(effect: str, tmp_path: Path) -> None:
    truth = make_record(effect, 4, tmp_path / "a.csv", visible=0.4)
    assert truth.visible == pytest.approx(0.4, rel=0.05)
    assert not truth.gain_limited
    drawn = make_record(effect, 4, tmp_path / "a.csv", visible=(0.8, 1.2))
    assert 0.75 <= drawn.visible <= 1.25
    huge = make_record(effect, 4, tmp_path / "a.csv", visible=1e4)
    assert huge.gain_limited
    assert huge.visible < 1e4


@slow
def test_two_effects_add_up(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    both = make_record("slow_creep", 5, path, more=("mains_hum",), more_visible=2.0)
    read = column(path, 2)
    alone = make_record("slow_creep", 5, path)
    (second,) = both.more
    assert second.effect.name == "mains_hum"
    assert second.visible == pytest.approx(2.0, rel=0.01)
    assert both.gain == alone.gain
    assert np.allclose(both.displacement, alone.displacement + second.added, atol=1e-18)
    assert np.std(read * 1e-6 - both.displacement) == pytest.approx(both.sigma, rel=0.05)
    only = make_record(None, 5, path, more=("mains_hum",), more_visible=2.0)
    assert only.effect is None
    assert np.array_equal(only.displacement - only.base_displacement != 0.0, only.times >= 0.0)


def test_thermometer_is_in_the_record(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    truth = make_record("temperature", 6, path)
    assert path.read_text(encoding="utf-8").startswith(HEADER + THERMOMETER + "\n")
    assert truth.temperature is not None
    assert np.allclose(column(path, 3), truth.temperature, atol=5.1e-4)
    assert np.ptp(truth.temperature) > 0.1
    assert make_record("slow_creep", 6, path).temperature is None


@slow
def test_a_pole_before_the_drive_vanishes_in_a_fit(tmp_path: Path) -> None:
    """Why a lag is scaled by a base that is fitted again: its linearisation cannot see this."""
    truth = make_record(None, 1, tmp_path / "a.csv")
    run = simulate_base(truth.stack, truth.times[:2000], truth.voltage[:2000], 12)
    late = first_order(-1.0 / 2e-3 + 0j, run.fine_command, run.fine_step).real / 2e-3
    added = follow(run, late).displacement - run.displacement
    assert visible_ratio(base_directions(run), added, truth.sigma) > 1.0
    assert refitted_ratio(run, added, truth.sigma) < 0.5
