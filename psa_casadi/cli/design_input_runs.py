"""What `psa design input` does once its input is checked: design, write, show."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import psa_casadi as psa
from psa_casadi.cli.failures import Outputs
from psa_casadi.cli.screen import show_results, show_written, working
from psa_casadi.common.units import FloatArray
from psa_casadi.design.tracking import targets
from psa_casadi.design.tracking.inversion import corrected
from psa_casadi.design.tracking.inversion import invert as inverted
from psa_casadi.design.tracking.minimum_time import quickest_move
from psa_casadi.design.tracking.tracking import track as tracked
from psa_casadi.export.importer import masters
from psa_casadi.report.page import designs
from psa_casadi.report.page.document import Picture
from psa_casadi.report.page.live import live_design
from psa_casadi.report.words.catalogue import say
from psa_casadi.report.words.design_words import Titled, error_table, limits_table

_Rows = list[tuple[str, targets.TrackingError]]


@dataclass(frozen=True)
class Task:
    """A stack, the limits, the files to write, and how to judge."""

    plant: "psa.Model"
    limits: targets.AmplifierLimits
    output: Path
    report: Path | None
    still: bool
    check_fmu: bool


def track(task: Task, path: targets.Target, minimax: bool) -> None:
    """Design the voltage for a path."""
    with working("designing") as progress:
        result = tracked(task.plant, path, task.limits, minimax=minimax, progress=progress)
        plain = targets.uncompensated(task.plant, path).displacement
        rows: _Rows = [("designed, full simulator", result.error)]
        for reached in _on_fmu(task, result.response, progress):
            rows.append(("designed, exported FMU", targets.error_of(path, reached)))
    how = [say("voltage.how", samples=len(path.time), r=result)]
    if result.by_program:
        rows.append(("designed, the program itself", targets.error_of(path, result.predicted)))
        how.append(say("voltage.rounded", r=result))
        how += [] if result.converged else [say("voltage.not_converged")]
    else:
        how.append(say("voltage.not_by_program"))
    rows += [
        ("inversion without limits, full simulator", result.inverse.error),
        ("uncompensated, full simulator", targets.error_of(path, plain)),
    ]
    summary = [*_follows(task, result.error, result.response), *how]
    badge = "least largest error" if minimax else "least squares"
    pictures = designs.tracking_pictures(result, plain)
    _finish(task, "Designed input", summary, rows, pictures, result.response, path, badge)


def invert(task: Task, path: targets.Target) -> None:
    """Invert the model along a path; the limits cut the voltage."""
    with working("inverting") as progress:
        result = inverted(task.plant, path, task.limits)
        rows: _Rows = [("inversion, full simulator", result.error)]
        for reached in _on_fmu(task, result.response, progress):
            rows.append(("inversion, exported FMU", targets.error_of(path, reached)))
    summary = _follows(task, result.error, result.response)
    summary.append(say("voltage.trials", count=len(result.trials)))
    curve = "inverted, simulated", result.response.displacement
    pictures = [
        designs.path_picture("Path and response", result.target, curve),
        designs.voltage_picture(result.response, task.limits),
    ]
    _finish(task, "Inverted input", summary, rows, pictures, result.response, path, "inversion")


def correct(task: Task, path: targets.Target, trial: "psa.Record") -> None:
    """Correct the voltage of a trial by what it showed."""
    with working("correcting"):
        result = corrected(task.plant, path, trial, task.limits)
    change = float(np.max(np.abs(result.response.voltage - result.played)))
    summary = [say("voltage.trial", e=result.error), say("voltage.change", change=change)]
    summary += targets.binding(result.response, task.limits)
    rows = [("the trial, measured", result.error)]
    pictures = [
        designs.path_picture("Path and trial", result.target, ("trial, measured", result.measured)),
        designs.voltage_picture(result.response, task.limits, result.played),
    ]
    _finish(task, "Corrected input", summary, rows, pictures, result.response, path, "one trial")


def move(task: Task, ends: tuple[float, float]) -> None:
    """Design a quickest move between two positions [um]."""
    with working("designing") as progress:
        begin, end = (1e-6 * position for position in ends)
        quick = quickest_move(task.plant, begin, end, task.limits, progress=progress)
        summary = [say("voltage.move", move=quick), say("voltage.behind", move=quick)]
        for reached in _on_fmu(task, quick.response, progress):
            worst = np.max(np.abs(reached - quick.response.displacement)) / abs(end - begin)
            summary.append(say("voltage.fmu", worst=worst))
    _finish(task, "Quickest move", summary, [], designs.move_pictures(quick), quick.response)


def _follows(task: Task, error: targets.TrackingError, response: targets.Response) -> list[str]:
    return [say("voltage.follows", e=error), *targets.binding(response, task.limits)]


@contextmanager
def _keeping(task: Task, response: targets.Response) -> Iterator[None]:
    """Write the voltage where an interrupt ends what comes after its design, and say that."""
    try:
        yield
    except KeyboardInterrupt:
        _write(task, response)
        files = Outputs({"--output": task.output, "--report": task.report}, [task.output])
        raise files.cut_off("the voltage was designed before") from None


def _write(task: Task, response: targets.Response) -> None:
    columns = {
        "time [s]": response.time,
        "voltage [V]": response.voltage,
        "displacement [um]": 1e6 * response.displacement,
    }
    psa.write_record(task.output, columns)


def _on_fmu(
    task: Task, response: targets.Response, progress: Callable[[str], None]
) -> Iterator[FloatArray]:
    """Yield the displacement (n,) [m] of the exported FMU, unless it is not to be checked."""
    if task.check_fmu:
        progress("exported FMU")
        with _keeping(task, response):
            reached = masters.played_on_fmu(task.plant, response.time, response.voltage)
        yield reached


def _finish(
    task: Task, title: str, summary: Sequence[str], rows: _Rows, pictures: Sequence[Picture],
    response: targets.Response, path: targets.Target | None = None, badge: str = "",
) -> None:  # fmt: skip
    """Write CSV and page, show sentences and tables."""
    tables: list[Titled] = [error_table(rows)] if rows else []
    tables.append(limits_table(response, task.limits))
    with _keeping(task, response):
        _write(task, response)
        if task.report is not None:
            live = None
            if not task.still:
                played = (response.time, response.voltage, response.displacement)
                wanted = None if path is None else path.displacement
                live = live_design(task.plant, played, wanted, rest=True)
            designs.write_design_page(
                task.report, title=title, summary=summary, tables=tables, figures=pictures,
                badges=(badge,) if badge else (), live=live,
            )  # fmt: skip
    show_results(summary, (titled.table for titled in tables))
    show_written(task.output, task.report)
