"""Blocks that learn the hysteresis sample by sample, or take it off.

The voltage goes in a line from one sample to the next, so that it turns at samples only: the kink
of eq. (8) never lies inside a step (`online_recursion`). The voltage at which `k_L u + f_H(u)` is
the wanted force, `K w` of a wanted displacement w at the stiffness K, is solved for by three Newton
steps. Every sample takes the same operations.
"""

from dataclasses import replace
from functools import partial
from itertools import islice

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.components.online_recursion import (
    COUNT,
    SHAPES,
    TRACKED,
    Constants,
    Memory,
    advance,
    constants,
    estimates,
    force_after,
    linearising_voltage,
)
from psa_casadi.scales import voltage_scale
from psa_casadi.variables import Input, Output, Parameter, State, Values


def force_scale(p: Values) -> float:
    """Return the size of a hysteresis force [N]."""
    return 0.1 * abs(p["k_L"]) * p["u_rated"]


def stroke(p: Values) -> float:
    """Return the displacement at the rated voltage, without hysteresis [m]."""
    return abs(p["k_L"]) * p["u_rated"] / p["stiffness"]


_ESTIMATES = tuple(
    Output(f"{name}_hat", unit, f"estimate of {name}", 1.0 if unit != "N" else force_scale)
    for name, unit in TRACKED.items()
)
_FORCE = Output("hysteresis_force", "N", "estimated hysteresis force", force_scale)
_CORRECTION = Output("correction", "V", "voltage to add so that the stack is linear", voltage_scale)
_VOLTAGE_IN = Input("voltage", "V", "voltage at the stack", nominal=voltage_scale)
_POSITION = Input("position", "m", "measured displacement", 0.0, stroke, "um")
_UNITS = {"A": "V", "beta": "V", "gamma": "V", "delta": "V.s", "n": "N"}
_MEANING = "of the covariance U D U' of the deviations"
#: What the block keeps between instants, in the order of `flattened`.
SAMPLED = (
    *(State(f"z_{n}", "1", f"deviation of {n} from its start, in spreads", 1.0) for n in TRACKED),
    *(
        State(f"D_{j + 1}", "1", f"variance {_MEANING}", 1.0, start=1.0)
        if i == j
        else State(f"U_{i + 1}_{j + 1}", "1", f"factor {_MEANING}", 1.0)
        for j in range(COUNT)
        for i in range(j + 1)
    ),
    State("u_last", "V", "voltage at the last instant", voltage_scale),
    State("f_H", "N", "estimated hysteresis force", force_scale),
    *(State(f"s_{n}", unit, f"derivative of f_H by {n}", 1.0) for n, unit in _UNITS.items()),
    State("u_lag", "V", "voltage behind the lag", voltage_scale),
    State("f_lag", "N", "estimated hysteresis force behind the lag", force_scale),
    *(State(f"l_{n}", unit, f"s_{n} behind the lag", 1.0) for n, unit in _UNITS.items()),
)


def flattened(m: Memory) -> list[Expression]:
    """Return the memory as a list, in the order of the sampled states."""
    factors = [value for column in m.factors for value in column]
    return [*m.z, *factors, m.u, m.f, *m.sigma, m.nu, m.phi, *m.psi]


def _memory(s: Symbols) -> Memory:
    """Return the memory that the sampled states hold, the inverse of `flattened`."""
    left = iter([getattr(s, state.name) for state in SAMPLED])
    z = list(islice(left, COUNT))
    factors = [list(islice(left, j + 1)) for j in range(COUNT)]
    u, f, sigma = next(left), next(left), list(islice(left, SHAPES))
    return Memory(z, factors, u, f, sigma, next(left), next(left), list(islice(left, SHAPES)))


def _learnt(
    s: Symbols, c: Constants, voltage: Expression
) -> tuple[Memory, Memory, Equations, dict[str, Expression]]:
    """Return the memory now and after a sample, what that says, and the estimates now."""
    now = _memory(s)
    after = advance(c, now, voltage, s.position)
    found = dict(zip(TRACKED, estimates(c, now.z), strict=True))
    shown = {**{f"{name}_hat": value for name, value in found.items()}, "hysteresis_force": now.f}
    names = [state.name for state in SAMPLED]
    return (
        now,
        after,
        Equations(next=dict(zip(names, flattened(after), strict=True)), out=shown),
        found,
    )


