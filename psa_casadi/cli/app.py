"""The table of subcommands."""

import inspect
import shlex
import sys
from collections.abc import Callable
from functools import partial
from typing import Annotated

import typer

from psa_casadi.cli.batch import batch
from psa_casadi.cli.check import check
from psa_casadi.cli.compare import compare
from psa_casadi.cli.datasets import datasets
from psa_casadi.cli.demo import demo
from psa_casadi.cli.design_experiment import experiment
from psa_casadi.cli.design_input import input_
from psa_casadi.cli.design_mechanism import mechanism
from psa_casadi.cli.diagnose import diagnose
from psa_casadi.cli.effects import effects
from psa_casadi.cli.examples import examples
from psa_casadi.cli.export import c, fmu, modelica, ssp
from psa_casadi.cli.failures import guarded, prepare
from psa_casadi.cli.identify import identify
from psa_casadi.cli.options import command
from psa_casadi.cli.sample import sample
from psa_casadi.cli.simulate import simulate
from psa_casadi.cli.stacks import stacks
from psa_casadi.cli.web import web
from psa_casadi.command_line import typed
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


def _add(
    group: typer.Typer,
    function: Callable[..., None],
    example: str,
    name: str | None = None,
    **settings: bool,
) -> None:
    """Add a command; its first sentence stands whole in the list, its example on one line."""
    first = (inspect.getdoc(function) or "").partition("\n\n")[0]
    group.command(
        name, short_help=first, epilog=f"\b\nExample: {example}", context_settings=settings
    )(command(function))


_add(app, demo, "psa demo my_demo")
_add(app, identify, "psa identify slow.csv fast.csv -o model.json --report fit.html")
_add(app, sample, "psa sample record.csv --model model.json -o posterior.nc --figure posterior.png")
_add(app, simulate, "psa simulate --stack P-885.51 --input voltage.csv --history 120,0 -o out.csv")
_add(app, diagnose, "psa diagnose a.csv --holdout b.csv -o extended.json --report report.html")
_add(app, batch, "psa batch records -o results --report population.html")
_add(app, compare, "psa compare before.json after.json -o compare.html")
_add(app, effects, "psa effects slow_creep --figure creep.png")
_add(app, stacks, "psa stacks P-885.51")
app.add_typer(export, name="export")
_add(export, fmu, "psa export fmu --model extended.json -o stack.fmu")
_add(export, modelica, "psa export modelica --model extended.json -o PiezoStack.mo")
_add(export, c, "psa export c --stack P-885.51 --step 10us -o code")
_add(export, ssp, "psa export ssp --stack P-885.51 -o stage.ssp")
app.add_typer(design, name="design")
_add(
    design,
    experiment,
    "psa design experiment --stack P-885.51 --duration 2"
    " --separate field_dependent_gain rate_independent_asymmetry -o voltage.csv",
)
_add(design, mechanism, "psa design mechanism --stack PTBS200 --damping 0.7 -o mount.json")
_add(
    design,
    input_,
    "psa design input --stack P-885.51 --move 2 10 --min-voltage -20 --max-voltage 120 -o move.csv",
    "input",
)
_add(app, check, "psa check stack.fmu --model extended.json")
_add(app, web, "psa web --model extended.json -o page.html", allow_extra_args=True)
_add(app, examples, "psa examples van_der_pol -o van_der_pol")
_add(app, datasets, "psa datasets micromanipulator -o records")


def main() -> None:
    """Run the command line."""
    prepare()
    typed.set(shlex.join(["psa", *sys.argv[1:]]))
    try:
        guarded(app)(prog_name="psa")
    except typer.Exit as end:  # of what fails outside the commands, such as writing the help
        sys.exit(end.exit_code)
