"""The benchmark `excerpts`: what a diagnosis does with pieces of measured records, spoilt.

Cut anywhere, at any length, decimated, scaled by powers of ten, with either column's sign turned:
each must end with a verdict, or be refused in a sentence, and its model must predict the piece.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from time import process_time

import numpy as np

from psa_casadi import datasets
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.errors import InputError
from psa_casadi.records.record import Record
from psa_casadi.report.words.tables import Table
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, on_all_cores

#: The seed, which no other benchmark uses; pieces; their samples.
SEED, PIECES, QUICK_PIECES, LENGTHS = 740501, 200, 6, (300, 2500)
#: Scales of the displacement, units mistaken by a power of ten among them; every so many samples
#: are kept of long pieces.
_SCALES, _KEPT, _LONG = (1.0, 1.0, 1.0, 10.0, 1e3, 1e-3), (1, 1, 2, 5), 1500
#: Shares of pieces whose displacement or voltage is turned round.
_TURNED, _FLIPPED = 0.15, 0.15


@dataclass(frozen=True)
class Ended:
    """How the diagnosis of a piece ended: a verdict, `refused` or `crashed`, and what was said."""

    piece: str
    how: str
    said: str
    seconds: float


def run(progress: Progress, quick: bool) -> Outcome:
    """Diagnose spoilt pieces of the measured records."""
    every = pieces(datasets.micromanipulator(), QUICK_PIECES if quick else PIECES)
    jobs = [(piece,) for piece in every]
    found = on_all_cores(ended_of, jobs, lambda e: f"{e.piece}: {e.how}", progress)
    return Outcome((table(found),))


def pieces(records: Sequence[Record], count: int) -> list[Record]:
    """Return so many pieces of records, in turn, each named for what was done to it."""
    rng = np.random.default_rng(SEED)
    found = []
    for k in range(count):
        whole = records[k % len(records)]
        length = int(rng.integers(LENGTHS[0], min(LENGTHS[1], whole.n)))
        first = int(rng.integers(0, whole.n - length + 1))
        keep = int(rng.choice(_KEPT)) if length > _LONG else 1
        scale = float(rng.choice(_SCALES)) * float(
            rng.choice([-1.0, 1.0], p=[_TURNED, 1 - _TURNED])
        )
        sign = float(rng.choice([-1.0, 1.0], p=[_FLIPPED, 1 - _FLIPPED]))
        part = whole.slice(first, first + length)
        name = f"{whole.name} {first}:{first + length}:{keep}, x {scale:g}, v {sign:+g}"
        shown = np.asarray(part.displacement)
        found.append(
            Record(
                name=name,
                time=part.time[::keep],
                voltage=sign * part.voltage[::keep],
                displacement=scale * shown[::keep],
            )
        )
    return found


def ended_of(piece: Record) -> Ended:
    """Diagnose a piece; any error but a refusal in words is a crash."""
    begin = process_time()
    try:
        d = diagnose([piece])
        finite = all(np.all(np.isfinite(y)) for y in (*d.base, *d.extended))
        how: str = d.verdict if finite and d.to_json() else "crashed"
        said = ", ".join(c.effect for c in d.causes)
    except InputError as error:
        how, said = "refused", str(error)
    except Exception as error:  # noqa: BLE001 - what is counted here
        how, said = "crashed", f"{type(error).__name__}: {error}"
    return Ended(piece.name, how, said, process_time() - begin)


def table(found: Sequence[Ended]) -> TitledTable:
    """Return how the pieces ended, and what was said of those that were refused or crashed."""
    counts = Counter(e.how for e in found)
    counts["crashed"] += 0
    rows = [(how, f"{n}", "") for how, n in sorted(counts.items())]
    said = Counter(
        (e.how, e.said.split(";")[0][:80]) for e in found if e.how in ("refused", "crashed")
    )
    rows += [(f"{how} because", f"{n}", text) for (how, text), n in sorted(said.items())]
    slowest = max(found, key=lambda e: e.seconds)
    return TitledTable(
        f"{len(found)} spoilt pieces of measured records",
        Table(("ended", "pieces", "said"), tuple(rows)),
        f"The slowest took {slowest.seconds:.0f} s of processor time: {slowest.piece}.",
    )
