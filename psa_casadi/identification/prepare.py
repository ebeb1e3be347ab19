"""What is done to a record before it is fitted: readings masked, put on one clock, averaged."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.identification.start.doubts import static_slope
from psa_casadi.identification.start.two_clocks import on_one_clock
from psa_casadi.records.decimate import decimated
from psa_casadi.records.noise import fast_noise
from psa_casadi.records.record import Record
from psa_casadi.records.split import MOST
from psa_casadi.records.suspects import cleaned, masked, suspects


def as_read(record: Record) -> Record:
    """Return the record with suspect samples masked and its readings on one clock."""
    return on_one_clock(cleaned(record))[0]


def prepared(record: Record) -> tuple[Record, tuple[str, ...]]:
    """Return the record to fit, and sentences on what was done to it.

    Outliers, drop-outs and a stuck sensor are masked; where the sampling is so fast that block
    averages lose nothing, they take the samples' place.
    """
    found = suspects(record)
    clean, clocks = on_one_clock(masked(record, found))
    said = [*found.sentences(record.name), *clocks]
    shorter, averages = _averaged(clean)
    return shorter, (*said, *averages)


def averaged(records: Sequence[Record]) -> tuple[list[Record], list[str]]:
    """Return records with block averages where these lose nothing, and sentences that tell it.

    As they are where all of their samples can be fitted.
    """
    if sum(r.n for r in records) <= MOST:
        return list(records), []
    ready = [_averaged(r) for r in records]
    return [r for r, _ in ready], [s for _, said in ready for s in said]


def _averaged(record: Record) -> tuple[Record, tuple[str, ...]]:
    """Return a record of block averages, where they lose nothing, and a sentence that tells it."""
    y = measured(record)
    noise, slope = fast_noise(y[np.isfinite(y)]), static_slope([record])
    if noise <= 0 or slope == 0:
        return record, ()
    shorter, factor = decimated(record, noise, slope)
    if factor == 1:
        return record, ()
    return shorter, (
        f"{record.name}: {record.n} samples are averaged in blocks of {factor}, which loses"
        " nothing of voltage or displacement beyond a tenth of the noise.",
    )
