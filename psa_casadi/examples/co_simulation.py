"""Two FMUs that push on each other in fmpy: a stack and a flexure stage, stepped in turn.

The coupled whole is also one model made by `ode_model` from the two models' equations: the truth
that the co-simulation approaches as its communication step shrinks: to first order where values are
held during a step, to second order where their slopes are passed on, which is stable up to 1 us.
"""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave
from matplotlib.figure import Figure

import psa_casadi as psa
from psa_casadi.common.units import FloatArray

#: The voltage rises by 0.2 V per microsecond; the coupled parts are run for 0.4 ms.
END, RATE = 4e-4, 2e5
#: Outputs of the stack that are inputs of the stage, and the way back.
TO_STAGE = (("displacement", "tip_position"), ("velocity", "tip_velocity"))
TO_STACK = (("reaction_force", "load_force"),)
COMMUNICATION_STEPS = (1e-6, 5e-7, 2.5e-7)
#: At this step the coupling with slopes is no longer stable, while held values still are.
TOO_LONG = 2e-6


def main(folder: Path) -> dict[str, float]:
    """Export both parts, couple them at several communication steps, compare with the whole."""
    stack = psa.stack_model("P-885.51").plant()
    stage = psa.compose([psa.COMPONENTS["flexure"]], name="stage")
    fmus = [
        psa.export_fmu(stack, folder / "stack.fmu"),
        psa.export_fmu(stage, folder / "stage.fmu"),
    ]
    expected = whole(stack, stage)
    held, sloped = (
        np.array([abs(coupled(fmus, h, slopes=slopes) / expected - 1) for h in COMMUNICATION_STEPS])
        for slopes in (False, True)
    )
    _draw(folder / "co_simulation.png", held, sloped)
    far, unstable = (abs(coupled(fmus, TOO_LONG, slopes=s) / expected - 1) for s in (False, True))
    return {
        "stage position at the end [um]": 1e6 * expected,
        "error at 1 us, values held [%]": 100.0 * float(held[0]),
        "error at 1 us, with slopes [%]": 100.0 * float(sloped[0]),
        "error at 2 us, values held [%]": 100.0 * far,
        "error at 2 us, with slopes [%]": 100.0 * unstable,
        "order, values held": _order(held),
        "order, with slopes": _order(sloped),
    }


def whole(stack: psa.Model, stage: psa.Model) -> float:
    """Return the stage's position at the end [m], from one set of equations."""
    x, z, t = ca.SX.sym("x", len(stack.state_names)), ca.SX.sym("z", 2), ca.SX.sym("t")
    p, q = stack.parameter_vector(), stage.parameter_vector()
    _, observed = stack.structure.f(t, x, ca.vertcat(RATE * t, 0.0), p)
    tip = [observed[stack.output_names.index(name)] for name, _ in TO_STAGE]
    zdot, out = stage.structure.f(t, z, ca.vertcat(*tip), q)
    force = out[stage.output_names.index("reaction_force")]
    xdot, _ = stack.structure.f(t, x, ca.vertcat(RATE * t, force), p)
    model = psa.ode_model(
        {"t": t, "x": ca.vertcat(x, z), "ode": ca.vertcat(xdot, zdot), "y": z[0]},
        name="stack_and_stage",
        states=[
            replace(state, nominal=size)
            for part in (stack, stage)
            for state, size in zip(part.structure.states, part.state_nominals(), strict=True)
        ],
        outputs=[psa.Output("position", "m", "position of the stage", 1e-5, "um")],
    )
    times = np.linspace(0.0, END, 41)
    start = np.zeros(len(model.state_names))
    return float(psa.run(model, times, np.zeros((41, 0)), start, rtol=1e-10).y[-1, 0])


def coupled(fmus: list[Path], step: float, *, slopes: bool) -> float:
    """Step both FMUs in turn and return the stage's position at the end [m].

    Each gets the other's last outputs, held during a step, or with their slopes.
    """
    stack, stage = (Slave(path) for path in fmus)
    with stack, stage:
        for k in range(round(END / step)):
            stack.set({"voltage": RATE * k * step}, {"voltage": RATE})
            _pass(stage, stack, TO_STACK, slopes)
            _pass(stack, stage, TO_STAGE, slopes)
            stack.step(k * step, step)
            stage.step(k * step, step)
        return stage.get(["x_f"])[0]


class Slave:
    """One co-simulation FMU in fmpy, by the names of its variables; a context manager.

    `fmu` is what fmpy calls.
    """

    def __init__(self, path: Path) -> None:
        description = read_model_description(str(path))
        self._at = {v.name: v.valueReference for v in description.modelVariables}
        self._unpacked = str(extract(str(path)))
        self.fmu = FMU2Slave(
            guid=description.guid, unzipDirectory=self._unpacked, instanceName=path.stem,
            modelIdentifier=description.coSimulation.modelIdentifier,
        )  # fmt: skip

    def __enter__(self) -> "Slave":
        self.fmu.instantiate()
        self.fmu.setupExperiment(tolerance=1e-8)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        return self

    def __exit__(self, *_: object) -> None:
        self.fmu.terminate()
        self.fmu.freeInstance()
        shutil.rmtree(self._unpacked, ignore_errors=True)

    def set(self, values: dict[str, float], rates: dict[str, float] | None = None) -> None:
        """Set inputs, and their first derivatives where there are any."""
        self.fmu.setReal([self._at[n] for n in values], list(values.values()))
        if rates:
            at = [self._at[n] for n in rates]
            self.fmu.setRealInputDerivatives(at, [1] * len(at), list(rates.values()))

    def get(self, names: Sequence[str]) -> list[float]:
        """Return the values of variables."""
        return list(self.fmu.getReal([self._at[n] for n in names]))

    def rates(self, names: Sequence[str]) -> list[float]:
        """Return the first derivatives of outputs."""
        at = [self._at[n] for n in names]
        return list(self.fmu.getRealOutputDerivatives(at, [1] * len(at)))

    def step(self, time: float, size: float) -> None:
        """Do one communication step."""
        self.fmu.doStep(currentCommunicationPoint=time, communicationStepSize=size)


def _pass(source: Slave, target: Slave, names: tuple[tuple[str, str], ...], slopes: bool) -> None:
    outputs, inputs = [n for n, _ in names], [n for _, n in names]
    rates = dict(zip(inputs, source.rates(outputs), strict=True)) if slopes else {}
    target.set(dict(zip(inputs, source.get(outputs), strict=True)), rates)


def _order(errors: FloatArray) -> float:
    """Return the slope of log error against log step."""
    return float(np.polyfit(np.log(COMMUNICATION_STEPS), np.log(errors), 1)[0])


def _draw(path: Path, held: FloatArray, sloped: FloatArray) -> None:
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    axes = figure.subplots()
    steps = 1e6 * np.array(COMMUNICATION_STEPS)
    axes.loglog(steps, 100.0 * held, "o-", color="#d55e00", label="values held")
    axes.loglog(steps, 100.0 * sloped, "o-", color="#0072b2", label="with slopes")
    axes.set_xticks(steps, [f"{s:g}" for s in steps])
    axes.set_xticks([], minor=True)
    axes.set(xlabel="communication step [us]", ylabel="error of the stage's position [%]")
    axes.grid(color="#e4e7ea", which="both")
    axes.legend()
    figure.savefig(path, dpi=110)
