"""The example of a pack for a motor, applied to plants with other laws."""

from pathlib import Path

import numpy as np
import pytest
from scipy.special import iv

from psa_casadi.examples import motor_pack


@pytest.mark.slow
def test_effects_of_a_pack_are_named_in_plants_of_other_forms(tmp_path: Path) -> None:
    """The program of the example: each cause hidden once, and one record without any."""
    table = motor_pack.main(tmp_path)
    clean = table.pop("nothing")
    assert clean.verdict == "adequate"
    assert not clean.causes
    for hidden, d in table.items():
        assert [c.effect for c in d.causes] == [hidden]
        assert d.causes[0].confidence > 0.95
        assert d.explained_share is not None
        assert d.explained_share > 0.95
        for error in d.errors:
            assert error.extended < 0.65 * error.base or error.extended < 1.1 * error.noise
    assert table["winding_heat"].verdict == "cause_named"

    pull = table["cogging"].model.values
    first = 0.012 * np.exp(-0.5) * 2.0 * iv(1, 0.5) / 0.5  # of the plant's Fourier series
    assert pull["cogging_torque"] == pytest.approx(first, rel=0.1)
    assert pull["cogging_phase"] == pytest.approx(np.pi - 0.7, abs=0.1)
    ripple = table["commutation_ripple"].model.values
    half = np.pi / 10.0
    assert ripple["k"] == pytest.approx(0.05 * np.sin(half) / half, rel=1e-3)
    assert 0.0202 < ripple["ripple"] < 0.0249  # the first wave, and half of the swing
    assert ripple["ripple_phase"] == pytest.approx(np.pi - 1.0, abs=0.05)
    heat = table["winding_heat"].model.values
    assert heat["heat_time"] == pytest.approx(15.0, rel=0.1)
    assert heat["heating"] * heat["R"] == pytest.approx(0.039 * 1.2, rel=0.2)
