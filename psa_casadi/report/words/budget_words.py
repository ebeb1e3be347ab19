"""The error budget and the unnamed correction in words and as a table."""

from psa_casadi.diagnosis.held_out import Budget, Share
from psa_casadi.diagnosis.patch import Patch
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.report.words.phrases import Scale, listing, number, plain
from psa_casadi.report.words.tables import Table
from psa_casadi.report.words.verdict_words import added

#: Ports that these records cannot distinguish.
_OPEN = "; these data cannot distinguish it from {}"


def share_percent(share: float) -> str:
    """Return a share as a percentage that is never 0 where it is not."""
    if 0.0 < share < 0.005:
        return "under 1 %"
    return f"{100.0 * share:.0f} %"


def patch_text(patch: Patch) -> str:
    """Say what the unnamed correction is, and what else it may be."""
    rest = _OPEN.format(listing(patch.open_to, "or")) if patch.open_to else ""
    return f"{patch.sentence}, at the {patch.port}{rest}"


def budget_sentence(d: Diagnosis, scale: Scale) -> str:
    """Say where the held-out error above the noise goes."""
    b = d.budget
    if b is None:
        return ""
    parts = [f"of {scale.text(b.excess_rms_m)} rms above the noise"]
    if added(d):
        parts.append(_removed(b))
    if b.unnamed is not None and d.patch is not None:
        more = "a further" if added(d) else "of it"
        parts.append(
            f"an unnamed correction would remove {more} {b.unnamed.text}: {patch_text(d.patch)}"
        )
    if added(d):
        left = f"{scale.text(b.remains_rms_m)} ({number(b.remains_percent, 2)} % of the range)"
        parts.append(f"above the noise the extended model leaves {left}")
    return "; ".join(parts)


def _removed(b: Budget) -> str:
    """Say what the causes remove; where they stand in for each other, what they do together."""
    each = listing([f"{plain(c.what)} removes {c.text}" for c in b.causes])
    alone = sum(c.share for c in b.causes)
    if len(b.causes) < 2 or b.together.share <= 0.0 or alone > 0.5 * b.together.share:
        return each
    names = listing([plain(c.what) for c in b.causes])
    return (
        f"{names} together remove {b.together.text}; each can do most of what another does, so that"
        f" beside the others {each}"
    )


def budget_table(d: Diagnosis, scale: Scale) -> Table:
    """Return the shares of the base model's held-out error: power above the noise, and rms."""
    b = d.budget
    if b is None:
        return Table(("", "share", "95 % interval"), ())
    rows = [share_row(plain(c.what), c) for c in b.causes]
    if len(b.causes) > 1:
        rows.append(share_row("all causes together" if d.causes else "all together", b.together))
    if b.unnamed is not None and d.patch is not None:
        rows.append(share_row(f"unnamed: {d.patch.name}", b.unnamed))
    remains = number(scale.factor * b.remains_rms_m)
    share = (b.remains_rms_m / b.excess_rms_m) ** 2 if b.excess_rms_m > 0 else 0.0
    rows.append(("remains above the noise", f"{share_percent(share)}, {remains} {scale.unit}", ""))
    return Table(("what", "removes", "95 % interval"), tuple(rows))


def share_row(what: str, s: Share) -> tuple[str, str, str]:
    """Return a row of the budget: what removes, its share, and the 95 % interval."""
    share, low, high = s.percents
    return (what, f"{share} %", f"{low} to {high} %")
