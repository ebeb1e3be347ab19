"""Exact steps give the same bits with and without wide vectors, and their C compiles cleanly."""

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from psa_casadi.simulation import stepper
from psa_casadi.simulation.compiler import FLAGS_VARIABLE, vector_flags, zig_command
from psa_casadi.simulation.exact import run as exact
from psa_casadi.simulation.start import start_on
from tests.c_host.build import tool
from tests.exact_cases import composite, inputs, times, with_effect
from tests.tiers import slow

FloatArray = NDArray[np.float64]


def _clear() -> None:
    """Forget the libraries that are loaded."""
    exact._compiled.cache_clear()
    exact._library.cache_clear()
    stepper._library.cache_clear()


@pytest.fixture
def _plain_vectors(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Compile without this processor's vectors, in libraries of their own."""
    _clear()
    monkeypatch.setattr(exact, "vector_flags", lambda: ())
    yield
    _clear()


def results(name: str) -> list[FloatArray]:
    """Return displacement, derivatives, states and outputs of a run."""
    model = with_effect(name)
    t = times(400, 1e-4)
    u = inputs(model, t, composite(400))
    unknowns: list[str | int] = ["k_L", "A", "R_s", "tau", "k_P"]
    found = exact.run_exact(
        model, t, u, start_on(model, t, u).x, tolerance=1e-7, unknowns=unknowns, everything=True
    )
    arrays = (found.shown, found.sensitivity, found.x, found.y)
    return [np.asarray(a) for a in arrays if a is not None]


@pytest.mark.skipif(not vector_flags(), reason="this processor has no wide vectors")
def test_wide_vectors_do_not_change_a_bit(
    request: pytest.FixtureRequest,
) -> None:
    wide = results("backlash")
    request.getfixturevalue("_plain_vectors")
    for ours, theirs in zip(wide, results("backlash"), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@slow
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_every_compiler_gives_the_same_bits(
    compiler: str, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """Where `ziglang` is not installed, the system's compiler takes its place."""
    request.addfinalizer(_clear)
    monkeypatch.delenv(FLAGS_VARIABLE, raising=False)
    found = []
    for command in ([tool(compiler)], zig_command()):
        _clear()
        monkeypatch.setenv("CC", " ".join(command))
        found.append(results("backlash"))
    for ours, theirs in zip(*found, strict=True):
        np.testing.assert_array_equal(ours, theirs)


@slow
def test_what_the_tests_compile_with_gives_the_bits_of_what_users_have(
    monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """Exact steps of one set and of four side by side, and the stepper: -Og, -O1 or -O3, -O2."""
    request.addfinalizer(_clear)
    monkeypatch.setenv("CC", tool("gcc"))
    found = []
    for flags in ("-Og", ""):
        _clear()
        monkeypatch.setenv(FLAGS_VARIABLE, flags)
        found.append([*results("backlash"), *_side_by_side("backlash"), *_stepped("backlash")])
    assert len(found[0]) == 7
    for ours, theirs in zip(*found, strict=True):
        np.testing.assert_array_equal(ours, theirs)
        assert np.ptp(ours) > 0.0


def _side_by_side(name: str) -> list[FloatArray]:
    """Return the displacement (n, 4) of four sets of parameters in lanes."""
    model = with_effect(name)
    t = times(400, 1e-4)
    u = inputs(model, t, composite(400))
    sets = [model.with_values({"k_L": share * model.values["k_L"]}) for share in (1, 1.1, 1.2, 1.3)]
    p = np.array([[m.values[n] for m in sets] for n in model.parameter_names])
    x0, nominal = (
        np.column_stack(columns)
        for columns in zip(*((start_on(m, t, u).x, m.state_nominals()) for m in sets), strict=True)
    )
    return [exact.run_sets(model.structure, t, u, p=p, x0=x0, nominal=nominal, tolerance=1e-7)]


def _stepped(name: str) -> list[FloatArray]:
    """Return outputs and derivatives of the stepper."""
    model = with_effect(name)
    t = times(400, 1e-4)
    u = inputs(model, t, composite(400))
    found = stepper.run(model, t, u, start_on(model, t, u).x, unknowns=["k_L", "A"])
    return [found.y, np.asarray(found.sensitivity)]
