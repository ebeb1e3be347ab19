"""Two small importers of one FMU: stepping it (co-simulation), integrating it (model exchange)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
import scipy

from psa_casadi.common.files import temporary_folder
from psa_casadi.common.units import FloatArray
from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu, FmuError, Instance
from psa_casadi.model.compose import Model
from psa_casadi.simulation.start import start_state


@dataclass(frozen=True)
class Signals:
    """Inputs that are linear between knots: `times` (k,), `values` (k, nu), columns as `names`.

    With `held` they keep the value of a knot up to the next one, where they jump.
    """

    names: tuple[str, ...]
    times: FloatArray
    values: FloatArray
    held: bool = False

    def at(self, times: FloatArray | float, *, before: bool = False) -> FloatArray:
        """Return the inputs at times (n,), shape (n, nu); at a jump those after it, or `before`."""
        wanted = np.atleast_1d(np.asarray(times, dtype=float))
        if self.held:
            side: Literal["left", "right"] = "left" if before else "right"
            rows = np.searchsorted(self.times, wanted, side) - 1
            return self.values[np.maximum(rows, 0)]
        columns = [np.interp(wanted, self.times, column) for column in self.values.T]
        return np.array(columns).reshape(len(self.names), len(wanted)).T

    def on(self, times: FloatArray) -> "Signals":
        """Return the signals sampled at times: what an importer that samples them passes on."""
        return Signals(self.names, times, self.at(times), self.held)


def communicate(
    instance: Instance,
    times: FloatArray,
    inputs: Signals,
    outputs: Sequence[str],
    *,
    settled: bool = False,
) -> FloatArray:
    """Step an initialised instance over communication points (n,); return outputs (n, ny).

    Inputs are set at the start of each step; their slope over the step is set too unless they are
    held, or FMI 3.0 has no way to. Outputs are read at the end of each step, and at the start; with
    `settled` after the inputs of that time are set, which counts where these jump.
    """
    samples = inputs.at(times)
    names = inputs.names
    result = np.empty((len(times), len(outputs)))
    instance.set(dict(zip(names, samples[0], strict=True)))
    result[0] = instance.get(outputs)
    for k, (begin, end) in enumerate(pairwise(times)):
        size = float(end - begin)
        instance.set(dict(zip(names, samples[k], strict=True)))
        if instance.fmu.version == 2 and not inputs.held:
            slope = (samples[k + 1] - samples[k]) / size
            instance.set_rates(dict(zip(names, slope, strict=True)))
        instance.step(float(begin), size)
        if settled:
            instance.set(dict(zip(names, samples[k + 1], strict=True)))
        result[k + 1] = instance.get(outputs)
    return result


def co_simulate(
    fmu: Fmu, times: FloatArray, inputs: Signals, outputs: Sequence[str], *,
    tolerance: float | None = None, values: dict[str, float] | None = None, settled: bool = False,
) -> FloatArray:  # fmt: skip
    """Run a new co-simulation instance over communication points; return outputs (n, ny)."""
    start = float(times[0])
    with fmu.start(CO_SIMULATION, tolerance=tolerance, values=values, start_time=start) as instance:
        return communicate(instance, times, inputs, outputs, settled=settled)


def integrate(
    fmu: Fmu, times: FloatArray, inputs: Signals, outputs: Sequence[str], *, tolerance: float,
    values: dict[str, float] | None = None,
) -> FloatArray:  # fmt: skip
    """Integrate a new model exchange instance with LSODA, restarted at every knot of the inputs.

    Returns the outputs (n, ny) at `times`, at an event those after it. The error of a step is held
    below tolerance (|state| + nominal / 100). It restarts at the FMU's time events too.
    """
    start = float(times[0])
    with fmu.open(MODEL_EXCHANGE) as instance:
        instance.setup(start_time=start, values=values)
        instance.set(dict(zip(inputs.names, inputs.at(start)[0], strict=True)))
        event = instance.leave_event_mode()
        states = fmu.states()
        x = instance.get(states)
        atol = 1e-2 * tolerance * np.array([fmu.nominals[s] for s in states])

        def rates(t: float, x: FloatArray) -> FloatArray:
            return instance.derivatives(t, x, dict(zip(inputs.names, inputs.at(t)[0], strict=True)))

        def read(t: float, x: FloatArray) -> FloatArray:
            rates(t, x)
            return instance.get(outputs)

        rows = [read(start, x)]
        inside = inputs.times[(inputs.times > times[0]) & (inputs.times < times[-1])]
        knots, now = [*inside, float(times[-1])], start
        same = 1e-12 * (times[-1] - times[0])  # times that differ only by rounding
        while knots:
            stop = event if event <= knots[0] + same else knots[0]
            wanted = times[len(rows) :][times[len(rows) :] < stop - same]
            points = [(t, x) for t in (*wanted, stop)]
            if states:
                points = _solved(rates, (now, stop), x, tolerance, atol, wanted)
            rows += [read(float(t), s) for t, s in points[:-1]]
            now, x = stop, points[-1][1]
            rates(now, x)
            after = inputs.at(max(now, min(knots[0], now + same)))[0]
            instance.set(dict(zip(inputs.names, after, strict=True)))
            if now == event:
                instance.require("EnterEventMode")
                event = instance.leave_event_mode()
            if len(rows) < len(times) and times[len(rows)] <= now + same:
                rows.append(instance.get(outputs))
            knots = [k for k in knots if k > now + same]
        return np.array(rows)


def _solved(
    rates: Callable[[float, FloatArray], FloatArray], span: tuple[float, float], x: FloatArray,
    tolerance: float, atol: FloatArray, wanted: FloatArray,
) -> list[tuple[float, FloatArray]]:  # fmt: skip
    """Return times and states at the wanted times of a span, and at its end."""
    solution = scipy.integrate.solve_ivp(
        rates, span, x, method="LSODA", rtol=tolerance, atol=atol,
        t_eval=np.union1d(wanted, [span[1]]),
    )  # fmt: skip
    if not solution.success:
        raise FmuError(f"model exchange stopped after {span[0]:g} s: {solution.message}")
    return list(zip(solution.t, solution.y.T, strict=True))


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
            values = co_simulate(
                fmu, time, inputs, ["displacement"], tolerance=tolerance, values=start
            )
    return np.asarray(values[:, 0])
