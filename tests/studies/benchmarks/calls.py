"""Which value an FMU sees, and when: the calls that importers make, as the FMU itself logs them.

The FMU is tests/export/faulty without a fault, its input the line u = t. fmpy and this project are
always there; libcosim where `pip install libcosimpy` has been run, PyFMI where it is installed.
"""

import os
import tempfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import fmpy
import numpy as np

from psa_casadi.common.errors import PsaError
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE
from psa_casadi.export.importer.imported import digest_of
from psa_casadi.export.importer.masters import Run, Signals, play
from tests.export.test_foreign_check import faulty
from tests.studies.benchmarks.table import Outcome, Progress, Row, TitledTable

_STEP, _END = 0.1, 0.3
_VARIABLE = "FMU_CALLS"


def run(progress: Progress, quick: bool) -> Outcome:
    """Log the calls of every importer that is there."""
    tables, summary = [], list[Row]()
    for name, importer in _IMPORTERS.items():
        progress(name)
        lines = _logged(name, importer)
        if not lines:
            summary.append({"importer": name} | dict.fromkeys(_HEADS, "not installed"))
            continue
        if len(lines) == 1:
            summary.append({"importer": name} | dict.fromkeys(_HEADS, "-") | {"read": lines[0]})
            continue
        summary.append({"importer": name, **_values_by_phase(lines)})
        rows = [{"call": line} for line in _shortened(lines)]
        tables.append(TitledTable(name, rows))
    what = TitledTable("The input u = t in the step from 0.1 s to 0.2 s", summary)
    return Outcome([what] if quick else [what, *tables])


def _logged(name: str, importer: Callable[[Path], None]) -> list[str]:
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "calls"
        os.environ[_VARIABLE] = str(place)
        try:
            importer(faulty(0, str("derivatives" in name).lower()))
        except ImportError:
            return []
        except ValueError as error:  # fmpy 0.3.32 has room for the derivatives of nine inputs only
            return [f"{type(error).__name__}: {error}"]
        finally:
            del os.environ[_VARIABLE]
        return place.read_text("utf-8").splitlines()


_HEADS = ("before initialization", "in it", "in the step", "read")


def _values_by_phase(lines: list[str]) -> Row:
    """Return which values of u there are before, in and after initialization, and in the step."""
    enter, leave = (lines.index(f"{w}InitializationMode") for w in ("Enter", "Exit"))
    after = lines[leave:]
    steps = [k for k, line in enumerate(after) if line.startswith("DoStep")]
    if steps:
        second = after[steps[0] : steps[1] + 1]
        in_step = [w for w in second if w.startswith(("Set u", "Set deri"))]
        in_step = in_step[-2:] if any(w.startswith("Set deri") for w in in_step) else in_step[-1:]
        later = after[steps[1] : steps[2]]
        read = [w for w in later if w.startswith(("Set u", "Get y"))]
    else:
        times = [k for k, w in enumerate(after) if w == "SetTime 0.1"]
        ends = [k for k, w in enumerate(after) if w == "SetTime 0.2"]
        rates = [w for w in after[times[-1] : ends[0]] if w.startswith("GetDer")]
        in_step, read = list(dict.fromkeys(rates)), []
    of = {"before initialization": lines[:enter], "in it": lines[enter:leave]}
    return {
        **{k: _join([w for w in part if w.startswith("Set u")]) for k, part in of.items()},
        "in the step": _join(in_step), "read": _join(list(dict.fromkeys(read))[:3]),
    }  # fmt: skip


def _join(words: list[str]) -> str:
    short = [w.replace("GetDerivatives with ", "") for w in words]
    return "; ".join(short[:3] + ["..."] * (len(short) > 3)) or "-"


def _shortened(lines: list[str]) -> list[str]:
    """Return the calls up to the end of the second step, without repeats."""
    texts, steps = list[str](), 0
    for line in lines:
        steps += line.startswith("DoStep")
        if steps > 2 or len(texts) > 40:
            break
        if not texts or texts[-1] != line:
            texts.append(line)
    return texts


def _fmpy(path: Path, **words: Any) -> None:
    times = np.linspace(0.0, _END, 4)
    table = np.array(list(zip(times, times, strict=True)), dtype=[("time", float), ("u", float)])
    fmpy.simulate_fmu(
        str(path), stop_time=_END, output_interval=_STEP, input=table, output=["y"],
        validate=False, **words,
    )  # fmt: skip


def _ours(path: Path, interface: int) -> None:
    times = np.linspace(0.0, _END, 4)
    inputs = Signals(("u",), times, times[:, None])
    result = play(Run(str(path), digest_of(path), interface, ("y",), {}, inputs))
    if isinstance(result, str):
        raise PsaError(result)


def _libcosim(path: Path) -> None:
    execution_module = import_module("libcosimpy.CosimExecution")
    slave_module = import_module("libcosimpy.CosimSlave")
    manipulator_module = import_module("libcosimpy.CosimManipulator")
    execution = execution_module.CosimExecution.from_step_size(int(_STEP * 1e9))
    slave = slave_module.CosimLocalSlave(fmu_path=str(path), instance_name="one")
    index = execution.add_local_slave(local_slave=slave)
    manipulator = manipulator_module.CosimManipulator.create_override()
    execution.add_manipulator(manipulator)
    for k in range(3):
        manipulator.slave_real_values(index, [2], [k * _STEP])
        execution.step()


def _pyfmi(path: Path) -> None:
    model = import_module("pyfmi.fmi").FMUModelCS2(str(path))
    times = np.linspace(0.0, _END, 4)
    options = {**model.simulate_options(), "ncp": 3, "result_handling": "memory"}
    model.simulate(0.0, _END, input=("u", np.column_stack([times, times])), options=options)


_IMPORTERS: dict[str, Callable[[Path], None]] = {
    "fmpy, co-simulation": lambda p: _fmpy(p, fmi_type="CoSimulation"),
    "fmpy, set_input_derivatives=True": lambda p: _fmpy(
        p, fmi_type="CoSimulation", set_input_derivatives=True
    ),
    "fmpy, model exchange": lambda p: _fmpy(p, fmi_type="ModelExchange"),
    "libcosim, an override before each step": _libcosim,
    "PyFMI, co-simulation": _pyfmi,
    "psa identify, co-simulation": lambda p: _ours(p, CO_SIMULATION),
    "psa identify, co-simulation, input derivatives": lambda p: _ours(p, CO_SIMULATION),
    "psa identify, model exchange as a whole": lambda p: _ours(p, MODEL_EXCHANGE),
}
