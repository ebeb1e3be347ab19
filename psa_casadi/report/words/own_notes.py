"""What the identification and the diagnosis of any model say, by the codes of their notes."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from psa_casadi.notes import Note
from psa_casadi.report.words.phrases import with_unit

if TYPE_CHECKING:  # which take long to load
    from psa_casadi.any_model.identify import OdeIdentification
    from psa_casadi.any_model.result import OdeDiagnosis

_VERDICTS = {
    "adequate": "what the model leaves cannot be distinguished from noise",
    "cause_named": "{} named, and nothing else is left",
    "partly_explained": "{} named, and more is left",
    "ambiguous": "a cause is found that these records cannot tell from others",
    "unexplained": "something is missing that no effect of the table explains",
}


def _diagnosis(d: "OdeDiagnosis") -> str:
    """Return the verdict, the causes with their sizes, the errors and what remains, in lines."""
    several = len(d.causes) > 1
    named = f"{len(d.causes)} causes are" if several else "a cause is"
    lines = [f"{d.verdict}: {_VERDICTS[d.verdict].format(named)}"]
    for c, removed in zip(d.causes, d.budget.causes, strict=True):
        lines.append(
            f"  {c.effect} ({c.confidence:.0%} sure), {c.description}; it removes"
            f" {removed.text} of the held-out error above the noise"
        )
        lines += [
            f"    {n} = {with_unit(_estimate(e.value, *e.interval), e.unit)}"
            for n, e in c.parameters.items()
        ]
        if c.cannot_be_told_from:
            lines.append(f"    may as well be {', '.join(c.cannot_be_told_from)}")
    if several:
        lines.append(f"  together they remove {d.budget.together.text} of it")
    for o in d.errors:
        base, extended, noise = (
            with_unit(f"{v:.3g}", o.unit) for v in (o.base, o.extended, o.noise)
        )
        lines.append(
            f"  {o.output}: held-out rms {base} of the base, {extended} of the extended model,"
            f" noise {noise}"
        )
    rest = (*d.moved, d.remaining.where, *d.notes, d.unnamed)
    return "\n".join([*lines, *(f"  {line}" for line in rest if line)])


def _identification(found: "OdeIdentification") -> str:
    """Return the parameters with their standard errors, and what is left of the outputs."""
    model = found.model
    rows = [
        f"  {n} = {model.values[n]:.6g} +- {e:.2g} {model.parameter(n).unit}"
        for n, e in found.errors.items()
    ]
    left = [f"  {n}: {v:.3g} rms left, noise {found.noise[n]:.3g}" for n, v in found.rms.items()]
    said = [f"  {w}" for w in found.warnings]
    return "\n".join([f"identified '{model.name}':", *rows, *left, *said])


def _moved(
    name: str, estimate: tuple[float, float, float], without: float, unit: str, causes: int
) -> str:
    value = with_unit(_estimate(*estimate), unit)
    return f"{name} = {value}, without the cause{'s' * (causes > 1)} {without:.4g}"


def _estimate(value: float, low: float, high: float) -> str:
    """Return a value with its interval, in as many digits as tell them apart, four at least."""
    half = max(high - value, value - low)
    digits = 4
    if 0.0 < half < abs(value):
        digits = max(4, min(9, 1 + math.ceil(math.log10(abs(value) / half))))
    return f"{value:.{digits}g} ({low:.{digits}g} to {high:.{digits}g})"


def _withdrawn(names: Sequence[str], share: float, output: str, why: Note) -> str:
    of = f" of {output}" if output else ""
    return (
        f"{' and '.join(names)} would remove {share:.0%} of the held-out error above the noise{of};"
        f" not named, because {why}."
    )


OWN_MODELS: Mapping[str, str | Callable[..., str]] = {
    "own_diagnosis": _diagnosis,
    "own_identification": _identification,
    "moved": _moved,
    # the records
    "stairs": (
        "The input '{input}' stands still between jumps in {records}, and each jump is read as a"
        " ramp of one sampling interval; if it is held between samples, as by a digital controller,"
        ' say so of these records: psa.Signals(..., hold="zero").'
    ),
    "no_column": "No record has a column '{output}'; that output is not compared.",
    # the fit
    "own_interrupted": "The search was interrupted; these are the best values so far.",
    "cut_off": "The fit was cut off before it converged; its values are not final.",
    "one_start": (
        "Of {starts} starts only one led to this minimum; it is the best found, and may not be the"
        " best there is."
    ),
    "own_undetermined": "'{name}' is not determined by these records.",
    "on_bound": "'{name}' sits on a bound of its range; its interval means nothing.",
    "output_missed": (
        "'{output}' is missed by {ratio:.2g} times its noise: the model lacks something, so that"
        " the values bend to it, and their errors are too small; psa.diagnose looks for the cause."
    ),
    "output_not_followed": (
        "'{output}' is left with {share:.0p} % of its own movement: see that its column, and those"
        " of the inputs, are in the model's units."
    ),
    # the verdict
    "own_few_held_out": (
        "Only {count} readings are held out, and no model can be judged by fewer than {least}:"
        " nothing is named."
    ),
    "held_out_unlike": (
        "The fitted samples leave no more than noise, but the held-out ones of {output}"
        " {ratio:.1f} times their noise: these records do not say the same, or their inputs are not"
        " read alike (see `hold`)."
    ),
    "free_function": (
        "A free function of {of} in {port} would remove {share:.0%} of what is left above the"
        " noise."
    ),
    "own_withdrawn": _withdrawn,
    "free_beats": "a free function of {of} in {port} explains more ({share:.0%})",
    "own_little": "that is less than {least:.0%} and much remains",
    "slight": (
        "{names: and } together fit better (ln of the Bayes factor higher by {more:.0f}). Not"
        " named, because {small: and } would remove less than {least:.0%} of what the rest does,"
        " and so little may only correct its form."
    ),
}
