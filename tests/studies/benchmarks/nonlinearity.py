"""How linear a positioner is: open and closed loop, with and without the hysteresis compensator.

The reference is a raster's triangle or a sine. Every case is simulated by the independent plain
loop of `nonlinearity_plant`; the product supplies the values only: what `nanopositioner` tunes and
`compensator_for` copies. The nonlinearity is the largest distance from the best straight line
through the position against that of the same loop with a linear stack, over the range: lags and
corners that a linear stack has too do not count. (A free delay would absorb hysteresis: for a sine
a loop is nearly one.)
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from math import copysign, pi, sqrt, tan
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from scipy.integrate import odeint

import psa_casadi as psa
from psa_casadi.units import FloatArray
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, styled

Values = Mapping[str, float]

#: States: filter, compensator (u, f_H), amplifier, stack (7), stage (2); their usual sizes.
_SIZES = np.array([1e-5, 1e2, 1e2, 1e2, 1e2, 1e2, 1e3, 1e-5, 1e-1, 1e-5, 1e-1, 1e-5, 1e-2])


@dataclass(frozen=True)
class Case:
    """One simulated positioner: arrays of the last period, [s], [m]; shares of the range."""

    closed: bool
    compensated: bool
    wave: str
    error: str
    time: FloatArray
    reference: FloatArray
    position: FloatArray
    deviation: FloatArray
    nonlinearity: float


class Run(NamedTuple):
    """At the instants: stage and tip of the stack [m], command and voltage at the stack [V]."""

    time: FloatArray
    position: FloatArray
    tip: FloatArray
    command: FloatArray
    voltage: FloatArray


def hysteresis_rate(p: Values, u: float, rate: float, force: float) -> float:
    """Return f_H' [N/s] by eq. (8), a voltage below `hold_rate` held."""
    sign = rate / sqrt(rate * rate + p["hold_rate"] ** 2)
    power: float = (abs(force) / p["h_ref"]) ** p["n"]
    bend = p["beta"] * rate * sign * copysign(power, force) + p["gamma"] * rate * power
    return p["A"] * rate - bend + p["delta"] * u * sign


def _rates(parts: Mapping[str, Values]) -> Callable[..., list[float]]:
    """Return the rates of the states at a held command; without compensator it passes through."""
    k, a, s, f = (parts[n] for n in ("controller", "amplifier", "stack", "flexure"))
    c = parts.get("compensator")
    slew = a["current_limit"] / a["load_capacitance"]

    def rates(z: FloatArray, t: float, command: float) -> list[float]:
        x_a, u_c, f_c, v, u, f_H, f_out, y, v_y, x, v_x, x_f, v_f = z.tolist()
        du_c = df_c = 0.0
        if c is not None:
            command -= c["compensation"] * f_c / (c["k_L"] * c["drive_gain"])
            du_c = (c["drive_gain"] * command - u_c) / c["drive_time"]
            df_c = hysteresis_rate(c, u_c, du_c, f_c)
        inside = min(max(a["gain"] * command, a["lowest_output"]), a["highest_output"])
        dv = 2.0 * pi * a["bandwidth"] * (inside - v)
        dv /= (1.0 + (dv / slew) ** 8) ** 0.125
        du = (s["G"] * v - u) / (s["R_s"] * s["C_p"])
        elastic = s["c_P"] * v_y + s["k_P"] * y
        pull = s["c_B"] * (v_x - v_y) + s["k_B"] * (x - y)
        contact = f["k_c"] * (x - x_f) + f["c_c"] * (v_x - v_f)
        return [
            (x_f - x_a) / k["filter_time"], du_c, df_c, dv, du, hysteresis_rate(s, u, du, f_H),
            (s["k_L"] * u + f_H - f_out) / s["tau"],
            v_y, (f_out - elastic) / s["m_P"],
            v_x, (elastic - contact - pull) / s["m_B"],
            v_f, (contact - f["c_f"] * v_f - f["k_f"] * x_f) / f["m_f"],
        ]  # fmt: skip

    return rates


