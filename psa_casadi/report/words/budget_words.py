"""The error budget and the unnamed correction in words and as a table."""

from psa_casadi.diagnosis.budget import Share
from psa_casadi.diagnosis.corrections.patch import Patch
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.report.words.phrases import Scale, listing, number, plain
from psa_casadi.report.words.tables import Table

#: Ports that these records cannot distinguish.
_OPEN = "; these data cannot distinguish it from {}"


def share_percent(share: float) -> str:
    """Return a share as a percentage that is never 0 where it is not."""
    if 0.0 < share < 0.005:
        return "under 1 %"
    return f"{100.0 * share:.0f} %"


def share_with_interval(s: Share) -> str:
    """Return "62 % (58 to 66 %)"."""
    low, high = (min(max(v, 0.0), 1.0) for v in s.interval)
    return f"{share_percent(max(s.share, 0.0))} ({100 * low:.0f} to {100 * high:.0f} %)"


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
    if d.causes:
        each = [f"{plain(c.what)} removes {share_with_interval(c)}" for c in b.causes]
        parts.append(listing(each))
    if b.unnamed is not None and d.patch is not None:
        more = "a further" if d.causes else "of it"
        parts.append(
            f"an unnamed correction would remove {more} {share_with_interval(b.unnamed)}:"
            f" {patch_text(d.patch)}"
        )
    if d.causes:
        left = f"{scale.text(b.remains_rms_m)} ({number(b.remains_percent, 2)} % of the range)"
        parts.append(f"above the noise the named ones leave {left}")
    return "; ".join(parts)


def budget_table(d: Diagnosis, scale: Scale) -> Table:
    """Return the shares of the base model's held-out error: power above the noise, and rms."""
    b = d.budget
    if b is None:
        return Table(("", "share", "95 % interval"), ())
    rows = [_row(plain(c.what), c) for c in b.causes]
    if len(b.causes) > 1:
        rows.append(_row("all causes together", b.together))
    if b.unnamed is not None and d.patch is not None:
        rows.append(_row(f"unnamed: {d.patch.name}", b.unnamed))
    remains = number(scale.factor * b.remains_rms_m)
    share = (b.remains_rms_m / b.excess_rms_m) ** 2 if b.excess_rms_m > 0 else 0.0
    rows.append(("remains above the noise", f"{share_percent(share)}, {remains} {scale.unit}", ""))
    return Table(("what", "removes", "95 % interval"), tuple(rows))


def _row(what: str, s: Share) -> tuple[str, str, str]:
    low, high = (100.0 * min(max(v, 0.0), 1.0) for v in s.interval)
    return (what, share_percent(max(s.share, 0.0)), f"{low:.0f} to {high:.0f} %")
