"""Records of a user's model in files and tables: units, noise, held inputs, what is refused."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import h5py
import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.experiments import column_notes, experiments_of, given_to
from psa_casadi.records.read.reading import records_given
from psa_casadi.records.split import Experiment
from tests.any_model import own_plants as plants
from tests.any_model.own_models import cylinder, motor, oscillator, oven

N = 400
T = np.arange(N, dtype=np.float64) * 2e-3
RNG = np.random.default_rng(5)
VALVE, FLOW, SPEED, WARM = (np.cumsum(RNG.standard_normal((4, N)), axis=1) + 3.0).round(6)


def _pump() -> psa.Model:
    w, h, valve, flow = (ca.SX.sym(n) for n in ("w", "h", "valve", "flow"))
    return psa.ode_model(
        {"x": [w, h], "u": [valve, flow], "ode": [valve - w, flow - h], "y": [w, h]},
        name="pump",
        inputs=[psa.Input("valve", "1", "opening"), psa.Input("flow", "m3/s", "flow")],
        outputs=[psa.Output("Speed", "rad/s", "speed"), psa.Output("oil_temp", "K", "warmth")],
    )


#: The columns of a record in units that are not the model's.
COLUMNS = {
    "Time [ms]": 1e3 * T,
    "valve [%]": 100.0 * VALVE,
    "FLOW (l/min)": 6e4 * FLOW,
    "speed (rpm)": SPEED * 30.0 / np.pi,
    "Oil-Temp [°C]": WARM - 273.15,
    "remark [V]": np.ones(N),
}
NAMES = [name.strip("])").replace("(", "[").partition("[") for name in COLUMNS]


def _rows(mark: str, point: str, end: str = "\n") -> str:
    table = np.column_stack([*COLUMNS.values()]).tolist()
    return end.join(mark.join(repr(v).replace(".", point) for v in row) for row in table)


def _csv(path: Path) -> Path:
    path.write_text(",".join(COLUMNS) + "\n" + _rows(",", "."), "utf-8")
    return path


def _german(path: Path) -> Path:
    """With a mark of UTF-8, a preamble, units in a separate row, and decimal commas."""
    head = "Prüfstand 3;;\r\n\r\nZeit;valve;flow;speed;Oil temp;remark\r\n"
    head += "[ms];[%];[l/min];[rpm];[degC];[V]\r\n"
    path.write_bytes(b"\xef\xbb\xbf" + (head + _rows(";", ",", "\r\n")).encode())
    return path


def _excel(path: Path) -> Path:
    pd.DataFrame(COLUMNS).to_excel(path, index=False)
    return path


def _parquet(path: Path) -> Path:
    pd.DataFrame(COLUMNS).to_parquet(path)
    return path


def _hdf5(path: Path) -> Path:
    with h5py.File(path, "w") as file:
        group = file.create_group("log")
        for (name, _, unit), values in zip(NAMES, COLUMNS.values(), strict=True):
            group.create_dataset(name.strip(), data=values).attrs["units"] = unit
    return path


def _matlab(path: Path) -> Path:
    """Without units, which are then the model's; a current in amperes would be a stack's."""
    log = {"valve": VALVE, "flow": FLOW, "speed": SPEED, "oil_temp": WARM}
    savemat(path, {"time": T, "log": log})
    return path


def _run(records: Any) -> Experiment:
    model = _pump()
    (run,) = experiments_of(model, given_to(model, records, None), judged=False)
    return run


def _columns(run: Experiment, names: Sequence[str]) -> FloatArray:
    """Return columns of an experiment's record (n, names)."""
    return np.column_stack([np.asarray(run.record.column(n)) for n in names])


def _assert_is_the_record(records: Any) -> None:
    run = _run(records)
    np.testing.assert_allclose(run.record.time - run.record.time[0], T, atol=1e-12)
    np.testing.assert_allclose(
        _columns(run, _pump().input_names), np.column_stack([VALVE, FLOW]), rtol=1e-12
    )
    np.testing.assert_allclose(
        _columns(run, _pump().output_names), np.column_stack([SPEED, WARM]), 1e-12, 1e-12
    )


@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("a.csv", _csv),
        ("a.txt", _german),
        ("a.xlsx", _excel),
        ("a.parquet", _parquet),
        ("a.h5", _hdf5),
        ("a.mat", _matlab),
    ],
)
def test_a_file_is_read_in_the_units_of_the_model(
    name: str, written: Callable[[Path], Path], tmp_path: Path
) -> None:
    path = written(tmp_path / name)
    _assert_is_the_record(path)
    _assert_is_the_record([str(path)])


