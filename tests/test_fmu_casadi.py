"""CasADi's own importer must see the right Jacobians, also those with respect to parameters.

It takes the sparsity from the dependencies in modelDescription.xml and is silently wrong where one
is missing, and it takes the entries from the FMU's directional derivatives.
"""

import zipfile
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from tests.fmu_models import exported, model_named


@pytest.mark.parametrize("name", ["P-885.51", "slow_creep", "single_mass"])
def test_jacobians(name: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(exported(name)) as archive:
        archive.extractall(tmp_path)
    imported = ca.DaeBuilder("stack", str(tmp_path)).create("f", ["x", "u", "p"], ["ode", "y"])
    model = model_named(name).plant()
    own = model.structure.f
    generator = np.random.default_rng(4)
    x = model.state_nominals() * generator.uniform(0.1, 1.0, len(model.state_names))
    u = generator.uniform(10.0, 50.0, len(model.input_names))
    p = model.parameter_vector()
    symbols = [ca.MX.sym(n, len(v)) for n, v in (("x", x), ("u", u), ("p", p))]

    def jacobian(function: ca.Function) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        every = ca.vertcat(*function(*symbols))
        dense = ca.densify(ca.jacobian(every, ca.vertcat(*symbols)))
        return np.array(ca.Function("j", symbols, [dense])(x, u, p))

    point = ca.Function("own", symbols, list(own(0.0, *symbols)))
    expected, found = jacobian(point), jacobian(imported)
    assert np.count_nonzero(expected[:, -len(p) :]) > 20
    assert found == pytest.approx(expected, rel=1e-9)
