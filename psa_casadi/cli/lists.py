"""`psa effects`, `stacks`, `datasets` and `examples`: what there is by name, and one of it."""

import textwrap
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

import psa_casadi as psa
from psa_casadi.cli import screen
from psa_casadi.cli.inputs import Inputs, similar
from psa_casadi.cli.options import names
from psa_casadi.common.errors import InputError
from psa_casadi.common.files import make_folder


def effects(
    name: Annotated[str | None, typer.Argument(autocompletion=names("effects"))] = None,
    *,
    figure: Path | None = None,
    model: Path | None = None,
    effects: list[str] | None = None,
    quiet: bool = False,
) -> None:
    """List the effects that a diagnosis looks for; show one: equation, signature, size, remedy.

    Options:
        quiet: Print names only.
        name: Name of one effect.
        figure: Picture of the effect's signature to write, PNG, SVG or PDF as its name ends; needs
            NAME.
        model: MODEL.json of the stack for which NAME's size is computed.

    Example:
        psa effects slow_creep --figure creep.png
    """
    from psa_casadi.diagnosis.remedy import example, signature
    from psa_casadi.model.effects.mechanics import MODAL_SERIES
    from psa_casadi.model.user_effects import known_effects
    from psa_casadi.report.plots.figures import save_signature
    from psa_casadi.report.words.tables import effects_table
    from psa_casadi.report.words.text import effect_page

    inputs = Inputs(effects=effects, quiet=quiet)
    listed = known_effects(inputs.user_effects)
    known = {**listed, **{e.name: e for e in MODAL_SERIES.values()}}
    stack, size = inputs.model(model), None
    inputs.outputs({"--figure": figure}, [])
    if name is None and figure is not None:
        inputs.add(
            "--figure draws one effect and none is named; say which, as in"
            f" `psa effects {next(iter(known))} --figure {figure}`."
        )
    wanted = _known_name(inputs, name, "effect", known, f"there are {', '.join(known)}.")
    inputs.check()
    if name is None and quiet:
        screen.show_always("\n".join(listed))
    elif name is None:
        screen.show_table(effects_table(listed.values()))
    else:
        if figure is not None:
            save_signature(known[wanted], signature(known[wanted]), figure)
        if quiet:
            screen.show_always(wanted)
        else:
            with suppress(psa.MachineError):  # no compiler to simulate it
                size = example(known[wanted], stack)
            screen.show(effect_page(known[wanted], screen.width(), size))
        screen.show_written(figure)


def _known_name(
    inputs: Inputs, name: str | None, kind: str, known: Iterable[str], otherwise: str
) -> str:
    """Return a name as the known ones are written; a name that is none of them is a problem."""
    wanted = (name or "").strip().lower().replace("-", "_").replace(" ", "_")
    wanted = wanted.removesuffix(".py").removesuffix(".md")
    if name is not None and wanted not in known:
        hint = similar(wanted, known, otherwise)
        inputs.add(f"There is no {kind} named '{name}'; {hint}")
    return wanted


def stacks(
    name: Annotated[str | None, typer.Argument(autocompletion=names("stacks"))] = None,
    *,
    quiet: bool = False,
) -> None:
    """List the stacks that can be used by name; show the figures of one with their sources.

    Options:
        quiet: Print names only.
        name: Name of one stack.

    Example:
        psa stacks P-885.51
    """
    from psa_casadi.report.words.tables import stack_table, stacks_table

    screen.set_quiet(quiet)
    description = psa.stack_model(name).description if name is not None else ""
    if quiet:
        screen.show_always(name or "\n".join(psa.STACKS))
    elif name is None:
        screen.show_table(stacks_table(psa.STACKS.values()))
    else:
        screen.show(textwrap.fill(f"{name}: {description}", screen.width()) + "\n")
        screen.show_table(stack_table(psa.STACKS[name]))


def datasets(
    name: Annotated[str | None, typer.Argument(autocompletion=names("datasets"))] = None,
    *,
    output: Path | None = None,
    quiet: bool = False,
) -> None:
    """List public records; show the source and licence of one; write its records to a folder.

    Records come from the folder that PSA_CASADI_DATA names; where it is not set, they are
    downloaded from their authors and checked.

    Options:
        quiet: Print names only.
        name: Name of one dataset.
        output: Folder to write its records to, as CSV files.

    Example:
        psa datasets micromanipulator -o records
    """
    from psa_casadi.datasets import DATASETS, copy, find, origin_text
    from psa_casadi.report.words.tables import Table

    screen.set_quiet(quiet)
    if name is None and output is not None:
        raise InputError("--output needs the name of a dataset; `psa datasets` lists them.")
    if name is None and quiet:
        screen.show_always("\n".join(DATASETS))
    elif name is None:
        each = DATASETS.values()
        rows = tuple((d.name, str(len(d.files)), d.licence, d.description) for d in each)
        screen.show_table(Table(("dataset", "records", "licence", "holds"), rows))
    elif output is None:
        screen.show_always(find(name).name if quiet else origin_text(find(name)))
    else:
        with screen.working(f"fetching {name}"):
            written = copy(name, output)
        screen.show_written(*written)


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

    inputs, known = Inputs(quiet=quiet), index.examples()
    if name is None and output is not None:
        inputs.add("-o needs the name of an example or a recipe; `psa examples` lists them.")
    if copy_only and output is None:
        inputs.add("--copy-only needs a folder to copy to; name it with -o.")
    wanted = _known_name(inputs, name, "example or recipe", known, "`psa examples` lists them.")
    inputs.check()
    if name is None and quiet:
        screen.show_always("\n".join(known))
    elif name is None:
        rows = tuple((e.name, e.kind, e.title) for e in known.values())
        screen.show_table(Table(("name", "kind", "what it shows"), rows))
        screen.show(
            "\npsa examples NAME shows one; psa examples NAME -o FOLDER copies it and runs an"
            " example"
        )
    elif output is None:
        screen.show_always(known[wanted].text.rstrip("\n"))
    else:
        chosen = known[wanted]
        make_folder(output)
        before = {p.name for p in output.iterdir()}
        written = index.copy_example(chosen, output)
        result: object = None
        if chosen.kind == "example" and not copy_only:
            with screen.working(f"running {chosen.name}"):
                result = index.run_example(chosen.name, output)
        if isinstance(result, Mapping):  # named figures, one in each line
            texts = ((k, f"{v:.4g}" if isinstance(v, float) else v) for k, v in result.items())
            result = "\n".join(f"{k}: {v}" for k, v in texts)
        if isinstance(result, str):
            screen.show(result)
        new = sorted(p for p in output.iterdir() if p.name not in before and p not in written)
        screen.show_written(*written, *new)
