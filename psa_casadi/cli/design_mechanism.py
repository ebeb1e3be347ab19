"""`psa design mechanism`: mass, damping and stiffness of a prestress mechanism."""

from pathlib import Path
from typing import Literal

import psa_casadi as psa
from psa_casadi.cli.inputs import Inputs
from psa_casadi.cli.options import StackName
from psa_casadi.cli.screen import show_results, show_written, working
from psa_casadi.common.errors import InputError


def mechanism(
    *,
    output: Path,
    model: Path | None = None,
    stack: StackName = None,
    damping: float | None = None,
    bandwidth: float | None = None,
    poles: str | None = None,
    max_stroke_loss: str = "10%",
    max_force: float | None = None,
    min_mass: float = 0.0,
    max_mass: float = 1.0,
    max_damping: float = 1e5,
    acts_on: Literal["wafers", "tip"] = "wafers",
    starts: int = 6,
    port: Path | None = None,
    report: Path | None = None,
    still: bool = False,
    inputs: Inputs,
) -> None:
    """Design a prestress mechanism for a wanted damping, bandwidth or poles, within limits.

    MECHANISM.json is a model: `psa export fmu --model MECHANISM.json` makes an FMU of it.

    Options:
        output: MECHANISM.json to write.
        damping: Least damping ratio of all mechanical poles.
        bandwidth: Least bandwidth of the mechanics [Hz].
        poles: One or two pairs of poles [rad/s]: -4e4+4e4j,-4e4-4e4j
        max_stroke_loss: Share of the stroke that the stiffness may take.
        max_force: Largest force in the mechanism in a step of rated voltage [N].
        min_mass: Least mass [kg].
        max_mass: Largest mass [kg].
        max_damping: Largest damping [N.s/m].
        acts_on: Where it acts: on all of the mechanics as in the paper, or on the output mass.
        starts: Starts of the search.
        port: Also write the stack with the port that the mechanism couples to.
        report: HTML page to write.

    Example:
        psa design mechanism --stack PTBS200 --damping 0.7 -o mount.json
    """
    from psa_casadi.design.mechanism.mechanism import Limits, Wish
    from psa_casadi.report.page.designs import write_mechanism_page
    from psa_casadi.report.words.design_words import (
        mechanism_sentences,
        mechanism_table,
        pole_table,
    )

    inputs.outputs({"--output": output, "--port": port, "--report": report}, [model])
    chosen = inputs.model_or_stack(model, stack)
    wanted = inputs.attempt(lambda: _poles(poles))
    loss = inputs.attempt(lambda: _share(max_stroke_loss))
    limits = Limits(loss or 0.0, max_force, (min_mass, max_mass), (0.0, max_damping))
    if wanted is not None:
        inputs.attempt(lambda: Wish(damping, bandwidth, wanted, limits, starts))
    chosen, goals = inputs.ready(chosen), inputs.ready(wanted)
    with working("designing") as progress:
        progress(f"{starts} starts")
        design = psa.design_mechanism(
            chosen, damping=damping, bandwidth=bandwidth, poles=goals, limits=limits,
            acts_on=acts_on, starts=starts,
        )  # fmt: skip
    psa.save_model(psa.mechanism_model(design), output)
    if port is not None:
        psa.save_model(psa.port_model(chosen), port)
    if report is not None:
        write_mechanism_page(design, report, chosen, still=still)
    tables = mechanism_table(design), pole_table(design)
    show_results(mechanism_sentences(design), tables)
    show_written(output, port, report)


def _poles(text: str | None) -> tuple[complex, ...]:
    """Read poles in rad/s, such as -4e4+4e4j,-4e4-4e4j."""
    poles = []
    for part in (text or "").split(","):
        if not part.strip():
            continue
        try:
            poles.append(complex(part.replace(" ", "").replace("i", "j")))
        except ValueError as error:
            raise InputError(
                f"--poles: '{part.strip()}' is no pole; write -4e4+4e4j,-4e4-4e4j in rad/s."
            ) from error
    return tuple(poles)


def _share(text: str) -> float:
    """Read a share: 10% or 0.1."""
    percent = text.strip().endswith("%")
    try:
        value = float(text.strip().removesuffix("%"))
    except ValueError as error:
        raise InputError(f"--max-stroke-loss: '{text}' is no share; write 10% or 0.1.") from error
    return value / 100.0 if percent else value
