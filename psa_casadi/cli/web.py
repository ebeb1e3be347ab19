"""`psa web`: a page that runs a stack, for everyone who has a browser, or one that diagnoses."""

import sys
import time
import webbrowser
from contextlib import suppress
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.inputs import PAGE, Fitting, Inputs, own_model
from psa_casadi.cli.options import StackName
from psa_casadi.cli.screen import print_message, show_always, show_written, working
from psa_casadi.common.errors import InputError
from psa_casadi.common.files import temporary_folder

if TYPE_CHECKING:
    import psa_casadi as psa
    from psa_casadi.cli.workbench.previews import Subject


def web(
    more: typer.Context,
    *,
    model: Path | None = None,
    output: Annotated[Path | None, typer.Option(show_default="playground.html")] = None,
    stack: StackName = None,
    diagnose: bool = False,
    port: Annotated[int | None, typer.Option(min=1, max=65535)] = None,
    no_browser: bool = False,
    fitting: Fitting,
    inputs: Inputs,
) -> None:
    """Write a page to play with a stack: any voltage, every effect, no network.

    It needs the compiler of the extra `compiler`; the page needs a browser alone. With --diagnose,
    serve a page that diagnoses records until Ctrl-C; nothing leaves the machine. The records are a
    stack's, or of --model FILE.py:FUNCTION or --fmu.

    Options:
        model: MODEL.json to play with; by default every named stack. With --diagnose, your
            model.
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
        any_model = own_model(inputs, model, fitting)
        if (model is not None and any_model is None) or stack is not None or output is not None:
            raise InputError(
                "--diagnose serves a separate page: leave --stack, -o and a stack's --model out;"
                " a MODEL.json to start from is dropped there."
            )
        inputs.check()
        _serve(port or 0, no_browser, _subject(any_model, model, fitting), inputs)
        return
    from psa_casadi.report.page.playground import write_playground

    path = output or Path("playground.html")
    if port is not None or no_browser:
        inputs.add("--port and --no-browser are of --diagnose; add that, or leave them out.")
    if fitting != Fitting():
        inputs.add("your model is for --diagnose; add that.")
    inputs.outputs({"--output": path}, [model], PAGE)
    chosen = inputs.model_or_stack(model, stack, needed=False)
    inputs.check()
    with working("compiling"):
        write_playground(path, chosen)
    show_written(path)


def _subject(model: "psa.Model | None", path: Path | None, fitting: Fitting) -> "Subject":
    """Return the subject of the page: a stack, or any other model."""
    from psa_casadi.cli.workbench.previews import Subject

    if model is None:
        return Subject()
    options = {"model": path and path.absolute(), **asdict(fitting)}
    if fitting.fmu:
        options["fmu"] = fitting.fmu.name
    arguments: list[str] = []
    for option, value in options.items():
        values = value if isinstance(value, list) else [value] if value else []
        begin = f"--{option.replace('_', '-')}"
        arguments += [begin if value is True else f"{begin}={v}" for v in values]
    units = {i.name: i.unit for i in model.structure.inputs}
    units |= {o.name: o.unit for o in model.structure.outputs}
    fmus = tuple(Path(f.place) for f in model.structure.foreign)
    return Subject(model.input_names, model.output_names, units, tuple(arguments), fmus)


def _serve(port: int, no_browser: bool, subject: "Subject", inputs: Inputs) -> None:
    """Serve the page until Ctrl-C; its files are removed then."""
    from psa_casadi.cli.workbench.desk import Desk
    from psa_casadi.cli.workbench.server import served
    from psa_casadi.model.user_effects import known_effects

    modules = inputs.effects or []
    here = str(Path.cwd())  # children look for named modules there, and for nothing else
    sys.path[:] = [p for p in sys.path if p not in ("", here)] + ([here] if modules else [])
    with temporary_folder() as place:
        folder = place / "files"
        folder.mkdir()
        desk = Desk(folder, list(known_effects(inputs.user_effects)), modules, subject)
        with suppress(KeyboardInterrupt), served(port, desk) as server:
            show_always(f"Open {server.address}")
            print_message("Ctrl-C ends the page and removes its files.")
            sys.stdout.flush()
            if not no_browser:  # by a file that leads there: other users see its command line
                way, address = place / "open.html", escape(server.address)
                way.write_text(
                    f'<!DOCTYPE html><meta http-equiv="refresh" content="0;url={address}">'
                    f'<a href="{address}">Open the page</a>',
                    encoding="utf-8",
                )
                webbrowser.open(way.as_uri())
            while True:
                time.sleep(3600.0)
        print_message("Ended; the files of the page are removed.")
