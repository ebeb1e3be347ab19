"""What a fit amounts to in sentences, and how well each parameter is determined."""

import math
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Literal, get_args

from psa_casadi.identification.determinacy import DETERMINED_WIDTH
from psa_casadi.identification.identify import StackIdentification
from psa_casadi.identification.result import Identification
from psa_casadi.model.compose import Model
from psa_casadi.report.words.phrases import Scale, listing, number, percent

if TYPE_CHECKING:
    from psa_casadi.report.words.series import ResidualFigures

Degree = Literal["determined", "weak", "undetermined", "on its bound", "fixed"]
DEGREES: tuple[Degree, ...] = get_args(Degree)

#: A relative standard error above this is weak.
WEAK_ERROR = 0.1
#: Two parameters whose estimates correlate by more than this are known only together.
STRONG_CORRELATION = 0.95
_NORMAL_95 = 1.959963984540054


@dataclass(frozen=True)
class Grade:
    """One parameter's relative standard error, and what that makes of it.

    It is over the value, or over an ordinary change of a parameter that may be zero
    (`by_change`); a fixed parameter has none (nan).
    """

    name: str
    error: float
    degree: Degree
    by_change: bool = False


def grades(identification: Identification) -> tuple[Grade, ...]:
    """Return a grade for every parameter of the identified model, in the model's order."""
    return tuple(grade(identification, p.name) for p in identification.model.structure.parameters)


def grade(identification: Identification, name: str) -> Grade:
    """Return the grade of one parameter."""
    values, errors = identification.model.values, identification.errors
    if name not in errors:
        return Grade(name, float("nan"), "fixed")
    parameter = identification.model.parameter(name)
    size = abs(values[name]) if parameter.log else parameter.typical(values)
    error = errors[name] / size if size > 0 else float("inf")
    degree: Degree = "weak" if error > WEAK_ERROR else "determined"
    if name in identification.determinacy.on_bound:
        degree = "on its bound"
    elif name in identification.undetermined:
        degree = "undetermined"
    return Grade(name, error, degree, by_change=not parameter.log)


def determined(model: Model, identification: StackIdentification | None = None) -> frozenset[str]:
    """Return the parameters that the records determine, if only weakly.

    Without an identification they are those whose 95 % interval is that of a
    standard error below `DETERMINED_WIDTH`.
    """
    if identification is not None:
        known = {g.name for g in grades(identification) if g.degree in ("determined", "weak")}
        return frozenset(known | set(identification.read_off))
    narrow = set()
    for name, interval in model.provenance.intervals.items():
        parameter = model.parameter(name)
        if parameter.log:
            width = math.log(interval.high / interval.low) if interval.low > 0.0 else math.inf
        else:
            width = (interval.high - interval.low) / (parameter.typical(model.values) or math.inf)
        if width <= 2.0 * _NORMAL_95 * DETERMINED_WIDTH:
            narrow.add(name)
    return frozenset(narrow)


def named(graded: tuple[Grade, ...], degree: Degree) -> list[str]:
    """Return the names of the parameters of one degree."""
    return [g.name for g in graded if g.degree == degree]


def strong_pairs(identification: Identification) -> list[tuple[str, str, float]]:
    """Return the pairs of parameters that are known only together, the strongest first."""
    names, matrix = identification.determinacy.names, identification.determinacy.correlations
    places = combinations(range(len(names)), 2)
    strong = [(i, k) for i, k in places if abs(matrix[i, k]) >= STRONG_CORRELATION]
    pairs = [(names[i], names[k], float(matrix[i, k])) for i, k in strong]
    return sorted(pairs, key=lambda pair: -abs(pair[2]))


#: Shares of the lags beyond the 95 % band up to which a residual passes for white, with the
#: correlation of neighbours that is negligible.
_WHITE_SHARE, _WHITE_NEIGHBOURS = 0.12, 0.05
_SHAPE = 0.5


