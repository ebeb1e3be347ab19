"""The part of a page that says what a model gets wrong: sentences, views, harmonic split."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.diagnosis.misfit import WORTH_SAYING, Misfit
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.report.page.document import Document
from psa_casadi.report.page.packed import Picture
from psa_casadi.report.plots.view_plots import spectrum_view_plot, view_named, view_plot
from psa_casadi.report.words.misfit_words import AXES, weight
from psa_casadi.report.words.phrases import added, length_scale, lowered, number, percent
from psa_casadi.report.words.tables import Table

#: Views that say much the same: one of each family is drawn.
_FAMILIES = {
    "displacement": "voltage",
    "since_reversal": "reversal",
    "since_reversal_lag": "reversal",
    "from_reversal": "reversal",
    "amplitude_gain": "amplitude",
    "amplitude_lag": "amplitude",
    "frequency_gain": "frequency",
    "frequency_lag": "frequency",
}
#: Views that are drawn; records whose sentences are listed, and how many of each.
_VIEWS, _RECORDS, _SENTENCES = 3, 4, 6


def add_misfit(page: Document, d: Diagnosis) -> None:
    """Add what the base model gets wrong, with the views before and after the extension.

    Adds nothing where the diagnosis has no record with enough samples.
    """
    if not d.misfit:
        return
    page.section("What the base model gets wrong")
    _sentences(page, d.misfit)
    pictures = _pictures(d)
    if pictures:
        page.pictures(pictures)
    for m in d.misfit[:_RECORDS]:
        if m.split is not None and m.split.linear + m.split.even + m.split.odd > 0:
            page.heading(f"Where the error lies among the drive's harmonics: {m.record}")
            page.table(split_table(m, _after(d, m), counts=in_counts(d, m)))
            page.paragraph(
                "Linear: at the lines that the voltage excites; even and odd: nonlinearity, at the"
                " harmonics that it does not excite.",
                "note",
            )


def add_remainder(page: Document, d: Diagnosis) -> None:
    """Add what the extended model leaves, in sentences."""
    if d.remainder and added(d):
        _sentences(page, d.remainder)


def drawn(misfits: Sequence[Misfit]) -> tuple[tuple[Misfit, str], ...]:
    """Return record and name of the views with the largest shares, one of every family.

    "spectrum" stands for the lines that are not the drive's.
    """
    best: dict[str, tuple[float, Misfit, str]] = {}
    for m in misfits:
        rows = [(v.name, v.share) for v in m.views if v.significant]
        rows += [("holds", m.holds.share)] if m.holds and m.holds.significant else []
        rows.append(("spectrum", m.spectrum.share))
        for name, share in rows:
            family = _FAMILIES.get(name, name)
            if share > WORTH_SAYING and (family not in best or share > best[family][0]):
                best[family] = (share, m, name)
    order = sorted(best.values(), key=lambda row: -row[0])
    return tuple((m, name) for _, m, name in order[:_VIEWS])


def data_view(d: Diagnosis, m: Misfit, name: str) -> Picture | None:
    """Return the picture of one view of a record's residual, None where there is nothing in it."""
    counts, after = in_counts(d, m), _after(d, m)
    if name == "spectrum":
        plot = spectrum_view_plot(m.spectrum, after.spectrum if after else None, counts=counts)
        return Picture(f"{m.record}: spectrum of the residual", plot)
    before = view_named(m, name)
    if before is None:
        return None
    plot = view_plot(before, view_named(after, name) if after else None, counts=counts)
    share = f", {percent(before.share)} of the excess" if before.significant else ""
    return Picture(f"{m.record}: {lowered(AXES[before.name].title)}{share}", plot)


def in_counts(d: Diagnosis, m: Misfit) -> bool:
    """Say whether the record's displacement is in counts of the sensor."""
    units = {e.record.name: e.record.displacement_unit for e in d.experiments}
    return units.get(m.record) == "counts"


def split_table(before: Misfit, after: Misfit | None, *, counts: bool) -> Table:
    """Return the parts of a residual under a periodic voltage: rms and share of the power."""
    s = before.split
    t = after.split if after is not None else None
    if s is None:
        return Table((), ())
    scale = length_scale(before.rms, counts=counts)
    total = s.linear + s.even + s.odd + s.noise or 1.0
    names = {"linear": "linear", "even": "even", "odd": "odd", "noise": "does not repeat"}
    head = ["part", f"base [{scale.unit} rms]", "share of the power"]
    head += [f"extended [{scale.unit} rms]"] if t is not None else []
    rows = []
    for key, words in names.items():
        power = float(getattr(s, key))
        row = [words, number(scale.factor * float(np.sqrt(power))), percent(power / total)]
        if t is not None:
            row.append(number(scale.factor * float(np.sqrt(getattr(t, key)))))
        rows.append(tuple(row))
    return Table(tuple(head), tuple(rows))


def _sentences(page: Document, misfits: Sequence[Misfit]) -> None:
    order = sorted(misfits, key=lambda m: -weight(m))
    for m in order[:_RECORDS]:
        page.bullets(m.sentences[:_SENTENCES])
    if len(order) > _RECORDS:
        page.paragraph(
            f"These are the {_RECORDS} of {len(order)} records with the largest error over their"
            " noise; DIAGNOSIS.json holds the sentences of all.",
            "note",
        )


def _pictures(d: Diagnosis) -> list[Picture]:
    found = [data_view(d, m, name) for m, name in drawn(d.misfit)]
    return [p for p in found if p is not None]


def _after(d: Diagnosis, m: Misfit) -> Misfit | None:
    """Return what the extended model leaves of the same record."""
    return next((r for r in d.remainder if r.record == m.record), None) if added(d) else None