def test_tables_and_signals_are_read_in_the_units_of_the_model() -> None:
    _assert_is_the_record(COLUMNS)
    _assert_is_the_record(pd.DataFrame(COLUMNS))
    table = {"valve": VALVE, "flow": 6e4 * FLOW, "Speed": SPEED, "oil_temp": WARM - 273.15}
    units = {"flow": "l/min", "oil_temp": "degC"}
    signals = psa.Signals(name="run", time=T, columns=table, units=units)
    _assert_is_the_record(signals)
    _assert_is_the_record(signals.to_frame())
    assert signals.plot(output="flow").axes[0].get_ylabel() == "flow [l/min]"
    assert len(signals.plot().axes) == len(signals.columns)


def test_the_same_record_in_other_units_is_the_same_identification(tmp_path: Path) -> None:
    record = plants.bouc_wen(1)
    table = {
        "t [ms]": 1e3 * record.time[:500],
        "Force [kN]": 1e-3 * record.columns["force"][:500],
        "position [mm]": 1e3 * record.columns["position"][:500],
    }
    path = tmp_path / "drive.csv"
    np.savetxt(
        path, np.column_stack([*table.values()]), "%.17g", ";", header=";".join(table), comments=""
    )
    columns = {n: v[:500] for n, v in record.columns.items()}
    plain = psa.Signals(name="drive", time=record.time[:500], columns=columns)
    expected = psa.identify(oscillator(), plain, starts=1).model.values
    for one in (table, path):
        assert psa.identify(oscillator(), one, starts=1).model.values == pytest.approx(expected)


def test_a_stacks_record_drives_any_model_and_signals_a_stack() -> None:
    u, x, k = ca.SX.sym("voltage"), ca.SX.sym("s"), ca.SX.sym("k")
    model = psa.ode_model(
        {"x": x, "u": u, "p": k, "ode": k * u - x, "y": x},
        name="any",
        inputs=[psa.Input("voltage", "kV", "voltage")],
        outputs=[psa.Output("strain", "ppm", "strain")],
        values={"k": 1.0},
    )
    record = psa.Record(name="r", time=T, voltage=10.0 * VALVE, strain=1e-6 * SPEED)
    (run,) = experiments_of(model, given_to(model, record, "zero"), judged=False)
    np.testing.assert_allclose(_columns(run, model.input_names)[:, 0], 1e-2 * VALVE, rtol=1e-12)
    np.testing.assert_allclose(_columns(run, model.output_names)[:, 0], SPEED, rtol=1e-12)
    assert (run.record.hold, run.record.sha256) == ("zero", record.sha256)
    columns = {"voltage": VALVE, "displacement": SPEED}
    units = {"voltage": "V", "displacement": "um"}
    signals = psa.Signals(name="s", time=T, columns=columns, units=units)
    (again,) = records_given(signals)
    np.testing.assert_allclose(np.asarray(again.displacement), 1e-6 * SPEED, rtol=1e-12)


