"""A design (an input, an experiment, a mechanism) as one HTML page that works offline."""

import os
from collections.abc import Sequence
from typing import Protocol

from psa_casadi.files import atomic_write
from psa_casadi.report.page.document import Document
from psa_casadi.report.page.live_part import LiveModel, add_live
from psa_casadi.report.page.packed import Picture
from psa_casadi.report.plots.figure import record_figure, response_figure
from psa_casadi.report.words.series import EXTENDED_COLOUR, Curve, Series
from psa_casadi.report.words.tables import Table


class TitledTableLike(Protocol):
    """A table of text under a title, with a note on how to read it (empty: none)."""

    @property
    def title(self) -> str:
        """What the table shows."""
        ...

    @property
    def table(self) -> Table:
        """Head and rows."""
        ...

    @property
    def note(self) -> str:
        """How to read it."""
        ...


def write_design_page(
    path: str | os.PathLike[str],
    *,
    title: str,
    summary: Sequence[str],
    tables: Sequence[TitledTableLike] = (),
    figures: Sequence[Picture] = (),
    badges: Sequence[str] = (),
    live: LiveModel | None = None,
) -> None:
    """Write the page of a design, whole or not at all.

    The first sentence of `summary` is the result, the others follow as a list; then come the
    figures (plots as `psa_casadi.report.plots.theme.styled` makes them) and the tables
    with their notes. `badges` are short marks under the title, such as "2,000 samples". `live` is
    a model that runs in the page on the designed voltage.

    Raises InputError when `path` cannot be written to.
    """
    page = Document(title, badges)
    if summary:
        page.paragraph(summary[0], "verdict")
    if summary[1:]:
        page.bullets(summary[1:])
    if live is not None:
        _still(page, live)
    if figures:
        page.section("Figures")
    for picture in figures:
        page.picture(picture)
    if live is not None:
        add_live(page, live)
    for titled in tables:
        page.section(titled.title)
        page.table(titled.table, {"FAIL": "bad", "pass": "good"})
        if titled.note:
            page.paragraph(titled.note, "note")
    atomic_write(path, page.text())


def _still(page: Document, live: LiveModel) -> None:
    """Add what is seen of the design where no script runs: beside its path, where it has one."""
    r = live.records[0]
    time, voltage, model = r.time, r.inputs["voltage"], r.measured - r.residual
    if not r.residual.any():
        page.still(response_figure(time, voltage, model), "The model's answer to the voltage")
        return
    curve = Curve("model", EXTENDED_COLOUR, model)
    series = Series(
        r.name, time, voltage, r.measured, (curve,), r.held_out, noise=0.0, counts=False
    )
    page.still(record_figure(series, origin=live.aim), f"The {live.aim} and the model")
