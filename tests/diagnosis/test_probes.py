"""The trial sizes at which effects are looked for stand close enough to find every size."""

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.probes import residual_jumps
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.records.split import whole


def _loops() -> tuple[FloatArray, FloatArray]:
    t = np.linspace(0.0, 4.0, 4001)
    return t, 50.0 - 40.0 * np.cos(2 * np.pi * t) * (1.0 - 0.15 * t)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.85])
def test_the_place_of_a_jump_is_read_off_the_residual(share: float) -> None:
    """Under noise as large as half the jump; in the model's displacement, whatever the offset."""
    model = psa.compose(psa.BASE)
    t, voltage = _loops()
    x = psa.simulate(model, t, voltage).displacement
    noise = 1e-8 * np.random.default_rng(4).standard_normal(t.size)
    place = float(x.min() + share * np.ptp(x))
    reading = x + 2e-8 * (x > place) + noise + 3e-6
    experiments = (whole(psa.Record(name="r", time=t, voltage=voltage, displacement=reading)),)
    places = residual_jumps(fit(model, experiments, ["k_L", "A"], sigma=[2e-8]), experiments)
    assert min(abs(p - place) for p in places) < 0.01 * np.ptp(x)
