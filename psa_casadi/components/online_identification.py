"""Recursive least squares of the hysteresis parameters, as a sampled block (paper eq. 38)."""

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.components.hysteresis_step import COUNT, SHAPES, TRACKED, constants, estimates
from psa_casadi.components.online_recursion import Memory, advance
from psa_casadi.scales import voltage_scale
from psa_casadi.variables import Input, Output, Parameter, State, Values

_SHAPED = tuple(TRACKED)[:SHAPES]


def force_scale(p: Values) -> float:
    """Return the size of a hysteresis force [N]."""
    return 0.1 * abs(p["k_L"]) * p["u_rated"]


def stroke(p: Values) -> float:
    """Return the displacement at the rated voltage, without hysteresis [m]."""
    return abs(p["k_L"]) * p["u_rated"] / p["stiffness"]


def estimate_outputs() -> tuple[Output, ...]:
    """Return the outputs that show the estimates."""
    return tuple(
        Output(f"{name}_hat", unit, f"estimate of {name}", 1.0 if unit != "N" else force_scale)
        for name, unit in TRACKED.items()
    )


def _sampled() -> tuple[State, ...]:
    """Return what the block keeps between instants, in the order of `flattened`."""
    z = [State(f"z_{n}", "1", f"deviation of {n} from its start, in spreads", 1.0) for n in TRACKED]
    meaning = "of the covariance U D U' of the deviations"
    factors = [
        State(f"D_{j + 1}", "1", f"variance {meaning}", 1.0, start=1.0)
        if i == j
        else State(f"U_{i + 1}_{j + 1}", "1", f"factor {meaning}", 1.0)
        for j in range(COUNT)
        for i in range(j + 1)
    ]
    units = {"A": "V", "beta": "V", "gamma": "V", "delta": "V.s", "n": "N"}
    return (
        *z,
        *factors,
        State("u_last", "V", "voltage at the last instant", voltage_scale),
        State("f_H", "N", "estimated hysteresis force", force_scale),
        *(State(f"s_{n}", units[n], f"derivative of f_H by {n}", 1.0) for n in _SHAPED),
        State("u_lag", "V", "voltage behind the lag", voltage_scale),
        State("f_lag", "N", "estimated hysteresis force behind the lag", force_scale),
        *(State(f"l_{n}", units[n], f"s_{n} behind the lag", 1.0) for n in _SHAPED),
    )


SAMPLED = _sampled()


def flattened(m: Memory) -> list[Expression]:
    """Return the memory as a list, in the order of the sampled states."""
    factors = [value for column in m.factors for value in column]
    return [*m.z, *factors, m.u, m.f, *m.sigma, m.nu, m.phi, *m.psi]


def gathered(values: list[Expression]) -> Memory:
    """Return the memory from a list, the inverse of `flattened`."""
    left = iter(values)

    def take(count: int) -> list[Expression]:
        return [next(left) for _ in range(count)]

    return Memory(
        z=take(COUNT),
        factors=[take(j + 1) for j in range(COUNT)],
        u=next(left),
        f=next(left),
        sigma=take(SHAPES),
        nu=next(left),
        phi=next(left),
        psi=take(SHAPES),
    )


def _online_identification(s: Symbols) -> Equations:
    c = constants({p.name: getattr(s, p.name) for p in _PARAMETERS})
    now = gathered([getattr(s, state.name) for state in SAMPLED])
    after = advance(c, now, s.voltage, s.position)
    names = [state.name for state in SAMPLED]
    found = dict(zip(TRACKED, estimates(c, now.z), strict=True))
    return Equations(
        next=dict(zip(names, flattened(after), strict=True)),
        out={
            **{f"{name}_hat": value for name, value in found.items()},
            "hysteresis_force": now.f,
            "correction": -now.f / found["k_L"],
            "prediction_error": s.position
            - (found["k_L"] * now.nu + now.phi + found["offset"]) / c.stiffness,
        },
    )


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

ONLINE_IDENTIFICATION = Component(
    name="online_identification",
    description="recursive least squares of the hysteresis parameters, one sample in, one out",
    source="Yang and Zhu 2015, eq. 38; Ljung and Soderstrom 1983, chapter 3",
    equation_text=(
        "e = K x - (k_L u_lag + f_lag + offset);  z+ = z + P d e/(noise^2 + d'P d);"
        "  P+ = S (P - P d d'P/(noise^2 + d'P d)) S;  d: derivatives of the prediction"
    ),
    belongs_to="drive",
    equations=_online_identification,
    parameters=_PARAMETERS,
    sampled=SAMPLED,
    sample_period="period",
    inputs=(
        Input("voltage", "V", "voltage at the stack", nominal=voltage_scale),
        Input("position", "m", "measured displacement", 0.0, stroke, "um"),
    ),
    outputs=(
        *estimate_outputs(),
        Output("hysteresis_force", "N", "estimated hysteresis force", force_scale),
        Output("correction", "V", "voltage to add so that the stack is linear", voltage_scale),
        Output("prediction_error", "m", "measured minus predicted displacement", stroke, "um"),
    ),
)
