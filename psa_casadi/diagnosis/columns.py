"""What each further column of the records decided: the search with it against one without it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from psa_casadi.component import Component
from psa_casadi.diagnosis.judgement import told_from
from psa_casadi.diagnosis.result import Decision, Verdict
from psa_casadi.diagnosis.screening import further_gains
from psa_casadi.diagnosis.search.steps import Step
from psa_casadi.diagnosis.task import Task
from psa_casadi.diagnosis.verdict import NAMING
from psa_casadi.identification.fitting.further import COLUMNS
from psa_casadi.identification.search.measured_load import LOAD, is_measured, without_column
from psa_casadi.notes import Note, note

#: The places that effects belong to, in the order in which they are told.
_PLACES = ("drive", "sensor", "plant", "environment")
#: Probability below which an effect is no rival.
_RIVAL = 0.01


def decisions(
    steps: Sequence[Step],
    task: Task,
    table: Sequence[Component],
    search: Callable[[Task], Sequence[Step]],
    verdict: Verdict,
) -> tuple[Decision, ...]:
    """Return what every fitted column, and a measured load, decided.

    `table` are all effects, `search` finds the steps of a task, `verdict` is that on `steps`. Each
    column costs a search.
    """
    experiments = task.experiments
    columns = [q.column for q in experiments[0].further]
    if is_measured(experiments):
        columns.append(LOAD)
    found = []
    for column in columns:
        task.progress(f"the same without {column}")
        effects = task.table
        if column == LOAD:
            effects = tuple(e for e in table if e in effects or e.measured_by == LOAD)
        alone = replace(
            task,
            experiments=without_column(experiments, column),
            table=effects,
            keep=lambda _: None,
            watch=lambda _: None,
        )
        found.append(_decision(column, steps, search(alone), effects, verdict))
    return tuple(found)


def _decision(
    column: str,
    steps: Sequence[Step],
    before: Sequence[Step],
    table: Sequence[Component],
    verdict: Verdict,
) -> Decision:
    first, last = steps[0].view.of, steps[-1].view.of
    now, then = _named(steps) if verdict in NAMING else {}, _named(before)
    effects = {e.name: e for e in table}
    k = next((k for k, f in enumerate(last.fit.further) if f.column == column), None)
    gained = further_gains(first.fit, last.fit, steps[-1].screening.colour).get(column, 0.0)
    ruled_out = tuple(n for n in then if n not in now)
    return Decision(
        column=column,
        role="input" if k is None else "output",
        unit="N" if k is None else COLUMNS[column].unit,
        noise=None if k is None else steps[-1].screening.colour.further[k].rms,
        base_rms=None if k is None else first.held_further[k],
        extended_rms=None if k is None else last.held_further[k],
        named=now,
        named_without=then,
        ruled_out=ruled_out,
        evidence=gained,
        outcome=decided(column, now, then, gained, effects, clear=verdict == "adequate"),
    )


def _named(steps: Sequence[Step]) -> dict[str, float]:
    """Return the named set of every cause, with the probability of each effect."""
    found: dict[str, float] = {}
    for step in steps:
        if step.chosen is None:
            continue
        for name in (step.cause.name, *told_from(step)):
            if step.probability.get(name, 0.0) >= _RIVAL:
                found.setdefault(name, step.probability[name])
    return found


def decided(
    column: str,
    now: Mapping[str, float],
    then: Mapping[str, float],
    gained: float,
    table: Mapping[str, Component],
    *,
    clear: bool,
) -> Note:
    """Return what a column decided, from what is named with it and without it.

    `clear` says that nothing is left to name with the column.
    """
    before = tuple(then.items())
    gone, new = [n for n in then if n not in now], tuple(n for n in now if n not in then)
    if not now and not then:
        return note("column_agrees" if clear else "column_decides_nothing", column=column)
    if not gone and not new:
        return note("column_adds", column=column, gained=gained)
    held = [n for n in gone if n in table and table[n].measured_by == column]
    if held and not now and clear:
        return note("column_holds", column=column, effect=held[0], before=before)
    if not gone:
        return note("column_names", column=column, new=new, then=tuple(then))
    if not now:
        return note("column_clears", column=column, before=before)
    kept = {table[n].belongs_to for n in now if n in table}
    lost = {table[n].belongs_to for n in gone if n in table} - kept
    places = tuple(p for p in _PLACES if p in lost)
    return note(
        "column_rules_out",
        column=column, places=places, effects=tuple(gone), now=tuple(now), before=before,
    )  # fmt: skip
