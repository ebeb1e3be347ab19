"""All targets, and the tables of what a campaign counted."""

from collections.abc import Sequence

from psa_casadi.errors import InputError
from psa_casadi.report.words.tables import Table
from tests.benchmarks.table import TitledTable
from tests.fuzz import (
    archives,
    binaries,
    blobs,
    cache,
    checks,
    environments,
    kills,
    laboratory,
    models,
    readers,
)
from tests.fuzz.campaign import Tally
from tests.fuzz.target import KINDS, Target

TARGETS: dict[str, Target] = {
    target.name: target
    for module in (
        readers,
        laboratory,
        models,
        binaries,
        archives,
        checks,
        blobs,
        kills,
        environments,
        cache,
    )
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
    counted = _counts(tally)
    return (counted, _failures(tally)) if tally.failures else (counted,)


def _counts(tally: Tally) -> TitledTable:
    names = [n for n in TARGETS if tally.inputs[n]]
    rows = []
    for name in names:
        failures = [tally.kinds[name, kind] for kind in KINDS]
        rows.append(
            _row(name, tally.inputs[name], tally.accepted[name], failures, tally.seconds[name])
        )
    failures = [sum(tally.kinds[n, kind] for n in names) for kind in KINDS]
    sums = (tally.inputs.total(), tally.accepted.total())
    rows.append(_row("all", *sums, failures, sum(tally.seconds.values())))
    head = ("target", "inputs", "accepted", *KINDS, "inputs per s of a core")
    return TitledTable(
        f"Inputs and failures, seed {tally.seed}",
        Table(head, tuple(rows)),
        "accepted: read or done without an error; all others were refused with a sentence.",
    )


def _row(
    name: str, inputs: int, accepted: int, failures: Sequence[int], seconds: float
) -> tuple[str, ...]:
    rate = f"{inputs / seconds:,.3g}" if seconds < inputs else f"{inputs / max(seconds, 1e-9):.2g}"
    return (name, f"{inputs:,}", f"{accepted:,}", *(f"{n:,}" for n in failures), rate)


def _failures(tally: Tally) -> TitledTable:
    rows = [
        (
            d.first.target,
            d.first.kind,
            f"{d.times:,}",
            " ".join(d.first.sentence.split())[:150],
            f"{d.first.index}",
            str(d.file or "-"),
        )
        for d in tally.distinct.values()
    ]
    head = ("target", "kind", "times", "the first of them", "input", "file")
    return TitledTable(
        "Distinct failures",
        Table(head, tuple(rows)),
        "Again, from the file: python -m tests.benchmarks fuzz --replay FILE;"
        f" from the seed: fuzz --only TARGET --seed {tally.seed} --from INPUT --inputs 1.",
    )
