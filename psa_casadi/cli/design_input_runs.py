"""What `psa design input` does once its input is checked: design, write, show."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from psa_casadi.cli.failures import kept
from psa_casadi.cli.screen import show, show_table, tell_written, working
from psa_casadi.design.tracking.inversion import corrected
from psa_casadi.design.tracking.inversion import invert as inverted
from psa_casadi.design.tracking.minimum_time import QuickMove, quickest_move
from psa_casadi.design.tracking.targets import (
    AmplifierLimits,
    Response,
    Target,
    TrackingError,
    binding,
    error_of,
    uncompensated,
)
from psa_casadi.design.tracking.tracking import TrackedInput
from psa_casadi.design.tracking.tracking import track as tracked
from psa_casadi.model.compose import Model
from psa_casadi.records import Record, write_record
from psa_casadi.report.page.designs import (
    inversion_pictures,
    move_pictures,
    tracking_pictures,
    trial_pictures,
    write_design_page,
)
from psa_casadi.report.page.live import LiveModel, live_design
from psa_casadi.report.words.design_words import Titled, error_table, limits_table
from psa_casadi.report.words.phrases import number

if TYPE_CHECKING:
    from psa_casadi.report.page.document import Picture

_Rows = list[tuple[str, TrackingError]]


@dataclass(frozen=True)
class Task:
    """A stack, the limits, the files to write, and how to judge."""

    plant: Model
    limits: AmplifierLimits
    output: Path
    report: Path | None
    still: bool
    check_fmu: bool
    quiet: bool


def track(task: Task, path: Target, minimax: bool) -> None:
    """Design the voltage for a path."""
    with working("designing", task.quiet) as progress:
        found = tracked(task.plant, path, task.limits, minimax=minimax, progress=progress)
        plain = uncompensated(task.plant, path).displacement
        rows: _Rows = [("designed, full simulator", found.error)]
        if task.check_fmu:
            progress("exported FMU")
            with _keeping(task, found.response):
                rows.append(("designed, exported FMU", _on_fmu(task, path, found.voltage)))
    if found.by_program:
        rows.append(("designed, the program itself", error_of(path, found.predicted)))
    rows += [
        ("inversion without limits, full simulator", found.inverse.error),
        ("uncompensated, full simulator", error_of(path, plain)),
    ]
    summary = [_follows(found.error), *binding(found.response, task.limits), *_how(found)]
    tables = (error_table(rows), limits_table(found.response, task.limits))
    badge = "least largest error" if minimax else "least squares"
    _finish(task, "Designed input", summary, tables, tracking_pictures(found, plain),
            found.response, badge, path=path)  # fmt: skip


def _how(found: TrackedInput) -> list[str]:
    """Return sentences on how a design came about and what it is worth."""
    said = [f"{len(found.target.time)} samples in {number(found.seconds)} s."]
    if not found.by_program:
        said.append(
            "The program (IPOPT) found no better voltage within the limits, so this is the"
            " inversion cut by them and corrected by trials on the simulator. A better one may"
            " exist."
        )
        return said
    said[0] = f"{said[0][:-1]}, {found.iterations} iterations of IPOPT."
    said.append(
        f"Kinks at reversals were rounded over {number(found.width)} V/s in the program only."
    )
    if not found.converged:
        said.append("IPOPT ran out of iterations: a better voltage within limits may exist.")
    return said


def invert(task: Task, path: Target) -> None:
    """Invert the model along a path; the limits cut the voltage."""
    with working("inverting", task.quiet) as progress:
        found = inverted(task.plant, path, task.limits)
        rows: _Rows = [("inversion, full simulator", found.error)]
        if task.check_fmu:
            progress("exported FMU")
            with _keeping(task, found.response):
                error = _on_fmu(task, path, found.response.voltage)
            rows.append(("inversion, exported FMU", error))
    summary = [_follows(found.error), *binding(found.response, task.limits)]
    summary.append(f"{len(found.trials)} trials on the simulator.")
    tables = (error_table(rows), limits_table(found.response, task.limits))
    pictures = inversion_pictures(found, task.limits)
    _finish(
        task, "Inverted input", summary, tables, pictures, found.response, "inversion", path=path
    )


def correct(task: Task, path: Target, trial: Record) -> None:
    """Correct the voltage of a trial by what it showed."""
    with working("correcting", task.quiet):
        found = corrected(task.plant, path, trial, task.limits)
    change = float(np.max(np.abs(found.response.voltage - found.played)))
    summary = [
        f"The trial missed the path by {number(found.error.rms_percent)} % of its range rms,"
        f" {number(found.error.largest_percent)} % at most.",
        f"The voltage changes by {number(change)} V at most; only the next trial can show what that"
        " is worth.",
        *binding(found.response, task.limits),
    ]
    tables = (
        error_table([("the trial, measured", found.error)]),
        limits_table(found.response, task.limits),
    )
    _finish(task, "Corrected input", summary, tables, trial_pictures(found), found.response,
            "one trial", path=path)  # fmt: skip


def move(task: Task, ends: tuple[float, float]) -> None:
    """Design a quickest move between two positions [um]."""
    with working("designing", task.quiet) as progress:
        begin, end = (1e-6 * position for position in ends)
        found = quickest_move(task.plant, begin, end, task.limits, progress=progress)
        summary = _moves(found)
        if task.check_fmu:
            progress("exported FMU")
            response = found.response
            with _keeping(task, response):
                shown = _played(task, response.time, response.voltage)
            worst = np.max(np.abs(shown - response.displacement)) / abs(end - begin)
            summary.append(
                f"The exported FMU differs from the simulator by {number(100.0 * worst, 2)} % of"
                " the move at most."
            )
    tables = (limits_table(found.response, task.limits),)
    _finish(task, "Quickest move", summary, tables, move_pictures(found), found.response)


def _moves(found: QuickMove) -> list[str]:
    return [
        f"The move takes {number(1e6 * found.move_time)} us; the linear part alone would take"
        f" {number(1e6 * found.linear_time)} us.",
        f"Behind it the displacement swings by {number(100.0 * found.residual, 2)} % of the"
        f" move at most, {number(100.0 * found.offset, 2)} % off its end, by the simulator.",
    ]


def _follows(error: TrackingError) -> str:
    return (
        f"The designed voltage follows the path to {number(error.rms_percent)} % of its range rms,"
        f" {number(error.largest_percent)} % at most, by the full simulator."
    )


@contextmanager
def _keeping(task: Task, response: Response) -> Iterator[None]:
    """Write the voltage where an interrupt ends what comes after its design, and say that."""
    try:
        yield
    except KeyboardInterrupt:
        _write(task, response)
        told = kept("the voltage was designed before", [task.output], [task.report])
        raise KeyboardInterrupt(told) from None


def _write(task: Task, response: Response) -> None:
    columns = {
        "time [s]": response.time,
        "voltage [V]": response.voltage,
        "displacement [um]": 1e6 * response.displacement,
    }
    write_record(task.output, columns)


def _on_fmu(task: Task, path: Target, voltage: np.ndarray) -> TrackingError:
    return error_of(path, _played(task, path.time, voltage))


def _played(task: Task, time: np.ndarray, voltage: np.ndarray) -> np.ndarray:
    from psa_casadi.export.importer.masters import played_on_fmu

    return played_on_fmu(task.plant, time, voltage)


def _live(task: Task, response: Response, path: Target | None) -> LiveModel | None:
    """Begin what lets the stack run in the page, unless that is to be still."""
    if task.still:
        return None
    played = (response.time, response.voltage, response.displacement)
    wanted = None if path is None else path.displacement
    return live_design(task.plant, played, wanted, rest=True)


def _finish(
    task: Task, title: str, summary: Sequence[str], tables: Sequence[Titled],
    pictures: "Sequence[Picture]", response: Response, *badges: str, path: Target | None = None,
) -> None:  # fmt: skip
    """Write CSV and page, show sentences and tables."""
    with _keeping(task, response):
        _write(task, response)
        if task.report is not None:
            write_design_page(
                task.report, title=title, summary=summary, tables=tables, figures=pictures,
                badges=badges, live=_live(task, response, path),
            )  # fmt: skip
    for sentence in summary:
        show(sentence, task.quiet)
    for titled in tables:
        show("", task.quiet)
        show_table(titled.table, task.quiet)
    tell_written(task.output, task.report, quiet=task.quiet)
