"""`python -m tests.studies`: the tables behind the project's figures, measured again."""

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from psa_casadi.cli.failures import guarded
from psa_casadi.cli.inputs import Given
from psa_casadi.cli.screen import Quiet, show, show_table, tell_written, working
from psa_casadi.errors import InputError
from psa_casadi.files import atomic_path, atomic_write
from psa_casadi.report.words.tables import Table
from tests.studies.benchmarks.table import BENCHES, Outcome, offers


def bench(
    name: Annotated[str | None, typer.Argument(help="Name of one benchmark.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer and smaller cases.")] = False,
    figure: Annotated[Path | None, typer.Option(help="Picture to write, PNG.")] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="The tables as JSON, to write.")
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(help="Folder of records of your own, in place of the public ones."),
    ] = None,
    size: Annotated[
        int | None, typer.Option(min=8, help="Number of cases, where a benchmark can vary it.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """List the benchmarks, or run one and print its tables."""
    if name is None:
        show_table(Table(("benchmark", "shows"), tuple(BENCHES.items())))
        return
    given = Given()
    ways = {"run_on": ("--folder", folder), "run_sized": ("--size", size)}
    if name not in BENCHES:
        given.add(f"There is no benchmark '{name}'; there are {', '.join(BENCHES)}.")
    for way, (option, value) in ways.items():
        if name in BENCHES and value is not None and offers(name, way) is None:
            given.add(f"{option}: '{name}' takes none; the list of benchmarks says which do.")
    given.outputs({"--figure": figure, "--json": json_file}, [])
    given.check()
    asked = [(way, value) for way, (_, value) in ways.items() if value is not None]
    way, value = (*asked, ("run", quick))[0]
    with working(f"benchmark {name}", quiet) as progress:
        outcome = offers(name, way)(progress, value)
    for titled in outcome.tables:
        show(f"\n{titled.title}\n", quiet)
        show_table(titled.table, quiet)
        show(f"\n{titled.note}" if titled.note else "", quiet)
    _write(outcome, figure, json_file)
    tell_written(figure, json_file, quiet=quiet)


def _write(outcome: Outcome, figure: Path | None, json_file: Path | None) -> None:
    if json_file is not None:
        tables = [
            {"title": t.title, "head": t.table.head, "rows": t.table.rows, "note": t.note}
            for t in outcome.tables
        ]
        atomic_write(json_file, json.dumps(tables, indent=2, ensure_ascii=False) + "\n")
    if figure is not None:
        if outcome.picture is None:
            raise InputError("This benchmark has no picture; leave --figure out.")
        with atomic_path(figure) as temporary:
            outcome.picture().savefig(temporary, dpi=150, format="png")


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
app.command(epilog="Example: python -m tests.studies identify --quick")(guarded(bench))

if __name__ == "__main__":
    if sys.argv[1:2] == ["fuzz"]:  # it has options of its own
        from tests.studies.benchmarks.fuzz import app as fuzz_app

        fuzz_app(sys.argv[2:], prog_name="python -m tests.studies fuzz")
    if sys.argv[1:2] == ["causes"]:
        from tests.studies.benchmarks.causes import app as causes_app

        causes_app(sys.argv[2:], prog_name="python -m tests.studies causes")
    app(prog_name="python -m tests.studies")