def _refused(records: Any, model: psa.Model | None = None) -> str:
    with pytest.raises(psa.InputError) as caught:
        psa.identify(_pump() if model is None else model, records, starts=1)
    return str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ("valve [%]", "valve [kV]"),
            r"states no unit; declare it, as psa.Input\('valve', 'V', ''\)",
        ),
        (("valve [%]", "vavle [%]"), "'valve' is missing.*say which column it is: --columns valve"),
        (("speed (rpm)", "speed [N]"), r"column 'Speed': cannot convert 'N' \(force\) to 'rad/s'"),
        (("speed (rpm)", "speed [foo]"), "column 'Speed': the unit 'foo' is unknown"),
        (("Time [ms]", "Time [mm]"), "column 'time': the unit 'mm' does not measure time"),
        (("Time [ms]", "hours of work"), "'time' is missing.*--columns \"?time=hours of work:s"),
        (("remark [V]", "Flow (m3/s)"), "column 6: 'flow' occurs twice in the header"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_what_to_type(
    change: tuple[str, str], message: str
) -> None:
    before, after = change
    table = {after if name == before else name: values for name, values in COLUMNS.items()}
    assert re.search(message, _refused(table), re.DOTALL)


def test_all_mistakes_of_all_records_are_reported_at_once(tmp_path: Path) -> None:
    bad = tmp_path / "bad.csv"
    bad.write_text("time [s],valve,flow,speed\n" + "0,1,2,x\n" * 20)
    statement = _refused([bad, tmp_path / "none.csv", 5, {"time": T, "valve": VALVE}])
    assert "bad.csv: line 2, column 'Speed': found 'x', expected a number" in statement
    assert "none.csv: there is no such file" in statement
    assert "int is no record; give the path of a file, a data frame" in statement
    assert (
        "record 4: column names: the column 'flow' is missing (present: time, valve)" in statement
    )
    statement = _refused({"time": T, "valve": VALVE, "flow": FLOW})
    assert "no output of the model 'pump' with eight samples or more; the model's are" in statement


def test_a_unit_that_is_not_stated_is_reported() -> None:
    result = psa.identify(motor(), plants.motor(2, friction=0.0), starts=1)
    assert not result.warnings
    record = plants.motor(2, friction=0.0)
    result = psa.identify(motor(), {"time": record.time, **record.columns}, starts=1)
    assert result.warnings == ("record states no unit of w and i; the model's are taken.",)


def test_a_column_that_is_like_a_missing_output_is_named(tmp_path: Path) -> None:
    columns = {**COLUMNS, "ol_temp [K]": WARM}
    del columns["Oil-Temp [°C]"]
    file = _csv(tmp_path / "p.csv")
    file.write_text(file.read_text("utf-8").replace("Oil-Temp", "ol_temp", 1), "utf-8")
    by_hand = psa.Signals(
        name="hand", time=T, columns={"valve": VALVE, "flow": FLOW, "Speed": SPEED, "ol_temp": WARM}
    )
    for inputs in (columns, file, by_hand):
        text = " ".join(map(str, column_notes(_pump(), [_run(inputs)])))
        assert "No record has a column 'oil_temp'; that output is not compared." in text
        assert "The records have 'ol_temp'; name the column 'oil_temp' if it is that." in text


def test_columns_are_named_where_the_header_does_not(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = np.column_stack([T, VALVE, FLOW, SPEED])
    np.savetxt(path, rows, "%.17g", ",", header="a,b,c,CH 4", comments="")
    read = partial(psa.read_signals, inputs=("valve", "flow"), outputs=("Speed", "oil_temp"))
    text = "time=a:s,valve=b:1,flow=3:m3/s,speed=CH 4:2rpm"
    (signals,) = read(path, columns=text)
    assert (signals.units["flow"], signals.units["Speed"]) == ("m3/s", "rpm")
    np.testing.assert_allclose(signals.columns["Speed"], 2.0 * SPEED, rtol=1e-12)
    (again,) = read([path], columns="valve=b,flow=c,Speed=CH 4", sample_time=0.1)
    assert again.time[-1] == pytest.approx(0.1 * (N - 1))
    with pytest.raises(psa.InputError, match=r"'sped' is no column of a record; is 'Speed' meant"):
        read(path, columns="sped=CH 4")


def _spoilt(record: psa.Signals, outputs: tuple[str, ...], seed: int) -> dict[str, Any]:
    """Return a record of which 1 % of the readings are far off, as columns."""
    rng, columns = np.random.default_rng(seed), dict(record.columns)
    for name in outputs:
        y = np.array(columns[name])
        places = rng.choice(y.size, y.size // 100, replace=False)
        y[places] += (
            rng.choice([-1, 1], places.size) * rng.uniform(0.05, 0.5, places.size) * np.ptp(y)
        )
        columns[name] = y
    return {"time": record.time, **columns}


def test_one_reading_in_a_hundred_that_is_far_off_is_masked_in_its_output_alone() -> None:
    record = plants.cylinder(30)[0]
    model = cylinder(dead_zone=0.6)
    (clean,) = experiments_of(model, [record], judged=False)
    assert np.isfinite(_columns(clean, model.output_names)).all()
    table = _spoilt(record, ("pressure",), 1)
    (run,) = experiments_of(model, given_to(model, table, None), judged=False)
    off = table["pressure"] != record.columns["pressure"]
    lost = np.isnan(_columns(run, model.output_names))
    assert not lost[:, 0].any()
    assert not (lost[:, 1] & ~off).any()
    assert lost[off, 1].sum() >= 0.95 * off.sum()


def test_a_clean_record_with_outliers_is_adequate() -> None:
    table = _spoilt(plants.motor(2, friction=0.0), ("w", "i"), 1)
    d = psa.diagnose(motor(), table, leave_out=["hysteresis", "stop", "curve", "delay"])
    assert d.verdict == "adequate"
    assert not d.causes
    assert all(e.base < 1.1 * e.noise for e in d.errors)
    for name in ("w", "i"):
        assert any(
            n.startswith(f"{name} of record: 30 samples stand out as spikes") for n in d.notes
        )


def test_identification_and_diagnosis_report_the_same_noise() -> None:
    table = _spoilt(plants.motor(2, friction=0.0), ("w", "i"), 1)
    fitted = psa.identify(motor(), table, starts=1)
    matches = psa.diagnose(motor(), table, leave_out=["hysteresis", "stop", "curve", "delay"])
    for result in (fitted, matches):
        assert [(n.record, n.output) for n in result.noise_kinds] == [
            ("record", "w"),
            ("record", "i"),
        ]
        for n in result.noise_kinds:
            assert [k.kind for k in n.kinds] == ["white", "outliers"]
            assert n.kinds[1].figures == {"count": 30.0}
        file = json.loads(result.to_json())
        assert [n["kinds"][1]["kind"] for n in file["noise_kinds"]] == ["outliers"] * 2
    items = [n for n in fitted.sentences if "outliers (at " in n]
    assert items == [n for n in matches.notes if "outliers (at " in n]
    assert items[0].startswith("w in record has 30 outliers (at ")


def test_a_sensor_that_sticks_or_is_saturated_is_masked_and_reported() -> None:
    record = plants.motor(2, friction=0.0)
    y = np.array(record.columns["w"])
    y[700:760] = y[700]
    top = float(np.quantile(y, 0.9))
    table = {"time": record.time, **record.columns, "w": np.minimum(y, top)}
    (run,) = experiments_of(motor(), given_to(motor(), table, None), judged=False)
    lost = np.isnan(_columns(run, motor().output_names)[:, 0])
    assert np.mean(lost[y >= top]) > 0.99
    assert lost[701:760].all()
    assert np.isfinite(_columns(run, motor().output_names)[:, 1]).all()
    output = psa.identify(motor(), table, starts=1).warnings
    assert any("while voltage moves w: the sensor is saturated there" in n for n in output)
    assert any("w of record: 59 samples repeat the last one to the last digit" in n for n in output)


def test_what_moves_in_jumps_without_noise_is_no_sensor_that_fails() -> None:
    """A valve that is open or not, and a mass at rest while its drive moves."""
    u = np.sin(2.0 * np.pi * 2.0 * T * 5.0)
    rest = np.maximum(u, 0.3)
    table = {"time": T, "valve": u, "flow": u, "speed": 1.0 * (u > 0.2), "oil_temp": rest}
    run = _run(table)
    assert np.isfinite(_columns(run, _pump().output_names)).all()


#: Effects that need no search where nothing is missing: their models would only be compiled.
_ALL_BUT_LAGS = (
    "bend", "saturation", "dead_zone", "constant", "loss", "friction", "drag", "curve", "stop",
    "hysteresis", "zero", "drift",
)  # fmt: skip


def has_ramps(messages: Sequence[str]) -> bool:
    """Return whether a message reports a staircase that is read as ramps."""
    return any("stands still" in m for m in messages)


@pytest.mark.slow
def test_an_input_that_is_held_is_read_so_and_a_staircase_read_as_lines_is_reported() -> None:
    held = plants.oven(40)
    few = [n for n in _ALL_BUT_LAGS if n != "zero"]
    d = psa.diagnose(oven(), held, known_start=True, leave_out=few)
    assert d.verdict == "cause_named"
    assert [c.effect for c in d.causes] == ["lag_of_air"]
    assert d.causes[0].parameters["lag_of_air_time"].value == pytest.approx(25.0, abs=0.5)
    assert not has_ramps(d.notes)
    other = plants.oven(41)
    heater = np.where(other.time > 600.0, 1.005, 1.0) * other.columns["heater"]
    unlike = replace(other, columns={**other.columns, "heater": heater}, hold="linear", sha256="")
    d = psa.diagnose(oven(), held, holdout=unlike, hold="zero", known_start=True, leave_out=few)
    assert d.verdict == "partly_explained"
    assert not d.remaining.white
    assert "but the held-out ones of" in d.remaining.where
    lines = replace(held, hold="linear")
    output = psa.identify(oven(), lines, known_start=True)
    assert any("'heater' stands still between jumps in oven, and" in w for w in output.warnings)
    again = psa.identify(oven(), lines, known_start=True, hold="zero")
    assert not has_ramps(again.warnings)
    assert again.model.values == psa.identify(oven(), held, known_start=True).model.values


def test_a_file_leaves_open_what_its_inputs_do_between_samples(tmp_path: Path) -> None:
    path, held = tmp_path / "oven.csv", plants.oven(40)
    units = {"heater": "W", "wall": "K", "air": "K"}
    columns = {f"{n} [{units[n]}]": v for n, v in held.columns.items()}
    psa.write_record(path, {"time [s]": held.time, **columns})
    read = psa.read_signals(path, inputs=oven().input_names, outputs=oven().output_names)
    result = psa.identify(oven(), read, known_start=True)
    assert {e.record.hold for e in result.experiments} == {"zero"}
    psa.save_model(result.model, tmp_path / "m.json")
    assert psa.load_model(tmp_path / "m.json").provenance.hold == "zero"
    stated = psa.identify(oven(), read, known_start=True, hold="linear")
    assert {e.record.hold for e in stated.experiments} == {"linear"}


@pytest.mark.slow
def test_a_record_without_noise_hides_nothing_and_shows_what_is_hidden() -> None:
    """A simulation errs by its tolerance, which is no cause; what is rounded is no cause either."""
    leave_out = ["hysteresis", "stop", "curve", "delay"]
    clean = plants.motor(2, friction=0.0, noise=0.0)
    rounded = {n: np.round(y, 3) for n, y in clean.columns.items()}
    for columns in (clean.columns, {**rounded, "voltage": clean.columns["voltage"]}):
        d = psa.diagnose(motor(), {"time": clean.time, **columns}, leave_out=leave_out)
        assert d.verdict == "adequate", d
    d = psa.diagnose(motor(), plants.motor(1, noise=0.0), leave_out=leave_out)
    assert d.causes[0].effect == "friction_in_speed"
    assert d.model.values["friction_in_speed_size"] == pytest.approx(0.012 / 3e-5, rel=0.02)


def test_words_and_records_that_cannot_be_meant_are_refused() -> None:
    record = plants.motor(2, friction=0.0)
    with pytest.raises(psa.InputError, match=r"`holdout` are those of 'drive', which is fitted"):
        psa.diagnose(motor(), record, holdout=record)
    with pytest.raises(psa.InputError, match=r"'known_stat' is not among the arguments for your"):
        psa.identify(motor(), record, known_stat=True)  # type: ignore[call-overload]
    with pytest.raises(psa.InputError, match=r"'known_start' is not among the arguments for a st"):
        psa.identify("record.csv", known_start=True)  # type: ignore[call-overload]
    with pytest.raises(psa.InputError, match=r"`leave_out` has 'slow_crep', which is no effect"):
        psa.diagnose("record.csv", leave_out=["slow_crep"])
    with pytest.raises(psa.InputError, match=r"name starts; of the \d+ there are.* are lag"):
        psa.diagnose(motor(), record, leave_out=["lagg"], starts=1)


def test_columns_in_another_unit_are_reported() -> None:
    record = plants.motor(2, friction=0.0)
    columns = {"voltage": record.columns["voltage"], "w": 9.55e3 * record.columns["w"]}
    result = psa.identify(motor(), {"time": record.time, **columns}, starts=1)
    assert any("of its own movement: see that its column" in w for w in result.warnings)
    assert "No record has a column 'i'; that output is not compared." in result.warnings


def test_what_an_input_did_in_a_gap_is_not_guessed() -> None:
    whole = plants.motor(2, friction=0.0)
    kept = np.r_[0:1200, 1500:3000]
    columns = {n: values[kept] for n, values in whole.columns.items()}
    record = replace(whole, time=whole.time[kept], columns=columns, sha256="")
    result = psa.identify(motor(), record, starts=1)
    assert [e.record.name for e in result.experiments] == ["drive[0:1200]", "drive[1200:2700]"]
    assert any(
        "no sample for 0.301 s from 1.199 s on, while the voltage" in w for w in result.warnings
    )
    for name, value in {"R": 1.2, "k": 0.05, "J": 3e-5, "b": 2e-5}.items():
        assert abs(result.model.values[name] - value) < 4.0 * result.errors[name]
    held = psa.identify(motor(), replace(record, hold="zero"), starts=1)
    assert len(held.experiments) == 1
