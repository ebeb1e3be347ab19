"""A residual in sentences: its size, what it follows, its lines and harmonics, its noise."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from psa_casadi.common.notes import Note
from psa_casadi.diagnosis.misfit import Misfit
from psa_casadi.records.drive import is_mains
from psa_casadi.report.words.phrases import listing, quantity, signed

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
    """Return the finding with the largest excess, None if nothing is above the noise."""
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


def _places(at: tuple[float, ...], count: float) -> str:
    more = f" and {count - len(at):.0f} more" if count > len(at) else ""
    return f"at {listing([f'{t:.6g} s' for t in at])}{more}"


def _times(count: float) -> str:
    return {1: "once", 2: "twice"}.get(round(count), f"{count:.0f} times")


def _frequencies(at: tuple[float, ...]) -> str:
    return listing([f"{f:.4g} Hz{' (mains)' if is_mains(f) else ''}" for f in at])


_EACH: Mapping[str, Callable[..., str]] = {
    "autoregressive": lambda where, unit, at, rms, order, time, peak=0.0: (
        f"The noise of {where} is correlated over {quantity(time, 's')} (autoregressive of order"
        f" {order:.0f}{f', strongest at {peak:.3g} Hz' if peak else ''}), {quantity(rms, unit)}"
        " rms, as behind a filter. Sampling faster tells little more; longer records do."
    ),
    "one_over_f": lambda where, unit, at, rms, slope, corner=0.0: (
        f"The noise of {where} is 1/f noise, {quantity(rms, unit)} rms: its spectrum falls with"
        f" f^-{slope:.2g}{f' below {corner:.3g} Hz, above which it is white' if corner else ''}."
        " Longer averages do not help: record shorter and more often, move faster, or measure a"
        " target at rest beside it."
    ),
    "coloured": lambda where, unit, at, rms, time: (
        f"What is left of {where} is correlated over {quantity(time, 's')}; from these records it"
        " may be noise, or something that the model lacks. A voltage that is played twice decides."
    ),
    "telegraph": lambda where, unit, at, count, apart: (
        f"The noise of {where} jumps {_times(count)} between two levels, {quantity(apart, unit)}"
        " apart (random telegraph noise). Look for a loose contact, a range that switches, a sensor"
        " between two states."
    ),
    "steps": lambda where, unit, at, count, size: (
        f"The readings of {where} jump {_times(count)} by about {quantity(size, unit)} and stay"
        f" ({_places(at, count)}). Look for skipped fringes or counts, a clamp that slips, or"
        " samples that were dropped, and cut the record there."
    ),
    "heavy_tails": lambda where, unit, at, freedom: (
        f"The noise of {where} has heavy tails (Student's t with {freedom:.2g} degrees of freedom)."
        " Look for interference; of repeats the median is better than the mean."
    ),
    "outliers": lambda where, unit, at, count: (
        f"{where} has {'1 outlier' if count == 1 else f'{count:.0f} outliers'}"
        f" ({_places(at, count)}). Empty these cells, and look for interference at these instants."
    ),
    "jitter": lambda where, unit, at, rms: (
        f"The clock of {where} jitters by {quantity(rms, 's')} rms: the error grows with the rate"
        " of the motion. Use its own time stamps, or let the generator's clock trigger the samples."
    ),
    "grows": lambda where, unit, at, share: (
        f"The noise of {where} grows with the reading, by {100.0 * share:.2g} % of it. Look for a"
        " supply or a gain of the sensor that fluctuates."
    ),
    "quantised": lambda where, unit, at, step, rms: (
        f"What is left of {where} is rounding to steps of {quantity(step, unit)}; nothing smaller"
        " is resolved. Take a smaller range of the sensor or a finer converter."
    ),
    "held": lambda where, unit, at, share, run: (
        f"{100.0 * share:.0f} % of the readings of {where} repeat the one before: the sensor is"
        " read more slowly than it is sampled, or misses samples. Record"
        f" {f'one of {run:.0f} samples' if run > 1.5 else 'with the time stamps of the sensor'}."
    ),
    "dropped": lambda where, unit, at, count: (
        f"{where} lacks {count:.0f} sample{'s' * (count > 1)} of an even clock. The model is driven"
        " on a straight line there: see that the recorder's buffer does not overflow."
    ),
    "lines": lambda where, unit, at, amplitude: (
        f"The noise of {where} has {'a line' if len(at) == 1 else 'lines'} whatever the drive does:"
        f" {_frequencies(at)}, the strongest with an amplitude of"
        f" {quantity(amplitude, unit)}. Look for hum and vibration: shield, earth at one point, and"
        " switch off what turns."
    ),
}


def _noise_kind(
    where: tuple[str, ...],
    unit: str,
    kind: str,
    figures: Mapping[str, float],
    at: tuple[float, ...],
) -> str:
    """Return a sentence on the first record, and which others have noise of the same kind."""
    others = f" (and likewise of {listing(where[1:], most=3)})" if len(where) > 1 else ""
    return _EACH[kind](where=where[0] + others, unit=unit, at=at, **figures)


def _noise_enters(
    output: str, place: str, rate: bool, rms: tuple[float, str], time: float, nats: float
) -> str:
    """Return where noise enters a model."""
    walks = time == float("inf")
    when = "white" if time == 0.0 else f"correlated over {quantity(time, 's')}"
    size = f"{quantity(*rms)} {'from the beginning to the end' if walks else f'rms, {when}'}"
    where = f"a load in the rate of {place}" if rate else f"noise at the input {place}"
    return (
        f"What is left of '{output}' is likelier {where} ({size}{'; a walk' if walks else ''}) than"
        f" noise of its sensor, by {nats:.0f} nats: the model lacks no effect of its inputs."
    )


NOISE: Mapping[str, Callable[..., str]] = {
    "noise_kind": _noise_kind, "noise_enters": _noise_enters,
}  # fmt: skip
