"""What to do after a diagnosis: which further records tell causes apart."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.diagnosis.result import Cause, NextExperiment, Verdict
from psa_casadi.notes import Note, note
from psa_casadi.records.quality.repeats import repeats
from psa_casadi.records.quality.repetitions import held
from psa_casadi.records.record import Record
from psa_casadi.records.stretches import counts, loop_sizes

#: A hold lasts so long [s]; the durations of the largest rises lie in so many bands, each a factor
#: of four wide, and loops have so many sizes.
_HOLD, _RATES, _SIZES = 3.0, 2, 3


def next_experiment(
    causes: Sequence[Cause],
    verdict: Verdict,
    alike: Sequence[Sequence[str]],
    records: Sequence[Record],
    *,
    doubted: bool,
) -> NextExperiment:
    """Return what to do next; `alike` are groups of effects that only a resonance tells apart."""
    if verdict == "not_driven":
        return NextExperiment(None, (), (note("correct_columns"),))
    if doubted:
        return NextExperiment(None, (), (note("record_again"),))
    open_ones = [(c.effect, *c.cannot_be_told_from) for c in causes if c.cannot_be_told_from]
    rivals = tuple(dict.fromkeys(n for own in open_ones for n in own))
    same = [own for own in open_ones if any(set(own) <= set(group) for group in alike)]
    steps = [note("same_curve", effects=own) for own in same]
    if verdict in ("unexplained", "partly_explained") or len(same) < len(open_ones):
        steps.append(useful_records(records))
    if steps:
        return NextExperiment(None, rivals, tuple(steps))
    return NextExperiment(None, (), (note("no_next"),))


def useful_records(records: Sequence[Record]) -> Note:
    """Return what to record next: what of holds, rates, amplitudes and repeats is lacking.

    Where nothing is, other conditions or quantities must decide.
    """
    span = max(float(np.ptp(r.voltage)) for r in records)
    kinds = counts(records, [np.ones(r.n, dtype=bool) for r in records], span)
    moves = [k for k in kinds if k.way]
    largest = max((k.size for k in moves), default=0)
    holds = max((float(r.time[b - 1] - r.time[a]) for r in records for a, b in held(r)), default=0)
    there = {
        "hold": holds >= _HOLD,
        "rates": len({k.band for k in moves if k.size == largest}) >= _RATES,
        "amplitudes": loop_sizes(records, span) >= _SIZES,
        "repeats": any(repeats(r) is not None for r in records),
    }
    lacking = tuple(what for what, found in there.items() if not found)
    return note("lacking", what=lacking) if lacking else note("other_conditions")
