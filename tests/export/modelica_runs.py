"""Exported packages in rumoca, an independent Modelica compiler, and what they should give."""

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
import rumoca

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.export.modelica.package import modelica_text

_SAMPLES = 200
#: The connectors and parts of Modelica's library that the wired example names, as stubs.
STUB = Path(__file__).with_name("modelica_stub.mo").read_text("utf-8")


@cache
def model_named(name: str) -> psa.Model:
    """Return a stack by name, P-885.51 with an effect of its ordinary size, or "every_effect"."""
    if name in psa.STACKS:
        return psa.stack_model(name)
    chosen = psa.EFFECTS.values() if name == "every_effect" else (psa.EFFECTS[name],)
    base = {k: figure.value for k, figure in psa.STACKS["P-885.51"].values.items()}
    model = psa.compose((*psa.BASE, *chosen), base)
    gains = {str(e.gain): model.parameter(str(e.gain)) for e in chosen}
    sizes = {g: p.typical({**model.values, g: 0.0}) for g, p in gains.items()}
    return model.with_values(sizes)


@cache
def text_of(name: str) -> str:
    """Return the package of a named model, sensor and environment included."""
    return modelica_text(model_named(name), include_sensor=True)


def load(text: str, name: str) -> rumoca.Model:
    """Compile one class of a text."""
    return rumoca.Session().loads(text, model=name)


def simulated(text: str, name: str, span: float, rtol: float = 1e-11) -> Mapping[str, FloatArray]:
    """Return every variable of a run of a class from 0 to span [s], and its times as "time"."""
    config = rumoca.SimConfig(solver="bdf", rtol=rtol, atol=1e-16, dt=span / _SAMPLES)
    result = load(text, name).simulate(t=(0.0, span), config=config)
    table = {n: np.asarray(result[n]) for n in result.names}
    return {**table, "time": np.asarray(result.time)}


def signal_class(text: str) -> str:
    """Return the lines of the class `Signal` without its annotation."""
    return text.partition("  model Signal ")[2].partition("annotation(")[0]


def pure_ode(model: psa.Model, text: str) -> str:
    """Return a class with the states' equations, and each output as the rate of one more state.

    rumoca hands its reading of a class to CasADi only if all equations are of the form
    der(x) = f(x); every other variable is replaced by its right-hand side.
    """
    declared, body = signal_class(text).split("\n  equation\n")
    body = re.sub(r"//[^\n]*", "", body)
    pairs = (" ".join(e.split()).partition(" = ") for e in body.split(";") if e.strip())
    sides = {left: right for left, _, right in pairs}

    def resolved(side: str) -> str:
        def replaced(match: re.Match[str]) -> str:
            name = match[0].replace(" ", "")
            return f"({resolved(sides[name])})" if name in sides else match[0]

        return re.sub(r"der\(\w+\)|\b[A-Za-z_]\w*\b", replaced, side)

    public = declared.partition("\n  protected\n")[0].split("\n")[2:]
    lines = [line for line in public if not line.lstrip().startswith("output ")]
    lines += [f"Real integral_{n}(start=0.0, fixed=true);" for n in model.output_names]
    lines += ["equation"]
    lines += [f"der({n}) = {resolved(sides[f'der({n})'])};" for n in model.state_names]
    lines += [f"der(integral_{n}) = {resolved(n)};" for n in model.output_names]
    return "\n".join(["model Pure", *lines, "end Pure;"])


def read_back(source: str) -> rumoca.SolveExport:
    """Return rumoca's reading of a pure ODE: `rhs(t, x, u, p)`, and the names of x, u, p."""
    return load(source, "Pure").to_casadi()


def right_side_error(model: psa.Model, text: str, points: int = 5) -> float:
    """Return the largest relative difference of derivatives and outputs at random points.

    At the last point the voltage is held: its rate is below `hold_rate`.
    """
    read = read_back(pure_ode(model, text))
    inputs = dict(zip(read.parameter_names, read.default_parameters, strict=True))
    values, draw = model.values, np.random.default_rng(1)
    starts = np.array([i.start for i in model.structure.inputs])
    sizes = np.array([50.0, 100.0, 10.0])[: len(starts)]
    worst = 0.0
    for k in range(points + 1):
        x = model.state_nominals() * draw.normal(size=len(model.state_names))
        u = starts + sizes * draw.normal(size=len(starts))
        if k == points:
            u[0], x[0] = 0.0, 0.7 * values["hold_rate"] * (values["R_s"] * values["C_p"])
        time = float(draw.uniform(0.1, 5.0))
        expected = model.structure.f(time, x, u, model.parameter_vector())
        inputs |= dict(zip(model.state_names, x, strict=True))
        inputs |= dict(zip(model.input_names, u, strict=True))
        inputs |= {f"integral_{n}": 0.0 for n in model.output_names}
        names = (read.state_names, read.input_names, read.parameter_names)
        rates = np.array(read.rhs(time, *([inputs[n] for n in listed] for listed in names))).ravel()
        got = dict(zip(read.state_names, rates, strict=True))
        left = [*model.state_names, *(f"integral_{n}" for n in model.output_names)]
        right = np.concatenate([np.array(v).ravel() for v in expected])
        for name, value in zip(left, right, strict=True):
            difference = abs(got[name] - value) / max(abs(value), 1e-300)
            worst = max(worst, difference) if np.isfinite(difference) else np.inf
    return worst
