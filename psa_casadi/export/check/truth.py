"""What the checks of the foreign code need of the model: plain data that goes to their process."""

from dataclasses import dataclass

import casadi as ca

from psa_casadi.export.importer.masters import FloatArray, Signals


@dataclass(frozen=True)
class Run:
    """One run: where its inputs and points are, what must come of it, how far off it may be.

    `expected` (n, ny) at `times` (n,); `integrated` says that model exchange is used; a `tolerance`
    of None is the importer's. `scale` (ny,) and `by` are those of the truth unless given.
    """

    name: str
    times: FloatArray
    inputs: Signals
    expected: FloatArray
    limit: float
    tolerance: float | None = None
    integrated: bool = False
    scale: FloatArray | None = None
    by: str = ""


@dataclass(frozen=True)
class Truth:
    """The equations of a model, the runs to compare with, and why there are no more of them.

    `f` and `switches` take time and the vectors of states, inputs, parameters and sampled states.
    `starts` are the values of states, inputs and outputs before anything is set, `settled_starts`
    those of states and voltage, each with its usual size, where the FMU is told to begin settled at
    `start_voltage` [V]; None if they are not known. `compared` names what the runs compare, `scale`
    (ny,) its size, `by` who computed it.
    """

    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    parameter_names: tuple[str, ...]
    output_names: tuple[str, ...]
    switch_names: tuple[str, ...]
    f: ca.Function
    switches: ca.Function
    starts: dict[str, float]
    settled: bool
    compared: tuple[str, ...]
    by: str
    scale: FloatArray
    runs: tuple[Run, ...]
    problem: str = ""
    start_voltage: float = 0.0
    settled_starts: dict[str, tuple[float, float]] | None = None
