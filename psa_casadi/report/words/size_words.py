"""How large an effect is, in a sentence for each kind of test."""

from collections.abc import Callable, Sequence

from psa_casadi.diagnosis.remedy import Size
from psa_casadi.report.words.phrases import (
    Scale,
    interval_text,
    listing,
    number,
    plain,
    prefixed_scale,
)

#: Returns the scale of a length [m].
Length = Callable[[float], Scale]


def size_text(sizes: Sequence[Size], length: Length) -> str:
    """Return what the tests of one effect give, as a sentence without its full stop."""
    if not sizes:
        return ""
    largest = max(abs(s.value) for s in sizes)
    return _TEXTS[sizes[0].test](sizes, lambda _: length(largest))  # one unit in a sentence


def _amount(size: Size, length: Length) -> str:
    """Return a figure with its interval, without its sign."""
    value = abs(size.value)
    in_metres = size.unit == "m" and size.output == "displacement"
    scale = (
        length(value) if in_metres or size.unit == "counts" else prefixed_scale(value, size.unit)
    )
    if size.interval is None:
        return scale.text(value)
    ends = sorted(scale.factor * abs(v) for v in size.interval)
    return f"{scale.text(value)} ({interval_text(*ends)})"


def _voltages(size: Size) -> str:
    low, high = size.voltages or (0.0, 0.0)
    return f"{low:.3g} to {high:.3g} V"


def _hold(sizes: Sequence[Size], length: Length) -> str:
    _, high = sizes[0].voltages or (0.0, 0.0)
    way = "falls back" if sizes[0].value < 0 else "goes on"
    each = [f"{_amount(s, length)} in {_time(s.at)}" for s in sizes]
    text = f"after a step to {high:.3g} V the displacement {way} by {listing(each)}"
    beyond = [_time(s.at) for s in sizes if s.beyond_records]
    if not beyond:
        return text
    return f"{text}; {listing(beyond)} {'lies' if len(beyond) == 1 else 'lie'} beyond these records"


def _time(seconds: float) -> str:
    return f"{seconds:g} s" if seconds < 60.0 else f"{seconds / 60.0:g} min"


def _reversal(sizes: Sequence[Size], length: Length) -> str:
    return (
        f"in loops of {_voltages(sizes[0])} it sets the ways up and down apart by up to"
        f" {_amount(sizes[0], length)}"
    )


def _range(sizes: Sequence[Size], length: Length) -> str:
    bent, top = sizes
    way = "adds" if top.value > 0 else "takes"
    return (
        f"over {_voltages(bent)} it {way} {_amount(top, length)} at the top, and bends the curve by"
        f" up to {_amount(bent, length)} beside zero and sensitivity"
    )


def _slew(sizes: Sequence[Size], length: Length) -> str:
    rate = prefixed_scale(sizes[0].at, "V").text(sizes[0].at)
    return f"at the fastest slew, {rate}/s, it amounts to {_amount(sizes[0], length)}"


def _resonance(sizes: Sequence[Size], length: Length) -> str:
    where = listing([number(s.at) for s in sizes])
    times = listing([_amount(s, length) for s in sizes])
    return f"at {where} Hz it makes the displacement {times} times as large"


def _record(sizes: Sequence[Size], length: Length) -> str:
    rows = {s.output: _amount(s, length) for s in sizes if s.test == "record"}
    rms = next((f", {_amount(s, length)} rms" for s in sizes if s.test == "rms"), "")
    each = listing([f"the {plain(name)} by up to {text}" for name, text in rows.items()])
    return f"within a record of {number(sizes[0].at)} s it moves {each}{rms}"


_TEXTS: dict[str, Callable[[Sequence[Size], Length], str]] = {
    "hold": _hold,
    "reversal": _reversal,
    "range": _range,
    "slew": _slew,
    "resonance": _resonance,
    "record": _record,
}
