"""Voltages and strengths of the records."""

from pathlib import Path

import numpy as np
import pytest

from tests.studies.plants.base import first_order, follow, simulate_base
from tests.studies.plants.excitations import EXCITATIONS, ExcitationKind
from tests.studies.plants.make import make_record
from tests.studies.plants.visibility import base_directions, refitted_ratio, visible_ratio
from tests.tiers import slow, slow_but


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
def test_a_pole_before_the_drive_vanishes_in_a_fit(tmp_path: Path) -> None:
    """Why a lag is scaled by a base that is fitted again: its linearisation cannot see this."""
    truth = make_record(None, 1, tmp_path / "a.csv")
    run = simulate_base(truth.stack, truth.times[:2000], truth.voltage[:2000], 12)
    late = first_order(-1.0 / 2e-3 + 0j, run.fine_command, run.fine_step).real / 2e-3
    added = follow(run, late).displacement - run.displacement
    assert visible_ratio(base_directions(run), added, truth.sigma) > 1.0
    assert refitted_ratio(run, added, truth.sigma) < 0.5
