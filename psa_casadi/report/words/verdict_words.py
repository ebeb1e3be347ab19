"""The verdict of a diagnosis and its error budget in sentences."""

from collections.abc import Sequence
from typing import get_args

import numpy as np

from psa_casadi.diagnosis.corrections import Correction, Family, Patch
from psa_casadi.diagnosis.held_out import Budget, Share, StackBudget
from psa_casadi.diagnosis.result import (
    Alternative,
    Cause,
    Decision,
    Diagnosis,
    StackDiagnosis,
    Verdict,
)
from psa_casadi.identification.start.doubts import doubtful_sign
from psa_casadi.report.words import phrases
from psa_casadi.report.words.tables import Table

VERDICTS: dict[str, str] = {verdict: verdict.replace("_", " ") for verdict in get_args(Verdict)}


#: Outputs that a sentence names one by one.
_NAMED = 4
#: A row of the budget.
_REMAINS = "remains above the noise"
#: What an interval of the gain from blocks of few records means.
OWN_VOLTAGES = (
    "The interval is taken over blocks of the held-out samples and holds for these voltages only;"
    " for other voltages hold out four records or more (--holdout)."
)


def gain_sentence(d: StackDiagnosis) -> str:
    """Say how far the held-out error falls."""
    gain = d.gain.holdout_rms_reduction_percent
    low, high = d.gain.interval
    if gain <= 0:
        return "the held-out error does not fall"
    fall, least, most = (f"{gain:.0f}", f"{low:.0f}", f"{high:.0f}")
    if least == "100":
        fall, least, most = Share("error", 0.01 * gain, (0.01 * low, 0.01 * high)).percents
    return f"the held-out error falls by {fall} % (95 % interval {least} to {most} %)"


def verdict_sentence(d: Diagnosis) -> str:
    """Say the verdict in one sentence, with confidence and gain."""
    if d.doubt and d.verdict == "adequate":
        text = f"Nothing beyond the noise is seen to be missing; {d.doubt}"
    elif d.doubt:
        text = f"Something is missing, and no cause is named; {d.doubt}"
    elif d.verdict == "adequate":
        text = f"Nothing beyond the noise is missing from the base model; {_base_errors(d)}"
    elif d.verdict == "not_driven":
        reason = (
            "The displacement falls while the voltage rises: correct the sign of one of them."
            " Nothing was diagnosed"
            if doubtful_sign([e.record for e in d.experiments])
            else "The displacement does not follow the voltage: nothing can be diagnosed"
        )
        text = f"{reason}; {_base_errors(d)}"
    elif d.verdict == "unexplained" or not d.causes:
        nothing = "Something is missing, and no effect in the table explains it: no cause is named"
        text = f"{nothing}; {_without_name(d)}{_base_errors(d)}"
    else:
        text = _named(d)
    return f"{text}."


def _named(d: Diagnosis) -> str:
    """Say which causes are named, and what they remove."""
    causes = [named_cause(c) for c in d.causes]
    one, share = len(causes) == 1, f"{d.budget.together.percents[0]} %"
    if d.verdict == "partly_explained" and share.startswith("100"):
        share = "nearly all"  # something remains
    # the noise is the floor
    removal = (
        f"{'removes' if one else 'remove'} {share} of the base model's held-out error above the"
        " noise (in power)"
    )
    if d.verdict == "ambiguous":
        first = d.causes[0]
        rivals = phrases.either((first.effect, *first.cannot_be_told_from))
        together = phrases.listing([phrases.plain(c.effect) for c in d.causes])
        return (
            f"Something is missing, and these data do not decide whether it is {rivals};"
            f" {together} {removal}"
        )
    are = f"{'cause is' if one else 'causes are'} {phrases.listing(causes)}"
    gone = f"{'it' if one else 'together they'} {removal}"
    if d.verdict == "partly_explained":
        return f"The closest known {are}: {gone}; more than noise remains"
    return f"The {are}: {gone}"


def of_range(d: Diagnosis, *, extended: bool = False) -> dict[str, float]:
    """Return a model's held-out error in every output, in % of its range in all records.

    That of a stack's displacement is each record's over that record's range.
    """
    if isinstance(d, StackDiagnosis):
        errors = d.extended_errors if extended else d.base_errors
        return {"displacement": errors.holdout_nrmse_percent}
    shares = {}
    for k, e in enumerate(d.errors):
        whole = np.concatenate([e.measured(k) for e in d.experiments])
        error = e.extended if extended else e.base
        shares[e.output] = 100.0 * error / float(np.nanmax(whole) - np.nanmin(whole))
    return shares


