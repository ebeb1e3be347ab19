"""The benchmark `fuzz`: damaged inputs, kills and hostile surroundings, counted; none may fail."""

import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from psa_casadi import InputError
from psa_casadi.cli.failures import guarded
from psa_casadi.cli.screen import Quiet, set_quiet, show, working
from tests.studies.benchmarks.table import TitledTable
from tests.studies.fuzz import commands, fmus, readers, surroundings
from tests.studies.fuzz.campaign import KINDS, Tally, Target, replay, run

TARGETS: dict[str, Target] = {
    target.name: target
    for module in (readers, fmus, commands, surroundings)
    for target in module.TARGETS
}


def chosen_targets(names: Sequence[str]) -> list[Target]:
    """Return the targets that are named, by their names or those of their rooms; all for none.

    Raises InputError for a name that is neither.
    """
    known = {*TARGETS, *(t.room for t in TARGETS.values())}
    unknown = [n for n in names if n not in known]
    if unknown:
        raise InputError(
            f"There is no target '{unknown[0]}'; there are {', '.join(sorted(known))}."
        )
    return [t for t in TARGETS.values() if not names or t.name in names or t.room in names]


def tables(tally: Tally) -> list[TitledTable]:
    """Return what was counted by target, and the distinct failures, if there are any."""
    rows = []
    for name in (*(n for n in TARGETS if tally.inputs[n]), "all"):
        targets = [n for n in TARGETS if name in (n, "all")]
        inputs, accepted = (sum(c[n] for n in targets) for c in (tally.inputs, tally.accepted))
        seconds = sum(tally.seconds.get(n, 0.0) for n in targets)
        kinds = {kind: f"{sum(tally.kinds[n, kind] for n in targets):,}" for kind in KINDS}
        rows.append({
            "target": name, "inputs": f"{inputs:,}", "accepted": f"{accepted:,}", **kinds,
            "inputs per s of a core": f"{inputs / max(seconds, 1e-9):,.3g}",
        })  # fmt: skip
    counted = TitledTable(
        f"Inputs and failures, seed {tally.seed}",
        rows,
        "accepted: read or done without an error; all others were refused with a sentence.",
    )
    failures = [
        {"target": d.first.target, "kind": d.first.kind, "times": f"{d.times:,}",
         "the first of them": " ".join(d.first.sentence.split())[:150], "input": d.first.index,
         "file": d.file or "-"}
        for d in tally.distinct.values()
    ]  # fmt: skip
    failed = TitledTable(
        "Distinct failures",
        failures,
        "Again, from the file: python -m tests.studies fuzz --replay FILE;"
        f" from the seed: fuzz --only TARGET --seed {tally.seed} --from INPUT --inputs 1.",
    )
    return [counted, failed] if failures else [counted]


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command(epilog="Example: python -m tests.studies fuzz --seconds 3600 --only readers,files")
@guarded
def fuzz(
    *,
    seconds: Annotated[
        float, typer.Option(help="How long all targets are attacked together [s].")
    ] = 60.0,
    inputs: Annotated[
        int | None, typer.Option(min=1, help="Inputs of each target, in place of a time.")
    ] = None,
    first: Annotated[int, typer.Option("--from", help="Number of the first input.")] = 0,
    seed: Annotated[int, typer.Option(help="Seed of the inputs.")] = 1,
    only: Annotated[
        str, typer.Option(help="Targets or rooms, such as readers,kills; by default all.")
    ] = "",
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
    set_quiet(quiet)
    if again is not None:
        tally = replay(again, TARGETS)
        for distinct in tally.distinct.values():
            show(distinct.first.detail)
    else:
        targets = chosen_targets([n.strip() for n in only.split(",") if n.strip()])
        each = None if inputs is None else {t.name: inputs for t in targets}
        for which in (
            signal.SIGINT,
            signal.SIGTERM,
        ):  # both end with a table, in the background too
            signal.signal(which, signal.default_int_handler)
        with working("attacking") as progress:
            tally = run(
                targets, seed, seconds=seconds if each is None else float("inf"), inputs=each,
                first=first, jobs=jobs, keep=keep, progress=progress,
            )  # fmt: skip
    for titled in tables(tally):
        show(f"\n{titled}")
    if tally.failures:
        raise typer.Exit(1)
