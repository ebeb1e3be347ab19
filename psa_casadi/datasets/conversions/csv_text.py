"""The CSV file of a record, as every conversion writes it."""

from collections.abc import Iterable

#: The columns of every record: time in s, voltage in V with six decimals, displacement in um with
#: four. Well above the rounding of double precision, so that every machine writes the same bytes.
_HEAD = "time [s],voltage [V],displacement [um]"


def csv_text(samples: Iterable[tuple[float, float]], sample_rate: float, decimals: int) -> bytes:
    """Return the file of samples of voltage [V] and displacement [um] at a rate [1/s].

    `decimals` are those of the time, which begins at 0.
    """
    rows = [_HEAD]
    for k, (voltage, displacement) in enumerate(samples):
        rows.append(f"{k / sample_rate:.{decimals}f},{voltage:.6f},{displacement:.4f}")
    return ("\n".join(rows) + "\n").encode("ascii")
