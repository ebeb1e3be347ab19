"""The paper's three verifications, with our stacks: loops, steps, a non-periodic voltage.

The paper (section 4.3, figures 6 to 10) identifies three stacks and compares loops, normalised
steps and one non-periodic response. Here the model is identified from a step and two loops, and
judged only on records that the fit has not seen.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from math import sqrt
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.signal import lsim

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records import time_grid
from psa_casadi.records.split import Experiment, split, whole
from psa_casadi.units import FloatArray
from tests.studies.benchmarks.records import Values, noisy, played, slowest, step_voltage
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, styled

#: White noise of the synthetic records, as a share of the range of each.
NOISE = 1e-3
LOOPS, STEPS, OTHER = "loops", "steps", "non-periodic"
INSTRUMENT = "micromanipulator"
#: Loops as (share of u_rated, frequency [Hz]): fitted, and kept for judging.
FITTED_LOOPS, KEPT_LOOPS = ((1.0, 1.0), (0.3, 10.0)), ((0.6, 3.0), (0.85, 0.5))
KEPT_STEP = 0.6
_PERIODS, _LOOP_SAMPLES, _STEP_SAMPLES, _OTHER_SAMPLES = 2, 300, 1500, 3000
_RTOL = 1e-8


@dataclass(frozen=True, eq=False)
class Comparison:
    """A record and what was predicted of it (n,) [m], in samples that no fit has seen.

    `kind` is LOOPS, STEPS or OTHER; `range_m` [m] is what errors are compared with: the range of
    the displacement, for a step its final value. A step is told normalised, as in the paper.
    """

    kind: str
    stack: str
    record: psa.Record
    predicted: FloatArray
    range_m: float

    @property
    def error(self) -> FloatArray:
        """Measured minus predicted [m]; nan where a fit has used the sample."""
        return measured(self.record) - self.predicted

    @property
    def largest(self) -> float:
        """Largest absolute error [m]."""
        return float(np.nanmax(np.abs(self.error)))

    @property
    def rms(self) -> float:
        """Root mean square of the error [m]."""
        return float(np.sqrt(np.nanmean(self.error**2)))


def synthetic(name: str, progress: Progress) -> list[Comparison]:
    """Identify a named stack from a step and two loops of the reference; predict other records."""
    p, draw = psa.stack_model(name).values, np.random.default_rng(2015)
    progress(f"{name}: records of the reference")
    fitted = [_step(p, 1.0), *(_loop(p, *loop) for loop in FITTED_LOOPS)]
    kept = [(LOOPS, _loop(p, *loop)) for loop in KEPT_LOOPS]
    kept += [(STEPS, _step(p, KEPT_STEP)), (OTHER, _non_periodic(p))]
    inputs = [noisy(r, NOISE * r.range_m, draw) for r in fitted]
    model = psa.identify(inputs, progress=lambda t: progress(f"{name}: {t}")).model
    items = []
    for kind, clean in kept:
        record = noisy(clean, NOISE * clean.range_m, draw)
        moved = psa.simulate(model, record.time, record.voltage, from_rest_at_zero=True)
        end = float(np.mean(measured(record)[-record.n // 20 :]))
        size = end if kind == STEPS else record.range_m
        items.append(Comparison(kind, name, record, moved.displacement, size))
    return items


def instrument(progress: Progress) -> list[Comparison]:
    """Identify the micromanipulator from blocks of one record; predict the rest and another record.

    Of the other one the first tenth tells offset and memory. The records are looked for in
    $PSA_CASADI_DATA; without them the list is empty.
    """
    folder = Path(os.environ.get("PSA_CASADI_DATA", "")) / INSTRUMENT
    try:
        sine, minor = (psa.read_record(folder / f"{n}.csv") for n in ("sine_1hz", "minor_loops"))
    except psa.InputError:
        return []
    cut = split(sine)
    part = replace(sine, displacement=np.where(cut.used, measured(sine), np.nan))
    result = psa.identify([part], progress=lambda text: progress(f"{INSTRUMENT}: {text}"))
    lead = np.arange(minor.n) < minor.n // 10
    led = Experiment(minor, minor.mask & lead, minor.mask & ~lead)
    again = fit(result.model, [led], [], sigma=[result.fit.rms])
    cases = (
        (LOOPS, "sine 1 Hz, blocks kept", cut, result.fit.predicted(result.experiments)),
        (OTHER, "minor loops, after a tenth", led, again.predicted([led])),
    )
    compared = []
    for kind, name, e, (predicted,) in cases:
        rest = np.where(e.held_out, measured(e.record), np.nan)
        record = replace(e.record, name=name, displacement=rest)
        compared.append(Comparison(kind, INSTRUMENT, record, predicted, e.record.range_m))
    return compared


def _step(p: Values, share: float) -> psa.Record:
    return played(p, f"step to {100 * share:.0f} %", *step_voltage(p, share, _STEP_SAMPLES))


def _loop(p: Values, share: float, frequency: float) -> psa.Record:
    """Return a sine from 0 to a share of u_rated."""
    time = time_grid(_PERIODS / frequency, 1.0 / (_LOOP_SAMPLES * frequency))
    half, turn = 0.5 * share * p["u_rated"], 2.0 * np.pi * frequency
    name = f"loop {100 * share:.0f} %, {frequency:g} Hz"
    return _smooth(p, name, time, lambda t: half * (1.0 - np.cos(turn * t)))


def _non_periodic(p: Values) -> psa.Record:
    """Return three sines of incommensurate frequencies, decaying about half the rated voltage."""
    tones = ((0.5, 1.0), (0.3, np.sqrt(7.0)), (0.2, 2.0 * np.pi))

    def voltage(t: float) -> float:
        swing = sum(weight * np.sin(2.0 * np.pi * f * t) for weight, f in tones)
        fade_in = 1.0 - np.exp(-((t / 0.15) ** 2))
        return float(0.5 * p["u_rated"] * fade_in * (1.0 + np.exp(-t / 2.0) * swing))

    time = time_grid(4.0, 4.0 / _OTHER_SAMPLES)
    return _smooth(p, "decaying, 1, 2.65 and 6.28 Hz", time, voltage)


def _smooth(
    p: Values, name: str, time: FloatArray, voltage: Callable[[float], float]
) -> psa.Record:
    return played(p, name, time, np.array([voltage(float(t)) for t in time]), voltage, _RTOL)


NAMES = {"cascade": "one-way cascade", "reciprocal": "reciprocal", "single_mass": "single mass"}
SAMPLES, _FINE_RTOL = 1200, 1e-9
#: Weight of the samples in the fits, as a share of the step: far below any difference of interest.
_SIGMA = 1e-4
_TWO_MASSES = ("k_L", "tau", "m_P", "c_P", "m_B", "c_B", "k_B")
_FREE = dict.fromkeys(NAMES, _TWO_MASSES) | {"single_mass": ("k_L", "tau", "m", "c")}
#: Starts: the wafers' share of the mass, k_P over k_B, and the damping ratios.
_SPLITS = ((0.3, 5.0, 0.03), (0.3, 2.0, 0.05), (0.5, 2.0, 0.05), (0.7, 0.5, 0.05))
_LINEAR = {"A": 0.0, "beta": 0.0, "gamma": 0.0, "delta": 0.0}


class Match(NamedTuple):
    """One model fitted to the step of one plant.

    `step` (n,) are the errors of the fit over the step's size; `load` (n,) those of the predicted
    response to a load step over its final value; `mass` is the whole mass found over the true one.
    """

    plant: str
    model: str
    step: FloatArray
    load: FloatArray
    mass: float


def with_single_mass(values: Values) -> dict[str, float]:
    """Return the values without hysteresis, and with eq. (6)'s m, c, k beside the cascade's.

    m is the whole mass, k the series stiffness, c what gives both oscillators' mean damping ratio.
    """
    p = {**values, **_LINEAR}
    ratios = [p[f"c_{q}"] / (2.0 * sqrt(p[f"m_{q}"] * p[f"k_{q}"])) for q in "PB"]
    p["m"] = p["m_P"] + p["m_B"]
    p["k"] = 1.0 / (1.0 / p["k_P"] + 1.0 / p["k_B"])
    p["c"] = sum(ratios) * sqrt(p["m"] * p["k"])
    return p


def plant_response(
    plant: str, p: Values, time: FloatArray, voltage: FloatArray, load: FloatArray
) -> FloatArray:
    """Return the displacement (n,) [m] of a plant from rest; inputs are linear between samples."""
    if plant == "reciprocal":
        return two_masses(p, time, voltage, load)
    v, f = (reference.from_samples(time, x) for x in (voltage, load))
    return reference.simulate(
        p, v, time, load_force=f, breakpoints=[float(time[1])],
        mechanics="cascade" if plant == "cascade" else "single_mass",
        rtol=_FINE_RTOL,
    ).displacement  # fmt: skip


def two_masses(p: Values, time: FloatArray, voltage: FloatArray, load: FloatArray) -> FloatArray:
    """Return x (n,) [m] of drive, lag and two masses with action and reaction, without hysteresis.

    m_P y'' + c_P y' + k_P y = f_out + c_B (x' - y') + k_B (x - y);
    m_B x'' + c_B (x' - y') + k_B (x - y) = f_load.  States: u, f_out, y, y', x, x'. Exact for
    inputs that are linear between uniform samples. Source: Newton's second and third law.
    """
    rc, m_P, m_B = p["R_s"] * p["C_p"], p["m_P"], p["m_B"]
    pull = np.array([0.0, 0.0, -p["k_B"], -p["c_B"], p["k_B"], p["c_B"]])
    a, b = np.zeros((6, 6)), np.zeros((6, 2))
    a[0, 0] = -1.0 / rc
    a[1, :2] = p["k_L"] / p["tau"], -1.0 / p["tau"]
    a[2, 3] = a[4, 5] = 1.0
    a[3] = (pull + np.array([0.0, 1.0, -p["k_P"], -p["c_P"], 0.0, 0.0])) / m_P
    a[5] = -pull / m_B
    b[0, 0], b[5, 1] = p["G"] / rc, 1.0 / m_B
    system = (a, b, np.eye(6)[4:5], np.zeros((1, 2)))
    return np.asarray(lsim(system, np.column_stack([voltage, load]), time)[1], dtype=np.float64)


def matches(
    values: Values, progress: Progress, plants: Sequence[str], starts: int = len(_SPLITS)
) -> list[Match]:
    """Fit every model to the step of every plant and predict the plant's response to a load."""
    p = with_single_mass(values)
    time, top = step_voltage(p, samples=SAMPLES)
    none, push = np.zeros_like(time), 0.1 * p["k_L"] * top
    items = []
    for plant in plants:
        x = plant_response(plant, p, time, top, none)
        step = psa.Record(name="step", time=time, voltage=top, displacement=x)
        loaded = plant_response(plant, p, time, none, push)
        for model, name in NAMES.items():
            progress(f"{name} fitted to the step of the {NAMES[plant]}")
            best = _best_fit(model, p, step, starts)
            run = psa.simulate(best.model, time, none, load_force=push, from_rest_at_zero=True)
            y, q = run.displacement, best.model.values
            mass = (q["m"] if "m" in q else q["m_P"] + q["m_B"]) * y[-1] / (loaded[-1] * p["m"])
            load = y / y[-1] - loaded / loaded[-1]
            items.append(Match(plant, model, best.residuals / x[-1], load, float(mass)))
    return items


