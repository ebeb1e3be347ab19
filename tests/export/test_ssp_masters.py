"""SSP archives in three masters, against one model and an independent solution."""

from functools import cache

import numpy as np
import pytest

from psa_casadi.export.importer.fmu import FmuError
from psa_casadi.export.importer.masters import Signals
from psa_casadi.export.ssp.archive import wiring_of
from psa_casadi.export.ssp.steps import stable_step
from psa_casadi.simulation.stepper import run
from psa_casadi.units import FloatArray
from tests.export.ssp_master import SspArchive, couple, points
from tests.export.ssp_systems import END, RATE, archive_of, closed_loop, monolithic, pushed_stage
from tests.studies.benchmarks.coupling import by_ecos, by_fmpy, load_ecos, settles
from tests.tiers import slow

_HEIGHT, _PERIOD, _LOOP_END = 4e-6, 2e-3, 1e-3


def ramp() -> Signals:
    return Signals(("command",), np.array([0.0, 1.0]), np.array([[0.0], [RATE]]))


def wanted(t: float) -> float:
    """Return the reference of the closed loop [m]: smooth, and 0 at the start."""
    return float(_HEIGHT * 0.5 * (1.0 - np.cos(2.0 * np.pi * t / _PERIOD)))


@cache
def one_model(step: float) -> FloatArray:
    """Return the stage's position of the closed loop as one model at the points k step [m]."""
    model = closed_loop().model()
    fine = 2.5e-7
    times = points(fine, _LOOP_END)
    u = np.array([[wanted(t)] for t in times])
    rest = np.array([s.start for s in model.structure.states])
    y = run(model, times, u, rest, rtol=1e-10).y[:, model.output_names.index("stage_position")]
    return y[:: round(step / fine)]


def own(step: float, *, rates: bool) -> FloatArray:
    """Return the stage's position of the closed loop from the package's own master [m]."""
    times = points(step, _LOOP_END)
    reference = Signals(("reference",), times, np.array([[wanted(t)] for t in times]), not rates)
    with SspArchive(archive_of("closed_loop")) as archive:
        found = couple(archive, times, reference, ["stage_position"], rates=rates, tolerance=1e-9)
    return np.asarray(found[:, 0])


@pytest.mark.parametrize(("rates", "order"), [(False, 1), (True, 2)])
def test_two_parts_approach_an_independent_solution(rates: bool, order: int) -> None:
    """LSODA on hand-wired equations; to first order, with input derivatives to second."""
    exact = np.array(monolithic())
    errors = []
    with SspArchive(archive_of("pushed_stage")) as archive:
        for step in (1e-6, 5e-7):
            found = couple(
                archive, points(step, END), ramp(), ["stack.x", "stage_position"], rates=rates,
                tolerance=1e-9,
            )  # fmt: skip
            errors.append(float(np.abs(found[-1] - exact).max()) / exact[0])
    assert errors[0] / errors[1] > 0.8 * 2**order
    assert errors[1] < (5e-3 if order == 1 else 2e-6)


@slow
@pytest.mark.parametrize(("rates", "order"), [(False, 1), (True, 2)])
def test_the_closed_loop_approaches_one_model_of_it(rates: bool, order: int) -> None:
    errors = [
        float(np.abs(own(step, rates=rates) - one_model(step)).max()) for step in (2.5e-6, 1.25e-6)
    ]
    assert 0.8 * 2**order < errors[0] / errors[1] < 1.25 * 2**order, errors
    assert errors[1] < (1e-2 if order == 1 else 1e-4) * _HEIGHT


@slow
def test_fmpy_and_ecos_agree_and_approach_one_model() -> None:
    """Both hold inputs and pass outputs on after every step, so only rounding is between them."""
    path, errors = archive_of("closed_loop"), []
    ecos = load_ecos()
    for step in (5e-6, 2.5e-6):
        count = round(_LOOP_END / step)
        theirs = by_fmpy(path, step, count, {"reference": wanted}, ["stage_position"])[:, 0]
        errors.append(float(np.abs(theirs - one_model(step)).max()))
        if ecos is not None:
            other = by_ecos(ecos, path, step, count, {"reference": wanted}, ["stage_position"])
            assert np.abs(theirs - other[:, 0]).max() < 1e-12 * _HEIGHT
    assert 1.6 < errors[0] / errors[1] < 2.5, errors
    assert errors[1] < 1e-2 * _HEIGHT


@pytest.mark.parametrize("rates", [False, True])
def test_the_predicted_step_is_where_the_coupling_turns_unstable(rates: bool) -> None:
    limit = stable_step(wiring_of(pushed_stage()), rates=rates)
    with SspArchive(archive_of("pushed_stage")) as archive:
        assert settles(archive, 0.95 * limit, {}, slopes=rates)
        assert not settles(archive, 1.05 * limit, {}, slopes=rates)


def test_a_coupling_that_blows_up_is_refused_with_the_reason() -> None:
    step = 4.0 * stable_step(wiring_of(pushed_stage()), rates=True)
    with (
        SspArchive(archive_of("pushed_stage")) as archive,
        pytest.raises(FmuError, match="the coupling is unstable"),
    ):
        couple(archive, points(step, 400 * step), ramp(), ["tip"], rates=True)
