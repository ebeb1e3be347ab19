"""What to do after a diagnosis: which further records tell causes apart."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.diagnosis.result import Cause, NextExperiment, Verdict
from psa_casadi.diagnosis.search.contenders import same_curve_note
from psa_casadi.records.record import Record
from psa_casadi.records.repeats import held, repeats
from psa_casadi.records.split import counts, loop_sizes

#: A hold lasts so long [s]; the durations of the largest rises lie in so many bands, each a factor
#: of four wide, and loops have so many sizes.
_HOLD, _RATES, _SIZES = 3.0, 2, 3

_AGAIN = "Correct the record, or record again, so that what the verdict says of it no longer holds."
_COLUMNS = "Correct the record as the notes say, and diagnose it again."


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
        return NextExperiment(None, (), _COLUMNS)
    if doubted:
        return NextExperiment(None, (), _AGAIN)
    open_ones = [(c.effect, *c.cannot_be_told_from) for c in causes if c.cannot_be_told_from]
    rivals = tuple(dict.fromkeys(n for own in open_ones for n in own))
    same = [own for own in open_ones if any(set(own) <= set(group) for group in alike)]
    notes = [same_curve_note(own) for own in same]
    if verdict in ("unexplained", "partly_explained") or len(same) < len(open_ones):
        notes.append(useful_records(records))
    if notes:
        return NextExperiment(None, rivals, " ".join(notes))
    return NextExperiment(None, (), "None is needed for this verdict.")


def useful_records(records: Sequence[Record]) -> str:
    """Say what to record next: what of holds, rates, amplitudes and repeats is lacking.

    Where nothing is, other conditions or quantities must decide.
    """
    span = max(float(np.ptp(r.voltage)) for r in records)
    kinds = counts(records, [np.ones(r.n, dtype=bool) for r in records], span)
    moves = [k for k in kinds if k.way]
    largest = max((k.size for k in moves), default=0)
    holds = max((float(r.time[b - 1] - r.time[a]) for r in records for a, b in held(r)), default=0)
    lacking = []
    if holds < _HOLD:
        lacking.append("a hold of several seconds, which separates creep and drift")
    if len({k.band for k in moves if k.size == largest}) < _RATES:
        lacking.append("the same loop at three rates, which separate delay, lag and creep")
    if loop_sizes(records, span) < _SIZES:
        lacking.append("the loop at three amplitudes, which separate asymmetry and memory")
    if all(repeats(r) is None for r in records):
        lacking.append("a voltage that repeats, which shows the noise")
    if lacking:
        *before, last = lacking
        joined = f"{'; '.join(before)}; and {last}" if before else last
        return f"Record what these records lack: {joined}."
    return (
        "These records hold what usually separates causes: a hold, several rates and amplitudes,"
        " repeats. Record the same voltage with another load, mean voltage or sensor, or a further"
        " column (current, charge, a second displacement)."
    )