def _best_fit(kind: str, p: Values, record: psa.Record, starts: int) -> Fit:
    """Fit from several starts that know the whole mass and stiffness; return the best."""
    fits = []
    inputs: Any = {"sigma": [_SIGMA * record.range_m], "evaluations": 200, "tolerance": 1e-7}
    for model in islice(_starts(kind, p, record), starts):
        with suppress(psa.PsaError):
            fits.append(fit(model, [whole(record)], _FREE[kind], **inputs))
    return min(fits, key=lambda f: f.cost)


def _starts(kind: str, p: Values, record: psa.Record) -> Iterator[psa.Model]:
    slope = record.range_m / p["u_rated"]
    common = {n: p[n] for n in ("G", "R_s", "C_p", "u_rated", "h_ref", "hold_rate", *_LINEAR)}
    common["tau"] = 0.1 * slowest(p)
    if kind == "single_mass":
        for _, _, ratio in _SPLITS[:2]:
            damping = 2.0 * ratio * sqrt(p["m"] * p["k"])
            mass = {"m": p["m"], "k": p["k"], "c": damping, "k_L": slope * p["k"]}
            yield psa.compose(psa.SIMPLIFIED, {**common, **mass})
        return
    for share, stiff, ratio in _SPLITS:
        parts = {"k_P": p["k"] * (1.0 + stiff), "k_B": p["k"] * (1.0 + 1.0 / stiff)}
        parts |= {"m_P": share * p["m"], "m_B": (1.0 - share) * p["m"]}
        parts |= {f"c_{q}": 2.0 * ratio * sqrt(parts[f"m_{q}"] * parts[f"k_{q}"]) for q in "PB"}
        observed = parts["k_P"] if kind == "reciprocal" else p["k"]
        cascade = psa.compose(psa.BASE, {**common, **parts, "k_L": slope * observed})
        effect, newton = psa.EFFECTS["reciprocal_coupling"], {"reciprocal_gain": 1.0}
        yield cascade.with_effect(effect, newton) if kind == "reciprocal" else cascade


