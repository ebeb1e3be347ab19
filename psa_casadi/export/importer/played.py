"""An FMU as a whole in the middle of a model: only what goes in and what comes out is known.

    u -- effects of inputs --> applied u -- FMU(p) --> y -- effects of outputs --> reported y

Effects are CasADi's as everywhere, with exact derivatives. Those of the FMU by its parameters, and
by those of effects at its inputs, are differences of whole runs, side by side in processes: one run
for each, and none for effects of outputs. What was run once is not run again.
"""

import atexit
import hashlib
import threading
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from psa_casadi.common.errors import InputError, MachineError
from psa_casadi.common.interruption import raise_if_stopped
from psa_casadi.common.processes import Processes
from psa_casadi.common.symbolic import in_turn
from psa_casadi.common.units import FloatArray
from psa_casadi.export.importer.fmu import CO_SIMULATION
from psa_casadi.export.importer.imported import Selected
from psa_casadi.export.importer.masters import Run, Signals, play
from psa_casadi.model.component import Component, Equations, Expression, Symbols
from psa_casadi.model.compose import Model, Structure
from psa_casadi.model.ports import Opened, ported
from psa_casadi.model.variables import Input, Output
from psa_casadi.simulation.exact.split import closure, dependence
from psa_casadi.simulation.side_by_side import threads
from psa_casadi.simulation.start import start_for
from psa_casadi.simulation.stepper import SimulationError, Steps, run

#: Step of a difference over the usual size of a parameter: far above what a solver with a tolerance
#: of 1e-6 errs by, and small enough for a slope that is right to a thousandth.
_STEP = 1e-3
#: A slope jumps at a sample where it is this many times its neighbours, and this share of the
#: largest: an output that is discontinuous at an event has another value there. Then the lesser of
#: the differences to either side is its slope.
_SPIKE, _SPIKE_SHARE = 5.0, 0.05
#: A step is divided until twice as many parts change an output by less than this share of its
#: standard deviation, a twentieth of a noise of 1 %; into this many parts at most.
_SETTLED, _MOST_PARTS = 5e-4, 32
#: Parts of a step by FMU and record.
_PARTS: dict[str, int] = {}
#: Runs that are kept, and how long [s] until it is looked whether the work is to end.
_KEPT, _LOOK = 512, 0.1
#: Prefixes of names in a model without its FMU: the FMU's outputs, which are played to it as
#: inputs, and the FMU's inputs, which are its outputs.
PLAYED, SUPPLIED = "played_", "given_"