def error_sentence(rms: float, noise: float, span: float, scale: Scale, origin: str) -> str:
    """Say how far the model is from the records; rms, noise and largest range in [m]."""
    ratio = f" and {number(rms / noise, 2)} times the noise" if noise > 0 else ""
    share = number(100.0 * rms / span, 2)
    return (
        f"The model misses the {origin} displacement by {scale.text(rms)} rms,"
        f" {share} % of the largest range{ratio}."
    )


def determined_sentence(graded: tuple[Grade, ...]) -> str:
    """Say how many parameters the records determine, and name those they do not."""
    fitted = [g for g in graded if g.degree != "fixed"]
    if not fitted:
        return "No intervals were estimated, so it is not known what these records determine."
    good = len(named(graded, "determined"))
    count = "all" if good == len(fitted) else f"{good} of"
    parts = [f"The records determine {count} {len(fitted)} fitted parameters to 10 % or better"]
    words: tuple[tuple[Degree, str, str], ...] = (
        ("weak", "weakly determined", "weakly determined"),
        ("undetermined", "undetermined", "undetermined"),
        ("on its bound", "on its bound", "on their bounds"),
    )
    for degree, one, several in words:
        names = named(graded, degree)
        if names:
            parts.append(f"{listing(names)} {f'is {one}' if len(names) == 1 else f'are {several}'}")
    return f"{'; '.join(parts)}."


def error_bar_note(graded: tuple[Grade, ...]) -> str:
    """Say what the bars of determinacy are relative to, and where their limits lie."""
    by_change = [g.name for g in graded if g.by_change]
    note = "Dotted: 10 %, beyond it weak; dashed: 50 %, beyond it undetermined."
    if not by_change:
        return note
    verb = "is" if len(by_change) == 1 else "of each is"
    return (
        f"{note} {listing(by_change)} may be zero, so the error {verb} relative to an ordinary"
        " change, not to the value."
    )


def pairs_sentence(pairs: list[tuple[str, str, float]]) -> str:
    """Say which parameters are known only together."""
    if not pairs:
        return f"No two estimates correlate by more than {STRONG_CORRELATION}."
    texts = [f"{a} with {b} ({_signed(r)})" for a, b, r in pairs[:6]]
    more = f", and {len(pairs) - 6} pairs more" if len(pairs) > 6 else ""
    return (
        "Known only together, since one can make up for a change of the other:"
        f" {', '.join(texts)}{more}."
    )


def residual_sentence(f: "ResidualFigures", model: str, time: Scale) -> str:
    """Say whether the residual of a model is white and normal, with the figures behind it."""
    figures = f"skewness {_signed(f.skewness)}, excess kurtosis {_signed(f.kurtosis)}"
    tail = f"{number(100.0 * f.beyond_three, 2)} % of the samples lie beyond three standard"
    tail += " deviations, 0.27 % in a normal distribution"
    words = []
    if abs(f.skewness) > _SHAPE:
        words.append("longer upwards" if f.skewness > 0 else "longer downwards")
    if abs(f.kurtosis) > _SHAPE:
        words.append("heavier in its tails" if f.kurtosis > 0 else "lighter in its tails")
    normal = f"{listing(words)} than a normal one" if words else "close to normal"
    white = whiteness_sentence(f, model, time)
    return f"{white} Its distribution is {normal} ({figures}; {tail})."


def whiteness_sentence(f: "ResidualFigures", model: str, time: Scale) -> str:
    """Say whether the residual of a model is white, with the figures behind it."""
    share = f"{percent(f.outside)} of the lags lie outside the 95 % band"
    if f.outside <= _WHITE_SHARE and abs(f.neighbours) <= _WHITE_NEIGHBOURS:
        return f"The residual of the {model} is as white as noise ({share}; 5 % are expected)."
    return (
        f"The residual of the {model} is not white: neighbouring samples correlate by"
        f" {_signed(f.neighbours)}, the autocorrelation first falls to that of noise after"
        f" {time.text(f.lasting, 2)}, and {share}."
    )


def _signed(value: float) -> str:
    return f"{value:.2f}".replace("-", "−")