def tables(found: Sequence[Match], stack: str) -> list[TitledTable]:
    """Return the errors of the fitted steps, and of what they predict under a load."""
    title = f"Three mechanics, {stack} without hysteresis: "
    how = "Rows: the plant that made the data; columns: the model. Rms and largest error, in %"
    steps, loads = (
        {plant: {"data from": NAMES[plant]} for plant in dict.fromkeys(m.plant for m in found)}
        for _ in range(2)
    )
    for m in found:
        steps[m.plant][NAMES[m.model]] = _errors(m.step)
        loads[m.plant][NAMES[m.model]] = f"{_errors(m.load)}, mass x {m.mass:.2f}"
    return [
        TitledTable(
            title + "voltage step, fitted",
            list(steps.values()),
            f"{how} of the step. The data have no noise: below 0.1 % no ordinary measurement tells."
            " Cascade and reciprocal pair both give four poles and a zero, so that a step hardly"
            " tells them apart; a single mass has two poles and shows.",
        ),
        TitledTable(
            title + "load step on the output, predicted by these fits",
            list(loads.values()),
            f"{how} of the final displacement, and the whole mass found over the true one. A"
            " voltage step determines no force, so each fit is scaled to the plant's stiffness"
            " against a load. Such a step tells the mass loosely with the right mechanics, and"
            " wrongly with another: scales or a second measurement must say which one it is.",
        ),
    ]


