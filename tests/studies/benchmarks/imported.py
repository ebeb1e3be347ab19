"""FMUs of other tools on records of independent plants: parameters, hidden effects, cost.

`--folder` holds public FMUs, as the Reference-FMUs of the Modelica Association give them (built for
this machine): `2.0/NAME.fmu` and `3.0/NAME.fmu`; missing files are listed. Two are made here by
PythonFMU and PythonFMU3, one is ours. The plants are SciPy's or exact; nothing of them is an FMU's.

The peer is SciPy's `least_squares` from the same start, over the same simulations of the FMU.
"""

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter

import casadi as ca
import fmpy
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from tests.export.supplied import INFLOW, TIMES, bounces, lagged, level, supplied
from tests.export.test_fmu_played import with_effects
from tests.studies.benchmarks.table import Outcome, Progress, Row, TitledTable

_NOISE, _SAMPLES, _SEED = 0.01, 500, 7
Values = Mapping[str, float]


@dataclass(frozen=True)
class Case:
    """An FMU, what is free in it and true of its plant, and the plant's outputs.

    `outputs` returns them by name for times, input and true values. `gain` is the parameters that
    are free where a gain hides; all of them could be it.
    """

    name: str
    path: Callable[[Path], Path]
    end: float
    free: Mapping[str, tuple[float, float]]
    true: Values
    outputs: Callable[[FloatArray, FloatArray, Values], dict[str, FloatArray]]
    lag: float
    gain: tuple[str, ...]
    input: str = ""
    size: float = 1.0
    offset: float = 0.0
    values: Values = field(default_factory=dict)


def _integrated(
    rate: Callable[[float, FloatArray, float, Values], list[float]],
    start: list[float],
    outputs: tuple[str, ...],
) -> Callable[[FloatArray, FloatArray, Values], dict[str, FloatArray]]:
    def simulated(t: FloatArray, u: FloatArray, p: Values) -> dict[str, FloatArray]:
        y = solve_ivp(
            lambda s, x: rate(s, x, float(np.interp(s, t, u)), p), (0.0, t[-1]), start,
            t_eval=t, method="LSODA", rtol=1e-9, atol=1e-11, max_step=4 * t[1],
        ).y  # fmt: skip
        return dict(zip(outputs, y, strict=False))

    return simulated


def _motor(_: Path) -> Path:
    i, w, v, k, inertia = (ca.SX.sym(n) for n in ("i", "w", "v", "k", "J"))
    model = psa.ode_model(
        {
            "x": [i, w], "u": v, "p": [k, inertia], "y": [i, w],
            "ode": [(v - 1.2 * i - k * w) / 2e-3, (k * i - 2e-5 * w) / inertia],
        },
        name="motor", outputs=["amps", "speed"], values={"k": 0.04, "J": 2e-5},
    )  # fmt: skip
    return psa.export_fmu(model, Path(_FOLDER.name) / "motor.fmu")


