"""CasADi's own importer must see the right Jacobians, also those with respect to parameters.

It takes the sparsity from the dependencies in modelDescription.xml and is silently wrong where one
is missing, and it takes the entries from the FMU's directional and, of FMI 3, adjoint derivatives.
With them it solves an optimal control problem on the binary.
"""

import zipfile
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest

from psa_casadi.model.compose import Model
from psa_casadi.variables import nominal_value
from tests.export.fmu_models import exported, model_named
from tests.tiers import slow_but

FloatArray = npt.NDArray[np.float64]

#: One seed at a time: CasADi 3.8.2 mixes up the results of several adjoint seeds, see below.
ONE_SEED = {"max_num_dir": 1}


def imported(name: str, fmi: int, directory: Path, **options: Any) -> ca.Function:
    """Return f(x, u, p) -> (ode, y) of an FMU as CasADi imports it."""
    with zipfile.ZipFile(exported(name, fmi)) as archive:
        archive.extractall(directory)
    builder = ca.DaeBuilder("stack", str(directory))
    return builder.create("f", ["x", "u", "p"], ["ode", "y"], options)


def symbolic(model: Model) -> ca.Function:
    """Return the same f of the model itself."""
    sizes = (len(model.state_names), len(model.input_names), len(model.parameter_names))
    x, u, p = (ca.MX.sym(n, size) for n, size in zip("xup", sizes, strict=True))
    return ca.Function("own", [x, u, p], list(model.structure.f(0.0, x, u, p)))


def a_point(model: Model) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return states, inputs and parameters of ordinary size, none of them 0."""
    generator = np.random.default_rng(4)
    x = model.state_nominals() * generator.uniform(0.1, 1.0, len(model.state_names))
    sizes = np.array([nominal_value(i.nominal, model.values) for i in model.structure.inputs])
    return x, sizes * generator.uniform(0.2, 1.0, len(sizes)), model.parameter_vector()


def blocks(f: ca.Function, model: Model) -> dict[str, FloatArray]:
    """Return d(ode, y)/d(x), /d(u), /d(p) at the point, block by block."""
    found = f.jacobian()(*a_point(model), 0, 0)
    names = ("ode by x", "ode by u", "ode by p", "y by x", "y by u", "y by p")
    return {n: np.array(ca.densify(block)) for n, block in zip(names, found, strict=True)}


def by_expression(f: ca.Function, model: Model) -> FloatArray:
    """Return the whole Jacobian of an expression that calls f; CasADi chooses the mode."""
    point = a_point(model)
    symbols = [ca.MX.sym(n, len(v)) for n, v in zip("xup", point, strict=True)]
    whole = ca.densify(ca.jacobian(ca.vertcat(*f(*symbols)), ca.vertcat(*symbols)))
    return np.array(ca.Function("j", symbols, [whole])(*point))


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize(
    "name", slow_but(["P-885.51"], ["P-885.51", "slow_creep", "single_mass", "flexure"])
)
def test_jacobians(name: str, fmi: int, tmp_path: Path) -> None:
    model = model_named(name).plant()
    expected, found = (blocks(f, model) for f in (symbolic(model), imported(name, fmi, tmp_path)))
    assert set(found) == set(expected)
    for block, entries in expected.items():
        assert block == "y by u" or np.any(entries), block
        assert found[block] == pytest.approx(entries, rel=1e-10, abs=0.0), block


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_jacobians_forwards_and_backwards(weight: float, fmi: int, tmp_path: Path) -> None:
    """Forwards by directional derivatives, backwards (of FMI 3) by adjoint derivatives."""
    model = model_named("P-885.51").plant()
    f = imported("P-885.51", fmi, tmp_path, ad_weight=weight, **ONE_SEED)
    expected = by_expression(symbolic(model), model)
    for columns in np.split(expected, [7, 9], axis=1):
        assert np.count_nonzero(columns) > 3
    assert by_expression(f, model) == pytest.approx(expected, rel=1e-10, abs=0.0)


STEPS, SIZE = 20, 2e-5
