"""The checks that run the foreign code of an FMU, in turn; their process may end in any of them."""

from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path

from psa_casadi.errors import InputError
from psa_casadi.export.check.calls import CALLS
from psa_casadi.export.check.comparison import compare
from psa_casadi.export.check.description import wrong_nominals
from psa_casadi.export.check.events import (
    event_indicators,
    event_mode,
    intermediate_update,
    wrong_indicators,
)
from psa_casadi.export.check.input_line import input_line_error
from psa_casadi.export.check.playback import played_again
from psa_casadi.export.check.rows import (
    BREAKDOWNS,
    LEFT_OUT,
    LEFT_OUT3,
    CheckRow,
    count,
    figure,
    stopped,
)
from psa_casadi.export.check.structure import (
    adjoint_error,
    directional_error,
    equation_error,
    incomplete_dependencies,
    settled_start_error,
    wrong_start,
)
from psa_casadi.export.check.task import Task
from psa_casadi.export.check.truth import Truth
from psa_casadi.export.common.variable_table import INPUT_LINE
from psa_casadi.export.fmu.sources import fixed_step_of
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu

_EQUATION_LIMIT = 1e-9
_LINE_LIMIT = 0.05
#: Both starts come of runs at tolerances of 1e-6 and less.
_START_LIMIT = 1e-5

#: The name of a check that begins now, or the row of the one that began last.
Progress = Iterator[str | CheckRow]


def measured(task: Task) -> Progress:
    """Yield names and rows of the checks of an FMU that was unpacked.

    Without a model there is no truth, and nothing is compared with it.
    """
    loaded: list[Fmu] = []
    yield "binary loads"
    yield count("binary loads", _load, task.path, task.unpacked, loaded)
    for fmu in loaded:
        with fmu:
            yield from _of_instances(fmu, task)


def _of_instances(fmu: Fmu, task: Task) -> Progress:
    fixed = fixed_step_of(fmu.directory) is not None
    left_out = (*LEFT_OUT, *LEFT_OUT3) if fixed else ()
    made: list[CheckRow] = []
    for name, kind in _INTERFACES.items():
        if name not in left_out:
            yield name
            made.append(count(name, _instantiates, fmu, kind))
            yield made[-1]
    if not all(row.passed for row in made):
        return
    yield from _of_calls(fmu, left_out)
    if task.truth:
        yield from _of_model(fmu, task.truth, left_out)
    for playback in task.playbacks:
        yield playback.name
        try:
            yield played_again(fmu, playback)
        except BREAKDOWNS as error:
            yield stopped(playback.name, f"the run stopped: {error}")


def _of_calls(fmu: Fmu, left_out: Collection[str]) -> Progress:
    third = fmu.version == 3
    calls = _CALLS | (_CALLS3 if third else {})
    figures = _FIGURES | (_FIGURES3 if third else {})
    if INPUT_LINE.name in fmu.references:
        figures["line of the input"] = (_LINE_LIMIT, input_line_error)
    for name in (*calls, *figures):
        if name in left_out:
            continue
        yield name
        yield (
            count(name, calls[name], fmu) if name in calls else figure(name, *figures[name], fmu)
        )


def _of_model(fmu: Fmu, truth: Truth, left_out: Collection[str]) -> Progress:
    yield "start of a run"
    yield count("start of a run", wrong_start, fmu, truth)
    if truth.settled_starts:
        yield "settled start"
        yield figure("settled start", _START_LIMIT, settled_start_error, fmu, truth)
    if "equations" not in left_out:
        yield "event indicators of the model"
        yield count("event indicators of the model", wrong_indicators, fmu, truth)
        yield "equations"
        yield figure("equations", _EQUATION_LIMIT, equation_error, fmu, truth)
    try:
        for run in truth.runs:
            yield run.name
            yield compare(fmu, truth, run)
        problem = truth.problem
    except BREAKDOWNS as error:
        problem = str(error)
    if problem:
        yield stopped("trajectories", f"the comparison stopped: {problem}")


def _load(path: Path, unpacked: Path, loaded: list[Fmu]) -> Iterator[str]:
    """Append the FMU with its binary; what prevents that is the problem."""
    try:
        loaded.append(Fmu(path, unpacked))
    except InputError as error:
        yield str(error)


def _instantiates(fmu: Fmu, interface: int) -> Iterator[str]:
    instance = fmu.instantiate(interface)
    if instance is None:
        yield "there is no instance: description and binary are not of the same export"
    else:
        instance.free()


_INTERFACES = {
    "co-simulation instantiates": CO_SIMULATION,
    "model exchange instantiates": MODEL_EXCHANGE,
}
_CALLS: dict[str, Callable[[Fmu], Iterable[str]]] = {
    **CALLS,
    "nominal values": wrong_nominals,
    "event indicators": event_indicators,
    "dependencies complete": incomplete_dependencies,
}
_CALLS3: dict[str, Callable[[Fmu], Iterable[str]]] = {
    "intermediate update": intermediate_update,
    "event mode": event_mode,
}
_FIGURES: dict[str, tuple[float, Callable[[Fmu], float]]] = {
    "directional derivatives": (1e-5, directional_error),
}
_FIGURES3: dict[str, tuple[float, Callable[[Fmu], float]]] = {
    "adjoint derivatives": (1e-10, adjoint_error),
}