_FOLDER = tempfile.TemporaryDirectory()
CASES = (
    Case(
        "VanDerPol, FMI 3", lambda f: f / "3.0/VanDerPol.fmu", 20.0, {"mu": (0.1, 10.0)},
        {"mu": 1.4},
        _integrated(
            lambda _, x, __, p: [x[1], p["mu"] * (1 - x[0] ** 2) * x[1] - x[0]], [2.0, 0.0],
            ("x0", "x1"),
        ),
        0.3, ("mu",),
    ),
    Case(
        "Dahlquist, FMI 2", lambda f: f / "2.0/Dahlquist.fmu", 6.0, {"k": (0.1, 10.0)},
        {"k": 1.3}, lambda t, _, p: {"x": np.exp(-p["k"] * t)}, 0.3, ("k",),
    ),
    Case(
        "BouncingBall, FMI 3", lambda f: f / "3.0/BouncingBall.fmu", 2.6,
        {"g": (-20.0, -5.0), "e": (0.5, 1.0)}, {"g": -9.0, "e": 0.8},
        lambda t, _, p: {"h": bounces(-p["g"], p["e"], t)}, 0.03, ("e", "g"),
    ),
    Case(
        "StateSpace, FMI 3", lambda f: f / "3.0/StateSpace.fmu", 20.0, {"A[1,1]": (-5.0, -0.1)},
        {"A[1,1]": -0.8},
        _integrated(lambda _, x, u, p: [p["A[1,1]"] * x[0] + u], [0.0], ("y_1",)),
        0.4, ("A[1,1]",), input="u[1]",
        values={"A[1,1]": -1.0, "D[1,1]": 0.0, "u[2]": 0.0, "u[3]": 0.0},
    ),
    Case(
        "tank, PythonFMU", lambda _: supplied("tank"), 100.0,
        {"area": (0.05, 4.0), "outlet": (1e-3, 0.1)}, {"area": 0.7, "outlet": 0.012},
        _integrated(
            lambda _, x, u, p: [
                (u - p["outlet"] * float(np.sqrt(max(0.0, 19.62 * x[0])))) / p["area"]
            ],
            [0.2], ("level",),
        ),
        3.0, ("outlet",), input="inflow", size=0.01, offset=0.02, values={"valve": 1.0},
    ),
    Case(
        "ball, PythonFMU3", lambda _: supplied("ball"), 2.6,
        {"g": (5.0, 20.0), "e": (0.4, 0.95)}, {"g": 9.0, "e": 0.8},
        lambda t, _, p: {"h": bounces(p["g"], p["e"], t)}, 0.03, ("e", "g"),
    ),
    Case(
        "motor, ours", _motor, 2.0, {"k": (4e-3, 0.4), "J": (2e-6, 2e-4)},
        {"k": 0.05, "J": 3e-5},
        _integrated(
            lambda _, x, u, p: [
                (u - 1.2 * x[0] - p["k"] * x[1]) / 2e-3, (p["k"] * x[0] - 2e-5 * x[1]) / p["J"],
            ],
            [0.0, 0.0], ("amps", "speed"),
        ),
        0.03, ("J",), input="v", size=6.0,
    ),
)  # fmt: skip


def run(progress: Progress, quick: bool, folder: Path | None = None, only: str = "") -> Outcome:
    """Identify every FMU, and diagnose it with a lag, with a gain and with nothing hidden."""
    result, hidden = list[Row](), list[Row]()
    for case in (c for c in CASES if only in c.name):
        path = case.path(folder or Path())
        if not path.is_file():
            result.append({"fmu": f"{case.name}: no {path}"} | dict.fromkeys(_HEADS, "-"))
            continue
        progress(case.name)
        result.append(_identified(case, path))
        if not quick:
            hidden.append(_diagnosed(case, path, progress))
    note = (
        "Off: distance from the truth in standard errors. Cost: half the sum of squares over the"
        " noise, ours over the peer's."
    )
    tables = [TitledTable("Parameters of FMUs, compared with SciPy's least_squares", result, note)]
    if hidden:
        tables.append(TitledTable("What hides around them", hidden))
    if not only:
        tables.append(TitledTable("The tank in an FMU with a gain and a lag, in fmpy", _held()))
    return Outcome(tables)


def _held() -> list[Row]:
    """Return fmpy's time with an FMU and with one that contains it, and the error."""
    held = psa.export_extended(with_effects(), Path(_FOLDER.name) / "held.fmu")
    rows, points = list[Row](), np.linspace(0.0, 100.0, 2001)
    flow = np.interp(points, TIMES, INFLOW)
    inputs = np.array([*zip(points, flow, strict=True)], [("time", float), ("inflow", float)])
    truth = lagged(level(0.7, 0.01, 0.88 * INFLOW), 3.0)
    for name, path, starts in (("original", supplied("tank"), {"valve": True}), ("held", held, {})):
        begin = perf_counter()
        y = fmpy.simulate_fmu(
            str(path), stop_time=100.0, output_interval=0.05, input=inputs, output=["level"],
            start_values=starts, validate=False,
        )  # fmt: skip
        took = perf_counter() - begin
        off = np.max(np.abs(np.interp(TIMES, y["time"], y["level"]) - truth))
        error = f"{off / np.ptp(truth):.2g}" if name == "held" else "-"
        rows.append({"fmu": name, "s": f"{took:.2f}", "error over the range": error})
    return rows


_HEADS = ("off", "cost")


