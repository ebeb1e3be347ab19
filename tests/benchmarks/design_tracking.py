"""Designed inputs measured: tracking, wrong parameters, quickest moves, time to design."""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from psa_casadi.design.tracking.inversion import correct, invert
from psa_casadi.design.tracking.minimum_time import INTERVALS, QuickMove, quickest_move
from psa_casadi.design.tracking.targets import (
    AmplifierLimits,
    Target,
    TrackingError,
    error_of,
    raster_scan,
    uncompensated,
)
from psa_casadi.design.tracking.tracking import track
from psa_casadi.effects import EFFECTS
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import stack_model
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.linear_part import linear_part
from tests.benchmarks.creeping_reference import creeping_displacement
from tests.benchmarks.linear_bound import bang_bang_bound
from tests.benchmarks.outcome import Progress, TitledTable
from tests.benchmarks.own_bang_bang import BangBang

FloatArray = npt.NDArray[np.float64]

#: The stack carries a payload [kg], so that it rings at 1.6 kHz, and a loop 10 % of the stroke.
PAYLOAD, LOOP = 0.5, 0.8
STROKE = 10e-6
#: Samples of one line of the scan; size of the parameters' errors; parameters that are conventions.
LINE, WRONG = 250, 0.05
_CONVENTIONS = ("hold_rate", "u_rated")
_SEED = 7
LIMITS = AmplifierLimits(min_voltage=-20.0, max_voltage=120.0)


def scanner(payload: float = PAYLOAD) -> Model:
    """Return the P-885.51 with a payload, creep, and a hysteresis loop 10 % of the stroke wide."""
    creep = {"creep_gain": 0.02, "creep_time": 0.01}
    model = stack_model("P-885.51").with_effect(EFFECTS["slow_creep"], creep).plant()
    loop = {name: LOOP * model.values[name] for name in ("A", "beta", "gamma")}
    return model.with_values({**loop, **({"m_B": payload} if payload else {})})


