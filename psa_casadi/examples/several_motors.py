"""Several motors by a user's model: a posterior, two side by side, the population of five.

`measured` makes the records, with what `model` lacks where that is wanted: dry friction, or the
voltage that the brushes drop.
"""

from pathlib import Path

import casadi as ca
import numpy as np
import scipy

import psa_casadi as psa
from psa_casadi.population.population import population


def measured(
    friction: float = 0.0, drop: float = 0.0, *, inertia: float = 3e-5, n: int = 3000, seed: int = 1
) -> dict[str, np.ndarray]:
    """Return a record of a motor: friction [N.m], drop of the brushes [V], inertia [kg.m2]."""
    t = np.arange(n) * 1e-3
    tones = (6, 1.1, 0), (4, 3.7, 1), (2, 0.4, 0)
    u = sum(a * np.sin(2 * np.pi * f * t + p) for a, f, p in tones)

    def rates(now: float, q: np.ndarray) -> list[float]:
        lost = drop * np.clip(20 * q[0], -1, 1)
        held = friction * np.tanh(q[1] / 0.2)
        return [
            (np.interp(now, t, u) - lost - 1.2 * q[0] - 0.05 * q[1]) / 2e-3,
            (0.05 * q[0] - 2e-5 * q[1] - held) / inertia,
        ]

    run = scipy.integrate.solve_ivp(
        rates, (0, t[-1]), [0, 0], t_eval=t, method="LSODA", rtol=1e-8, max_step=1e-3
    )
    noise = np.random.default_rng(seed).standard_normal((2, n))
    amps, w = run.y
    return {"time": t, "voltage": u, "w": w + 0.3 * noise[0], "amps": amps + 0.005 * noise[1]}


def model() -> psa.Model:
    """Return the motor: current and speed, driven by a voltage; no friction, no brushes."""
    i, speed, v, k, J, b = (ca.SX.sym(n) for n in ("i", "speed", "voltage", "k", "J", "b"))
    return psa.ode_model(
        {
            "x": [i, speed],
            "u": v,
            "p": [k, J, b],
            "y": [speed, i],
            "ode": [(v - 1.2 * i - k * speed) / 2e-3, (k * i - b * speed) / J],
        },
        name="motor",
        outputs=["w", "amps"],
        parameters=[
            psa.Parameter("k", 0.04, "N.m/A", (0.005, 0.5), "torque constant", log=True),
            psa.Parameter("J", 2e-5, "kg.m2", (1e-6, 1e-3), "inertia", log=True),
            psa.Parameter("b", 1e-5, "N.m.s", (1e-7, 1e-2), "damping", log=True),
        ],
    )


def main(folder: Path) -> dict[str, object]:
    """Sample one motor, compare two, and look at five, of which the last is 3 % heavier."""
    motor, records = model(), folder / "motors"
    records.mkdir(exist_ok=True)
    for k in range(5):
        record = measured(inertia=3.09e-5 if k == 4 else 3e-5, n=600, seed=k + 2)
        table = np.column_stack(list(record.values()))
        header = ",".join(record)
        np.savetxt(records / f"{k}.csv", table, delimiter=",", header=header, comments="")

    posterior = psa.sample(
        motor, records / "0.csv", known_start=True, chains=2, draws=200, tune=200, seed=1
    )
    posterior.save(folder / "motor.nc")
    posterior.report(folder / "posterior.html")

    two = [psa.identify(motor, records / f"{k}.csv", known_start=True) for k in (3, 4)]
    both = psa.compare(*two)
    both.report(folder / "two_motors.html")

    options = psa.Options(model=motor, words={"known_start": True})
    done = psa.batch(records, folder / "results", options=options)
    motors = population(done.findings)
    psa.write_population(motors, folder / "motors.html")
    outliers = ", ".join(f"{o.parameter} of {o.device}" for o in motors.outliers)
    return {"posterior": posterior, "two motors": both, "outliers": outliers}