def _base_errors(d: Diagnosis) -> str:
    """Say the base model's error in every output, over its range."""
    shares = of_range(d)
    each = [f"{phrases.number(share, 2)} %" for share in shares.values()]
    if len(each) == 1:
        return f"the base model's held-out error is {each[0]} of the range"
    if len(each) > _NAMED:
        low, high = (phrases.number(f(shares.values()), 2) for f in (min, max))
        return f"the base model's held-out errors are {low} to {high} % of the ranges"
    pairs = [f"{share} of {output}" for output, share in zip(shares, each, strict=True)]
    return f"the base model's held-out errors are {phrases.listing(pairs)}, over their ranges"


def within(share: float) -> float:
    """Return a share cut to 0 and 1."""
    return max(0.0, min(1.0, share))


def _without_name(d: Diagnosis) -> str:
    """Say what an extended model without a cause holds and would take, "" where nothing."""
    text, b = "", d.budget
    if d.kept:
        one = len(d.kept) == 1
        text = (
            f"{phrases.listing([phrases.plain(name) for name in d.kept])}"
            f" {'removes' if one else 'remove'}"
            f" {phrases.percent(within(b.together.share))} of the error above the noise and"
            f" {'is' if one else 'are'} kept in the extended model without being"
            f" {'a cause' if one else 'causes'}; "
        )
    if d.patch is not None and b.unnamed is not None:
        more = "a further " if phrases.added(d) else ""
        share = phrases.percent(within(b.unnamed.share))
        text += f"{d.patch.sentence} would remove {more}{share} of the error above the noise; "
    return text


def named_cause(cause: Cause) -> str:
    """Name a cause with its place, its confidence, and its indistinguishable rivals."""
    sure = f"{phrases.place_of(cause)}, {phrases.confidence_text(cause.confidence)}"
    if cause.cannot_be_told_from:
        sure += f"; or {phrases.either(cause.cannot_be_told_from)}"
    return f"{phrases.plain(cause.effect)} ({sure})"


#: Least probability from which on a sentence mentions what was not tried.
_LEAST_REST = 0.005
#: What effects of a kind do, and the places of a rig.
_DOES = {
    "curve": "a bent static curve",
    "gain": "another gain",
    "hysteresis": "a dependence on past reversals",
    "relaxation": "a relaxation",
    "resonance": "a resonance",
    "lag": "a lag or a delay",
    "damping": "a loss",
    "time": "a change with time alone",
    "changing gain": "a gain that changes",
    "": "an effect of its own kind",
}
_PLACES = {
    "plant": "the stack or its load",
    "drive": "the drive",
    "sensor": "the sensor",
    "environment": "the surroundings",
}


def family_sentence(families: Sequence[Family]) -> str:
    """Say what a cause does and where it sits, and how far it may be none of the listed effects.

    Or nothing that was tried.
    """
    parts = []
    for f in families:
        place = _PLACES.get(f.place, f.place)
        part = f"{_DOES[f.kind]} in {place} ({phrases.probability_text(f.probability)})"
        if not f.effects and any(other.effects for other in families):
            part += ", none of the listed effects"
        parts.append(part)
    rest = 1.0 - sum(f.probability for f in families)
    if families and rest >= _LEAST_REST:
        parts.append(f"something that was not tried ({phrases.percent(rest)})")
    return phrases.listing(parts, "or")


def alternative_sentence(d: Diagnosis, a: Alternative) -> str:
    """Say which of two causes an exported plant holds, and what that makes of its displacement."""
    apart = phrases.scale_of(d.experiments, a.plant_differs_m).text(a.plant_differs_m, 2)
    inside = any(c.name == a.cause for c in d.model.plant().components)
    holds = "holds" if inside else "leaves out"
    return (
        f"an exported plant {holds} the {phrases.plain(a.cause)}; with {phrases.plain(a.instead)}"
        f" in its place its displacement differs by up to {apart}"
        f" ({phrases.number(a.plant_differs_percent, 2)} % of range),"
        " which these data do not decide"
    )


def column_sentence(d: StackDiagnosis, c: Decision) -> str:
    """Say what a further column decided, and what the models miss of it in held-out samples."""
    if c.base_rms is None or c.noise is None or c.extended_rms is None:
        return c.sentence
    after = f", extended {phrases.number(c.extended_rms)}" if phrases.added(d) else ""
    errors = f"base {phrases.number(c.base_rms)}{after}, noise {phrases.number(c.noise)}"
    return f"{c.sentence} Held-out rms: {phrases.with_unit(errors, c.unit)}."


