"""What held-out samples can be asked: whether the fitted ones show the same kinds of stretch."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.diagnosis.held_out.confirmation import too_few_held_out
from psa_casadi.notes import Note, note
from psa_casadi.records.split import Experiment
from psa_casadi.records.stretches import Kind, counts

#: Shares of the samples, and of the voltage's span, that are worth a word.
_SAMPLES, _SPAN = 0.02, 0.01


def coverage_notes(experiments: Sequence[Experiment]) -> tuple[Note, ...]:
    """Return what the held-out figure does not rest on; none where all is shown.

    There may be too few of them. It extrapolates where held-out samples have kinds of stretch that
    no fitted sample shows, and where their voltage goes beyond the fitted one. It says nothing of
    kinds that are not held out.
    """
    records = [e.record for e in experiments]
    voltage = np.concatenate([r.voltage for r in records])
    span = float(np.ptp(voltage))
    fitted = counts(records, [e.used for e in experiments], span)
    held = counts(records, [e.held_out for e in experiments], span)
    few = too_few_held_out(experiments)
    if not fitted or few is not None:
        return () if few is None else (note("held_out_says_little", why=few),)
    notes = []
    for code, asked, known in (
        ("extrapolates", held, fitted), ("not_held_out", fitted, held),
    ):  # fmt: skip
        share, kinds = _without_like(asked, known)
        if share > _SAMPLES:
            notes.append(note(code, share=share, kinds=kinds))
    used = np.concatenate([e.record.voltage[e.used] for e in experiments])
    judged = np.concatenate([e.record.voltage[e.held_out] for e in experiments])
    low, high, least, most = (float(f(v)) for v in (used, judged) for f in (np.min, np.max))
    if max(low - least, most - high) > _SPAN * span:
        notes.append(note("voltages_beyond", least=least, most=most, low=low, high=high))
    return tuple(notes)


def _without_like(asked: dict[Kind, int], known: dict[Kind, int]) -> tuple[float, tuple[str, ...]]:
    """Return the share of samples whose kind is not near any `known` one, and the largest kinds."""
    alone = {k: n for k, n in asked.items() if not any(k.near(other) for other in known)}
    first = sorted(alone, key=lambda k: -alone[k])[:2]
    return sum(alone.values()) / sum(asked.values()), tuple(k.words for k in first)