def _input(case: Case) -> tuple[FloatArray, FloatArray]:
    t = np.linspace(0.0, case.end, _SAMPLES)
    tones = ((2.3, 0.6, 0.0), (5.1, 0.5, 1.0), (11.7, 0.4, 2.0))
    u = sum(a * np.sin(2 * np.pi * f * t / case.end + p) for f, a, p in tones)
    return t, case.offset + case.size * np.asarray(u)


def record_of(case: Case, *, lag: float = 0.0, gain: float = 1.0) -> dict[str, FloatArray]:
    """Return the record of a plant; a lag in its first output, a gain of its input, else of it."""
    t, u = _input(case)
    y = case.outputs(t, u * gain if case.input else u, case.true)
    first, of = next(iter(y.items()))
    of = of if case.input else gain * of
    if lag:
        y[first] = solve_ivp(
            lambda s, z: (np.interp(s, t, of) - z) / lag, (0.0, t[-1]), of[:1], t_eval=t,
            rtol=1e-8, max_step=t[1],
        ).y[0]  # fmt: skip
    else:
        y[first] = of
    rng = np.random.default_rng(_SEED)
    noisy = {n: v + _NOISE * np.std(v) * rng.standard_normal(len(t)) for n, v in y.items()}
    driven = {_plain(case.input): u} if case.input else {}
    return {"time": t, **driven, **noisy}


def _plain(name: str) -> str:
    return name.replace("[", "_").rstrip("]").replace(",", "_")


def _identified(case: Case, path: Path) -> Row:
    model = psa.fmu_model(path, free=case.free, values=dict(case.values))
    record = record_of(case)
    result = psa.identify(model, record, known_start=True)
    names = [_plain(n) for n in case.true]
    off = max(
        abs(result.model.values[n] - v) / result.errors[n]
        for n, v in zip(names, case.true.values(), strict=True)
    )
    ours = 0.5 * float(np.sum(_residuals(result.model, case, record) ** 2))
    peer = _peer(model, case, record)
    return {"fmu": case.name, "off": f"{off:.1f}", "cost": f"{ours / peer:.5f}"}


def _residuals(model: psa.Model, case: Case, record: Mapping[str, FloatArray]) -> FloatArray:
    """Return what a model at its values leaves of all outputs, over the noise."""
    t, u = record["time"], np.column_stack([record[n] for n in ("time", _plain(case.input)) if n])
    x0 = np.array([q.start for q in model.structure.states])
    y = dict(zip(model.output_names, psa.run(model, t, u[:, 1:], x0).y.T, strict=True))
    outputs = [n for n in record if n in y]
    return np.concatenate([(y[n] - record[n]) / (_NOISE * np.std(record[n])) for n in outputs])


def _peer(model: psa.Model, case: Case, record: Mapping[str, FloatArray]) -> float:
    """Return the cost that SciPy reaches from a model's values."""
    names = [_plain(n) for n in case.true]

    def residuals(values: FloatArray) -> FloatArray:
        return _residuals(
            model.with_values(dict(zip(names, values.tolist(), strict=True))), case, record
        )

    starts = np.array([model.values[n] for n in names])
    low, high = np.array([case.free[n] for n in case.true]).T
    result = least_squares(
        residuals, starts, bounds=(low, high), x_scale=np.abs(starts),
        diff_step=[1e-3] * len(starts),
    )  # fmt: skip
    return float(result.cost)


def _diagnosed(case: Case, path: Path, progress: Progress) -> Row:
    row: dict[str, object] = {"fmu": case.name}
    narrow = {n: case.free[n] for n in case.gain}
    kept = {n: v for n, v in case.true.items() if n not in case.gain}
    for hidden in ("lag", "gain", "nothing"):
        progress(f"{case.name}: {hidden}")
        record = record_of(
            case, lag=case.lag if hidden == "lag" else 0.0, gain=0.85 if hidden == "gain" else 1.0
        )
        model = psa.fmu_model(path, free=narrow, values={**case.values, **kept})
        d = psa.diagnose(model, record, known_start=True)
        causes = ", ".join(f"{c.effect} {c.confidence:.2f}" for c in d.causes)
        row[hidden] = causes or d.verdict
    return row