def scan(model: Model, samples: int) -> Target:
    """Return a raster scan at a twentieth of the first resonance, 250 samples a line."""
    frequency = linear_part(model).first_resonance() / 20.0
    lines = max(1, samples // LINE)
    return raster_scan(low=0.0, high=STROKE, frequency=frequency, lines=lines, samples=samples)


def judged(values: Mapping[str, float], target: Target, voltage: FloatArray) -> TrackingError:
    """Return the error on the independent reference, with creep."""
    return error_of(target, creeping_displacement(values, target.time, voltage))


def tables(progress: Progress, quick: bool) -> tuple[TitledTable, ...]:
    """Measure everything; `quick` on shorter scans, fewer draws and sizes."""
    model = scanner()
    target = scan(model, 500 if quick else 2000)
    progress("scan")
    designed = track(model, target)
    return (
        _errors(model, target, designed.voltage),
        _wrong(model, target, designed.voltage, 2 if quick else 10, progress),
        _moves(progress, quick),
        _times(model, (500,) if quick else (500, 1000, 2000, 4000), progress),
    )


def _errors(model: Model, target: Target, voltage: FloatArray) -> TitledTable:
    plain, inverse = uncompensated(model, target).voltage, invert(model, target).response.voltage
    named = {"uncompensated": plain, "inversion": inverse, "designed": voltage}
    rows = []
    for name, played in named.items():
        error = judged(model.values, target, played)
        rows.append((name, number(error.rms_percent), number(error.largest_percent)))
    note = (
        f"{len(target.time)} samples at 1/20 of the first resonance (1.6 kHz), hysteresis 10 % of"
        " the stroke, creep on; displacement of the independent reference. Target: 0.1 % rms."
    )
    head = ("voltage", "error, rms [% of range]", "largest [%]")
    return TitledTable("Raster scan on the independent reference", Table(head, tuple(rows)), note)


def wrong_values(model: Model, generator: np.random.Generator) -> dict[str, float]:
    """Return the values with every parameter off by 5 %, up or down at random."""
    changed = {
        name: value * (1.0 + WRONG * generator.choice([-1.0, 1.0]))
        for name, value in model.values.items()
        if name not in _CONVENTIONS
    }
    return {**model.values, **changed}


def after_trials(
    model: Model, values: Mapping[str, float], target: Target, voltage: FloatArray, trials: int = 2
) -> tuple[float, float, list[float]]:
    """Return the errors [% rms] as designed, with the range calibrated, and after trials.

    The plant is the reference with `values`; the model knows its own values only.
    """
    shown = creeping_displacement(values, target.time, voltage)
    raw = error_of(target, shown).rms_percent
    gain = target.span / float(np.ptp(shown))
    calibrated = judged(values, target, gain * voltage).rms_percent
    found = []
    for _ in range(trials):
        voltage = correct(model, target, voltage, shown)
        shown = creeping_displacement(values, target.time, voltage)
        found.append(error_of(target, shown).rms_percent)
    return raw, calibrated, found


def _wrong(
    model: Model, target: Target, voltage: FloatArray, draws: int, progress: Progress
) -> TitledTable:
    generator, short = np.random.default_rng(_SEED), len(target.time) // 4
    part = Target(target.time[:short], target.displacement[:short])
    found = []
    for draw in range(draws):
        progress(f"parameters off by 5 %: draw {draw + 1} of {draws}")
        values = wrong_values(model, generator)
        raw, calibrated, trials = after_trials(model, values, part, voltage[:short])
        found.append([raw, calibrated, *trials])
    worst, middle = np.max(found, axis=0), np.median(found, axis=0)
    names = ("as designed", "scaled by one measured range", "after one trial", "after two trials")
    rows = tuple(
        (n, number(float(m)), number(float(w)))
        for n, m, w in zip(names, middle, worst, strict=True)
    )
    note = (
        f"{draws} draws of random signs, all parameters off by 5 %, the gain by up to 10 %: no"
        " voltage that is played blind is right then. A trial is one measured run of the scan."
    )
    head = ("voltage", "error, median [% rms]", "worst [% rms]")
    return TitledTable("Every parameter off by 5 %", Table(head, rows), note)


def _moves(progress: Progress, quick: bool) -> TitledTable:
    rows = []
    for payload in (PAYLOAD,) if quick else (PAYLOAD, 0.0):
        model = scanner(payload)
        for begin, end in ((2e-6, 10e-6), (10e-6, 2e-6))[: 1 if quick else 2]:
            progress(f"quickest move, {payload:g} kg")
            found = quickest_move(model, begin, end, LIMITS)
            bound = bang_bang_bound(model.values, begin, end, -20.0, 120.0)
            own = own_bang_bang(model, found)
            over = ["none found"] * 2 if own is None else [
                number(1e6 * own), number(100.0 * (found.move_time / own - 1.0))
            ]  # fmt: skip
            rows.append(
                (
                    f"{payload:g}", f"{1e6 * begin:g} to {1e6 * end:g}",
                    number(1e6 * found.move_time), number(1e6 * bound),
                    number(100.0 * (found.move_time / bound - 1.0)), *over,
                    number(100.0 * found.residual, 2),
                )
            )  # fmt: skip
    note = (
        "-20 V to 120 V. The bound is that of the linear part, which knows neither hysteresis nor"
        " creep. The hysteresis takes part of the voltage of a move, and more of it downward, where"
        " only 20 V lie beyond the rest. The stack's own bang-bang move, five switches between the"
        " limits, is solved on the independent reference with hysteresis and creep. Targets: 10 %"
        " over the bound, 0.1 % of residual vibration."
    )
    head = (
        "payload [kg]", "move [um]", "time [us]", "bang-bang bound [us]", "over it [%]",
        "own bang-bang [us]", "over that [%]", "residual vibration [%]",
    )  # fmt: skip
    return TitledTable("Quickest moves", Table(head, tuple(rows)), note)


def own_bang_bang(model: Model, found: QuickMove) -> float | None:
    """Return the length [s] of the stack's own bang-bang move that a design leads to."""
    first = dict(zip(model.state_names, found.response.states[0].tolist(), strict=True))
    chain = ("u", "f_H", "f_out", "y", "v_y", "x", "v_x")
    low, high = found.limits.min_voltage, found.limits.max_voltage
    own = BangBang(
        model.values, {n: first[n] for n in chain}, found.begin, found.end, (low, high),
        found.end > found.begin,
    )  # fmt: skip
    played = found.response.voltage[2 : 2 + INTERVALS]
    return own.shortest(played, found.move_time)


def _times(model: Model, sizes: Sequence[int], progress: Progress) -> TitledTable:
    rows = []
    for samples in sizes:
        progress(f"{samples} samples")
        target = scan(model, samples)
        found = track(model, target)
        rows.append(
            (str(samples), number(found.seconds), str(found.iterations),
             number(found.error.rms_percent))
        )  # fmt: skip
    head = ("samples", "time to design [s]", "IPOPT iterations", "error, rms [% of range]")
    note = "Inversion, three solutions and the simulations between them. Target: 2,000 in 60 s."
    return TitledTable("Time to design", Table(head, tuple(rows)), note)
