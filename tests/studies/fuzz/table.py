"""All targets, and the tables of what a campaign counted."""

from collections.abc import Sequence

from psa_casadi.errors import InputError
from psa_casadi.report.words.tables import Table
from tests.studies.benchmarks.table import TitledTable
from tests.studies.fuzz import commands, fmus, readers, surroundings
from tests.studies.fuzz.campaign import KINDS, Tally, Target

TARGETS: dict[str, Target] = {
    target.name: target
    for module in (readers, fmus, commands, surroundings)
    for target in module.TARGETS
}


def chosen_targets(names: Sequence[str]) -> list[Target]:
    """Return the targets that are named, by their own names or those of their rooms; all for none.

    Raises InputError for a name that is neither.
    """
    known = {*TARGETS, *(t.room for t in TARGETS.values())}
    unknown = [n for n in names if n not in known]
    if unknown:
        raise InputError(
            f"There is no target '{unknown[0]}'; there are {', '.join(sorted(known))}."
        )
    return [t for t in TARGETS.values() if not names or t.name in names or t.room in names]


def tables(tally: Tally) -> tuple[TitledTable, ...]:
    """Return what was counted by target, and the distinct failures, if there are any."""
    rows = []
    for name in (*(n for n in TARGETS if tally.inputs[n]), "all"):
        own = [n for n in TARGETS if name in (n, "all")]
        inputs, accepted = (sum(c[n] for n in own) for c in (tally.inputs, tally.accepted))
        seconds = sum(tally.seconds[n] for n in own)
        failures = [sum(tally.kinds[n, kind] for n in own) for kind in KINDS]
        counts = [f"{n:,}" for n in (inputs, accepted, *failures)]
        rows.append((name, *counts, f"{inputs / max(seconds, 1e-9):,.3g}"))
    counted = TitledTable(
        f"Inputs and failures, seed {tally.seed}",
        Table(("target", "inputs", "accepted", *KINDS, "inputs per s of a core"), tuple(rows)),
        "accepted: read or done without an error; all others were refused with a sentence.",
    )
    if not tally.failures:
        return (counted,)
    found = tuple(
        (d.first.target, d.first.kind, f"{d.times:,}", " ".join(d.first.sentence.split())[:150],
         f"{d.first.index}", str(d.file or "-"))
        for d in tally.distinct.values()
    )  # fmt: skip
    failed = TitledTable(
        "Distinct failures",
        Table(("target", "kind", "times", "the first of them", "input", "file"), found),
        "Again, from the file: python -m tests.studies fuzz --replay FILE;"
        f" from the seed: fuzz --only TARGET --seed {tally.seed} --from INPUT --inputs 1.",
    )
    return counted, failed
