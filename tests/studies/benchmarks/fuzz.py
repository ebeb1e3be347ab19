"""The benchmark `fuzz`: damaged inputs, kills and hostile surroundings, counted; none may fail."""

import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from psa_casadi.cli.failures import guarded
from psa_casadi.cli.screen import Quiet, show, working
from psa_casadi.errors import InputError
from psa_casadi.report.words.tables import Table
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable
from tests.studies.fuzz import commands, fmus, readers, surroundings
from tests.studies.fuzz.campaign import KINDS, Amount, Tally, Target, replay
from tests.studies.fuzz.campaign import run as attack

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


_SECONDS, _QUICK_SECONDS = 60.0, 10.0


def run(progress: Progress, quick: bool) -> Outcome:
    """Attack everything for a minute, or for ten seconds."""
    amount = Amount(seconds=_QUICK_SECONDS if quick else _SECONDS)
    return Outcome(tables(attack(chosen_targets(()), 1, amount, progress=progress)))


def fuzz(
    *,
    seconds: Annotated[
        float, typer.Option(help="How long all targets are attacked together [s].")
    ] = _SECONDS,
    inputs: Annotated[
        int | None, typer.Option(help="Inputs of each target, in place of a time.")
    ] = None,
    first: Annotated[int, typer.Option("--from", help="Number of the first input.")] = 0,
    seed: Annotated[int, typer.Option(help="Seed of the inputs.")] = 1,
    only: Annotated[
        str | None,
        typer.Option(help="Targets or rooms, such as readers,kills; by default all."),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(help="Processes side by side; by default one for each core.")
    ] = None,
    keep: Annotated[Path, typer.Option(help="Folder for the inputs that fail.")] = Path(
        "fuzz_failures"
    ),
    again: Annotated[
        Path | None, typer.Option("--replay", help="A saved input to attack with once more.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Attack the package with damaged inputs; exit code 1 if anything fails."""
    if again is not None:
        tally = replay(again, TARGETS)
        for distinct in tally.distinct.values():
            show(distinct.first.detail, quiet)
    else:
        tally = _campaign(seconds, inputs, first, seed, only, jobs, keep, quiet)
    for titled in tables(tally):
        show(f"\n{titled}", quiet)
    if tally.failures:
        raise typer.Exit(1)


def _campaign(
    seconds: float, inputs: int | None, first: int, seed: int, only: str | None, jobs: int | None,
    keep: Path, quiet: bool,
) -> Tally:  # fmt: skip
    names = [n.strip() for n in (only or "").split(",") if n.strip()]
    targets = chosen_targets(names)
    if inputs is not None and inputs < 1:
        raise InputError(f"--inputs is {inputs}; give how many, at least 1.")
    each = None if inputs is None else dict.fromkeys([t.name for t in targets], inputs)
    amount = Amount(seconds if each is None else float("inf"), each, first)
    for which in (signal.SIGINT, signal.SIGTERM):  # both end with a table, also in the background
        signal.signal(which, signal.default_int_handler)
    with working("attacking", quiet) as progress:
        return attack(targets, seed, amount, jobs=jobs, keep=keep, progress=progress)


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
app.command(epilog="Example: python -m tests.studies fuzz --seconds 3600 --only readers,files")(
    guarded(fuzz)
)
