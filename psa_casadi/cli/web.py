"""`psa web`: a page that runs a stack, for everyone who has a browser, or one that diagnoses."""

import sys
import time
import webbrowser
from html import escape
from pathlib import Path
from typing import Annotated

import typer

from psa_casadi.cli.inputs import Given
from psa_casadi.cli.options import StackName
from psa_casadi.cli.screen import show, tell, tell_written, working
from psa_casadi.errors import InputError
from psa_casadi.files import temporary_folder


def web(
    more: typer.Context,
    *,
    model: Path | None = None,
    output: Annotated[Path | None, typer.Option(show_default="playground.html")] = None,
    stack: StackName = None,
    diagnose: bool = False,
    port: Annotated[int | None, typer.Option(min=1, max=65535)] = None,
    no_browser: bool = False,
    given: Given,
) -> None:
    """Write a page to play with a stack: any voltage, every effect, no network.

    It needs the compiler of the extra `compiler`; the page needs a browser alone. With --diagnose,
    serve a page that diagnoses records until Ctrl-C; nothing leaves the machine.

    Options:
        model: MODEL.json to play with; by default every named stack.
        output: HTML page to write.
        diagnose: Serve a page, to this machine only, that diagnoses records: drop files, map their
            columns, watch the search.
        port: Port of the page that --diagnose serves; by default a free one.
        no_browser: Print the address and open no browser.

    Example:
        psa web --model extended.json -o page.html
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
        _serve(port or 0, no_browser, given)
        return
    from psa_casadi.report.page.playground import write_playground

    path = output or Path("playground.html")
    if port is not None or no_browser:
        given.add("--port and --no-browser are of --diagnose; add that, or leave them out.")
    given.outputs({"--output": path}, [model], page="--output")
    chosen = given.model_or_stack(model, stack, needed=False)
    given.check()
    with working("compiling", given.quiet):
        write_playground(path, chosen)
    tell_written(path, quiet=given.quiet)


def _serve(port: int, no_browser: bool, given: Given) -> None:
    """Serve the page until Ctrl-C; its files are removed then."""
    from psa_casadi.model.own_effects import known_effects
    from psa_casadi.workbench.desk import Desk
    from psa_casadi.workbench.server import served

    given.check()
    modules = given.effects or []
    here = str(Path.cwd())  # children look for named modules there, and for nothing else
    sys.path[:] = [p for p in sys.path if p not in ("", here)] + ([here] if modules else [])
    with temporary_folder() as place:
        folder = place / "files"
        folder.mkdir()
        desk = Desk(folder, list(known_effects(given.own)), modules)
        with served(port, desk) as server:
            show(f"Open {server.address}")
            tell("Ctrl-C ends the page and removes its files.")
            sys.stdout.flush()
            if not no_browser:  # by a file that leads there: other users see what it is told
                way, address = place / "open.html", escape(server.address)
                way.write_text(
                    f'<!DOCTYPE html><meta http-equiv="refresh" content="0;url={address}">'
                    f'<a href="{address}">Open the page</a>',
                    encoding="utf-8",
                )
                webbrowser.open(way.as_uri())
            try:
                while True:
                    time.sleep(3600.0)
            except KeyboardInterrupt:
                tell("Ended; the files of the page are removed.")
