"""What a residual shows, in sentences: its size, what it follows, its lines and harmonics."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from psa_casadi.diagnosis.misfit import Misfit
from psa_casadi.notes import Note
from psa_casadi.report.words.phrases import quantity, signed

#: A quantity: value and SI unit.
Quantity = tuple[float, str]


class AxisWords(NamedTuple):
    """A coordinate of a residual: the title of its view, its label, and its name in a sentence."""

    title: str
    label: str
    noun: str


_ALONG = "the residual counted along the motion"
_ABOVE = "the residual counted along the voltage's deviation"
_SINCE, _SWING = "time since the last reversal", "local peak-to-peak voltage"
_AMPLITUDE, _FREQUENCY = "the amplitude of the drive", "the frequency of the drive"
AXES: Mapping[str, AxisWords] = {
    "time": AxisWords("Time", "time", "time"),
    "voltage": AxisWords("Voltage", "voltage", "the voltage"),
    "displacement": AxisWords("Displacement", "predicted displacement", "the displacement"),
    "rate": AxisWords("Voltage rate", "voltage rate", "the voltage rate"),
    "since_reversal": AxisWords("Time since a reversal", _SINCE, f"the {_SINCE}"),
    "since_reversal_lag": AxisWords(
        "Time since a reversal, along the motion", _SINCE, f"the {_SINCE}, {_ALONG}"
    ),
    "from_reversal": AxisWords(
        "Voltage since a reversal",
        "voltage since the last reversal",
        "the voltage's distance from the last reversal",
    ),
    "amplitude": AxisWords("Amplitude of the drive", _SWING, _AMPLITUDE),
    "amplitude_gain": AxisWords("Gain against amplitude", _SWING, f"{_AMPLITUDE}, {_ABOVE}"),
    "amplitude_lag": AxisWords("Lag against amplitude", _SWING, f"{_AMPLITUDE}, {_ALONG}"),
    "frequency": AxisWords("Frequency of the drive", "local frequency", _FREQUENCY),
    "frequency_gain": AxisWords(
        "Gain against frequency", "local frequency", f"{_FREQUENCY}, {_ABOVE}"
    ),
    "frequency_lag": AxisWords(
        "Lag against frequency", "local frequency", f"{_FREQUENCY}, {_ALONG}"
    ),
    "holds": AxisWords("Holds", "time since the hold began", "the time since a hold began"),
    "temperature": AxisWords("Temperature", "warming", "the warming"),
    "spectrum": AxisWords("Spectrum", "frequency", "the frequency"),
}


def weight(m: Misfit) -> float:
    """Return the excess over the noise, by which records are compared."""
    return m.excess * (m.rms / m.floor.level if m.floor.level > 0 else 1.0)


def strongest(misfits: Sequence[Misfit]) -> Note | None:
    """Return what says most of what is wrong, None if nothing is above the noise."""
    above_noise = [m for m in misfits if len(m.findings) > 1]
    return max(above_noise, key=weight).findings[1] if above_noise else None


MISFIT: Mapping[str, Callable[..., str]] = {
    "residual": lambda record, rms, noise, ratio, source, excess, mean: (
        f"The residual of {record} is {quantity(*rms)} rms, {_over_noise(ratio, noise, source)}"
        f"{f': {100.0 * excess:.0f} % of its power is above the noise' if excess > 0 else ''}."
        f"{'' if mean is None else f' Its mean, {signed(*mean)}, is left out.'}"
    ),
    "follows": lambda axis, ends, share: (
        f"The residual follows {AXES[axis].noun}{': ' if ends else ''}"
        + " and ".join(f"{signed(*value)} at {quantity(*at)}" for value, at in ends)
    ),
    "holds": lambda count, moves, share: (
        f"In {'a hold' if count == 1 else f'{count} holds'} the residual moves "
        + (
            "without a trend in the logarithm of time"
            if moves is None
            else f"by {signed(*moves)} per decade of time, counted in the direction of the"
            " voltage's last change"
        )
    ),
    "lines": lambda lines, count, share: (
        f"The residual has {'a line' if count == 1 else 'lines'} whatever the drive does: "
        + ", ".join(
            f"{frequency:.4g} Hz{f' ({name})' if name else ''} with {quantity(*amplitude)}"
            for frequency, name, amplitude in lines
        )
        + " of amplitude"
    ),
    "harmonics": lambda periods, excited, parts, rest: (
        f"Over {periods} periods of the drive the residual's power is "
        + ", ".join(
            f"{100.0 * share:.0f} % {_part(part, excited)} ({quantity(*rms)} rms)"
            for part, share, rms in parts
        )
        + f", and {100.0 * rest:.0f} % does not repeat."
        if parts
        else f"Nothing in the residual repeats over {periods} periods of the drive."
    ),
}


def _over_noise(ratio: float | None, noise: Quantity, source: str) -> str:
    if ratio is None:
        return "without any noise"
    times = "as large as" if 0.95 < ratio < 1.05 else f"{quantity(ratio)} times"
    return f"{times} the noise of {quantity(*noise)} (from {source})"


def _part(part: str, excited: int) -> str:
    if part != "linear":
        return f"{part} nonlinearity"
    return f"linear misfit at {'the excited lines' if excited > 1 else 'harmonic 1'}"


def _view_explains(share: float) -> str:
    return f"; this view explains {100.0 * share:.0f} % of the excess."


#: How sentences go on that say what share of the excess over the noise they explain.
ENDINGS: Mapping[str, Callable[[float], str]] = {
    "follows": _view_explains,
    "holds": _view_explains,
    "lines": lambda share: f"; this explains {100.0 * share:.0f} % of the excess.",
}
