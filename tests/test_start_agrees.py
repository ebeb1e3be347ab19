"""One start for all: `psa simulate`, FMU and check begin in one state with the same options."""

import html
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from psa_casadi.cli.app import app
from psa_casadi.export.check.agreement import truth_of
from psa_casadi.export.check.description import wrong_start_values
from psa_casadi.export.check.structure import wrong_start
from psa_casadi.export.fmu.documentation import documentation
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import Fmu
from psa_casadi.export.importer.masters import Signals, co_simulate
from psa_casadi.model.model_file import save_model
from psa_casadi.model.stacks import stack_model
from psa_casadi.records import read_record, write_record
from psa_casadi.simulation.history import memory_after, settled_at
from psa_casadi.simulation.simulate import simulate
from psa_casadi.units import FloatArray
from tests.fmu_models import exported, model_named

STACK = stack_model("P-885.51")
OPTIONS = ["--start-voltage", "60", "--history", "120,0"]
TIME = np.linspace(0.0, 0.1, 1001)
VOLTAGE = 60.0 + 60.0 * np.sin(2 * np.pi * 10.0 * TIME)


def _run(*words: str) -> str:
    done = CliRunner().invoke(app, list(words))
    assert done.exit_code == 0, done.output
    return done.output


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sine about 60 V, the stack as a model file, with and without starts, and its FMU."""
    made = tmp_path_factory.mktemp("starts")
    write_record(made / "v.csv", {"time [s]": TIME, "voltage [V]": VOLTAGE})
    save_model(STACK, made / "plain.json")
    save_model(settled_at(STACK, 60.0, [120.0, 0.0]), made / "held.json")
    said = _run(
        "export", "fmu", "--model", str(made / "plain.json"), "-o", str(made / "m.fmu"), *OPTIONS
    )
    assert "start: the start values of the model at 60 V" in said
    return made


def _simulated(folder: Path, model: str, *options: str) -> tuple[FloatArray, str]:
    out = folder / "out.csv"
    files = ["--model", str(folder / model), "--input", str(folder / "v.csv"), "-o", str(out)]
    said = _run("simulate", *files, *options)
    found = read_record(out).displacement
    assert found is not None
    return found, next(line for line in said.splitlines() if line.startswith("start: "))


def test_the_same_start_gives_the_same_trajectory_in_the_command_and_in_the_fmu(
    folder: Path,
) -> None:
    """Also where the start is in the model file; without it the two differ, and it is said."""
    inputs = Signals(("voltage",), TIME, VOLTAGE[:, None])
    with Fmu(folder / "m.fmu") as fmu:
        truth = co_simulate(fmu, TIME, inputs, ["displacement"], tolerance=1e-9)[:, 0]
    span = float(np.ptp(truth))
    for model, options in (("plain.json", OPTIONS), ("held.json", [])):
        found, said = _simulated(folder, model, *options)
        assert np.abs(found - truth).max() < 3e-6 * span, model
        assert "at 60 V, as an exported FMU has them" in said
        assert "step" not in said
    relaxed, said = _simulated(folder, "plain.json")
    assert np.abs(relaxed - truth).max() > 0.02 * span
    assert "settled at 60 V" in said
    assert "--start-voltage 60" in said
    _, said = _simulated(folder, "held.json", "--start-voltage", "0")
    assert "at 0 V" in said
    assert "step from there to 60 V" in said
    _, said = _simulated(folder, "held.json", "--history", "120,0")
    assert "where the history 120,0 V leaves them" in said


def test_the_option_that_is_named_begins_as_the_fmu_does(folder: Path) -> None:
    """A relaxed start at 60 V and one that rose there from 0 V remember other things."""
    inputs = Signals(("voltage",), TIME, VOLTAGE[:, None])
    with Fmu(exported("P-885.51")) as fmu:
        truth = co_simulate(
            fmu, TIME, inputs, ["displacement"], tolerance=1e-9, values={"start_voltage": 60.0}
        )[:, 0]
    relaxed, said = _simulated(folder, "plain.json")
    assert "give --start-voltage 60 here too to begin as it does" in said
    named, _ = _simulated(folder, "plain.json", "--start-voltage", "60")
    assert np.abs(named - truth).max() < 1e-5 * np.ptp(truth)
    assert np.abs(relaxed - truth).max() > 0.05 * np.ptp(truth)


def test_a_history_is_played_from_relaxed_whatever_start_the_model_has() -> None:
    held = settled_at(STACK, 60.0, [120.0])
    assert memory_after(held, [100.0], at=30.0) == memory_after(STACK, [100.0], at=30.0)
    t, v = TIME[:3], np.full(3, 60.0)
    one, other = (simulate(m, t, v, as_exported=False).displacement for m in (held, STACK))
    assert np.array_equal(one, other)
    assert abs(simulate(held, t, v).displacement[0] - other[0]) > 1e-7


def test_the_check_has_a_row_for_the_start(folder: Path) -> None:
    plain, settled = STACK.plant(), settled_at(STACK, 60.0, [120.0, 0.0]).plant()
    with Fmu(folder / "m.fmu") as fmu:
        assert list(wrong_start(fmu, truth_of(settled, 2))) == []
        found = list(wrong_start(fmu, truth_of(plain, 2)))
        assert any("co-simulation 'voltage' starts at 60, the model at 0" in f for f in found)
        assert any("model exchange 'voltage' starts at 60" in f for f in found)
    with Archive(folder / "m.fmu") as archive:
        assert any(
            f.startswith("'voltage' starts at 60") for f in wrong_start_values(archive, plain)
        )
    with Fmu(exported("flexure", 3)) as fmu:
        assert list(wrong_start(fmu, truth_of(model_named("flexure"), 3))) == []


def test_the_page_states_the_start() -> None:
    page = html.unescape(documentation(STACK))
    assert "It starts relaxed at 0 V" in page
    assert "keep their start values it stays there" in page
    settled = settled_at(STACK, 60.0, [120.0])
    page = html.unescape(documentation(settled))
    assert "It starts at 60 V with the start values of the tables" in page
    assert "it stays there" in page
    at_start = simulate(settled, TIME[:2], [60.0, 60.0]).displacement[0]
    assert f"{1e6 * at_start:.6g} um" in page
    moving = settled.with_starts({"voltage": 0.0})
    assert "it moves from there" in html.unescape(documentation(moving))
    assert replace(moving, name="x").starts_itself