def cause_size(d: Diagnosis, cause: Cause) -> str:
    """Return "name = value unit (low to high)" for every parameter of a cause.

    Of one that is several of a kind, and has many, at which frequencies they are; of weights that
    mean something only together, how many there are.
    """
    effect = next((c for c in d.model.components if c.name == cause.effect), None)
    if effect is not None and effect.count > 1:
        tones = sorted(d.model.values[p.name] for p in effect.parameters if p.unit == "Hz")
        return f"at {', '.join(phrases.number(v) for v in tones)} Hz"
    weights = [n for n in cause.parameters if effect is not None and n in effect.linear]
    texts = []
    for name, e in cause.parameters.items():
        if name in weights:
            continue
        unit, (value, *ends) = phrases.in_display_unit(d.model, name, e.value, *e.interval)
        estimate = phrases.with_unit(phrases.number(value), unit)
        texts.append(f"{name} = {estimate} ({phrases.interval_text(*ends)})")
    if weights:
        texts.append(f"{len(weights)} weights, which shape its loop together")
    return ", ".join(texts)


def patch_text(patch: Correction) -> str:
    """Say what the unnamed correction is, and what else it may be."""
    others = phrases.listing(patch.open_to, "or")
    rest = f"; these data cannot distinguish it from {others}" if others else ""
    where = f", at the {patch.port}" if isinstance(patch, Patch) else ""
    return f"{patch.sentence}{where}{rest}"


def budget_sentence(d: Diagnosis) -> str:
    """Say where the held-out error above the noise goes."""
    b, parts = d.budget, ["of the held-out error above the noise"]
    stack = b if isinstance(b, StackBudget) else None
    scale = phrases.scale_of(d.experiments, d.errors[0].base)
    if stack:
        parts = [f"of {scale.text(stack.excess_rms_m)} rms above the noise"]
    if phrases.added(d):
        parts.append(_removed(b))
    if b.unnamed is not None and d.patch is not None:
        more = "a further" if phrases.added(d) else "of it"
        parts.append(
            f"an unnamed correction would remove {more} {b.unnamed.text}: {patch_text(d.patch)}"
        )
    if phrases.added(d) and stack:
        share = phrases.number(stack.remains_percent, 2)
        left = f"{scale.text(stack.remains_rms_m)} ({share} % of the range)"
        parts.append(f"above the noise the extended model leaves {left}")
    return "; ".join(parts)


def _removed(b: Budget) -> str:
    """Say what the causes remove; where they stand in for each other, what they do together."""
    each = phrases.listing([f"{phrases.plain(c.what)} removes {c.text}" for c in b.causes])
    alone = sum(c.share for c in b.causes)
    if len(b.causes) < 2 or b.together.share <= 0.0 or alone > 0.5 * b.together.share:
        return each
    names = phrases.listing([phrases.plain(c.what) for c in b.causes])
    return (
        f"{names} together remove {b.together.text}; each can do most of what another does, so that"
        f" beside the others {each}"
    )


def budget_table(d: Diagnosis) -> Table:
    """Return the shares of the base model's held-out error: power above the noise, and rms."""
    b = d.budget
    rows = [share_row(phrases.plain(c.what), c) for c in b.causes]
    if len(b.causes) > 1:
        rows.append(share_row("all causes together" if d.causes else "all together", b.together))
    if b.unnamed is not None and d.patch is not None:
        rows.append(share_row(f"unnamed: {d.patch.name}", b.unnamed))
    low, high = b.together.interval
    left = (_REMAINS, "100 %", "")
    if phrases.added(d):
        left = share_row(_REMAINS, Share("left", 1.0 - b.together.share, (1.0 - high, 1.0 - low)))
    if isinstance(b, StackBudget):
        scale = phrases.scale_of(d.experiments, b.excess_rms_m)
        share = (b.remains_rms_m / b.excess_rms_m) ** 2 if b.excess_rms_m > 0 else 0.0
        rest = "under 1 %" if 0.0 < share < 0.005 else phrases.percent(share)
        left = (_REMAINS, f"{rest}, {scale.text(b.remains_rms_m)}", "")
    return Table(("what", "removes", "95 % interval"), (*rows, left))


def share_row(what: str, s: Share) -> tuple[str, str, str]:
    """Return a row of the budget: what removes, its share, and the 95 % interval."""
    share, low, high = s.percents
    return (what, f"{share} %", f"{low} to {high} %")
