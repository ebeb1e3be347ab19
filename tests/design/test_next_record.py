"""The next record of any model: within its limits, informative as predicted, for two inputs too."""

import math
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.design import Limits, design_experiment
from psa_casadi.design.experiment.experiment import Informative, Separated
from psa_casadi.design.experiment.search import Effort
from psa_casadi.report.words.design_words import design_tables
from tests.contract.helpers import done, refused, table
from tests.tiers import slow

#: Outflows of two tanks, the flow between them, rms noise of the levels [m].
TRUTH, NOISE = {"a": 9e-4, "b": 1.2e-3, "c": 4e-4}, 1e-3
LIMITS = {
    "q": Limits(0.0, 8e-4, 600.0, 600, rate=4e-5),
    "r": Limits(0.0, 6e-4, 600.0, 600, bandwidth=0.02),
}
BRIEF = Effort(draws=2, starts=1, steps=3)


def tanks() -> psa.Model:
    h, k, q, r, a, b, c = (ca.SX.sym(n) for n in ("h", "k", "q", "r", "a", "b", "c"))
    between = c * (h - k)
    return psa.ode_model(
        {
            "x": [h, k],
            "u": [q, r],
            "p": [a, b, c],
            "ode": [(q - a * h - between) / 0.02, (r - b * k + between) / 0.02],
            "y": [h, k],
        },
        name="tanks",
        states=[psa.State("h", "m", "level", 0.3, start=0.2), psa.State("k", "m", "level", 0.3)],
        inputs=[psa.Input("q", "m3/s", "flow", start=2e-4), psa.Input("r", "m3/s", "flow")],
        parameters=[
            psa.Parameter(n, v, "m2/s", (1e-5, 1e-2), "outflow", log=True) for n, v in TRUTH.items()
        ],
        outputs=[psa.Output("high", "m", "level"), psa.Output("low", "m", "level")],
    )


def played(record: psa.Signals, seed: int) -> psa.Signals:
    """Return what two tanks of SciPy do with the inputs of a record, with noise."""
    t, (q, r) = record.time, (record.columns[n] for n in ("q", "r"))
    a, b, c = TRUTH.values()

    def rates(time: float, x: FloatArray) -> list[float]:
        flow = c * (x[0] - x[1])
        first = np.interp(time, t, q) - a * x[0] - flow
        return [first / 0.02, (np.interp(time, t, r) - b * x[1] + flow) / 0.02]

    x = solve_ivp(rates, (t[0], t[-1]), [0.2, 0.0], t_eval=t, rtol=1e-8, max_step=1.0).y
    x = x + NOISE * np.random.default_rng(seed).standard_normal(x.shape)
    return psa.Signals(name="played", time=t, columns={**record.columns, "high": x[0], "low": x[1]})


@cache
def sharp() -> Informative:
    informative = design_experiment(
        tanks(), LIMITS, noise={"high": NOISE, "low": NOISE}, known_start=True, effort=BRIEF
    )
    assert isinstance(informative, Informative)
    return informative


def test_inputs_keep_their_limits_and_start_at_their_start_values() -> None:
    record = sharp().record
    assert (record.n, record.units) == (600, {"q": "m3/s", "r": "m3/s"})
    for name, first in (("q", 2e-4), ("r", 0.0)):
        values, item = record.columns[name], LIMITS[name]
        assert values[0] == pytest.approx(first, abs=1e-12)
        assert item.low <= values.min() < values.max() <= item.high
        assert np.ptp(values) > 0.3 * item.span
    rate = np.abs(np.diff(record.columns["q"]) / np.diff(record.time))
    assert rate.max() <= 4e-5 * (1.0 + 1e-6)
    assert abs(np.corrcoef(record.columns["q"], record.columns["r"])[0, 1]) < 0.95
    assert min(sharp().factor.values()) > 1.0