def _errors(shares: FloatArray) -> str:
    return f"{100 * np.sqrt(np.mean(shares**2)):.2g} / {100 * np.max(np.abs(shares)):.2g}"


#: Whose mechanics the three models are compared on: the stack that rings.
RINGING = "PTBS200"
_SYNTHETIC = (
    f"The stacks are synthetic: the independent reference, from rest, with white noise of"
    f" {100 * NOISE:g} % of each record's range, which is in the errors. Identified from a step to"
    " 100 % and loops of 100 % at 1 Hz and 30 % at 10 Hz; none of the records listed was fitted."
)
_MEASURED = (
    " The micromanipulator is measured (Y. N. Aye): identified from three quarters of the 1 Hz sine"
    " in blocks, judged on the rest and on the minor loops, whose first tenth gives offset and"
    " memory."
)


def run(progress: Progress, quick: bool) -> Outcome:
    """Identify, predict what was kept, and compare three mechanics; `quick` takes one stack."""
    stacks = ("P-885.51",) if quick else ("PTBS200", "WYDS0808020", "P-885.51")
    items = [c for name in stacks for c in synthetic(name, progress)]
    items += [] if quick else instrument(progress)
    plants = ("reciprocal",) if quick else tuple(NAMES)
    values = psa.stack_model(RINGING).values
    result = matches(values, progress, plants, 2 if quick else len(_SPLITS))
    return Outcome([*verification_tables(items), *tables(result, RINGING)], partial(picture, items))