class Controller:
    """The sampled controller: the command for a reference and a filtered position."""

    def __init__(self, p: Values) -> None:
        self.p = p
        self.integral = self.last = 0.0
        self.errors = [0.0, 0.0]
        self.filtered = [0.0, 0.0]
        t = tan(pi * p["notch_frequency"] * p["sample_time"])
        top, below = 2.0 * p["notch_floor"] * t, 2.0 * p["notch_width"] * t
        self.b = np.array([1.0 + top + t * t, 2.0 * (t * t - 1.0), 1.0 - top + t * t])
        self.a = np.array([1.0 + below + t * t, 2.0 * (t * t - 1.0), 1.0 - below + t * t])

    def __call__(self, reference: float, position: float) -> float:
        """Return the command; the notch is the difference equation a * e = b * (r - x)."""
        p, raw = self.p, reference - position
        known = self.a[1] * self.filtered[0] + self.a[2] * self.filtered[1]
        inputs = self.b[0] * raw + self.b[1] * self.errors[0] + self.b[2] * self.errors[1]
        error = float((inputs - known) / self.a[0])
        self.errors, self.filtered = [raw, self.errors[0]], [error, self.filtered[0]]
        self.integral += 0.5 * p["integral_gain"] * p["sample_time"] * (error + self.last)
        self.last = error
        wanted = p["proportional_gain"] * error + self.integral + p["feed_forward"] * reference
        command = min(max(wanted, p["lowest_command"]), p["highest_command"])
        self.integral += p["anti_windup"] * (command - wanted)
        return command


def simulate_positioner(
    parts: Mapping[str, Values],
    reference: Callable[[float], float],
    end: float,
    period: float,
    rtol: float = 1e-8,
) -> Run:
    """Simulate from rest; `parts` are the values of the system's parts by their names.

    Without a part "compensator" the command goes to the amplifier.
    """
    rates, state = _rates(parts), np.zeros(len(_SIZES))
    control = Controller(parts["controller"])
    time: FloatArray = period * np.arange(round(end / period) + 1, dtype=np.float64)
    rows = []
    for t in time:
        command = control(reference(float(t)), float(state[0]))
        rows.append((state[11], state[9], command, state[3]))
        held = partial(rates, command=command)
        atol: Any = 1e-2 * rtol * _SIZES  # one for each state, which the stubs do not know
        state = odeint(held, state, [0.0, period], rtol=rtol, atol=atol)[1]
    return Run(time, *np.array(rows).T)


#: Colour and name of a case by (closed loop, compensated).
LOOKS = {
    (False, False): ("#9a9a9a", "open loop"),
    (False, True): ("#0072b2", "open loop, compensated"),
    (True, False): ("#e69f00", "closed loop"),
    (True, True): ("#d55e00", "closed loop, compensated"),
}


def picture(cases: Sequence[Case]) -> Figure:
    """Return three panels: loops in open loop, deviation from the line, largest deviation."""
    figure = Figure(figsize=(14.0, 6.2), layout="constrained")
    loops, deviations, sizes = figure.subplots(1, 3, width_ratios=(1.0, 1.15, 1.25))
    styled(loops, "reference [um]", "position of the stage [um]", "triangle at 10 Hz, open loop")
    distance = "% of range (linear within 0.01 %)"
    styled(deviations, "time in the period [ms]", distance, "distance from the linear loop")
    styled(sizes, title="nonlinearity [% of range]")
    groups = list(dict.fromkeys((c.wave, c.error) for c in cases))
    for c in cases:
        colour, _ = LOOKS[c.closed, c.compensated]
        if (c.wave, c.error) == ("triangle", "exact"):
            if not c.closed:
                loops.plot(1e6 * c.reference, 1e6 * c.position, color=colour, linewidth=1.6)
            share = 100.0 * c.deviation / np.ptp(c.position)
            deviations.plot(1e3 * (c.time - c.time[0]), share, color=colour, linewidth=1.2)
        at = 0.19 * (list(LOOKS).index((c.closed, c.compensated)) - 1.5)
        place, height = groups.index((c.wave, c.error)) + at, 100.0 * c.nonlinearity
        sizes.barh(place, height, 0.18, color=colour)
        sizes.text(1.12 * height, place, f"{height:.2g}", va="center", fontsize=8)
    deviations.set_yscale("symlog", linthresh=1e-2)
    sizes.set_yticks(range(len(groups)), [f"{wave},\n{error}" for wave, error in groups])
    sizes.invert_yaxis()
    sizes.set_xscale("log")
    items = [100.0 * c.nonlinearity for c in cases]
    sizes.set_xlim(0.5 * min(items), 4.0 * max(items))
    handles = [Patch(color=colour, label=name) for colour, name in LOOKS.values()]
    figure.legend(handles=handles, fontsize=11, loc="outside lower center", ncols=len(handles))
    return figure


