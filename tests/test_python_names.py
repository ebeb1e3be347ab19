"""The public names: few to begin with, the others where they belong; a model in CasADi's words."""

import ast
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import psa_casadi as psa


def test_dir_has_every_public_name_and_all_are_there() -> None:
    """Those that a tool or a reader looks for: of the package, its stubs for types, its spaces."""
    spaces = {"datasets", "design", "online", "system", "__version__"}
    assert spaces < set(dir(psa)) == set(psa.__all__)
    tree = ast.parse(Path(psa.__file__).read_text(encoding="utf-8"))
    typed = {
        alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)
        for alias in node.names
    } - {"import_module", "TYPE_CHECKING", "Any"}  # fmt: skip
    assert typed == set(dir(psa))
    assert {*psa.online.__all__, *psa.system.__all__} <= set(dir(psa))
    for name in dir(psa):
        assert getattr(psa, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = psa.nothing


@pytest.mark.parametrize("space", ["design", "online", "system"])
def test_a_space_has_what_it_names(space: str) -> None:
    module = getattr(psa, space)
    assert module.__all__ == sorted(module.__all__, key=lambda n: (n.upper() != n, n.islower(), n))
    for name in module.__all__:
        assert getattr(module, name) is not None
        assert name in dir(module)
    with pytest.raises(AttributeError, match="nothing"):
        _ = module.nothing


def test_a_model_in_casadis_words_integrates_as_it_simulates() -> None:
    model = psa.stack_model("P-885.51").plant()
    dae = model.casadi()
    sizes = {k: v.numel() for k, v in dae.items()}
    assert sizes["x"] == sizes["ode"] == len(model.state_names)
    assert (sizes["u"], sizes["p"]) == (len(model.input_names), len(model.parameter_names))
    step = ca.integrator(
        "step", "cvodes", {k: dae[k] for k in ("x", "u", "p", "ode")}, 0.0, 2e-3,
        {"reltol": 1e-10, "abstol": 1e-14},
    )  # fmt: skip
    volts = {"voltage": 50.0}
    u = np.array([volts.get(n, 0.0) for n in model.input_names])
    p = model.parameter_vector()
    end = step(x0=np.zeros(sizes["x"]), u=u, p=p)["xf"]
    y = ca.Function("y", [dae[k] for k in "xup"], [dae["y"]])(end, u, p)
    displacement = float(y[model.output_names.index("displacement")])
    t = np.linspace(0.0, 2e-3, 21)
    run = psa.run(model, t, np.tile(u, (21, 1)), np.zeros(sizes["x"]), rtol=1e-10)
    expected = run.y[-1, model.output_names.index("displacement")]
    assert displacement == pytest.approx(expected, rel=1e-6)


def test_a_models_words_make_a_model_again() -> None:
    model = psa.stack_model("P-885.51").plant()
    values = {f"p_{k}": v for k, v in enumerate(model.parameter_vector())}
    names = [[f"{c}_{k}" for k in range(n)] for c, n in (("x", len(model.state_names)),
             ("u", len(model.input_names)), ("y", len(model.output_names)))]  # fmt: skip
    again = psa.system.ode_model(
        model.casadi(), name="again", states=names[0], inputs=names[1], outputs=names[2],
        parameters=list(values), values=values,
    )  # fmt: skip
    x, u = np.linspace(0.0, 1e-6, len(names[0])), np.ones(len(names[1]))
    for one, other in zip(
        model.structure.f(0.0, x, u, model.parameter_vector()),
        again.structure.f(0.0, x, u, again.parameter_vector()),
        strict=True,
    ):
        np.testing.assert_allclose(np.array(one), np.array(other), rtol=1e-12)


def test_sampled_states_have_no_such_words() -> None:
    name = next(n for n in psa.PARTS if psa.system.part_model(n).sampled_names)
    with pytest.raises(psa.InputError, match="sample instants only"):
        psa.system.part_model(name).casadi()
