"""Records: units, layouts, formats, missing readings, several files, mistakes with their place."""

import hashlib
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

import psa_casadi as psa
from tests.contract.helpers import DATA, Floats, done, refused, table, write

N = 40
T = np.arange(N) / 1000.0
V = np.round(50.0 + 40.0 * np.sin(np.arange(N) / 3.0), 4)
X = np.round(5.0 + 4.0 * np.sin(np.arange(N) / 3.0 - 0.2), 4)  # um
PLAIN = {"time [s]": T, "voltage [V]": V, "displacement [um]": X}
ROWS = [f"{t:.3f},{v},{x}" for t, v, x in zip(T, V, X, strict=True)]
HEADER = "time [s],voltage [V],displacement [um]"


def moved(record: psa.Record) -> Floats:
    assert record.displacement is not None
    return record.displacement


def assert_same(record: psa.Record, accuracy: float = 1e-12) -> None:
    np.testing.assert_allclose(record.time - record.time[0], T, atol=1e-9)
    np.testing.assert_allclose(record.voltage, V, rtol=accuracy)
    np.testing.assert_allclose(moved(record), 1e-6 * X, rtol=accuracy)


def lines(path: Path, *rows: str, encoding: str = "utf-8") -> Path:
    path.write_bytes(("\n".join(rows) + "\n").encode(encoding))
    return path


@pytest.mark.parametrize(
    ("column", "unit", "factor", "shift"),
    [
        ("time", "ms", 1e-3, 0.0), ("time", "us", 1e-6, 0.0), ("voltage", "mV", 1e-3, 0.0),
        ("voltage", "kV", 1e3, 0.0), ("displacement", "m", 1.0, 0.0),
        ("displacement", "mm", 1e-3, 0.0), ("displacement", "nm", 1e-9, 0.0),
        ("displacement", "µm", 1e-6, 0.0), ("load_force", "kN", 1e3, 0.0),
        ("load_force", "mN", 1e-3, 0.0), ("current", "mA", 1e-3, 0.0),
        ("current", "uA", 1e-6, 0.0), ("temperature", "degC", 1.0, 273.15),
        ("temperature", "K", 1.0, 0.0), ("charge", "uC", 1e-6, 0.0),
        ("monitor_voltage", "mV", 1e-3, 0.0), ("displacement_2", "nm", 1e-9, 0.0),
        ("strain", "ppm", 1e-6, 0.0),
    ],
)  # fmt: skip
def test_a_unit_in_the_header_becomes_si_in_any_order_of_columns(
    column: str, unit: str, factor: float, shift: float, tmp_path: Path
) -> None:
    numbers = 1.0 + np.arange(N) + 0.25 * (np.arange(N) % 3)
    others = {k: v for k, v in PLAIN.items() if k.split()[0] != column}
    columns = {f"{column} [{unit}]": numbers, **dict(reversed(others.items()))}
    record = psa.read_record(write(tmp_path / "r.csv", columns))
    np.testing.assert_allclose(getattr(record, column), factor * numbers + shift, rtol=1e-12)


def test_binary_formats_hold_the_same_record(tmp_path: Path) -> None:
    frame, names = pd.DataFrame(PLAIN), ("time", "voltage", "displacement")
    frame.to_excel(tmp_path / "r.xlsx", index=False)
    frame.to_parquet(tmp_path / "r.parquet")
    arrays = {"t": T, "log": {"u": V, "x": X}}
    savemat(tmp_path / "r.mat", arrays)
    np.savez(tmp_path / "r.npz", t=T, u=V, x=X)
    with h5py.File(tmp_path / "r.h5", "w") as file:
        for name, values, unit in zip(names, (T, V, X), ("s", "V", "um"), strict=True):
            file.create_dataset(name, data=values).attrs["unit"] = unit
    for kind, columns in {
        "xlsx": None, "parquet": None, "h5": None,
        "mat": "time=t:s,voltage=log.u:V,displacement=log.x:um",
        "npz": "time=t:s,voltage=u:V,displacement=x:um",
    }.items():  # fmt: skip
        assert_same(psa.read_record(tmp_path / f"r.{kind}", columns=columns))


def test_options_say_what_a_file_does_not(tmp_path: Path) -> None:
    bare = lines(tmp_path / "bare.csv", *ROWS)
    assert_same(psa.read_record(bare, columns="time=1:s,voltage=2:V,displacement=3:um"))
    scope = lines(tmp_path / "scope.csv", "t,CH1,CH2", *ROWS)
    record = psa.read_record(scope, columns="time=t:s,voltage=CH1:15V,displacement=CH2:10um")
    np.testing.assert_allclose(record.voltage, 15.0 * V)
    np.testing.assert_allclose(moved(record), 1e-5 * X)
    timeless = write(tmp_path / "none.csv", {k: v for k, v in PLAIN.items() if "time" not in k})
    assert_same(psa.read_record(timeless, sample_time=1e-3))


