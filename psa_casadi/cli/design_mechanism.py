"""`psa design mechanism`: mass, damping and stiffness of a prestress mechanism."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.screen import (
    EffectsOption,
    ModelOption,
    Quiet,
    StackOption,
    StillOption,
    show,
    show_table,
    tell_written,
    working,
)

if TYPE_CHECKING:
    from psa_casadi.design.mechanism.mechanism import MechanismDesign


class ActsOn(StrEnum):
    """Where the mechanism's force acts."""

    WAFERS = "wafers"
    TIP = "tip"


def mechanism(
    output: Annotated[Path, typer.Option("-o", "--output", help="MECHANISM.json to write.")],
    model: ModelOption = None,
    stack: StackOption = None,
    damping: Annotated[
        float | None, typer.Option(help="Least damping ratio of all mechanical poles.")
    ] = None,
    bandwidth: Annotated[
        float | None, typer.Option(help="Least bandwidth of the mechanics [Hz].")
    ] = None,
    poles: Annotated[
        str | None,
        typer.Option(help="One or two pairs of poles [rad/s]: -4e4+4e4j,-4e4-4e4j"),
    ] = None,
    max_stroke_loss: Annotated[
        str, typer.Option(help="Share of the stroke that the stiffness may take.")
    ] = "10%",
    max_force: Annotated[
        float | None,
        typer.Option(help="Largest force in the mechanism in a step of rated voltage [N]."),
    ] = None,
    min_mass: Annotated[float, typer.Option(help="Least mass [kg].")] = 0.0,
    max_mass: Annotated[float, typer.Option(help="Largest mass [kg].")] = 1.0,
    max_damping: Annotated[float, typer.Option(help="Largest damping [N.s/m].")] = 1e5,
    acts_on: Annotated[
        ActsOn,
        typer.Option(
            help="Where it acts: on all of the mechanics as in the paper, or on the output mass."
        ),
    ] = ActsOn.WAFERS,
    starts: Annotated[int, typer.Option(help="Starts of the search.")] = 6,
    port: Annotated[
        Path | None,
        typer.Option(help="Also write the stack with the port that the mechanism couples to."),
    ] = None,
    report: Annotated[Path | None, typer.Option(help="HTML page to write.")] = None,
    still: StillOption = False,
    effects: EffectsOption = None,
    quiet: Quiet = False,
) -> None:
    """Design a prestress mechanism for a wanted damping, bandwidth or poles, within limits.

    MECHANISM.json is a model: `psa export fmu --model MECHANISM.json` makes an FMU of it.
    """
    from psa_casadi.cli.inputs import Given
    from psa_casadi.design.mechanism.mechanism import (
        check_goals,
        design_mechanism,
        mechanism_model,
        port_model,
    )
    from psa_casadi.design.mechanism.search import Limits
    from psa_casadi.model.model_file import save_model
    from psa_casadi.report.page.designs import write_mechanism_page

    given = Given(effects)
    given.outputs({"--output": output, "--port": port, "--report": report}, [model])
    chosen = given.model_or_stack(model, stack)
    wanted = given.attempt(lambda: _poles(poles))
    loss = given.attempt(lambda: _share(max_stroke_loss))
    limits = Limits(loss or 0.0, max_force, (min_mass, max_mass), (0.0, max_damping))
    if wanted is not None:
        given.attempt(lambda: check_goals(damping, bandwidth, wanted, limits, starts))
    given.check()
    if chosen is None or wanted is None:
        return
    with working("designing", quiet) as progress:
        progress(f"{starts} starts")
        design = design_mechanism(
            chosen, damping=damping, bandwidth=bandwidth, poles=wanted, limits=limits,
            acts_on=acts_on.value, starts=starts,
        )  # fmt: skip
    save_model(mechanism_model(design), output)
    if port is not None:
        save_model(port_model(chosen), port)
    if report is not None:
        write_mechanism_page(design, report, chosen, still=still)
    _tell(design, quiet)
    tell_written(output, port, report, quiet=quiet)


def _tell(design: "MechanismDesign", quiet: bool) -> None:
    from psa_casadi.report.words.design_words import (
        mechanism_sentences,
        mechanism_table,
        pole_table,
    )

    for sentence in mechanism_sentences(design):
        show(sentence, quiet)
    for table in (mechanism_table(design), pole_table(design)):
        show("", quiet)
        show_table(table, quiet)


def _poles(text: str | None) -> tuple[complex, ...]:
    """Read poles in rad/s, such as -4e4+4e4j,-4e4-4e4j."""
    from psa_casadi.errors import InputError

    found = []
    for part in (text or "").split(","):
        if not part.strip():
            continue
        try:
            found.append(complex(part.replace(" ", "").replace("i", "j")))
        except ValueError as error:
            raise InputError(
                f"--poles: '{part.strip()}' is no pole; write -4e4+4e4j,-4e4-4e4j in rad/s."
            ) from error
    return tuple(found)


def _share(text: str) -> float:
    """Read a share: 10% or 0.1."""
    from psa_casadi.errors import InputError

    percent = text.strip().endswith("%")
    try:
        value = float(text.strip().removesuffix("%"))
    except ValueError as error:
        raise InputError(f"--max-stroke-loss: '{text}' is no share; write 10% or 0.1.") from error
    return value / 100.0 if percent else value
