"""What a fit amounts to in sentences, and how well each parameter is determined."""

from typing import TYPE_CHECKING

from psa_casadi.identification.grades import STRONG_CORRELATION, Degree, Grade, named
from psa_casadi.report.words.phrases import Scale, listing, number, percent

if TYPE_CHECKING:
    from psa_casadi.report.words.series import ResidualFigures

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