def test_several_files_are_several_experiments_and_channels_are_joined(tmp_path: Path) -> None:
    one, two = (tmp_path / "a.csv", tmp_path / "b.csv")
    write(one, PLAIN)
    write(two, {**PLAIN, "displacement [um]": 2.0 * X})
    a, b = psa.read_records([one, two])
    assert (a.name, b.name) == ("a", "b")
    assert a.sha256 == hashlib.sha256(one.read_bytes()).hexdigest()
    np.testing.assert_allclose(moved(b), 2e-6 * X)
    write(tmp_path / "CH1.csv", {k: PLAIN[k] for k in ("time [s]", "voltage [V]")})
    write(tmp_path / "CH2.csv", {k: PLAIN[k] for k in ("time [s]", "displacement [um]")})
    (joined,) = psa.read_records([f"{tmp_path / 'CH1.csv'}+{tmp_path / 'CH2.csv'}"])
    assert_same(joined)


def test_of_several_tables_in_a_file_one_is_chosen(tmp_path: Path) -> None:
    second = [f"{t:.3f},{v},{2 * x:.4f}" for t, v, x in zip(T, V, X, strict=True)]
    path = lines(tmp_path / "two.csv", HEADER, *ROWS, "", HEADER, *second)
    with pytest.raises(psa.InputError, match="table="):
        psa.read_record(path)
    assert_same(psa.read_record(path, columns="table=1"))
    np.testing.assert_allclose(moved(psa.read_record(path, columns="table=2")), 2e-6 * X)
    assert len(psa.read_records([path], columns="table=all")) == 2


def test_every_mistake_of_all_files_is_reported_at_once(tmp_path: Path) -> None:
    bad = lines(tmp_path / "bad.csv", HEADER, "0,a,1", "1,2,b", *ROWS[2:])
    message = refused(
        "diagnose", bad, tmp_path / "absent.csv", "--model", tmp_path / "no.json",
        "-o", tmp_path / "missing" / "m.json", "--stiffness", "-3", folder=tmp_path,
    )  # fmt: skip
    parts = ("'a'", "'b'", "line 2", "line 3", "absent.csv", "no.json", "create it first", "-3 N/m")
    assert [part for part in parts if part not in message] == []


def test_records_that_cannot_be_fitted_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "m.json"
    same = [lines(tmp_path / name, HEADER, *ROWS) for name in ("a.csv", "b.csv")]
    assert "holds the same data as" in refused("identify", *same, "-o", out)
    still = write(tmp_path / "c.csv", {**PLAIN, "voltage [V]": 0.0 * V + 3.0})
    assert "expected a voltage that changes" in refused("identify", still, "-o", out)
    few = lines(tmp_path / "d.csv", HEADER, *ROWS[:3])
    assert "found 3 samples" in refused("diagnose", few)
    wrong = write(tmp_path / "e.csv", {"time [s]": T, "voltage [V]": V, "displacement [m]": X})
    assert "displacement" in refused("identify", wrong, "-o", out)


def test_tables_and_arrays_are_records(tmp_path: Path) -> None:
    for inputs in (PLAIN, pd.DataFrame(PLAIN)):
        assert_same(psa.record_from(inputs))
    frame = pd.DataFrame({"t": T, "u": V, "y": X})
    assert_same(psa.record_from(frame, columns="time=t:s,voltage=u:V,displacement=y:um"))
    made = psa.Record(name="loop", time=T, voltage=V, displacement=1e-6 * X)
    assert_same(psa.record_from(made.to_frame()))
    path = tmp_path / "loop.csv"
    psa.write_record(path, made)
    again = psa.read_record(path)
    for name in ("time", "voltage", "displacement"):
        np.testing.assert_array_equal(getattr(again, name), getattr(made, name))
    with pytest.raises(psa.InputError, match="39"):
        psa.Record(name="loop", time=T, voltage=V[:-1])
    with pytest.raises(ValueError, match="read-only"):
        made.voltage[0] = 1.0


def test_the_packaged_record_is_that_of_its_file() -> None:
    record, columns = psa.read_record(DATA / "demo.csv"), table(DATA / "demo.csv")
    assert record.n == 5248
    np.testing.assert_allclose(record.voltage, columns["voltage [V]"], rtol=1e-15)
    np.testing.assert_allclose(moved(record), 1e-6 * columns["displacement [um]"], rtol=1e-14)
    assert "5248" in record._repr_html_() or "5,248" in record._repr_html_()


def test_measured_records_are_listed_and_written_with_their_hash(
    tmp_path: Path, measured_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PSA_CASADI_DATA", str(measured_data))
    assert "micromanipulator" in done("datasets").out
    assert "MIT" in done("datasets", "micromanipulator").out
    done("datasets", "micromanipulator", "-o", tmp_path)
    for name in ("sine_1hz", "minor_loops"):
        written = (tmp_path / f"{name}.csv").read_bytes()
        assert written == (measured_data / "micromanipulator" / f"{name}.csv").read_bytes()
    sine, loops = psa.datasets.micromanipulator()
    assert (sine.name, loops.name) == ("sine_1hz", "minor_loops")
    assert sine.sha256 == hashlib.sha256((tmp_path / "sine_1hz.csv").read_bytes()).hexdigest()
    assert (sine.n, loops.n) == (7927, 3600)
    assert np.median(np.diff(sine.time)) == pytest.approx(5e-3, rel=1e-9)
