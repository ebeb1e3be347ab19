"""A voltage played on a model's exported FMU by a co-simulation master of its own."""

import numpy as np

from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.importer.fmu import Fmu
from psa_casadi.export.importer.masters import FloatArray, Signals, co_simulate
from psa_casadi.model.compose import Model
from psa_casadi.scratch import temporary_folder
from psa_casadi.simulation.start import start_state


def played_on_fmu(
    model: Model, time: FloatArray, voltage: FloatArray, *, tolerance: float = 1e-7
) -> FloatArray:
    """Export a stack as an FMU, play a voltage (n,) [V] on it, return the displacement (n,) [m].

    The FMU starts in the state that rests at the first voltage and is stepped from sample to
    sample, the voltage linear in between. Raises PsaError if the FMU cannot be made or run.
    """
    u = [i.start for i in model.structure.inputs]
    u[model.input_names.index("voltage")] = float(voltage[0])
    start = dict(zip(model.state_names, start_state(model, u).x.tolist(), strict=True))
    with temporary_folder() as folder:
        path = export_fmu(model, folder / "stack.fmu", name="stack")
        with Fmu(path) as fmu:
            inputs = Signals(("voltage",), time, voltage[:, None])
            found = co_simulate(
                fmu, time, inputs, ["displacement"], tolerance=tolerance, values=start
            )
    return np.asarray(found[:, 0])