@dataclass(frozen=True)
class Played:
    """An FMU that is run as a whole: its file, and its variables in the order of the model's.

    `names` are those of its parameters in the model.
    """

    file: str
    digest: str
    interface: int
    selected: Selected
    names: tuple[str, ...]

    def play(
        self, values: Mapping[str, float], t: FloatArray, u: FloatArray, hold: str, parts: int = 1
    ) -> Run:
        """Return a run with values of parameters and inputs (n, nu), each step in `parts`."""
        s = self.selected
        starts = zip(s.parameters, (values[n] for n in self.names), strict=True)
        inputs = Signals(s.inputs, t, u, hold == "zero")
        what = s.outputs, {**dict(s.fixed), **dict(starts)}, inputs, parts
        return Run(self.file, self.digest, self.interface, *what)

    def _parts(self, run: Run) -> int:
        """Return into how many parts a step of co-simulation is divided with the inputs of a run.

        It is decided once for a record, at the first values: as many as it takes until twice as
        many change no output by more than a small share of its standard deviation.
        """
        if self.interface != CO_SIMULATION:
            return 1
        key = _key(replace(run, values=dict(self.selected.fixed)))
        if key not in _PARTS:
            parts, (before,) = 1, RUNS.of([run])
            while parts < _MOST_PARTS:
                (after,) = RUNS.of([replace(run, parts=2 * parts)])
                size = np.maximum(np.std(after, axis=0), 1e-300)
                if np.max(np.sqrt(np.mean((after - before) ** 2, axis=0)) / size) < _SETTLED:
                    break
                parts, before = 2 * parts, after
            _PARTS[key] = parts
        return _PARTS[key]

    def run(
        self, model: Model, t: FloatArray, u: FloatArray, x0: FloatArray, *, rtol: float,
        hold: str, unknowns: Sequence[str | int], s0: FloatArray | None,
        outputs: Sequence[str] | None, values: Mapping[str, float] | None = None,
    ) -> Steps:  # fmt: skip
        """Run a model with this FMU in it; see `stepper.run`.

        States are those of effects. They begin as far from rest as `x0` is from the rest that
        `start_for` finds without the FMU, whatever `s0` is.
        """
        at = dict(values or model.values)
        inner = inner_of(model).with_values(at)
        wanted = list(model.output_names if outputs is None else outputs)
        away, names = x0 - start_for(model, t, u, {}).x, inner.output_names
        states = dict(zip(model.state_names, away.tolist(), strict=True))
        count, inputs = len(unknowns), [SUPPLIED + n for n in model.input_names]

        def around(y: FloatArray, texts: Sequence[str], by: Sequence[str | int]) -> Steps:
            """Return a run of the effects alone, with outputs (n, ny) of the FMU."""
            whole = np.hstack([u, y])
            begin = start_for(inner, t, whole, states)
            columns = [
                begin.by_parameter[:, inner.parameter_names.index(q)]
                if isinstance(q, str)
                else begin.by_start[:, q]
                for q in by
            ]
            slopes = np.array(columns).reshape(len(by), len(x0)).T
            return run(
                inner, t, whole, begin.x, rtol=rtol, hold=hold, unknowns=by, s0=slopes,
                outputs=texts,
            )  # fmt: skip

        silent = np.zeros((len(t), len(self.selected.outputs)))
        before = around(silent, inputs, unknowns)
        applied = before.y[:, [names.index(n) for n in inputs]]
        kept = hold if not _filtered(inner.structure) else "linear"
        moved = [
            k
            for k, q in enumerate(unknowns)
            if q in self.names or np.any(before.sensitivity[:, :, k])
        ]
        steps = {k: _step(inner, unknowns[k], at) for k in moved}

        parts = self._parts(self.play(at, t, u, kept))

        def changed(k: int, side: int) -> Run:
            """Return the run with a step of an unknown to one side."""
            q, h = unknowns[k], side * steps[k]
            new = {**at, q: at[q] + h} if isinstance(q, str) else at
            return self.play(new, t, applied + h * before.sensitivity[:, :, k], kept, parts)

        plain, *others = RUNS.of(
            [self.play(at, t, applied, kept, parts), *(changed(k, 1) for k in moved)]
        )
        result = around(plain, wanted, unknowns)
        rows = [names.index(n) for n in wanted]

        def slope(k: int, side: int, y: FloatArray) -> FloatArray:
            return (around(y, wanted, ()).y[:, rows] - result.y[:, rows]) / (side * steps[k])

        slopes = {k: slope(k, 1, y) for k, y in zip(moved, others, strict=True)}
        jumping = [k for k in moved if _jumps(slopes[k])]
        back = RUNS.of([changed(k, -1) for k in jumping])
        for k, y in zip(jumping, back, strict=True):
            slopes[k] = _lesser(slopes[k], slope(k, -1, y))
        sensitivity = result.sensitivity.copy()
        for k in moved:
            sensitivity[:, :, k] += slopes[k]
        every = [names.index(n) for n in model.output_names]
        return replace(
            result, y=result.y[:, every], sensitivity=sensitivity.reshape(len(t), len(rows), count)
        )


def _jumps(slope: FloatArray) -> bool:
    """Whether a difference (n, m) leads across jumps: samples far above their neighbours."""
    size = np.abs(slope)
    others = np.maximum(size[:-2], size[2:])
    least = _SPIKE_SHARE * np.max(size, axis=0, initial=0.0)
    return bool(np.any((size[1:-1] > _SPIKE * others) & (size[1:-1] > least)))


