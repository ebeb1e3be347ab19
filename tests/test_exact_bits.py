"""Exact steps give the same bits with and without wide vectors, and their C compiles cleanly."""

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from psa_casadi.simulation.compiler import vector_flags, zig_command
from psa_casadi.simulation.exact import run as exact
from psa_casadi.simulation.start import start_on
from tests.c_host.build import tool
from tests.exact_cases import composite, inputs, times, with_effect
from tests.tiers import slow

FloatArray = NDArray[np.float64]

LANES = (1, 4)


def _clear() -> None:
    """Forget the libraries that are loaded."""
    exact._compiled.cache_clear()
    exact._library.cache_clear()


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


def test_two_runs_have_the_same_bits() -> None:
    first, second = results("load_stiffness"), results("load_stiffness")
    assert len(first) == 4
    for ours, theirs in zip(first, second, strict=True):
        np.testing.assert_array_equal(ours, theirs)
        assert np.isfinite(ours).all()


@slow
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_every_compiler_gives_the_same_bits(
    compiler: str, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """Where `ziglang` is not installed, the system's compiler takes its place."""
    request.addfinalizer(_clear)
    found = []
    for command in ([tool(compiler)], zig_command()):
        _clear()
        monkeypatch.setenv("CC", " ".join(command))
        found.append(results("backlash"))
    for ours, theirs in zip(*found, strict=True):
        np.testing.assert_array_equal(ours, theirs)