def test_no_interval_leaves_the_bounds_of_its_parameter() -> None:
    for name, value in TRUTH.items():
        assert sharp().before[name] == (1e-5, 1e-2)  # of its order of magnitude nothing is known
        low, high = sharp().intervals[name]
        assert 1e-5 < low < value < high < 1e-2
        assert low * high == pytest.approx(value**2)  # on a logarithmic scale
    (table, *_) = design_tables(sharp())
    assert [row[3] for row in table.table.rows] == ["1.00e-5 to 0.0100"] * 3


def test_identify_is_as_sure_on_the_designed_record_as_was_predicted() -> None:
    result = psa.identify(tanks(), played(sharp().record, 1), starts=1, known_start=True)
    for name, (low, high) in sharp().intervals.items():
        half = 0.5 * (high - low)
        assert 1.96 * result.errors[name] == pytest.approx(half, rel=0.2)
        assert abs(result.model.values[name] - TRUTH[name]) < 2.0 * half
    before = played(sharp().record, 2)
    again = design_experiment(
        tanks(), LIMITS, records=[before], zeros=["low"], parameters=["c"], effort=BRIEF,
        optimality="E", kinds=["steps"],
    )  # fmt: skip
    assert isinstance(again, Informative)
    low, high = again.before["c"]
    more, less = again.intervals["c"]
    assert list(again.intervals) == ["c"]
    assert high - low > less - more > 0.4 * (high - low)  # a record like the first: 1 / sqrt(2)


def test_what_does_not_fit_is_named() -> None:
    model = tanks()
    for words, output in (
        ({"limits": {"u": Limits(0.0, 1.0, 1.0, 100)}}, "'u', which is no input of 'tanks'"),
        ({"noise": 1e-3}, "give the noise of each by name"),
        ({"noise": {"middle": 1.0}}, "The noise of 'middle'"),
        ({"separate": ["friction_in_z", "drag_in_h"]}, "no effect 'friction_in_z'"),
        ({"parameters": ["d"]}, "no parameter 'd'"),
        ({"zeros": ["middle"]}, "`zeros` has 'middle'"),
    ):
        with pytest.raises(psa.InputError, match=output):
            design_experiment(model, **{"limits": LIMITS, **words})  # type: ignore[arg-type]


@slow
def test_a_designed_record_distinguishes_two_effects(tmp_path: Path) -> None:
    """The present effect is named on a record that was designed with ordinary sizes."""
    psa.save_model(tanks(), tmp_path / "m.json")
    done(
        "design", "experiment", "--model", tmp_path / "m.json", "--input", "q=0:8e-4", "--input",
        "r=0:6e-4", "--duration", "600", "--samples", "600", "--noise", "high=1e-3", "--noise",
        "low=1e-3", "--known-start", "--starts", "1", "--separate", "bend_of_q", "loss_in_h",
        "-o", tmp_path / "next.csv", "--report", tmp_path / "next.html",
    )  # fmt: skip
    columns = table(tmp_path / "next.csv")
    assert list(columns) == ["time [s]", "q [m3/s]", "r [m3/s]"]
    assert "The r to apply" in (tmp_path / "next.html").read_text("utf-8")
    result = design_experiment(
        tanks(), LIMITS, separate=["bend_of_q", "drag_in_h"], known_start=True, effort=BRIEF
    )
    assert isinstance(result, Separated)
    assert min(p.designed for p in result.pairs) > 0.0
    assert all(math.isfinite(p) for p in result.chance.values())


def test_the_command_states_which_input_may_move(tmp_path: Path) -> None:
    psa.save_model(tanks(), tmp_path / "m.json")
    words = ("design", "experiment", "--model", tmp_path / "m.json", "--duration", "600")
    assert "add --input NAME=LOW:HIGH, of q, r." in refused(*words)
    output = refused(*words, "--input", "q=1", "--low", "3", "--noise", "-1")
    for part in ("--input is 'q=1'", "--low does not apply to your model", "--noise is -1"):
        assert part in output
    output = refused("design", "experiment", "--stack", "demo", "--duration", "1", "--known-start")
    assert "--known-start applies to your model" in output
