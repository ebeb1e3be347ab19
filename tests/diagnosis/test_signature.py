"""The signature of an effect: reported along the coordinate that physics implies, for each."""

from pathlib import Path

import numpy as np
import pytest

from psa_casadi.diagnosis.remedy import signature
from psa_casadi.model.effects import EFFECTS
from tests.contract.helpers import refused

#: Coordinates along which an effect shows by its physics.
COORDINATES = {
    "slow_creep": {"holds"},
    "hysteresis_memory": {"from_reversal"},
    "rate_independent_asymmetry": {"from_reversal"},
    "field_dependent_gain": {"voltage", "displacement"},
    "saturation_of_strain": {"voltage", "displacement"},
    "structural_mode": {"spectrum"},
    "load_stiffness": {"displacement"},
    "preload_loss": {"displacement"},
    "backlash": {"from_reversal"},
    "voltage_saturation": {"voltage", "displacement"},
    "drive_lag": {"rate"},
    "sensor_delay": {"rate"},
    "sensor_lag": {"rate"},
    "sensor_nonlinearity": {"displacement"},
    "sensor_ripple": {"displacement"},
    "sensor_jump": {"displacement"},
    "offset_drift": {"time"},
    "ageing": {"time"},
    "mains_hum": {"spectrum"},
    "temperature": {"temperature"},
}


@pytest.mark.parametrize("name", COORDINATES)
def test_the_telling_coordinate_is_the_physical_one(name: str) -> None:
    observed = signature(EFFECTS[name])
    assert observed.telling.name in COORDINATES[name]
    assert 0.5 < observed.telling.share <= 1.0


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_has_a_signature_of_a_telling_size(name: str) -> None:
    observed = signature(EFFECTS[name])
    d = observed.difference
    assert np.isfinite(d).all()
    assert 1e-3 < np.std(d) / observed.stroke < 0.05
    # offset and slope of the base are fitted: what is left is orthogonal to both
    for known in (np.ones_like(d), observed.base - np.mean(observed.base)):
        assert abs(d @ known) < 1e-6 * np.linalg.norm(d) * np.linalg.norm(known)
    assert observed.telling.x.size == observed.telling.mean.size >= 3
    assert observed.coordinate.shape == observed.counted.shape
    low, high = EFFECTS[name].parameters[0].bounds
    assert low <= observed.size <= high or observed.gain != EFFECTS[name].parameters[0].name


def test_creep_grows_during_holds_and_hum_is_a_line_at_its_frequency() -> None:
    creep = signature(EFFECTS["slow_creep"])
    assert np.all(np.diff(creep.telling.mean[creep.telling.x > 0.01]) > 0)
    hum = signature(EFFECTS["mains_hum"]).telling
    assert hum.x[np.argmax(hum.mean)] == pytest.approx(50.0, abs=0.5)
    delay = signature(EFFECTS["sensor_delay"])
    # a reading that lags by T differs by -T times its rate
    slope = np.polyfit(delay.telling.x, delay.telling.mean, 1)[0]
    gain = delay.stroke / np.ptp(delay.voltage)
    assert slope == pytest.approx(-delay.size * gain, rel=0.25)


def test_a_picture_is_of_one_effect(tmp_path: Path) -> None:
    assert "none is named" in refused("effects", "--figure", tmp_path / "x.png")
    assert not list(tmp_path.iterdir())
