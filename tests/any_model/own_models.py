"""Models that are no stacks, without the causes: what tests and tables fit."""

import casadi as ca

import psa_casadi as psa


def _parameter(name: str, value: float, unit: str) -> psa.Parameter:
    return psa.Parameter(name, value, unit, (0.03 * value, 30.0 * value), name, log=True)


def oscillator() -> psa.Model:
    x, v, force, m, c, k = (ca.SX.sym(n) for n in ("x", "v", "force", "m", "c", "k"))
    return psa.ode_model(
        {"x": [x, v], "u": force, "p": [m, c, k], "ode": [v, (force - c * v - k * x) / m], "y": x},
        name="oscillator",
        states=[psa.State("x", "m", "position", 1.0), psa.State("v", "m/s", "velocity", 1.0)],
        inputs=[psa.Input("force", "N", "force")],
        outputs=[psa.Output("position", "m", "position")],
        parameters=[
            _parameter("m", 1.0, "kg"),
            _parameter("c", 30.0, "N.s/m"),
            _parameter("k", 6e4, "N/m"),
        ],
    )


def motor() -> psa.Model:
    i, w, u, R, k, J, b = (ca.SX.sym(n) for n in ("current", "speed", "voltage", *"RkJb"))
    return psa.ode_model(
        {
            "x": [i, w], "u": u, "p": [R, k, J, b], "y": [w, i],
            "ode": [(u - R * i - k * w) / 2e-3, (k * i - b * w) / J],
        },
        name="motor",
        outputs=[psa.Output("w", "rad/s", "speed"), psa.Output("i", "A", "current")],
        parameters=[
            _parameter("R", 1.5, "Ohm"),
            _parameter("k", 0.04, "N.m/A"),
            _parameter("J", 2e-5, "kg.m2"),
            _parameter("b", 1e-5, "N.m.s"),
        ],
    )  # fmt: skip


def tanks() -> psa.Model:
    upper, lower, pump, a, c, d = (ca.SX.sym(n) for n in ("h1", "h2", "pump", "a", "c", "d"))
    through, out = (f * ca.sqrt(ca.fmax(h, 1e-4)) for f, h in ((a, upper), (c, lower)))
    return psa.ode_model(
        {
            "x": [upper, lower], "u": pump, "p": [a, c, d], "y": lower,
            "ode": [d * pump - through, through - out],
        },
        name="tanks",
        states=[psa.State(n, "m", n, 1.0, 0.1) for n in ("h1", "h2")],
        outputs=[psa.Output("level", "m", "level of the lower tank")],
        parameters=[_parameter(n, v, "1") for n, v in (("a", 0.02), ("c", 0.02), ("d", 0.003))],
    )  # fmt: skip


def pair() -> psa.Model:
    x, v, z, w, f1, f2 = (ca.SX.sym(n) for n in ("x1", "v1", "x2", "v2", "f1", "f2"))
    k, kc, c = (ca.SX.sym(n) for n in ("k", "kc", "c"))
    rates = [v, f1 - k * x - kc * (x - z) - c * v, w, f2 - k * z - kc * (z - x) - c * w]
    return psa.ode_model(
        {"x": [x, v, z, w], "u": [f1, f2], "p": [k, kc, c], "ode": rates, "y": [x, z]},
        name="pair",
        outputs=["y1", "y2"],
        parameters=[_parameter(n, v, "1") for n, v in (("k", 80.0), ("kc", 30.0), ("c", 0.5))],
    )


def cylinder(dead_zone: float = 0.0) -> psa.Model:
    """Return a hydraulic cylinder; `dead_zone` is a known one of its valve [V]."""
    p, v, x, u, kq, c, leak, b, ks = (
        ca.SX.sym(n) for n in ("p", "v", "x", "u", "Kq", "C", "leak", "b", "ks")
    )
    volt = ca.sign(u) * ca.fmax(ca.fabs(u) - dead_zone, 0.0) if dead_zone else u
    return psa.ode_model(
        {
            "x": [p, v, x], "u": u, "p": [kq, c, leak, b, ks], "y": [x, p],
            "ode": [
                (kq * volt - 1.2e-3 * v - leak * p) / c, (1.2e-3 * p - b * v - ks * x) / 85.0, v
            ],
        },
        name="cylinder",
        inputs=[psa.Input("u", "V", "voltage of the valve")],
        outputs=[psa.Output("position", "m", "position"), psa.Output("pressure", "Pa", "pressure")],
        parameters=[
            _parameter("Kq", 4e-5, "m3/(s.V)"),
            _parameter("C", 2e-13, "m3/Pa"),
            _parameter("leak", 1e-12, "m3/(s.Pa)"),
            _parameter("b", 900.0, "N.s/m"),
            _parameter("ks", 4e4, "N/m"),
        ],
    )  # fmt: skip


def oven() -> psa.Model:
    wall, air, heater, cw, c_a, h1, h2 = (
        ca.SX.sym(n) for n in ("tw", "ta", "heater", "Cw", "Ca", "h1", "h2")
    )
    return psa.ode_model(
        {
            "x": [wall, air], "u": heater, "p": [cw, c_a, h1, h2], "y": [wall, air],
            "ode": [(heater - h1 * (wall - air)) / cw, (h1 * (wall - air) - h2 * air) / c_a],
        },
        name="oven",
        outputs=[psa.Output(n, "K", f"{n} above the room") for n in ("wall", "air")],
        parameters=[
            _parameter("Cw", 2000.0, "J/K"),
            _parameter("Ca", 400.0, "J/K"),
            _parameter("h1", 15.0, "W/K"),
            _parameter("h2", 5.0, "W/K"),
        ],
    )  # fmt: skip
