"""A second compiler's reading: pymoca, where it is installed."""

from typing import Any

import casadi as ca
import numpy as np
import pytest

from psa_casadi.model.compose import Model
from tests.modelica_runs import model_named, text_of

parser = pytest.importorskip("pymoca.parser")
generator = pytest.importorskip("pymoca.backends.casadi.generator")


def _derivatives(read: Any, model: Model, x: Any, u: Any) -> dict[str, float]:
    """Solve pymoca's residuals, left minus right sides, for the left sides."""
    residuals = {(e.dep(0) if e.n_dep() else e).name(): e for e in read.equations}
    known = {
        **dict(zip(model.state_names, x, strict=True)),
        **dict(zip(model.input_names, u, strict=True)),
        **model.values,
        "time": 0.7,
    }
    symbols = {v.name(): v for v in ca.symvar(ca.vertcat(*read.equations))}
    unknowns = [symbols[name] for name in residuals]
    given = [v for name, v in symbols.items() if name not in residuals]
    function = ca.Function("r", [ca.vertcat(*unknowns), *given], [ca.vertcat(*residuals.values())])
    values = [known[v.name()] for v in given]
    found = np.ones(len(unknowns))
    for _ in range(2 * len(found)):  # explicit equations: z - (left - right) ends at right
        found = found - np.array(function(found, *values)).ravel()
        found[~(np.abs(found) < 1e100)] = 1.0
    return dict(zip(residuals, found, strict=True))


@pytest.mark.parametrize("name", ["P-885.51", "slow_creep", "hysteresis_memory", "every_effect"])
def test_pymoca_reads_the_same_equations(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(generator.OP_MAP, "/", "__truediv__")  # pymoca 0.12 with casadi 3.8
    model = model_named(name)
    read = generator.generate(parser.parse(text_of(name)), "PiezoStack.Signal")
    draw = np.random.default_rng(3)
    x = model.state_nominals() * draw.normal(size=len(model.state_names))
    u = np.array([40.0, 10.0, 300.0])[: len(model.input_names)]
    got = _derivatives(read, model, x, u)
    expected = np.array(model.structure.f(0.7, x, u, model.parameter_vector())[0]).ravel()
    for state, value in zip(model.state_names, expected, strict=True):
        assert got[f"der({state})"] == pytest.approx(value, rel=1e-9), state
