"""`psa examples`: worked examples and recipes for other tools, shown, copied or run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from psa_casadi.cli.inputs import Given, similar
from psa_casadi.cli.options import names
from psa_casadi.cli.screen import show, show_table, tell_written, working
from psa_casadi.files import make_folder


def examples(
    name: Annotated[str | None, typer.Argument(autocompletion=names("examples"))] = None,
    *,
    output: Path | None = None,
    copy_only: bool = False,
    quiet: bool = False,
) -> None:
    """List examples and recipes; show one; with -o copy it to a folder and run an example there.

    Options:
        name: Name of an example or a recipe.
        output: Folder for its files; it is created.
        copy_only: Copy the files to the folder, run nothing.

    Example:
        psa examples van_der_pol -o van_der_pol
    """
    from psa_casadi.examples import index
    from psa_casadi.report.words.tables import Table

    inputs, known = Given(), index.examples()
    if name is None and output is not None:
        inputs.add("-o needs the name of an example or a recipe; `psa examples` lists them.")
    if copy_only and output is None:
        inputs.add("--copy-only needs a folder to copy to; name it with -o.")
    wanted = (name or "").strip().lower().replace("-", "_").removesuffix(".py").removesuffix(".md")
    if name is not None and wanted not in known:
        meant = similar(wanted, known, "`psa examples` lists them.")
        inputs.add(f"There is no example or recipe named '{name}'; {meant}")
    inputs.check()
    if name is None and quiet:
        show("\n".join(known))
    elif name is None:
        rows = tuple((e.name, e.kind, e.title) for e in known.values())
        show_table(Table(("name", "kind", "what it shows"), rows))
        show(
            "\npsa examples NAME shows one; psa examples NAME -o FOLDER copies it and runs an"
            " example"
        )
    elif output is None:
        show(known[wanted].text.rstrip("\n"))
    else:
        matches = known[wanted]
        make_folder(output)
        before = {p.name for p in output.iterdir()}
        written = index.copy_example(matches, output)
        result: object = None
        if matches.kind == "example" and not copy_only:
            with working(f"running {matches.name}", quiet):
                result = index.run_example(matches.name, output)
        if isinstance(result, Mapping):  # named figures, one in each line
            displayed = ((k, f"{v:.4g}" if isinstance(v, float) else v) for k, v in result.items())
            result = "\n".join(f"{k}: {v}" for k, v in displayed)
        if isinstance(result, str):
            show(result, quiet)
        new = sorted(p for p in output.iterdir() if p.name not in before and p not in written)
        tell_written(*written, *new, quiet=quiet)
