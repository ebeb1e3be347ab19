"""The verdict of a diagnosis and its error budget in sentences."""

from collections.abc import Sequence
from typing import Any, get_args

import numpy as np

from psa_casadi.common.notes import Note
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
from psa_casadi.report.words.catalogue import TABLES, say
from psa_casadi.report.words.tables import Table

VERDICTS: dict[str, str] = {verdict: verdict.replace("_", " ") for verdict in get_args(Verdict)}


#: Outputs that a sentence names one by one.
_NAMED = 4
#: A row of the budget.
_REMAINS = "remains above the noise"
#: What an interval of the gain from blocks of few records means.
OWN_VOLTAGES = say("verdict.own_voltages")


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
    code: str = d.verdict
    values: dict[str, Any] = {"d": d, "base": _base_errors, **since_reference(d)}
    if d.doubt:
        code = "unconfirmed" if d.verdict == "adequate" else "doubted"
    elif d.verdict == "not_driven" and doubtful_sign([e.record for e in d.experiments]):
        code = "turned"
    elif d.verdict not in ("adequate", "not_driven"):
        if d.verdict == "unexplained" or not d.causes:
            code, values["rest"] = "unexplained", _without_name(d)
        else:
            values |= _named(d)
    return say(f"verdict.{code}", **values)


def since_reference(d: Diagnosis) -> dict[str, Any]:
    """Return whether a diagnosis has a reference, and which base parameter has changed since."""
    notes = {n.code: n.values for n in d.remarks if isinstance(n, Note)}
    return {"since": "since" in notes, "moved": notes.get("since_moved", {}).get("name", "")}


def _named(d: Diagnosis) -> dict[str, Any]:
    """Return which causes are named, what they remove, and which effects the first may be."""
    share, first = f"{d.budget.together.percents[0]} %", d.causes[0]
    if d.verdict == "partly_explained" and share.startswith("100"):
        share = "nearly all"  # something remains
    return {
        "causes": [named_cause(c) for c in d.causes],
        "effects": [phrases.plain(c.effect) for c in d.causes],
        "rivals": phrases.either((first.effect, *first.cannot_be_told_from)),
        "share": share,
    }


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
    each = [phrases.number(share, 2) for share in shares.values()]
    ends = [phrases.number(f(shares.values()), 2) for f in (min, max)]
    return say("verdict.base_errors", each=each, ends=ends, outputs=list(shares), most=_NAMED)


def _without_name(d: Diagnosis) -> str:
    """Say what an extended model without a cause holds and would take, "" where nothing."""
    return say("verdict.without_name", d=d, added=phrases.added(d))


def named_cause(cause: Cause) -> str:
    """Name a cause with its place, its confidence, and its indistinguishable rivals."""
    return say("verdict.named_cause", cause=cause)


#: Least probability from which on a sentence mentions what was not tried.
_LEAST_REST = 0.005


def family_sentence(families: Sequence[Family]) -> str:
    """Say what a cause does and where it sits, and how far it may be none of the listed effects.

    Or nothing that was tried.
    """
    parts, known, named = [], TABLES["part_of_rig"], any(f.effects for f in families)
    for f in families:
        sure = phrases.probability_text(f.probability)
        part = f"{say(f'does.{f.kind}')} in {known.get(f.place, f.place)} ({sure})"
        parts.append(f"{part}, none of the listed effects" if named and not f.effects else part)
    rest = 1.0 - sum(f.probability for f in families)
    if families and rest >= _LEAST_REST:
        parts.append(f"something that was not tried ({phrases.percent(rest)})")
    return phrases.listing(parts, "or")


def alternative_sentence(d: Diagnosis, a: Alternative) -> str:
    """Say which of two causes an exported plant holds, and what that makes of its displacement."""
    apart = phrases.scale_of(d.experiments, a.plant_differs_m).text(a.plant_differs_m, 2)
    inside = any(c.name == a.cause for c in d.model.plant().components)
    return say("verdict.alternative", a=a, apart=apart, inside=inside)


def column_sentence(d: StackDiagnosis, c: Decision) -> str:
    """Say what a further column decided, and what the models miss of it in held-out samples."""
    if c.base_rms is None or c.noise is None or c.extended_rms is None:
        return c.sentence
    return say("verdict.column", c=c, added=phrases.added(d))


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
        digits = phrases.interval_digits(*ends)
        estimate = phrases.with_unit(phrases.number(value, digits), unit)
        texts.append(f"{name} = {estimate} ({phrases.interval_text(*ends)})")
    if weights:
        texts.append(f"{len(weights)} weights, which shape its loop together")
    return ", ".join(texts)


def patch_text(patch: Correction) -> str:
    """Say what the unnamed correction is, and what else it may be."""
    port = patch.port if isinstance(patch, Patch) else ""
    return say("verdict.patch", patch=patch, port=port)


def budget_sentence(d: Diagnosis) -> str:
    """Say where the held-out error above the noise goes."""
    stack = d.budget if isinstance(d.budget, StackBudget) else None
    scale, added = phrases.scale_of(d.experiments, d.errors[0].base), phrases.added(d)
    removed, patch = _removed(d.budget) if added else "", d.patch and patch_text(d.patch)
    values = {"stack": stack, "scale": scale, "removed": removed, "patch": patch}
    return say("verdict.budget", b=d.budget, added=added, **values)


def _removed(b: Budget) -> str:
    """Say what the causes remove; where they stand in for each other, what they do together."""
    each = phrases.listing([f"{phrases.plain(c.what)} removes {c.text}" for c in b.causes])
    alone = sum(c.share for c in b.causes)
    if len(b.causes) < 2 or b.together.share <= 0.0 or alone > 0.5 * b.together.share:
        return each
    names = phrases.listing([phrases.plain(c.what) for c in b.causes])
    return say("verdict.stand_ins", names=names, together=b.together.text, each=each)


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
