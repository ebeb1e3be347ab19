"""The table of subcommands."""

import inspect
import shlex
import sys
from collections.abc import Callable
from functools import partial
from typing import Annotated

import typer

from psa_casadi.cli.batch import batch, compare
from psa_casadi.cli.check import check
from psa_casadi.cli.demo import demo
from psa_casadi.cli.design import experiment, input_, mechanism
from psa_casadi.cli.diagnose import diagnose
from psa_casadi.cli.export import c, fmu, modelica, ssp
from psa_casadi.cli.failures import guarded, prepare
from psa_casadi.cli.identify import identify
from psa_casadi.cli.linearize import linearize
from psa_casadi.cli.lists import datasets, effects, examples, stacks
from psa_casadi.cli.options import command
from psa_casadi.cli.sample import sample
from psa_casadi.cli.simulate import simulate
from psa_casadi.cli.web import web
from psa_casadi.common.progress import typed
from psa_casadi.version import __version__

_group = partial(typer.Typer, no_args_is_help=True, rich_markup_mode=None)
app = _group(
    name="psa",
    help="Models of piezoelectric stack actuators: identify, diagnose what is missing, export.",
    epilog="Start with: psa demo",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
export = _group(help="Write a model in a format that other tools read.")
design = _group(help="Design an experiment, a voltage for a path, or a mounting.")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"psa_casadi {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and stop."
        ),
    ] = False,
) -> None:
    """Models of piezoelectric stack actuators: identify, diagnose what is missing, export."""


def _add(group: typer.Typer, *functions: Callable[..., None]) -> None:
    """Add commands; the list shows the whole first sentence, the help the example on one line."""
    for function in functions:
        about, _, example = (inspect.getdoc(function) or "").partition("\n\nExample:\n")
        kinds = [p.annotation for p in inspect.signature(function).parameters.values()]
        group.command(
            function.__name__.strip("_"),
            short_help=about.partition("\n\n")[0],
            epilog=f"\b\nExample: {' '.join(example.split())}" if example else None,
            context_settings={"allow_extra_args": typer.Context in kinds},
        )(command(function))


_add(app, demo, identify, sample, simulate, diagnose, batch, compare, effects, stacks)
_add(app, check, linearize, web, examples, datasets)
_add(export, fmu, modelica, c, ssp)
_add(design, experiment, mechanism, input_)
app.add_typer(export, name="export")
app.add_typer(design, name="design")


def main() -> None:
    """Run the command line."""
    prepare()
    typed.set(shlex.join(["psa", *sys.argv[1:]]))
    try:
        guarded(app)(prog_name="psa")
    except typer.Exit as end:  # of what fails outside the commands, such as writing the help
        sys.exit(end.exit_code)