def _lesser(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return what is nearer to 0, and 0 where the signs differ."""
    nearer = np.where(np.abs(one) < np.abs(other), one, other)
    return np.where(one * other > 0, nearer, 0.0)


def _step(model: Model, unknown: str | int, values: Mapping[str, float]) -> float:
    """Return the step of a difference, away from the nearer bound."""
    if not isinstance(unknown, str):
        return _STEP * float(model.state_nominals()[unknown])
    p, value = model.parameter(unknown), values[unknown]
    size = _STEP * p.typical(values)
    return -size if value + size > p.bounds[1] else size


@dataclass(frozen=True, eq=False)
class Passed:
    """Outputs with the inputs that they are, 0 without one; `still` is a state that stays."""

    pairs: tuple[tuple[str, str], ...]
    still: str = ""

    def __call__(self, s: Symbols) -> Equations:
        """Return the equations."""
        out: dict[str, Expression] = {o: getattr(s, i) if i else ca.SX(0) for o, i in self.pairs}
        return Equations(out=out, der={self.still: ca.SX(0)} if self.still else {})


def inner_of(model: Model) -> Model:
    """Return a model without its FMU, whose outputs are inputs `played_y` instead.

    It has outputs `given_u`: the inputs that the FMU gets. Raises InputError where effects lead
    from its outputs to its inputs.
    """
    inner = model.with_components(_inner(c) if c.played else c for c in model.components)
    if _loops(inner.structure):
        raise InputError(
            "An effect at an input of the FMU depends on an output of it; only effects before it"
            " and behind it can be simulated."
        )
    return inner


@cache
def _inner(component: Component) -> Component:
    opened = component.equations if isinstance(component.equations, Opened) else None
    inputs, outputs = component.inputs, component.outputs
    played = [Input(PLAYED + o.name, o.unit, o.description) for o in outputs]
    supplied = [Output(SUPPLIED + i.name, i.unit, i.description) for i in inputs]
    pairs = [*zip(outputs, played, strict=True), *zip(supplied, inputs, strict=True)]
    plain = replace(
        opened.component if opened else component,
        equations=Passed(tuple((o.name, i.name) for o, i in pairs)),
        inputs=(*inputs, *played),
        outputs=(*outputs, *supplied),
        foreign=None,
        played=None,
    )
    return ported(plain, frozenset(opened.ports)) if opened else plain


@cache
@in_turn
def _loops(structure: Structure) -> bool:
    """Whether inputs of an FMU depend on its outputs, directly or through states."""
    reach = closure(dependence(structure.xdot, structure.x))
    played = ca.vertcat(
        ca.SX(0, 1),
        *(structure.symbols[i.name] for i in structure.inputs if i.name.startswith(PLAYED)),
    )
    hit = [k for k, rate in enumerate(ca.vertsplit(structure.xdot)) if ca.depends_on(rate, played)]
    behind = [k for k in range(structure.x.numel()) if any(k == j or reach[k, j] for j in hit)]
    return _inputs_depend(structure, ca.vertcat(played, structure.x[behind]))


@cache
@in_turn
def _filtered(structure: Structure) -> bool:
    """Whether inputs of an FMU depend on states, so that held inputs are not held there."""
    return _inputs_depend(structure, structure.x)


def _inputs_depend(structure: Structure, symbols: Expression) -> bool:
    """Whether inputs of an FMU depend on symbols."""
    rows = [k for k, o in enumerate(structure.outputs) if o.name.startswith(SUPPLIED)]
    return bool(rows and symbols.numel() and ca.depends_on(structure.y[rows], symbols))


class _Runs:
    """Runs of FMUs in processes; those that were are kept.

    `count` is how many there were, `samples` how many samples they had.
    """

    def __init__(self) -> None:
        self.count = self.samples = 0
        self._kept: dict[str, Future[Any]] = {}
        self._processes: Processes | None = None
        self._lock = threading.Lock()

    def of(self, runs: Iterable[Run]) -> list[FloatArray]:
        """Return the outputs of runs. Raises SimulationError."""
        futures = []
        with self._lock:
            for wanted in runs:
                key = _key(wanted)
                if key not in self._kept:
                    self._kept[key] = self._submitted(wanted)
                futures.append(self._kept[key])
            for key in list(self._kept)[:-_KEPT]:
                del self._kept[key]
        try:
            return [_waited(future) for future in futures]
        except KeyboardInterrupt:
            self.end()
            raise

    def _submitted(self, wanted: Run) -> Future[Any]:
        self.count, self.samples = self.count + 1, self.samples + len(wanted.inputs.times)
        if self._processes is None:
            self._processes = Processes(threads(), again=True)
            atexit.register(self.end)
        return self._processes.submit(play, wanted)

    def forget(self) -> None:
        """Forget the runs that were."""
        self._kept.clear()

    def end(self) -> None:
        """End the processes, and forget."""
        self.forget()
        if self._processes is not None:
            self._processes.end()
            self._processes = None


def _waited(future: Future[Any]) -> FloatArray:
    """Return what comes of a run. Raises SimulationError, KeyboardInterrupt."""
    result: FloatArray | str | None = None
    while result is None:
        try:
            result = future.result(timeout=_LOOK)
        except TimeoutError:
            raise_if_stopped()
        except MachineError as error:
            result = str(error)
    if isinstance(result, str) or not np.isfinite(result).all():
        why = result if isinstance(result, str) else "its outputs are not finite"
        raise SimulationError(f"The FMU could not be simulated: {why}")
    return result


def _key(r: Run) -> str:
    i = r.inputs
    what = (r.file, r.digest, r.interface, i.names, r.outputs, r.values, i.held, r.parts)
    return hashlib.sha256(repr(what).encode() + i.times.tobytes() + i.values.tobytes()).hexdigest()


RUNS = _Runs()