STACK = "P-885.51"
#: Peak of the reference [m] and its frequency [Hz]; the period of the controller [s].
PEAK, FREQUENCY, PERIOD = 10e-6, 10.0, 5e-5
_PERIODS = 2
#: What the stack's hysteresis parameters are, over what the compensator takes them for.
ERRORS: dict[str, Mapping[str, float]] = {
    "exact": {},
    "all +10 %": {"A": 1.1, "beta": 1.1, "gamma": 1.1, "delta": 1.1},
    "all -10 %": {"A": 0.9, "beta": 0.9, "gamma": 0.9, "delta": 0.9},
    "A +10 %, beta -10 %": {"A": 1.1, "beta": 0.9},
}

_NOTE = (
    f"Stack {STACK} on the flexure stage (0.2 kg, 5 N/um), {1e6 * PEAK:g} um at {FREQUENCY:g} Hz,"
    f" controller every {1e6 * PERIOD:g} us; second period from rest, simulated by an independent"
    " plain loop (scipy). Nonlinearity: largest distance from the best line of position against the"
    " position of the same loop with a linear stack, over the range. In open loop the command is"
    " the reference over the linear plant's gain, in closed loop it is the feed-forward too."
)
_WRONG = "The stack simulated has other hysteresis parameters than compensator and controller know."
#: The raster, up to the peak and down at one speed, and a sine from 0 to the peak [m].
WAVES: dict[str, Callable[[float], float]] = {
    "triangle": lambda t: PEAK * (1.0 - abs(2.0 * (t * FREQUENCY % 1.0) - 1.0)),
    "sine": lambda t: 0.5 * PEAK * (1.0 - float(np.cos(2.0 * np.pi * FREQUENCY * t))),
}


def run(progress: Progress, quick: bool) -> Outcome:
    """Simulate all cases; `quick` takes the triangle, and of the errors one."""
    cases = []
    waves, errors = (list(of)[: n if quick else None] for of, n in ((WAVES, 1), (ERRORS, 2)))
    for wave, closed, compensated in product(waves, (False, True), (False, True)):
        for error in errors if compensated else ("exact",):
            loop = "closed" if closed else "open"
            progress(f"{wave}, {loop} loop, {'' if compensated else 'un'}compensated, {error}")
            cases.append(simulate_case(wave, closed, compensated, error))
    return Outcome(tables(cases), partial(picture, cases))


def simulate_case(wave: str, closed: bool, compensated: bool, error: str = "exact") -> Case:
    """Simulate one case and measure its last period."""
    values = _values(closed, compensated)
    for name, factor in ERRORS[error].items():
        values["stack"][name] *= factor
    result = simulate_positioner(values, WAVES[wave], _PERIODS / FREQUENCY, PERIOD)
    last = result.time >= result.time[-1] - 1.0 / FREQUENCY
    time, position = result.time[last], result.position[last]
    reference = np.array([WAVES[wave](float(t)) for t in time])
    line = np.polynomial.Polynomial.fit(
        linear := linear_run(wave, closed).position[last], position, 1
    )
    deviation = position - line(linear)
    nonlinearity = float(np.abs(deviation).max() / np.ptp(position))
    displayed = (time, reference, position, deviation, nonlinearity)
    return Case(closed, compensated, wave, error, *displayed)


def _values(closed: bool, compensated: bool) -> dict[str, dict[str, float]]:
    """Return the values of the parts; in open loop the feed-forward is the whole command."""
    system = psa.nanopositioner(STACK, compensated=compensated, sample_time=PERIOD)
    values = {name: dict(model.values) for name, model in system.parts.items()}
    if not closed:
        values["controller"] |= dict.fromkeys(("proportional_gain", "integral_gain"), 0.0)
    return values


@cache
def linear_run(wave: str, closed: bool) -> Run:
    """Simulate the loop with a stack that has no hysteresis, and so nothing to compensate."""
    values = _values(closed, False)
    values["stack"] |= dict.fromkeys(("A", "beta", "gamma", "delta"), 0.0)
    return simulate_positioner(values, WAVES[wave], _PERIODS / FREQUENCY, PERIOD)


def tables(cases: Sequence[Case]) -> tuple[TitledTable, ...]:
    """Return the nonlinearity of exact compensators, and of wrong ones."""
    rows = [
        {"reference": c.wave, "loop": "closed" if c.closed else "open",
         "compensator": "with" if c.compensated else "without",
         "stack's parameters": c.error,
         "nonlinearity [% of range]": f"{100 * c.nonlinearity:.3f}"}
        for c in cases
    ]  # fmt: skip
    exact = [r for r in rows if r["stack's parameters"] == "exact"]
    off = [r for r in rows if r["compensator"] == "with"]
    return (
        TitledTable("Nonlinearity of the positioner", exact, _NOTE),
        TitledTable("With hysteresis parameters that are off", off, _WRONG),
    )
