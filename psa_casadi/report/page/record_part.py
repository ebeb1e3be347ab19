"""The part of a page that shows the records one by one, within the size a page may have."""

from collections.abc import Sequence

from psa_casadi.report.page.document import Document
from psa_casadi.report.page.packed import Picture
from psa_casadi.report.plots.figure import record_figure
from psa_casadi.report.plots.residual_plots import (
    autocorrelation_plot,
    distribution_plot,
    error_loop_plot,
    loop_plot,
    spectrum_plot,
    time_plot,
    zoom_plot,
)
from psa_casadi.report.words.fit_words import residual_sentence
from psa_casadi.report.words.phrases import listing
from psa_casadi.report.words.series import ResidualFigures, Series, most_telling

#: Samples of all records that may be drawn together: with all their curves about 0.5 MB of text.
_MOST_POINTS = 13_000
#: Records that are drawn; of more, those that the model misses most.
MOST_RECORDS = 16


def add_records(
    page: Document,
    series: Sequence[Series],
    figures: Sequence[ResidualFigures],
    origin: str,
    *,
    above: str = "",
) -> None:
    """Add every record: time and residual, loop, window, and what the last curve leaves.

    `figures` are those of the last curve's residual in each record; `above` names the record whose
    time and residual the page shows already.
    """
    shown = _worst(figures)
    if len(shown) < len(series):
        page.paragraph(
            f"Of {len(series)} records these {len(shown)} are drawn, which the model misses by the"
            " largest share of their range.",
            "note",
        )
    for k in shown:
        _add(page, series[k], figures[k], origin, points_each(len(shown)), above)


def add_worst(page: Document, series: Sequence[Series], origin: str) -> None:
    """Add the record that the first model misses most: curves above, residual below."""
    s = most_telling(series)
    add_still(page, s, origin)
    curves = listing([origin, *(c.label for c in s.curves)])
    noise = "Below: the residual; dashed: two standard deviations of the noise."
    shaded = " Shaded: held out." if s.held_out.any() else ""
    plot = time_plot(s, origin, points_each(len(series)))
    page.picture(Picture(f"{s.name}: {curves}", plot, f"{noise}{shaded}"))


def add_still(page: Document, shown: Series, origin: str) -> None:
    """Add what is seen of a record where no script runs: measured against model, loop, residual."""
    page.still(record_figure(shown, origin=origin), f"{shown.name}: {origin} and model")


def points_each(records: int) -> int:
    """Return how many samples of each record may be drawn, so that the page stays below 3 MB."""
    return _MOST_POINTS // min(MOST_RECORDS, max(1, records))


def _worst(figures: Sequence[ResidualFigures]) -> list[int]:
    order = sorted(range(len(figures)), key=lambda k: -figures[k].range_share)
    return sorted(order[:MOST_RECORDS])


def _add(
    page: Document, s: Series, figures: ResidualFigures, origin: str, limit: int, above: str
) -> None:
    page.heading(f"{s.name} ({origin})")
    page.paragraph(residual_sentence(figures, s.curves[-1].label, s.time_scale))
    shaded = " Shaded: held out." if s.held_out.any() else ""
    noise = "Dashed: two standard deviations of the noise."
    if s.name == above:
        page.paragraph(f"{s.title} and residual over time: at the top of the page.", "note")
    else:
        page.picture(
            Picture(
                f"{s.title}, and residual: {origin} minus model",
                time_plot(s, origin, limit),
                f"{noise}{shaded}",
            )
        )
    driver = s.against.partition(" [")[0]
    over_it = [
        Picture(f"Loop: {s.quantity} over {driver}", loop_plot(s, origin, limit)),
        Picture(f"Residual over {driver}", error_loop_plot(s, limit), noise),
    ]
    page.pictures(
        [
            *(over_it if driver else []),
            Picture("Where the difference is easiest to see", zoom_plot(s, origin, limit)),
            Picture(
                "Spectrum of the residual",
                spectrum_plot(s, limit),
                "Dashed: white noise of the record's noise level.",
            ),
            Picture(
                "Autocorrelation of the residual",
                autocorrelation_plot(s),
                "Dashed: 95 % of the lags of white noise lie between these lines.",
            ),
            Picture(
                "Distribution of the residual",
                distribution_plot(s),
                "Dashed: normal distribution of the same mean and standard deviation.",
            ),
        ]
    )
