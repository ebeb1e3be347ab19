"""How linear a positioner is: open and closed loop, with and without the hysteresis compensator.

The reference is a raster's triangle or a sine. Every case is simulated by the independent plain
loop of `nonlinearity_plant`; the product supplies the values only: what `nanopositioner` tunes and
`compensator_for` copies. The nonlinearity is the largest distance from the best straight line
through the position against that of the same loop with a linear stack, over the range: lags and
corners that a linear stack has too do not count. (A free delay would absorb hysteresis: for a sine
a loop is nearly one.)
"""

from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from itertools import product

import numpy as np
import numpy.typing as npt

from psa_casadi.model.nanopositioner import margins_of, nanopositioner, positioner_plant
from psa_casadi.report.words.tables import Table
from tests.benchmarks.nonlinearity_figure import picture
from tests.benchmarks.nonlinearity_plant import Case, Run, simulate_positioner
from tests.benchmarks.outcome import Outcome, Progress, TitledTable

FloatArray = npt.NDArray[np.float64]
Signal = Callable[[float], float]

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
    " position of the same loop with a linear stack, over the range. Tracking error: largest"
    " |position - reference| over the reference's range, nothing fitted; in open loop the command"
    " is the reference over the linear plant's gain, in closed loop it is the feed-forward too."
)
_WRONG = (
    "The stack simulated has other hysteresis parameters than the compensator and the controller"
    " were made from."
)


def triangle(t: float) -> float:
    """Return the raster: up to the peak and down, both at one speed [m]."""
    return PEAK * (1.0 - abs(2.0 * (t * FREQUENCY % 1.0) - 1.0))


def sine(t: float) -> float:
    """Return a sine from 0 to the peak [m]."""
    return 0.5 * PEAK * (1.0 - float(np.cos(2.0 * np.pi * FREQUENCY * t)))


WAVES: dict[str, Signal] = {"triangle": triangle, "sine": sine}


def run(progress: Progress, quick: bool) -> Outcome:
    """Simulate all cases; `quick` takes the triangle, and of the errors one."""
    cases = list(_cases(progress, quick))
    return Outcome(tables(cases), partial(picture, cases))


def _cases(progress: Progress, quick: bool) -> Iterator[Case]:
    for wave, closed, compensated in product(
        ("triangle",) if quick else WAVES, (False, True), (False, True)
    ):
        for error in ERRORS if compensated else ("exact",):
            if quick and error not in ("exact", "all +10 %"):
                continue
            loop = "closed" if closed else "open"
            progress(f"{wave}, {loop} loop, {'' if compensated else 'un'}compensated, {error}")
            yield simulate_case(wave, closed=closed, compensated=compensated, error=error)


def simulate_case(
    wave: str, *, closed: bool, compensated: bool, error: str = "exact", periods: int = _PERIODS
) -> Case:
    """Simulate one case and measure its last period."""
    values = _values(closed=closed, compensated=compensated)
    for name, factor in ERRORS[error].items():
        values["stack"][name] *= factor
    found, ideal = _positions(values, wave, periods), linear_run(wave, closed, periods)
    last = found.time >= found.time[-1] - 1.0 / FREQUENCY
    time, position = found.time[last], found.position[last]
    reference = np.array([WAVES[wave](float(t)) for t in time])
    deviation = line_deviation(ideal.position[last], position)
    return Case(
        closed,
        compensated,
        wave,
        error,
        time=time,
        reference=reference,
        position=position,
        deviation=deviation,
        nonlinearity=float(np.abs(deviation).max() / np.ptp(position)),
        tracking=float(np.abs(position - reference).max() / np.ptp(reference)),
    )


def _values(*, closed: bool, compensated: bool) -> dict[str, dict[str, float]]:
    """Return the values of the parts; in open loop the feed-forward is the whole command."""
    system = nanopositioner(STACK, compensated=compensated, sample_time=PERIOD)
    values = {name: dict(model.values) for name, model in system.parts.items()}
    if not closed:
        controller = values["controller"]
        controller["proportional_gain"] = controller["integral_gain"] = 0.0
    return values


def _positions(values: Mapping[str, Mapping[str, float]], wave: str, periods: int) -> Run:
    return simulate_positioner(values, WAVES[wave], periods / FREQUENCY, PERIOD)


@cache
def linear_run(wave: str, closed: bool, periods: int) -> Run:
    """Simulate the loop with a stack that has no hysteresis, and so nothing to compensate."""
    values = _values(closed=closed, compensated=False)
    values["stack"] |= dict.fromkeys(("A", "beta", "gamma", "delta"), 0.0)
    return _positions(values, wave, periods)


def line_deviation(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return y minus its least-squares line in x."""
    basis = np.column_stack([x, np.ones_like(x)])
    left: FloatArray = y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
    return left


def tables(cases: list[Case]) -> tuple[TitledTable, ...]:
    """Return the nonlinearity of exact compensators, of wrong ones, and the tuned controller."""
    head = ("reference", "loop", "compensator", "nonlinearity [% of range]", "tracking error [%]")
    exact = tuple(_row(c)[:5] for c in cases if c.error == "exact")
    off = tuple((*_row(c)[:2], c.error, *_row(c)[3:]) for c in cases if c.compensated)
    wrong = ("reference", "loop", "stack's parameters", *head[3:])
    return (
        TitledTable("Nonlinearity of the positioner", Table(head, exact), _NOTE),
        TitledTable("With hysteresis parameters that are off", Table(wrong, off), _WRONG),
        _controller_table(),
    )


def _row(c: Case) -> tuple[str, ...]:
    loop, with_it = "closed" if c.closed else "open", "with" if c.compensated else "without"
    return (c.wave, loop, with_it, f"{100 * c.nonlinearity:.3f}", f"{100 * c.tracking:.3f}")


def _controller_table() -> TitledTable:
    """Return the margins of the controller, at the steepest slope of the loop and at rest."""
    controller = nanopositioner(STACK, sample_time=PERIOD).parts["controller"]
    rows = []
    for compensated in (True, False):
        plant = positioner_plant(STACK, compensated=compensated).model()
        m = margins_of(plant, controller, "stage_position")
        rows.append(
            (
                "with" if compensated else "without, at rest",
                f"{m.crossover:.0f}",
                f"{m.sensitivity:.2f}",
                f"{m.gain:.2f}",
                f"{np.degrees(m.phase):.0f}",
                f"{m.resonance:.0f}",
            )
        )
    head = ("compensator", "crossover [Hz]", "largest sensitivity", "gain margin",
            "phase margin [deg]", "resonance [Hz]")  # fmt: skip
    p = controller.values
    note = (
        f"K_p {p['proportional_gain']:.4g} V/m, K_i {p['integral_gain']:.4g} V/(m.s), notch at"
        f" {p['notch_frequency']:.0f} Hz (damping {p['notch_floor']:g} over {p['notch_width']:g}):"
        " the largest integral gain with a sensitivity below 1.6, also with the resonance 10 % off."
    )
    return TitledTable("The controller", Table(head, tuple(rows)), note)
