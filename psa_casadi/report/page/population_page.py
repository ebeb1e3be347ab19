"""A population of devices as one HTML page: what is common, who stands out, batches and drift."""

import os
from collections.abc import Sequence

from psa_casadi.files import atomic_write
from psa_casadi.population.population import Population
from psa_casadi.report.page.document import Document
from psa_casadi.report.page.packed import Picture
from psa_casadi.report.plots.device_plots import drift_plot, spread_plot
from psa_casadi.report.words.population_words import (
    METHOD,
    batch_table,
    drift_table,
    frequency_table,
    left_out_sentence,
    outlier_table,
    population_sentences,
    spread_table,
)
from psa_casadi.report.words.tables import Table

#: Parameters that have a plot; those in which devices stand out come first.
_MOST_PLOTS = 12


def write_population(
    found: Population,
    path: str | os.PathLike[str],
    *,
    without: Sequence[tuple[str, str, str]] = (),
) -> None:
    """Write the page of a population, whole or not at all.

    `without` are devices that have no result: name, status, and why.

    Raises InputError when `path` cannot be written to.
    """
    atomic_write(path, _page(found, without))


def _page(p: Population, without: Sequence[tuple[str, str, str]]) -> str:
    batches = {f.batch for f in p.findings if f.batch}
    badges = [f"{len(p.findings)} devices"]
    badges += [f"{len(batches)} batch{'es' if len(batches) > 1 else ''}"] if batches else []
    page = Document("Population of devices", badges)
    page.paragraph(" ".join(population_sentences(p)), "verdict")
    page.tiles(_tiles(p, len(without)))
    if p.outliers:
        page.section("Devices that stand out")
        page.table(outlier_table(p))
    page.section("Parameters over the devices")
    page.paragraph(METHOD, "note")
    page.table(spread_table(p))
    if left_out_sentence(p):
        page.paragraph(left_out_sentence(p), "note")
    _plots(page, p)
    _batches(page, p)
    if p.verdicts:
        page.section("Verdicts and causes by frequency")
        page.table(frequency_table("verdict", p.verdicts))
    if p.causes:
        page.table(frequency_table("cause", p.causes))
    if without:
        page.section("Devices without a result")
        page.table(Table(("device", "ended", "why"), tuple(without)))
    return page.text()


def _tiles(p: Population, lost: int) -> list[tuple[str, str, str]]:
    count = len({o.device for o in p.outliers})
    tiles = [
        ("devices", str(len(p.findings)), f"{lost} more without a result" if lost else ""),
        ("stand out", str(count), ""),
    ]
    if p.batch_p:
        differ = len(p.batches_differ)
        tiles.append(("parameters in which batches differ", str(differ), f"of {len(p.batch_p)}"))
    if p.drift_p:
        tiles.append(("parameters that drift", str(len(p.drifting)), f"of {len(p.drift_p)}"))
    return tiles


def _plots(page: Document, p: Population) -> None:
    counts = {s.estimates.name: 0 for s in p.spreads}
    for o in p.outliers:
        counts[o.parameter] += 1
    shown = sorted(p.spreads, key=lambda s: -counts[s.estimates.name])[:_MOST_PLOTS]
    page.paragraph(
        "Bars are 95 % intervals of each device; lines are the mean and where 95 % of the devices"
        " lie. Devices that stand out are those of the table, with their names.",
        "note",
    )
    page.pictures(
        [Picture(s.estimates.name, spread_plot(p, s), s.estimates.meaning) for s in shown]
    )


def _batches(page: Document, p: Population) -> None:
    if p.batches_differ:
        page.section("Batches")
        page.table(batch_table(p))
    if p.drifting:
        page.section("Drift over the date")
        page.table(drift_table(p))
        page.pictures(
            [
                Picture(f"{s.estimates.name} over the date", drift_plot(p, s))
                for s in p.spreads
                if s.estimates.name in p.drifting
            ]
        )
