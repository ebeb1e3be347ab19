"""Linearised models: matrices at an operating point, margins of a loop, a Kalman filter.

dx' = A dx + B du,  dy = C dx + D du,   about x_0, u_0, y_0
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import casadi as ca
import numpy as np
import scipy

from psa_casadi.common.display import Celled
from psa_casadi.common.errors import InputError, PsaError, quoted
from psa_casadi.common.files import atomic_path, atomic_write
from psa_casadi.common.strict_json import json_text
from psa_casadi.common.units import ComplexArray, FloatArray
from psa_casadi.model.compose import Model
from psa_casadi.model.ode_model import ode_model
from psa_casadi.model.variables import Input, Output, State, nominal_value
from psa_casadi.simulation.start import is_stack, start_state

#: What a rate may be at rest, over the largest usual size of its row.
_REST = 1e-9
FORMAT = "psa_casadi.linear/1"
V = TypeVar("V", State, Input, Output)


@dataclass(frozen=True, eq=False, repr=False)
class Linear(Celled):
    """A model linearised at an operating point; matrices in SI units, in the order of the names.

    `held` are states that rest at any value (hysteresis): they are constants here, so that the gain
    is that of the elastic part; `simulate` has that of small loops. `rates` (nx,) are x' at the
    point, 0 at rest.
    """

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray
    x: FloatArray
    u: FloatArray
    y: FloatArray
    rates: FloatArray
    states: tuple[State, ...]
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    name: str
    held: tuple[str, ...] = ()

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states."""
        return tuple(s.name for s in self.states)

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return tuple(i.name for i in self.inputs)

    @property
    def output_names(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return tuple(o.name for o in self.outputs)

    @property
    def poles(self) -> ComplexArray:
        """Eigenvalues of A [1/s], the slowest first."""
        poles = np.linalg.eigvals(self.a).astype(complex)
        return np.asarray(poles[np.argsort(np.abs(poles))])

    def __repr__(self) -> str:
        """Return the operating point and the poles."""
        at = ", ".join(f"{n} = {v:.6g}" for n, v in zip(self.input_names, self.u, strict=True))
        lines = [f"'{self.name}' about {at or 'its start'}: {len(self.x)} states"]
        if self.held:
            lines.append(f"  constant here, though small loops move it: {', '.join(self.held)}")
        for p in self.poles:
            size, real = abs(p), p.real
            if p.imag > 0.0:
                mode = f"{size / (2 * np.pi):.6g} Hz, damping ratio {-real / size:.4g}"
                lines.append(f"  mode {mode}")
            elif p.imag == 0.0:
                lines.append(f"  pole {real:.6g} 1/s")
        return "\n".join(lines)

    def response(self, omega: FloatArray) -> ComplexArray:
        """Return the outputs over the inputs (n, ny, nu) at angular frequencies (n,) [rad/s]."""
        systems = 1j * omega[:, None, None] * np.eye(len(self.a)) - self.a
        right = np.broadcast_to(self.b.astype(complex), (len(omega), *self.b.shape))
        return np.asarray(self.c @ np.linalg.solve(systems, right) + self.d)

    def to_control(self) -> Any:
        """Return python-control's StateSpace with the names. Needs the extra `control`."""
        return _control().ss(
            self.a, self.b, self.c, self.d, states=list(self.state_names),
            inputs=list(self.input_names), outputs=list(self.output_names), name=self.name,
        )  # fmt: skip

    def to_json(self) -> dict[str, Any]:
        """Return matrices, point, names and units."""
        groups: dict[str, Sequence[State | Input | Output]] = {
            "states": self.states, "inputs": self.inputs, "outputs": self.outputs,
        }  # fmt: skip
        named = {k: [{"name": v.name, "unit": v.unit} for v in g] for k, g in groups.items()}
        matrices = {n: getattr(self, n.lower()).tolist() for n in "ABCD"}
        point = {n: getattr(self, n).tolist() for n in ("x", "u", "y", "rates")}
        head = {"format": FORMAT, "name": self.name}
        return {**head, **matrices, **point, **named, "held": list(self.held)}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write NAME.mat, a MATLAB file with A, B, C, D, the point and names, or NAME.json.

        Raises InputError for another ending, or a file that cannot be written.
        """
        target = Path(path)
        if target.suffix.lower() == ".json":
            atomic_write(target, json_text(self.to_json()))
        elif target.suffix.lower() == ".mat":
            names = {"x": self.state_names, "u": self.input_names, "y": self.output_names}
            content: dict[str, Any] = {n: getattr(self, n.lower()) for n in "ABCD"}
            content |= {"x0": self.x, "u0": self.u, "y0": self.y}
            content |= {f"{k}_name": np.array(v, dtype=object) for k, v in names.items()}
            with atomic_path(target) as temporary:
                scipy.io.savemat(str(temporary), content, appendmat=False, oned_as="column")
        else:
            raise InputError(f"{target}: matrices go to NAME.mat or NAME.json; name it so.")


def linearize(
    model: Model,
    inputs: Mapping[str, float] | None = None,
    *,
    states: Mapping[str, float] | None = None,
    time: float = 0.0,
) -> Linear:
    """Linearise a model at rest with constant inputs, or at states.

    `inputs` are their values in SI units, by default their starts. A stack rests settled at its
    voltage. Another model rests where its rates are 0, searched from its starts; with `states`,
    some or all by name, it is linearised there, at rest or not. An imported FMU has its
    derivatives; one that is run as a whole has none.

    Raises InputError for unknown names, sampled states, an FMU that is run as a whole, and where no
    rest exists.
    """
    s, arguments = model.structure, dict(inputs or {})
    known = {"input": model.input_names, "state": model.state_names}
    for kind, names in (("input", arguments), ("state", states or {})):
        for name in (n for n in names if n not in known[kind]):
            raise InputError(
                f"The model '{model.name}' has no {kind} '{name}'; it has"
                f" {quoted(known[kind]) or 'none'}."
            )
    if s.sampled:
        raise InputError(f"The model '{model.name}' has sampled states; leave that part out.")
    if s.played is not None:
        raise InputError(
            "An FMU that is run as a whole has no equations to linearise; model exchange without"
            " events has."
        )
    u = np.array([arguments.get(i.name, i.start) for i in s.inputs])
    x = np.array([(states or {}).get(q.name, q.start) for q in s.states])
    held = tuple(q.name for q in s.states if q.memory and not q.settles)
    p = model.parameter_vector()
    if not states:
        x = start_state(model, u.tolist()).x if is_stack(model) else _rest(model, time, x, u)
    a, b, c, d = (np.array(m) for m in s.slopes(time, x, u, p))
    rates, y = (np.array(v).ravel() for v in s.f(time, x, u, p))
    kept = [k for k, q in enumerate(s.states) if q.name not in held]
    return Linear(
        a[np.ix_(kept, kept)], b[kept], c[:, kept], d, x[kept], u, y, rates[kept],
        tuple(_sized(s.states[k], model) for k in kept),
        tuple(_sized(i, model) for i in s.inputs), tuple(_sized(o, model) for o in s.outputs),
        model.name, held,
    )  # fmt: skip


def _rest(model: Model, time: float, x: FloatArray, u: FloatArray) -> FloatArray:
    """Return the states at which the rates are 0, from states on. Raises InputError."""
    s, p, sizes = model.structure, model.parameter_vector(), model.state_nominals()
    if not len(x):
        return x

    def rates(z: FloatArray) -> FloatArray:
        return np.asarray(np.array(s.f(time, z * sizes, u, p)[0]).ravel() / scale)

    slopes = np.array(s.slopes(time, x, u, p)[0]) * sizes
    scale = np.maximum(np.max(np.abs(slopes), axis=1), 1e-300)
    try:
        with np.errstate(all="ignore"):  # of what runs away
            solution = scipy.optimize.least_squares(
                rates, x / sizes, x_scale="jac", xtol=1e-15, gtol=1e-15
            )
    except (ValueError, RuntimeError) as error:  # rates that are not finite
        raise InputError(
            f"The search for a rest of '{model.name}' failed ({error}); specify `states`."
        ) from error
    if not np.max(np.abs(solution.fun)) <= _REST:
        raise InputError(
            f"The search for a rest of '{model.name}' from its starts, with these inputs, failed;"
            " specify `states`, where it need not rest."
        )
    return np.asarray(solution.x * sizes)


def margins(
    of: Linear, controller: tuple[Sequence[float], Sequence[float]], *,
    input: str | None = None, output: str | None = None,
) -> dict[str, float]:  # fmt: skip
    """Return how far a loop around one input and one output is from instability.

    The controller is a transfer function (numerator, denominator), highest power first, that acts
    on the setpoint less the output. `gain_margin` is a factor, `phase_margin` in degrees, each with
    the frequency [Hz] where it is; `delay_margin` [s]; `stable` is 1 where the closed loop is.
    Needs the extra `control`.
    """
    control = _control()
    row = _one(of.output_names, output, "`output`, --to")
    plant = of.to_control()[row, _one(of.input_names, input, "`input`, --from")]
    try:
        loop = plant * control.tf(*map(list, controller))
    except ValueError as error:
        raise InputError(
            f"The controller is no transfer function ({error}); give numerator and denominator, the"
            " latter of the same or a higher degree."
        ) from error
    gain, phase, _, at_gain, at_phase, _ = control.stability_margins(loop)
    closed = control.feedback(loop, 1)
    return {
        "gain_margin": float(gain), "gain_margin_at": float(at_gain) / (2 * np.pi),
        "phase_margin": float(phase), "phase_margin_at": float(at_phase) / (2 * np.pi),
        "delay_margin": float(np.deg2rad(phase) / at_phase) if at_phase else float("inf"),
        "stable": float(np.all(closed.poles().real < 0.0)),
    }  # fmt: skip


def observer(
    of: Linear, *, input_noise: Mapping[str, float], output_noise: Mapping[str, float],
    step: float,
) -> Model:  # fmt: skip
    """Return the stationary Kalman filter of a linearised model, as a model to export.

        x^' = A x^ + B (u - u_0) + L (y - y_0 - C x^ - D (u - u_0)),  L = P C' V^-1
        A P + P A' - P C' V^-1 C P + B W B' = 0

    Its inputs are the model's inputs and, named measured_y, its outputs of `output_noise`; its
    outputs the estimated states, and estimated_y of all outputs. Noises are standard deviations
    [SI] of samples at every `step` [s]: W and V are their variances times the step.

    Raises InputError for unknown names, and where no filter exists, as where an output does not
    show a mode that is not damped.
    """
    rows = [_one(of.output_names, n) for n in output_noise]
    if not rows:
        raise InputError(
            "An observer needs the noise of one measured output at least: `output_noise`, --noise."
        )
    for name, size in {**input_noise, **output_noise}.items():
        if not 0.0 < size < np.inf:
            raise InputError(f"The noise of '{name}' is {size:g}; give a positive number.")
    w = np.zeros(len(of.u))
    for name, size in input_noise.items():
        w[_one(of.input_names, name)] = size**2 * step
    v = step * np.array([*output_noise.values()]) ** 2
    c, d = of.c[rows], of.d[rows]
    gain = _kalman_gain(of, w, c, v)
    names = [f"measured_{of.output_names[r]}" for r in rows]
    x, u, y = (
        ca.vertcat(ca.SX(0, 1), *(ca.SX.sym(n) for n in group))
        for group in ([f"of_{n}" for n in of.state_names], of.input_names, names)
    )
    moved = u - of.u
    innovation = y - of.y[rows] - c @ x - d @ moved
    estimates = ca.vertcat(x + of.x, of.y + of.c @ x + of.d @ moved)
    measured = [of.outputs[r] for r in rows]
    estimated: list[State | Output] = [*of.states, *of.outputs]
    return ode_model(
        {
            "x": x, "u": ca.vertcat(u, y), "y": estimates,
            "ode": of.a @ x + of.b @ moved + gain @ innovation,
        },
        name=f"{of.name}_observer",
        states=[State(f"of_{s.name}", s.unit, f"{s.description}, less its value at the point",
                      s.nominal) for s in of.states],
        inputs=[
            *of.inputs,
            *(Input(n, o.unit, f"measured {o.description}", y0, o.nominal)
              for n, o, y0 in zip(names, measured, of.y[rows].tolist(), strict=True)),
        ],
        outputs=[
            Output(f"estimated_{v.name}", v.unit, f"estimated {v.description}")
            for v in estimated
        ],
        description=f"stationary Kalman filter of '{of.name}'",
        source="Kalman and Bucy, J. Basic Eng. 83 (1961), 95",
    )  # fmt: skip


def _kalman_gain(of: Linear, w: FloatArray, c: FloatArray, v: FloatArray) -> FloatArray:
    """Return L (nx, ny) for the intensities w (nu,) of inputs and v (ny,) of outputs C x.

    Riccati's equation is solved in states over their usual sizes and outputs over their noise: in
    SI units the entries of a stack differ by 1e20. Raises InputError where no filter is stable.
    """
    sizes, deviation = np.array([s.nominal for s in of.states], dtype=float), np.sqrt(v)
    a, reading = of.a / sizes[:, None] * sizes, c * sizes / deviation[:, None]
    driven = of.b / sizes[:, None] * np.sqrt(w)
    problem, p = "its error would grow", np.full_like(a, np.nan)
    try:
        p = scipy.linalg.solve_continuous_are(a.T, reading.T, driven @ driven.T, np.eye(len(v)))
    except (np.linalg.LinAlgError, ValueError) as error:
        problem = str(error)
    if not np.isfinite(p).all() or any(np.linalg.eigvals(a - p @ reading.T @ reading).real >= 0.0):
        raise InputError(
            f"No Kalman filter results ({problem}); measure more outputs, or give inputs noise."
        )
    return np.asarray(p @ reading.T * sizes[:, None] / deviation)


def _sized(variable: V, model: Model) -> V:
    """Return a variable whose usual size is a number, not a function of parameters."""
    return replace(variable, nominal=nominal_value(variable.nominal, model.values))


def _one(names: Sequence[str], name: str | None, what: str = "") -> int:
    if name is None and len(names) == 1:
        return 0
    if name not in names:
        which = f"'{name}' is none of" if name else f"Name one ({what}) of"
        raise InputError(f"{which} {quoted(names)}.")
    return names.index(name)


def _control() -> Any:
    try:
        return import_module("control")
    except ImportError as error:
        raise PsaError(
            "python-control is not installed; run `pip install 'psa-casadi[control]'`."
        ) from error
