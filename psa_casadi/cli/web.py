"""`psa web`: a page that runs a stack, for everyone who has a browser, or one that diagnoses."""

import sys
import time
import webbrowser
from html import escape
from pathlib import Path
from typing import Annotated

import typer

from psa_casadi.cli.screen import (
    EffectsOption,
    Quiet,
    StackOption,
    show,
    tell,
    tell_written,
    working,
)
from psa_casadi.errors import InputError


def web(
    more: typer.Context,
    model: Annotated[
        Path | None,
        typer.Option(help="MODEL.json to play with; by default every named stack."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="HTML page to write.", show_default="playground.html"),
    ] = None,
    stack: StackOption = None,
    diagnose: Annotated[
        bool,
        typer.Option(
            "--diagnose",
            help="Serve a page, to this machine only, that diagnoses records: drop files, map their"
            " columns, watch the search.",
        ),
    ] = False,
    port: Annotated[
        int | None,
        typer.Option(
            "--port",
            help="Port of the page that --diagnose serves; by default a free one.",
            min=1,
            max=65535,
        ),
    ] = None,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the address and open no browser.")
    ] = False,
    effects: EffectsOption = None,
    quiet: Quiet = False,
) -> None:
    """Write a page to play with a stack: any voltage, every effect, no network.

    It needs the compiler of the extra `compiler`; the page needs a browser alone. With --diagnose,
    serve a page that diagnoses records until Ctrl-C; nothing leaves the machine.
    """
    if more.args and model is None:  # as it was written before there was --model here
        model = Path(more.args.pop(0))
    if more.args:
        raise InputError(f"{more.args[0]}: is one file too many; give one model, by --model.")
    if diagnose:
        if model is not None or stack is not None or output is not None:
            raise InputError(
                "--diagnose serves a page of its own: leave --model, --stack and -o out; a"
                " MODEL.json to start from is dropped there."
            )
        _serve(port or 0, no_browser, effects or [])
        return
    from psa_casadi.cli.inputs import Given
    from psa_casadi.report.page.playground import write_playground

    given, path = Given(effects), output or Path("playground.html")
    if port is not None or no_browser:
        given.add("--port and --no-browser are of --diagnose; add that, or leave them out.")
    given.outputs({"--output": path}, [model])
    chosen = None
    if model is not None or stack is not None:
        chosen = given.model_or_stack(model, stack)
    given.check()
    with working("compiling", quiet):
        write_playground(path, chosen)
    tell_written(path, quiet=quiet)


def _serve(port: int, no_browser: bool, modules: list[str]) -> None:
    """Serve the page until Ctrl-C; its files are removed then."""
    from psa_casadi.cli.inputs import Given
    from psa_casadi.files import temporary_folder
    from psa_casadi.model.own_effects import known_effects
    from psa_casadi.workbench.desk import Desk
    from psa_casadi.workbench.server import served

    given = Given(modules)
    given.check()
    here = str(Path.cwd())  # children look for named modules there, and for nothing else
    sys.path[:] = [p for p in sys.path if p not in ("", here)] + ([here] if modules else [])
    with temporary_folder() as place:
        folder = place / "files"
        folder.mkdir()
        desk = Desk(folder, list(known_effects(given.effects)), modules)
        with served(port, desk) as server:
            show(f"Open {server.address}")
            tell("Ctrl-C ends the page and removes its files.")
            sys.stdout.flush()
            if not no_browser:
                _open(server.address, place)
            try:
                while True:
                    time.sleep(3600.0)
            except KeyboardInterrupt:
                tell("Ended; the files of the page are removed.")


def _open(address: str, place: Path) -> None:
    """Open a browser by a file that leads to the address, as other users see what it is told."""
    way = place / "open.html"
    way.write_text(
        f'<!DOCTYPE html><meta http-equiv="refresh" content="0;url={escape(address)}">'
        f'<a href="{escape(address)}">Open the page</a>',
        encoding="utf-8",
    )
    webbrowser.open(way.as_uri())
