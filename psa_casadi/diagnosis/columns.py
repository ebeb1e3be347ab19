"""What each further column of the records decided: the search with it against one without it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from psa_casadi.component import Component
from psa_casadi.diagnosis.judgement import told_from
from psa_casadi.diagnosis.result import Decision, Verdict
from psa_casadi.diagnosis.screening.evidence import further_gains
from psa_casadi.diagnosis.search.steps import Step
from psa_casadi.diagnosis.task import Task
from psa_casadi.diagnosis.verdict import NAMING
from psa_casadi.identification.fitting.further import COLUMNS
from psa_casadi.identification.search import LOAD, is_measured, without_column

#: What the places are called that effects belong to.
PLACES = {
    "drive": "the amplifier",
    "sensor": "the sensor",
    "plant": "the stack with its load",
    "environment": "the surroundings",
}
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
    words = {e.name: e for e in table}
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
        sentence=decision_sentence(column, now, then, gained, words, clear=verdict == "adequate"),
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


def decision_sentence(
    column: str,
    now: Mapping[str, float],
    then: Mapping[str, float],
    gained: float,
    table: Mapping[str, Component],
    *,
    clear: bool,
) -> str:
    """Say in words what a column decided, from what is named with it and without it.

    `clear` says that nothing is left to name with the column.
    """
    before = ", ".join(f"{n} {100 * p:.0f} %" for n, p in then.items())
    gone, new = [n for n in then if n not in now], [n for n in now if n not in then]
    if not now and not then:
        agrees = "agrees with the model" if clear else "decides nothing"
        return f"{column} {agrees}: with it as without it nothing is named."
    if not gone and not new:
        return f"{column} changes no name; it adds {gained:.0f} to the ln of the Bayes factor."
    held = [n for n in gone if n in table and table[n].measured_by == column]
    if held and not now and clear:
        return (
            f"{column} explains by itself what without it is named ({before}): {held[0]} is in the"
            " column."
        )
    if not gone:
        return f"Only with {column} is there {_joined(new)}; without it {_joined(then)}."
    if not now:
        return f"With {column} nothing is named; without it {before}."
    kept = {table[n].belongs_to for n in now if n in table}
    places = [p for p in PLACES if p not in kept and any(_of(table, n) == p for n in gone)]
    ruled = [PLACES[p] for p in places] or gone
    verb = "is" if len(ruled) == 1 else "are"
    return (
        f"With {column} {' and '.join(ruled)} {verb} ruled out: what is left is {_joined(now)}"
        f" (without it: {before})."
    )


def _of(table: Mapping[str, Component], name: str) -> str:
    return table[name].belongs_to if name in table else ""


def _joined(names: Sequence[str] | Mapping[str, float]) -> str:
    return " or ".join(names) or "nothing is named"