def _online_identification(s: Symbols) -> Equations:
    c = _constants(s, _PARAMETERS)
    now, _, said, found = _learnt(s, c, s.voltage)
    predicted = (found["k_L"] * now.nu + now.phi + found["offset"]) / c.stiffness
    more = {"correction": -now.f / found["k_L"], "prediction_error": s.position - predicted}
    return replace(said, out={**said.out, **more})


_PARAMETERS = (
    Parameter("k_L", 10.0, "N/V", (1e-6, 1e6), "start of the linear force per volt", log=True),
    Parameter("A", -2.5, "N/V", (-1e5, 1e5), "start of the slope of the hysteresis force"),
    Parameter("beta", 2.5, "N/V", (-1e5, 1e5), "start of the dissipative bend"),
    Parameter("gamma", 0.4, "N/V", (-1e5, 1e5), "start of the elastic bend; below beta"),
    Parameter("delta", 0.0, "N/(V.s)", (-1e5, 1e5), "start of the asymmetry"),
    Parameter("n", 1.5, "1", (1.0, 4.0), "start of the sharpness of the bend"),
    Parameter("h_ref", 100.0, "N", (1e-9, 1e7), "reference force of the bend; not tracked"),
    Parameter("hold_rate", 0.1, "V/s", (1e-9, 1e6), "rate below which the voltage counts as held"),
    Parameter("u_rated", 150.0, "V", (1e-3, 1e5), "rated voltage span, sets nominal sizes"),
    Parameter("stiffness", 5e7, "N/m", (1.0, 1e12), "force per displacement of the stack at rest"),
    Parameter(
        "lag", 1e-4, "s", (1e-9, 10.0), "from voltage to displacement: first moment", "ms", log=True
    ),
    Parameter("period", 1e-4, "s", (1e-7, 10.0), "sample period", "ms", log=True),
    Parameter("memory", 1.0, "s", (1e-6, 1e9), "time over which what was learnt is forgotten"),
    Parameter(
        "standstill_rate", 1.0, "V/s", (0.0, 1e9), "voltage rate below which nothing is learnt"
    ),
    Parameter(
        "noise", 3e-8, "m", (1e-15, 1.0), "rms error of the displacement and the model", "nm"
    ),
    Parameter("spread", 0.3, "1", (1e-6, 10.0), "how far the starts may be off, as a share"),
)

_block = partial(Component, belongs_to="drive", sample_period="period")
ONLINE_IDENTIFICATION = _block(
    name="online_identification",
    description="recursive least squares of the hysteresis parameters, one sample in, one out",
    source="Yang and Zhu 2015, eq. 38; Ljung and Soderstrom 1983, chapter 3",
    equation_text=(
        "e = K x - (k_L u_lag + f_lag + offset);  z+ = z + P d e/(noise^2 + d'P d);"
        "  P+ = S (P - P d d'P/(noise^2 + d'P d)) S;  d: derivatives of the prediction"
    ),
    equations=_online_identification,
    parameters=_PARAMETERS,
    sampled=SAMPLED,
    inputs=(_VOLTAGE_IN, _POSITION),
    outputs=(
        *_ESTIMATES,
        _FORCE,
        _CORRECTION,
        Output("prediction_error", "m", "measured minus predicted displacement", stroke, "um"),
    ),
)


_LEARNING = ("lag", "memory", "standstill_rate", "noise", "spread")
_OBSERVING = tuple(
    replace(p, description=p.description.removeprefix("start of the "))
    for p in ONLINE_IDENTIFICATION.parameters
    if p.name not in _LEARNING
)
_VOLTAGE = Output("voltage", "V", "voltage at which the stack is where it is wanted", voltage_scale)
_WANTED = Input("wanted", "m", "displacement that is wanted", 0.0, stroke, "um")
_LAST = (
    State("u_last", "V", "voltage at the last instant", voltage_scale),
    State("f_H", "N", "estimated hysteresis force", force_scale),
)
_WANTED_LAST = State(
    "wanted_last", "m", "wanted displacement of the last instant", stroke, 0.0, "um"
)
_PAPER = "Yang and Zhu 2015, section 5.1:"


