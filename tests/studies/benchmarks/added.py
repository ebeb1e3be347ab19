"""The benchmark `added`: an effect of an independent plant on top of what a measured record has.

The plant plays the record's own voltage with the effect and without it; the difference, scaled to
the record's stroke, is added to what was measured. What the record has by itself stays.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from psa_casadi import datasets
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.records.drive import reversals
from psa_casadi.records.record import Record
from psa_casadi.report.words.tables import Table
from tests.studies.benchmarks.hidden_cases import names_of
from tests.studies.benchmarks.table import (
    Outcome,
    Progress,
    TitledTable,
    on_all_cores,
    share,
    table_of,
)
from tests.studies.plants.base import simulate_base
from tests.studies.plants.hide import hide
from tests.studies.plants.stack import FloatArray, draw_stack
from tests.studies.plants.table import HIDDEN_EFFECTS, KNOWN, called
from tests.studies.plants.visibility import base_directions

#: The first of the seeds, which no other benchmark uses; samples of an excerpt; excerpts.
FIRST, LENGTH, EXCERPTS = 620401, 2400, 2
#: Rms of what is added and the base cannot absorb, over what the extended model of the record as it
#: was measured leaves.
SIZE = 3.0
#: Samples in which the plant's voltage rises from zero to where an excerpt begins.
_LEAD = 400


@dataclass(frozen=True)
class Added:
    """What was said of an excerpt as it was measured, and with an effect on top.

    `own` are the names and their sets without the effect; `named` and `within` those with it.
    """

    record: str
    effect: str
    own: tuple[str, ...]
    verdict: str
    named: tuple[str, ...]
    within: tuple[str, ...]

    @property
    def right(self) -> bool:
        """Whether the effect is in a named set."""
        return called(self.effect) in self.within

    def __str__(self) -> str:
        """Return case and answer in a line."""
        return f"{self.record} with {self.effect}: {', '.join(self.within)}"

    @property
    def wrong(self) -> tuple[str, ...]:
        """Causes that neither the record has by itself nor the effect is."""
        return tuple(n for n in self.named if n not in (*self.own, called(self.effect)))

    @property
    def alone(self) -> bool:
        """Whether one wrong cause is named as the only one, with nothing left."""
        return self.verdict == "cause_named" and self.named == self.wrong and len(self.named) == 1


def run(progress: Progress, quick: bool) -> Outcome:
    """Diagnose excerpts of the measured records as they are and with every effect on top."""
    effects = [e for e in KNOWN if HIDDEN_EFFECTS[e].room is None][:: 5 if quick else 1]
    pieces = excerpts(1 if quick else EXCERPTS)[: 1 if quick else None]
    plain = on_all_cores(said_of, [(p,) for p in pieces], lambda one: ", ".join(one[0]), progress)
    jobs = [
        (piece, effect, FIRST + 100 * k + j, *own)
        for k, (piece, own) in enumerate(zip(pieces, plain, strict=True))
        for j, effect in enumerate(effects)
    ]
    found = on_all_cores(with_effect, jobs, str, progress)
    each = table_of(
        "What was said of each",
        found,
        {
            "record": lambda f: f.record,
            "named by itself": lambda f: ", ".join(f.own) or "-",
            "added": lambda f: f.effect,
            "verdict": lambda f: f.verdict,
            "named": lambda f: ", ".join(f.within) or "-",
        },
    )
    return Outcome((summary(found), each))


def excerpts(each: int) -> list[Record]:
    """Return excerpts of the measured records, each from a reversal on."""
    rng = np.random.default_rng(FIRST)
    found = []
    for record in datasets.micromanipulator():
        turns = [t for t in reversals(record.voltage) if t + LENGTH <= record.n]
        for start in np.sort(rng.choice(turns, each, replace=False)).tolist():
            piece = record.slice(start, start + LENGTH)
            found.append(replace(piece, name=f"{record.name} from {record.time[start]:.1f} s"))
    return found


def said_of(record: Record) -> tuple[tuple[str, ...], float]:
    """Return all that is named of a record, and what its extended model leaves, rms [m]."""
    d = diagnose([record])
    return names_of(d)[1], d.extended_errors.holdout_rms_m


def with_effect(record: Record, effect: str, seed: int, own: tuple[str, ...], left: float) -> Added:
    """Diagnose a record with an effect on top of what it has by itself."""
    more = difference(record, effect, seed, SIZE * left)
    d = diagnose([replace(record, displacement=np.asarray(record.displacement) + more)])
    named, within = names_of(d)
    return Added(record.name, effect, own, d.verdict, named, within)


def difference(record: Record, effect: str, seed: int, size: float) -> FloatArray:
    """Return what an effect adds to a plant's displacement at a record's voltage (n,) [m].

    The plant's voltage is the record's over its range; `size` [m] is the rms of what a base model
    cannot absorb.
    """
    rng = np.random.default_rng(seed)
    stack = draw_stack(rng)
    v, step = record.voltage, record.sample_time
    command = stack.u_rated * (v - v.min()) / float(np.ptp(v))
    lead = command[0] * 0.5 * (1.0 - np.cos(np.pi * np.arange(_LEAD) / _LEAD))
    played: FloatArray = np.concatenate([lead, command])
    times: FloatArray = step * np.arange(played.size, dtype=np.float64)
    run = simulate_base(stack, times, played)
    scale = record.range_m / float(np.ptp(run.displacement[_LEAD:]))
    hidden = hide(
        HIDDEN_EFFECTS[effect], run, rng, base_directions(run), size / scale, 1.0, visible=1.0
    )
    return np.asarray(scale * hidden.added[_LEAD:], dtype=np.float64)


def summary(found: Sequence[Added]) -> TitledTable:
    """Return how often the effect is named, and how often another one that is not there."""
    new = [f for f in found if called(f.effect) not in f.own]
    rows = (
        ("the effect in a named set", "-", share(sum(f.right for f in new), len(new))),
        ("a single wrong name", "at most 2 %", share(sum(f.alone for f in new), len(new))),
        ("any cause that the record has not by itself", "-",
         share(sum(bool(f.wrong) for f in new), len(new))),
    )  # fmt: skip
    return TitledTable(
        "An effect added to a measured record",
        Table(("figure", "asked", "reached"), rows),
        f"{len(found) - len(new)} of {len(found)} effects are named of the record by itself and do"
        f" not count. What is added is {SIZE:g} times what the extended model of the record leaves,"
        " beside what the base can absorb.",
    )
