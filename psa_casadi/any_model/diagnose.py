"""Diagnose any model: fit it, search for causes at its ports, judge."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from difflib import get_close_matches
from typing import Any

from psa_casadi.any_model.effects.table import effects_of
from psa_casadi.any_model.fit import refuse_unfit
from psa_casadi.any_model.hypothesis import Table
from psa_casadi.any_model.identify import (
    free_of,
    known_zeros,
    reweighted,
    search_starts,
    unlike,
    with_noise,
)
from psa_casadi.any_model.judge import judged
from psa_casadi.any_model.result import OdeDiagnosis
from psa_casadi.any_model.runs import runs_of, sized, sizes_of, told_of_columns
from psa_casadi.any_model.search import search
from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model
from psa_casadi.records.signals import Hold, signals_given


def diagnose_ode(
    model: Model,
    records: Any,
    *,
    holdout: Any = (),
    free: Sequence[str] | None = None,
    leave_out: Sequence[str] = (),
    starts: int = 8,
    zeros: Sequence[str] = (),
    known_start: bool = False,
    hold: Hold | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> OdeDiagnosis:
    """Find what a model gets wrong on its records, name the cause and its place, measure the gain.

    The model is fitted as by `identify`; then generic effects at its inputs, outputs and rates are
    searched by the score of a stack's diagnosis: evidence less 8 nats for every cause, confirmed by
    held-out samples. These are the records `holdout`, else a quarter of every record in blocks.
    `leave_out` names effects, or beginnings of their names such as "zero_of", that cannot be.
    Other words are those of `identify`.

    Raises InputError for records or names that do not fit, SimulationError where the model cannot
    be simulated at its values.
    """
    refuse_unfit(model)
    if model.effects:
        names = ", ".join(c.name for c in model.effects)
        raise InputError(
            f"The model '{model.name}' has effects already ({names}); diagnose it without them."
        )
    given = signals_given(records, hold)
    held = signals_given(holdout, hold, len(given) + 1) if _any(holdout) else []
    runs = runs_of(model, given, held)
    shifted = known_zeros(model, zeros)
    progress("fitting from several starts")
    base, runs, _ = search_starts(
        sized(model, runs), runs, free_of(model, free), starts=starts, zeros=shifted,
        known_start=known_start,
    )  # fmt: skip
    if base.interrupted:
        raise KeyboardInterrupt
    sizes = sizes_of(base.model, runs, base.starts())
    gone = (*leave_out, *(f"zero_of_{n}" for n in shifted))
    every = effects_of(base.model, sizes)
    _refuse_unknown(leave_out, [e.name for e in every])
    table = Table(base.model, tuple(e for e in every if not e.name.startswith(gone)))
    known = search(base, runs, table, progress)
    runs = with_noise(known.best().fit, runs)
    if unlike(runs, known.runs):
        progress("searching again, noise by record")
        known = search(reweighted(base, runs), runs, table, progress)
    progress("judging")
    found = judged(known)
    return replace(found, remarks=(*found.remarks, *told_of_columns(model, runs)))


def _any(given: Any) -> bool:
    return not (isinstance(given, tuple | list) and not given)


def _refuse_unknown(leave_out: Sequence[str], names: Sequence[str]) -> None:
    for name in leave_out:
        if not any(n.startswith(name) for n in names):
            near = get_close_matches(name, names, 3, 0.3) or names
            raise InputError(
                f"`leave_out` has '{name}', which begins the name of no effect; of the {len(names)}"
                f" there are, the nearest are {', '.join(near)}."
            )
