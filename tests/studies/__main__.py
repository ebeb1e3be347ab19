"""`python -m tests.studies`: the tables behind the project's figures, measured again."""

import json
import sys
from inspect import signature
from pathlib import Path
from typing import Annotated

import typer

from psa_casadi import InputError
from psa_casadi.cli.failures import guarded
from psa_casadi.cli.screen import Quiet, set_quiet, show, show_table, show_written, working
from psa_casadi.report.words.tables import Table
from tests.studies.benchmarks.table import BENCHES, bench


def study(
    name: Annotated[str | None, typer.Argument(help="Name of one benchmark.")] = None,
    *,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer and smaller cases.")] = False,
    figure: Annotated[Path | None, typer.Option(help="Picture to write, PNG.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="The tables as JSON.")] = None,
    folder: Annotated[
        Path | None, typer.Option(help="Records in place of the public ones.")
    ] = None,
    size: Annotated[
        int | None, typer.Option(min=8, help="Number of cases, where a benchmark can vary it.")
    ] = None,
    only: Annotated[
        str | None, typer.Option(help="Pattern of the cases, where a benchmark has named ones.")
    ] = None,
    seed: Annotated[
        list[int] | None, typer.Option(min=0, help="Draw of fresh seeds; may be repeated.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """List the benchmarks, or run one and print its tables."""
    if name is None:
        show_table(Table(("benchmark", "shows"), tuple(BENCHES.items())))
        return
    if name not in BENCHES:
        raise InputError(f"There is no benchmark '{name}'; there are {', '.join(BENCHES)}.")
    set_quiet(quiet)
    run = bench(name)
    options = {"folder": folder, "size": size, "only": only, "seed": seed}
    table = {k: v for k, v in options.items() if v is not None}
    for option in table:
        if option not in signature(run).parameters:
            raise InputError(
                f"--{option}: '{name}' takes none; the list of benchmarks names those that do."
            )
    with working(f"benchmark {name}") as progress:
        outcome = run(progress, quick, **table)
    for titled in outcome.tables:
        show(f"\n{titled.title}\n")
        show_table(titled.table)
        show(f"\n{titled.note}" if titled.note else "")
    if json_file is not None:
        content = [{"title": t.title, "rows": t.rows, "note": t.note} for t in outcome.tables]
        json_file.write_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", "utf-8")
    if figure is not None:
        if outcome.picture is None:
            raise InputError("This benchmark has no picture; leave --figure out.")
        outcome.picture().savefig(figure, dpi=150, format="png")
    show_written(figure, json_file)


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
app.command(epilog="Example: python -m tests.studies identify --quick")(guarded(study))

if __name__ == "__main__":
    command = bench(sys.argv[1], "app") if sys.argv[1:] else None  # with further options
    if command is not None:
        command(sys.argv[2:], prog_name=f"python -m tests.studies {sys.argv[1]}")
    app(prog_name="python -m tests.studies")