#: Of each kind: title, the paper's row, and the picture's title and axes with that of the error.
_KINDS = {
    LOOPS: ("Hysteresis loops (paper, figures 6 and 8)", ("loops", "0.41 um", "2.65"),
            "loops (paper, figures 6 and 8)", "voltage [V]", "displacement [um]", "error [um]"),
    STEPS: ("Normalised steps (paper, figures 7 and 9)", ("steps", "0.0142", "1.42"),
            "normalised step (figures 7 and 9)", "time [ms]", "displacement over its final value",
            "error"),
    OTHER: ("Non-periodic voltage (paper, figure 10)", ("no figure given", "", ""),
            "non-periodic voltage (figure 10)", "time [s]", "displacement [um]", "error [um]"),
}  # fmt: skip


def verification_tables(shown: Sequence[Comparison]) -> list[TitledTable]:
    """Return one table each for the paper's loops, steps and non-periodic voltage."""
    note = _SYNTHETIC + _MEASURED * any(c.stack == INSTRUMENT for c in shown)
    items = []
    for kind, (title, paper, *_) in _KINDS.items():
        cells = []
        for c in (c for c in shown if c.kind == kind):
            share = c.largest / c.range_m
            largest = f"{share:.4f}" if kind == STEPS else f"{1e6 * c.largest:.3f} um"
            rms = f"{100 * c.rms / c.range_m:.3f}"
            cells.append((c.stack, c.record.name, largest, f"{100 * share:.2f}", rms))
        cells.append(("paper, its measured stacks", *paper, ""))
        head = ("stack", "record, not fitted", "largest error", "of range [%]", "rms [%]")
        rows = [dict(zip(head, row, strict=True)) for row in cells]
        items.append(TitledTable(title, rows, note if kind == LOOPS else ""))
    return items


def picture(shown: Sequence[Comparison]) -> Figure:
    """Return a column for every stack; in each, three pairs of curves above their error."""
    stacks = list(dict.fromkeys(c.stack for c in shown))
    figure = Figure(figsize=(4.6 * len(stacks) + 0.6, 15.0), layout="constrained")
    parts = figure.add_gridspec(6, len(stacks), height_ratios=(2.1, 1.0) * 3)
    for column, stack in enumerate(stacks):
        for row, kind in enumerate(_KINDS):
            of_kind = [c for c in shown if (c.stack, c.kind) == (stack, kind)]
            if of_kind:
                upper = figure.add_subplot(parts[2 * row, column])
                _draw(upper, figure.add_subplot(parts[2 * row + 1, column]), of_kind)
    return figure


def _draw(upper: Axes, lower: Axes, of_kind: Sequence[Comparison]) -> None:
    """Draw measured and predicted where something was measured, and the errors below."""
    stack, kind = of_kind[0].stack, of_kind[0].kind
    _, _, title, x_label, y_label, error = _KINDS[kind]
    origin: str | None = "measured" if stack == INSTRUMENT else "synthetic, with noise"
    for c, colour in zip(of_kind, ("#d55e00", "#009e73"), strict=False):
        size, r = 1.0 / c.range_m if kind == STEPS else 1e6, c.record
        x = {LOOPS: r.voltage, STEPS: 1e3 * r.time, OTHER: r.time}[kind]
        there = np.where(np.isfinite(measured(r)), c.predicted, np.nan)
        upper.plot(x, size * measured(r), color="#9a9a9a", linewidth=3.2, label=origin)
        label = "model" if origin else None
        upper.plot(x, size * there, color="#0072b2", linewidth=1.0, label=label)
        lower.plot(x, size * c.error, color=colour, linewidth=0.7, label=r.name)
        origin = None
    styled(upper, "", y_label, f"{stack}: {title}", size=11.0)
    styled(lower, x_label, error, size=11.0)
    upper.legend(fontsize=9.0, loc="lower right", framealpha=0.85)
    upper.tick_params(labelbottom=False)
    upper.sharex(lower)
    lower.axhline(0.0, color="black", linewidth=0.7)
    if kind == LOOPS and len(of_kind) > 1:
        largest = 1e6 * max(c.largest for c in of_kind)
        lower.set_ylim(-1.15 * largest, 1.9 * largest)
        lower.legend(fontsize=8.0, loc="upper center", ncols=2, framealpha=0.85)
