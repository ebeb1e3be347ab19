"""What a step costs: the generated code of fixed steps beside the ordinary FMU, step by step.

Both are compiled into one program and timed on every step of a voltage with ramps, holds, tones and
jumps. For each step the least time of many repetitions counts.
"""

import subprocess
import tempfile
from pathlib import Path

import fmpy
import numpy as np
import numpy.typing as npt

from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.fixed_step.export import export_c, fixed_step
from psa_casadi.export.fixed_step.probe import VOLTAGES
from psa_casadi.export.fmu.sources import compiled_files, exported_texts
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import stack_model
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.compiler import OPTIMISE, compiler_command, run_compiler
from tests.benchmarks.outcome import Progress, TitledTable

FloatArray = npt.NDArray[np.float64]

#: The step of issue and table [s], and what is asked of it.
STEP, MOST_NS, MOST_RATIO = 1e-5, 400.0, 1.5
_SOURCE = Path(__file__).parent.parent / "c_host" / "step_cost.c"


def voltage(model: Model) -> FloatArray:
    """Return 1000 voltages [V]: 200 of each reference voltage."""
    share = np.linspace(0.0, 1.0, 1001)[1:]
    parts = [
        shape(share)[200 * k : 200 * (k + 1)] for k, (_, shape) in enumerate(VOLTAGES.values())
    ]
    return np.asarray(model.values["u_rated"] * np.concatenate(parts))


def measured(model: Model, repetitions: int, *, fixed: bool) -> FloatArray:
    """Return the time [ns] of every step, (1000, 2): of the generated code and of an FMU.

    The FMU is the ordinary one, or the one with a `fixed` step.
    """
    table = {v.name: k for k, v in enumerate(variable_table(model), start=1)}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        export_c(model, folder, step=STEP, name="stack", substeps=1)
        step = fixed_step(model, name="stack", step=STEP, substeps=1) if fixed else None
        token, texts, _ = exported_texts(model, model.name, fixed=step)
        for file, text in texts.items():
            (folder / file).write_text(text, encoding="utf-8")
        sources = compiled_files(texts)
        headers = Path(fmpy.__file__).parent / "c-code"
        command = [*compiler_command(), *OPTIMISE, "-I.", f"-I{headers}"]
        files = [str(_SOURCE), "stack.c", *sources, "-lm", "-o", "step_cost"]
        run_compiler([*command, *files], folder)
        given = [str(repetitions), str(table["voltage"]), str(table["displacement"])]
        done = subprocess.run(
            [str(folder / "step_cost"), token, *given],
            input="\n".join(map(repr, voltage(model).tolist())),
            capture_output=True, text=True, check=True,
        )  # fmt: skip
    return np.array([[float(v) for v in line.split()] for line in done.stdout.splitlines()])


def cost_table(progress: Progress, *, quick: bool) -> TitledTable:
    """Return mean, worst and their ratio for a stack."""
    progress("cost of a step")
    model, repetitions = stack_model("P-885.51").plant(), 50 if quick else 400
    ordinary, fixed = (measured(model, repetitions, fixed=f).T for f in (False, True))
    ways = {
        "psa export c": ordinary[0],
        "psa export fmu --solver fixed": fixed[1],
        "psa export fmu": ordinary[1],
    }
    rows = tuple(
        (name, f"{c.mean():.0f}", f"{c.max():.0f}", f"{c.max() / c.mean():.2f}")
        for name, c in ways.items()
    )
    return TitledTable(
        f"cost of a step of {1e6 * STEP:g} us, P-885.51: ramps, holds, tones and jumps",
        Table(("way", "mean [ns]", "worst [ns]", "worst / mean"), rows),
        f"Asked of the generated code: at most {MOST_NS:g} ns, worst over mean below"
        f" {MOST_RATIO:g}. Each step counts with the least time of its repetitions.",
    )