def _constants(s: Symbols, parameters: tuple[Parameter, ...]) -> Constants:
    """Return the constants; what learning needs has its default where a block does not learn."""
    default: dict[str, Expression] = {p.name: p.value for p in ONLINE_IDENTIFICATION.parameters}
    return constants(default | {p.name: getattr(s, p.name) for p in parameters})


def _observer(s: Symbols) -> Equations:
    c = _constants(s, _OBSERVING)
    force = force_after(c, c.start, s.f_H, s.u_last, s.voltage)
    return Equations(
        next={"u_last": s.voltage, "f_H": force},
        out={"hysteresis_force": s.f_H, "correction": -s.f_H / s.k_L},
    )


def _next_voltage(
    c: Constants, s: Symbols, theta: list[Expression], force: Expression, last: Expression
) -> Expression:
    """Return the voltage at the next instant, from the force and the voltage at the last one."""
    guess = last + (s.wanted - s.wanted_last) * s.stiffness / s.k_L
    return linearising_voltage(c, theta, force, last, guess, s.stiffness * s.wanted)


def _feed_forward(s: Symbols) -> Equations:
    c = _constants(s, _OBSERVING)
    u = _next_voltage(c, s, list(c.start), s.f_H, s.u_last)
    force = force_after(c, c.start, s.f_H, s.u_last, u)
    return Equations(
        next={"u_last": u, "f_H": force, "wanted_last": s.wanted},
        out={"voltage": s.u_last, "hysteresis_force": s.f_H},
    )


def _adaptive(s: Symbols) -> Equations:
    """The voltage that was returned last has been applied when the displacement is measured."""
    c = _constants(s, ONLINE_IDENTIFICATION.parameters)
    _, after, said, _ = _learnt(s, c, s.applied)
    u = _next_voltage(c, s, estimates(c, after.z), after.f, after.u)
    return Equations(
        next={**said.next, "applied": u, "wanted_last": s.wanted},
        out={"voltage": s.applied, **said.out},
    )


HYSTERESIS_OBSERVER = _block(
    name="hysteresis_observer",
    description="observer of the hysteresis force on the known voltage, one sample in, one out",
    source=f"{_PAPER} observer (37)",
    equation_text="f_H+ = f_H by (8) along the line from u- to u",
    equations=_observer,
    parameters=_OBSERVING,
    sampled=_LAST,
    inputs=(_VOLTAGE_IN,),
    outputs=(_FORCE, _CORRECTION),
)

FEED_FORWARD = _block(
    name="feed_forward",
    description="voltage for a wanted displacement of a stack, its hysteresis taken off, sampled",
    source=f"{_PAPER} observer (37), compensation (39) to (41)",
    equation_text="k_L u + f_H(u) = K w for u;  f_H(u) by (8) along the line from u-",
    equations=_feed_forward,
    parameters=_OBSERVING,
    sampled=(*_LAST, _WANTED_LAST),
    inputs=(_WANTED,),
    outputs=(_VOLTAGE, _FORCE),
)

ADAPTIVE_FEED_FORWARD = _block(
    name="adaptive_feed_forward",
    description="feed-forward whose hysteresis parameters follow the measured displacement",
    source=f"{_PAPER} equations (37) to (41)",
    equation_text="as feed_forward, with A, beta, gamma, delta, n, k_L of online_identification",
    equations=_adaptive,
    parameters=ONLINE_IDENTIFICATION.parameters,
    sampled=(
        *SAMPLED,
        State("applied", "V", "voltage that was returned last", voltage_scale),
        _WANTED_LAST,
    ),
    inputs=(_WANTED, _POSITION),
    outputs=(_VOLTAGE, *_ESTIMATES, _FORCE),
)
