"""What held-out samples can be asked: whether the fitted ones show the same kinds of stretch."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.diagnosis.held_out.confirmation import too_few_held_out
from psa_casadi.records.split import Experiment, Kind, counts

#: Shares of the samples, and of the voltage's span, that are worth a word.
_SAMPLES, _SPAN = 0.02, 0.01


def coverage_notes(experiments: Sequence[Experiment]) -> tuple[str, ...]:
    """Return what the held-out figure does not rest on, in sentences; none where all is shown.

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
    if not fitted or few:
        return (f"{few[0].upper()}{few[1:]}: the held-out error says little.",) if few else ()
    notes = []
    share, kinds = _without_like(held, fitted)
    if share > _SAMPLES:
        notes.append(
            f"{100 * share:.0f} % of the held-out samples are of a kind that no fitted sample shows"
            f" ({kinds}): there the held-out error extrapolates."
        )
    share, kinds = _without_like(fitted, held)
    if share > _SAMPLES:
        notes.append(
            f"{100 * share:.0f} % of the fitted samples are of a kind that is not held out"
            f" ({kinds}): the held-out error says nothing of it."
        )
    known = np.concatenate([e.record.voltage[e.used] for e in experiments])
    asked = np.concatenate([e.record.voltage[e.held_out] for e in experiments])
    low, high = float(known.min()), float(known.max())
    if max(low - float(asked.min()), float(asked.max()) - high) > _SPAN * span:
        notes.append(
            f"Held-out voltages go from {asked.min():.4g} to {asked.max():.4g} V, fitted ones from"
            f" {low:.4g} to {high:.4g} V: beyond these the held-out error extrapolates."
        )
    return tuple(notes)


def _without_like(asked: dict[Kind, int], known: dict[Kind, int]) -> tuple[float, str]:
    """Return the share of samples whose kind is not near any `known` one, and the largest kinds."""
    alone = {k: n for k, n in asked.items() if not any(k.near(other) for other in known)}
    first = sorted(alone, key=lambda k: -alone[k])[:2]
    return sum(alone.values()) / sum(asked.values()), " and ".join(k.words for k in first)
