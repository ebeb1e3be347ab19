"""Further columns: fitted, each with its noise, and what each decided.

The plants are independent ones (`tests/studies/plants/further_columns.py`): other equations than
the effects, and sensors with scales and zeros.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.notes import texts
from psa_casadi.diagnosis.diagnose import decided
from psa_casadi.identification.fitting.fit import Objective, fit
from psa_casadi.identification.fitting.prediction import scaled
from psa_casadi.identification.prepare import COLUMNS, columns_of, with_levels
from psa_casadi.identification.start.ordinary import capacitance_of, starting_model
from psa_casadi.model.components.surroundings import flexure
from psa_casadi.records.split import split, whole
from psa_casadi.simulation.simulate import Way
from tests.studies.plants import further_columns as plants
from tests.studies.plants.excitations import ExcitationKind
from tests.tiers import slow

BENDS = ("load_stiffness", "sensor_nonlinearity")
VOLTAGES = ("amplifier_nonlinearity", "saturation_of_strain")
CHARGES = ("field_dependent_capacitance", "field_dependent_gain")
SAMPLES = 3000
Hide = Callable[[plants.Truth, float], plants.Truth]


def diagnosed(
    hide: Hide,
    gain: float,
    column: str,
    effects: tuple[str, ...],
    excitation: ExcitationKind = "rich",
    seed: int = 2,
) -> psa.StackDiagnosis:
    truth = hide(plants.plain(seed, excitation), gain)
    record = truth.record(seed, column, samples=SAMPLES)
    return psa.diagnose([record], effects=[psa.EFFECTS[n] for n in effects])


def test_every_column_is_read_and_its_scale_and_noise_are_fitted(tmp_path: Path) -> None:
    """A file with all columns, under laboratories' names too; the sensors' scales come back."""
    truth = plants.plain(1)
    r = truth.record(1, *COLUMNS, samples=1500)
    path = tmp_path / "a.csv"
    names = ("time", "voltage", "displacement", "monitor_voltage", "charge", "current")
    sizes = (1.0, 1.0, 1e6, 1.0, 1e6, 1e3, 1e6, 1e6)
    columns = [
        size * getattr(r, n)
        for n, size in zip((*names, "displacement_2", "strain"), sizes, strict=True)
    ]
    header = "t [s],u [V],x [um],V_mon [V],q [uC],i [mA],x2 [um],strain [um/m]"
    np.savetxt(
        path, np.column_stack(columns), delimiter=",", header=header, comments="", fmt="%.9g"
    )
    read = psa.read_record(path)
    for name in COLUMNS:
        np.testing.assert_allclose(getattr(read, name), getattr(r, name), rtol=1e-6, atol=1e-12)
    start = starting_model([read])
    result = columns_of(start, [read])
    assert result.fitted == tuple(COLUMNS)
    assert not result.left_out
    experiments = with_levels([whole(read)], result.fitted)
    free = ["k_L", "A", "beta", "gamma", "delta", "n", "tau", "R_s"]
    fitted = fit(result.model, experiments, free, sigma=[plants.NOISE * read.range_m])
    p = fitted.model.values
    assert p["monitor_scale"] == pytest.approx(0.01, rel=3e-3)
    assert p["sensor_2_scale"] == pytest.approx(0.83, rel=3e-3)
    assert p["strain_scale"] == pytest.approx(55.0, rel=3e-3)
    for f in fitted.further:
        if f.column == "current":  # which shows lags that the displacement does not determine
            assert f.rms < 2.0 * f.straight
            continue
        inputs = {n: getattr(read, n) for n in COLUMNS}[f.column]
        assert f.rms == pytest.approx(plants.FURTHER_NOISE * np.ptp(inputs), rel=0.2), f.column
    # a charge gives the capacitance of the free stack, with what the displacement frees
    capacitance = capacitance_of([replace(read, current=None)])
    assert capacitance is not None
    assert capacitance.source == "charge"
    stack, slope = truth.run.stack, np.polyfit(truth.voltage, truth.displacement, 1)[0]
    assert capacitance.value == pytest.approx(stack.c_p_el + stack.k_l * slope, rel=0.05)


@slow
def test_the_derivatives_of_further_columns_are_those_of_their_residuals() -> None:
    r = plants.plain(1).record(1, "charge", "monitor_voltage", samples=300)
    result = columns_of(starting_model([r]), [r])
    experiments = with_levels([whole(r)], result.fitted)
    some = fit(result.model, experiments, ["k_L", "A", "R_s"], sigma=[1e-8], evaluations=1)
    way = Way(1e-9, 1e-9)
    evaluate = Objective(result.model, experiments, some.unknowns, [1e-8], way)
    theta, rows = some.theta, slice(300, 900)
    at = evaluate(theta)
    assert at is not None
    for k in range(3):
        step = np.zeros_like(theta)
        step[k] = 1e-4
        up, down = evaluate(theta + step), evaluate(theta - step)
        assert up is not None
        assert down is not None
        cost = 0.5 * (np.sum(up[0][rows] ** 2) - np.sum(down[0][rows] ** 2)) / 2e-4
        # Kaufman's Jacobian has the gradient of the cost exactly
        assert at[1][rows, k] @ at[0][rows] == pytest.approx(cost, rel=2e-3, abs=1e-3)


def test_a_column_that_the_model_cannot_give_is_refused_and_a_useless_one_left_out() -> None:
    time = np.linspace(0.0, 1.0, 50)
    r = psa.Record(
        name="r",
        time=time,
        voltage=10 * time,
        displacement=1e-6 * time,
        monitor_voltage=time,
        strain=0.0 * time,
    )
    with pytest.raises(
        psa.InputError, match="'monitor_voltage', but the model 'psa' does not give it"
    ):
        columns_of(psa.compose([flexure]), [r])
    result = columns_of(starting_model([r]), [r])
    assert result.fitted == ("monitor_voltage",)
    assert texts(result.left_out) == ("strain is left out: it never changes.",)
    assert "monitor_voltage" in result.model.output_names
    turned = replace(r, current=-np.gradient(time), monitor_voltage=None, strain=None)
    (statement,) = columns_of(starting_model([turned]), [turned]).left_out
    assert "does not follow the voltage as a capacitance's does" in str(statement)
    with pytest.raises(psa.InputError, match="column 'monitor_voltage': found no value"):
        replace(r, monitor_voltage=np.where(time > 0.5, np.nan, time))


def test_a_turned_sign_is_reported() -> None:
    r = plants.plain(1).record(1, "charge", samples=400)
    turned = replace(r, charge=-np.asarray(r.charge))
    for record, output in ((r, False), (turned, True)):
        result = columns_of(starting_model([record]), [record])
        experiments = with_levels([whole(record)], result.fitted)
        (further,) = fit(result.model, experiments, [], sigma=[1e-8], evaluations=1).further
        assert ("its sign is probably turned" in texts(further.notes)[-1]) is output


@pytest.mark.parametrize(
    ("now", "then", "sentence"),
    [
        ({}, {}, "agrees with the model"),
        ({"slow_creep": 1.0}, {"slow_creep": 1.0}, "changes no name; it adds 7 "),
        ({"slow_creep": 1.0}, {}, "Only with monitor_voltage is there slow_creep; without it noth"),
        ({}, {"slow_creep": 1.0}, "nothing is named; without it slow_creep 100 %"),
        ({"slow_creep": 1.0}, {"drive_lag": 0.6, "slow_creep": 0.4}, "the amplifier is ruled out"),
        ({"slow_creep": 1.0}, {"ageing": 0.6, "slow_creep": 0.4}, "With monitor_voltage ageing is"),
        (
            {"drive_lag": 1.0},
            {"ageing": 0.6, "sensor_lag": 0.4},
            "the sensor and the stack with its load are rul",
        ),
    ],
)
def test_decisions_in_words(now: dict[str, float], then: dict[str, float], sentence: str) -> None:
    assert sentence in str(decided("monitor_voltage", now, then, 7.2, psa.EFFECTS, clear=not now))


def test_a_column_explains_nothing_where_something_is_left() -> None:
    of = {"load_stiffness": 0.5, "sensor_nonlinearity": 0.5}
    clear = str(decided("load_force", {}, of, 0.0, psa.EFFECTS, clear=True))
    assert "load_stiffness is in the column" in clear
    assert "nothing is named" in str(decided("load_force", {}, of, 0.0, psa.EFFECTS, clear=False))
    assert "decides nothing" in str(decided("load_force", {}, {}, 0.0, psa.EFFECTS, clear=False))


def test_a_level_is_no_smaller_than_what_a_sensor_s_straightness_allows() -> None:
    r = plants.plain(1).record(1, "displacement_2", samples=400)
    result = columns_of(starting_model([r]), [r])
    some = fit(
        result.model, with_levels([split(r)], result.fitted), [], sigma=[1e-8], evaluations=1
    )
    (further,) = some.further
    assert further.straight == pytest.approx(1e-3 * further.spread)
    model, (others,) = scaled(some.model, some.further)
    assert model.values == pytest.approx(some.model.values)  # the scale is in the model already
    assert others.factors == pytest.approx([1.0])
    assert "displacement_2: fitted beside the displacement" in str(further.notes[0])


@slow
def test_a_second_sensor_distinguishes_a_bent_one_from_a_stiffening_load(tmp_path: Path) -> None:
    right = "sensor_nonlinearity"
    result = diagnosed(plants.bent_sensor, 0.03, "displacement_2", BENDS)
    assert [c.effect for c in result.causes] == [right]
    assert result.causes[0].cannot_be_told_from == ()
    (decided,) = result.columns
    assert set(decided.named_without) == set(BENDS)
    assert decided.ruled_out == tuple(n for n in decided.named_without if n != right)
    assert decided.base_rms is not None
    assert decided.noise == pytest.approx(decided.extended_rms, rel=0.1)
    assert decided.evidence > 20.0
    text = " ".join(psa.story(result).split())
    assert "With displacement_2 the stack with its load is ruled out" in text
    assert json.loads(result.to_json())["columns"][0]["named"] == {right: pytest.approx(1.0)}
    psa.write_report(result, tmp_path / "page.html", still=True)
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "What the further columns decided" in page
    assert "With displacement_2" in page


@slow
def test_a_load_cell_distinguishes_a_bent_sensor_from_a_stiffening_load() -> None:
    """The measured load is an input; a load that stiffens is in the column then."""
    bent = diagnosed(plants.bent_sensor, 0.03, "load_force", BENDS)
    assert [c.effect for c in bent.causes] == ["sensor_nonlinearity"]
    assert bent.columns[0].ruled_out == ("load_stiffness",)
    loaded = diagnosed(plants.stiffening_load, 0.03, "load_force", BENDS)
    assert loaded.verdict == "adequate"
    (decided,) = loaded.columns
    assert decided.role == "input"
    assert set(decided.named_without) == set(BENDS)
    assert "load_stiffness is in the column" in decided.sentence
    # and it determines the stiffness that it meets, which nothing else does
    stiffness = 1.0 / plants.plain(2).run.stack.compliance
    assert loaded.model.values["k_B"] == pytest.approx(stiffness, rel=0.15)


@slow
@pytest.mark.parametrize(
    ("hide", "right", "place"),
    [
        (plants.soft_amplifier, "amplifier_nonlinearity", "the stack with its load"),
        (plants.saturating_stack, "saturation_of_strain", "the amplifier"),
    ],
)
def test_a_monitor_voltage_distinguishes_the_amplifier_from_the_stack(
    hide: Hide, right: str, place: str
) -> None:
    result = diagnosed(hide, 0.1, "monitor_voltage", VOLTAGES, "triangle")
    assert [c.effect for c in result.causes] == [right]
    (decided,) = result.columns
    assert set(decided.named_without) == set(VOLTAGES)
    assert f"{place} is ruled out" in decided.sentence
    assert decided.named[right] > 0.99


@slow
def test_a_capacitance_that_grows_shows_in_the_charge_alone() -> None:
    result = diagnosed(plants.growing_capacitance, 0.3, "charge", CHARGES, seed=1)
    assert [c.effect for c in result.causes] == ["field_dependent_capacitance"]
    (decided,) = result.columns
    assert decided.named_without == {}
    assert "Only with charge" in decided.sentence


@slow
def test_a_column_of_a_clean_stack_raises_no_alarm() -> None:
    record = plants.plain(2).record(2, "current", samples=SAMPLES)
    result = psa.diagnose([record], effects=[psa.EFFECTS[n] for n in (*VOLTAGES, *CHARGES)])
    assert result.verdict == "adequate"
    (decided,) = result.columns
    assert "agrees with the model" in decided.sentence
    assert decided.base_rms == pytest.approx(decided.noise, rel=0.25)
