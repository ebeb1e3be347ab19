"""Models that are no stacks: plants that are hard, and public nonlinear benchmarks.

The public records are not in the project: `--folder` holds the files of EMPS (Janot, Gautier and
Brunot 2019), Silverbox (Wigren and Schoukens 2013) and F-16 (Noel and Schoukens 2017), as
nonlinearbenchmark.org gives them; missing files are listed.
Each model is the plain one from which an engineer starts.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import casadi as ca
import numpy as np
from scipy.io import loadmat

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from tests.any_model import hard_plants as hard
from tests.studies.benchmarks.table import Outcome, Progress, Row, TitledTable

Table = hard.Table
#: Step between the samples of EMPS that are taken (1 kHz, whose force is held).
_EVERY = 10


def run(progress: Progress, quick: bool, folder: Path | None = None) -> Outcome:
    """Identify and diagnose the plants, and the public records that there are; `quick`: two."""
    plants = [
        ("pendulum under a controller", hard.pendulum, ""),
        ("the same, hidden drag", lambda: hard.pendulum(drag=0.05), "drag_in_w"),
        ("chaos in two wells", hard.duffing, ""),
        ("chaos, a state without output", hard.lorenz, ""),
        ("slide, dry friction and slope", hard.slide, "friction_in_v, constant_in_v"),
        ("spring that softens", lambda: (hard.spring(), hard.aged(0), {}), "change_of_k_with_time"),
        ("battery, resistance over charge", lambda: (*hard.battery(), {}), "change_of_R0_with_soc"),
        ("two bodies, a spring that hardens", hard.hardening, "curve_of_stretch_in_spring"),
        ("grazing, less per head", hard.grazing, "eaten / (1 + 0.02 x)"),
    ]
    rows = [_plant(progress, *plant) for plant in plants[: 2 if quick else None]]
    tables = [
        TitledTable(
            "Plants that are hard", rows,
            "Off: the largest relative error of a parameter, of the base where nothing is hidden,"
            " else of the extended model. Errors: held-out rms over the noise's.",
        )
    ]  # fmt: skip
    if folder is not None and not quick:
        public = [_public(progress, folder, *case) for case in PUBLIC]
        tables.append(TitledTable("Public benchmarks", public, "Test: rms of simulated records."))
    return Outcome(tables)


def _plant(progress: Progress, name: str, made: Callable[[], hard.Plant], hidden: str) -> Row:
    progress(name)
    model, record, truth = made()
    d = psa.diagnose(model, record)
    off = max((abs(d.model.values[n] / v - 1.0) for n, v in truth.items()), default=np.nan)
    errors = [(e.base / e.noise, e.extended / e.noise) for e in d.errors]
    base, extended = (max(e) for e in zip(*errors, strict=True))
    return {
        "plant": name, "hidden": hidden or "-", "verdict": d.verdict, "named": _names(d),
        "off": "-" if np.isnan(off) else f"{100 * off:.1f} %", "base": f"{base:.3g}",
        "extended": f"{extended:.3g}",
    }  # fmt: skip


def _names(d: psa.Diagnosis) -> str:
    law = "-" if d.correction is None else d.correction.equation or d.correction.name
    return ", ".join(f"{c.effect} {c.confidence:.2f}" for c in d.causes) or law


def _public(
    progress: Progress, folder: Path, name: str, files: tuple[str, ...],
    made: Callable[..., tuple[psa.Model, Table, Table]], published: str,
) -> Row:  # fmt: skip
    progress(name)
    paths = [folder / f for f in files]
    if absent := [p.name for p in paths if not p.exists()]:
        return dict.fromkeys(("benchmark", "verdict"), name) | {"verdict": f"no {absent[0]}"}
    model, fitted, test = made(*paths)
    d = psa.diagnose(model, fitted)
    output = d.errors[0].output
    both = [_simulated(fit.model, output, test) for fit in (d.base_fit, d.extended_fit)]
    return {
        "benchmark": name, "verdict": d.verdict, "named": _names(d),
        "test, base": f"{both[0]:.3g}", "test, extended": f"{both[1]:.3g}",
        "published": published,
    }  # fmt: skip


def _simulated(model: psa.Model, output: str, test: Table) -> float:
    """Return the rms error of a simulation from the first reading on; the rest rests."""
    x0 = np.zeros(len(model.state_names))
    x0[0] = test[output][0]
    u = np.column_stack([test[n] for n in model.input_names])
    y = psa.run(model, test["time"], u, x0, hold="linear").y[:, model.output_names.index(output)]
    return float(np.sqrt(np.mean((y - test[output]) ** 2)))


def emps(*paths: Path) -> tuple[psa.Model, Table, Table]:
    """An electro-mechanical positioning system: a mass with viscous friction alone [m]."""
    q, v, u, mass, friction = (ca.SX.sym(n) for n in ("q", "v", "force", "M", "Fv"))
    model = psa.ode_model(
        {
            "x": [q, v], "u": u, "p": [mass, friction], "y": q,
            "ode": [v, (u - friction * v) / mass],
        },
        name="emps",
        states=[psa.State("q", "m", "position", 0.1), psa.State("v", "m/s", "speed", 0.1)],
        inputs=[psa.Input("force", "N", "force")],
        outputs=[psa.Output("position", "m", "position")],
        parameters=[
            psa.Parameter("M", 80.0, "kg", (10.0, 500.0), "mass", log=True),
            psa.Parameter("Fv", 100.0, "N.s/m", (1.0, 2000.0), "viscous friction", log=True),
        ],
    )  # fmt: skip

    def table(path: Path) -> Table:
        result = loadmat(str(path))
        rows: Mapping[str, FloatArray] = {n: result[n][::_EVERY, 0] for n in ("t", "vir", "qm")}
        force = float(result["gtau"][0, 0]) * rows["vir"]
        return {"time": rows["t"], "force": force, "position": rows["qm"]}

    fitted, test = map(table, paths)
    return model, fitted, test


def silverbox(path: Path) -> tuple[psa.Model, Table, Table]:
    """An electronic oscillator with a cubic spring: the line alone [V]; the test is the arrow."""
    x, v, u, gain, damping, stiffness = (ca.SX.sym(n) for n in ("x", "v", "u", "b", "d", "k"))
    model = psa.ode_model(
        {
            "x": [x, v], "u": u, "p": [gain, damping, stiffness], "y": x,
            "ode": [v, gain * u - damping * v - stiffness * x],
        },
        name="silverbox",
        states=[psa.State("x", "V", "deflection", 0.1), psa.State("v", "V/s", "speed", 40.0)],
        inputs=[psa.Input("u", "V", "force")],
        outputs=[psa.Output("y", "V", "deflection")],
        parameters=[
            psa.Parameter("b", 1e5, "1/s^2", (1e4, 1e7), "gain", log=True),
            psa.Parameter("d", 20.0, "1/s", (1.0, 500.0), "damping", log=True),
            psa.Parameter("k", 2e5, "1/s^2", (2e4, 2e6), "stiffness", log=True),
        ],
    )  # fmt: skip
    rows, step = np.genfromtxt(path, delimiter=",", skip_header=1), 2**14 / 1e7

    def table(begin: int, count: int) -> Table:
        u, y = rows[begin : begin + count, :2].T
        return {"time": step * np.arange(count), "u": u, "y": y}

    return model, table(42_000, 8192), table(0, 40_500)


def f16(*paths: Path) -> tuple[psa.Model, Table, Table]:
    """The wing of an F-16 with its payload: three linear modes, three accelerations [m/s^2]."""
    q, v, u = ca.SX.sym("q", 3), ca.SX.sym("v", 3), ca.SX.sym("force")
    f, z, shares = ca.SX.sym("f", 3), ca.SX.sym("z", 3), ca.SX.sym("g", 3, 3)
    rates = u - 2.0 * z * (2.0 * np.pi * f) * v - (2.0 * np.pi * f) ** 2 * q
    model = psa.ode_model(
        {
            "x": ca.vertcat(q, v), "u": u, "p": ca.vertcat(f, z, ca.vec(shares)),
            "ode": ca.vertcat(v, rates), "y": shares @ rates,
        },
        name="f16",
        states=[
            *(psa.State(f"q{k}", "N.s^2", "deflection", 0.01) for k in range(3)),
            *(psa.State(f"v{k}", "N.s", "speed", 0.5) for k in range(3)),
        ],
        inputs=[psa.Input("force", "N", "force")],
        outputs=[psa.Output(f"a{k + 1}", "m/s^2", "acceleration") for k in range(3)],
        parameters=[
            *(psa.Parameter(f"f{k}", f, "Hz", (2.0, 15.0), "frequency", log=True)
              for k, f in enumerate((5.2, 7.3, 9.2))),
            *(psa.Parameter(f"z{k}", 0.02, "1", (0.001, 0.3), "damping ratio", log=True)
              for k in range(3)),
            *(psa.Parameter(f"g{j}{k}", 0.01, "1/kg", (-1.0, 1.0), "share", scale=0.01)
              for k in range(3) for j in range(3)),
        ],
    )  # fmt: skip

    def table(path: Path) -> Table:
        rows = np.genfromtxt(path, delimiter=",", skip_header=1)[8192 : 8192 + 4096, [0, 2, 3, 4]]
        time = np.arange(len(rows)) / 400.0
        return {"time": time, **dict(zip(("force", "a1", "a2", "a3"), rows.T, strict=True))}

    fitted, test = map(table, paths)
    return model, fitted, test


#: Name, files, what makes model and records, and figures of others on the same test.
PUBLIC = (
    (
        "EMPS, viscous friction alone [m]", ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"), emps,
        "dynoNet 0.00264",
    ),
    (
        "Silverbox, a line, one multisine; arrow [V]", ("SNLS80mV.csv",), silverbox,
        "dynoNet 0.00122 (multisine)",
    ),
    (
        "F-16, three modes, level 5; level 6 [m/s^2]",
        ("F16Data_FullMSine_Level5.csv", "F16Data_FullMSine_Level6_Validation.csv"), f16, "",
    ),
)  # fmt: skip
