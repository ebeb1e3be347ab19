"""Two ways through a record: exact steps where the model and the record allow, else the stepper."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.model.compose import Model
from psa_casadi.simulation.exact.run import NotExact, run_exact
from psa_casadi.simulation.stepper import Steps, run

FloatArray = npt.NDArray[np.float64]

#: Outputs that are the displacement a model shows, the first that it has.
SHOWN = ("measured_displacement", "displacement")
#: Names of the two ways in results.
EXACT, STEPPER = "exact steps", "stepper"
#: The stepper's tolerance of a step over the one asked of the whole run: with the 0.003 of the
#: FMU (`fmu_src/instance.c`) clipped voltages and light resonances erred by 3 times what was asked.
STEP_SHARE, SMALLEST_STEP_RTOL = 0.0005, 1e-12
#: Exact steps for `accurate`: tolerance of a step over the one asked, least halvings of a sample.
#: Each is judged by the one before; a turn that one halving misses as well is seen after two.
LADDER = ((0.03, 0), (0.01, 2), (3e-3, 4), (3e-3, 6))
#: Share of the tolerance to which two runs agree: the finer one may err by a part of it that both
#: have in common.
AGREE = 0.5
#: Below this tolerance two runs may share an error that is of its size: the stepper is taken.
TIGHTEST = 1e-6
#: Loosest tolerance of exact steps: beyond it nothing is won.
LOOSEST = 1e-5
#: Range below which a displacement counts as constant, over its nominal size.
STILL = 1e-3


@dataclass(frozen=True)
class Way:
    """How a record is run: tolerance of an exact step, and of a step of the stepper.

    Exact steps divide every sample by 2^`halved` at least; `stepped` rules them out.
    """

    rtol: float
    step_rtol: float
    halved: int = 0
    stepped: bool = False

    @property
    def finer(self) -> "Way":
        """A way whose error is far smaller: what this one's is judged by."""
        return Way(0.1 * self.rtol, 0.1 * self.step_rtol, self.halved + 1, self.stepped)


@dataclass(frozen=True)
class Traced:
    """One output (n,), its derivatives (n, k), and the way that was taken."""

    output: FloatArray
    sensitivity: FloatArray
    way: str


def output_of(model: Model) -> str | None:
    """Return the name of the displacement that a model shows, None if it has none."""
    return next((n for n in SHOWN if n in model.output_names), None)


def trace(
    model: Model,
    t: FloatArray,
    u: FloatArray,
    x0: FloatArray,
    *,
    way: Way,
    output: str,
    unknowns: Sequence[str | int] = (),
    s0: FloatArray | None = None,
    steps_limit: int = 0,
    steps_most: int = 0,
) -> Traced:
    """Return one output of a run and its derivatives by `unknowns` (see `run`).

    `steps_limit` bounds the stepper's work between two samples, `steps_most` that of the run.
    Raises SimulationError where both ways fail.
    """
    none = np.zeros((len(t), 0))
    if not way.stepped:
        try:
            found = run_exact(
                model, t, u, x0, tolerance=min(way.rtol, LOOSEST), coarsest=way.halved,
                unknowns=unknowns, s0=s0, output=output,
            )  # fmt: skip
            slopes = none if found.sensitivity is None else found.sensitivity
            return Traced(found.shown, slopes, EXACT)
        except NotExact:
            pass
    steps = run(
        model, t, u, x0, rtol=way.step_rtol, steps_limit=steps_limit, steps_most=steps_most,
        unknowns=unknowns, s0=s0, output=output,
    )  # fmt: skip
    slopes = none if steps.sensitivity is None else steps.sensitivity
    return Traced(steps.y[:, model.output_names.index(output)], slopes, STEPPER)


def accurate(
    model: Model, t: FloatArray, u: FloatArray, x0: FloatArray, *, rtol: float, hold: str
) -> tuple[Steps, str]:
    """Return a run whose displacement errs by less than `rtol` of its range, and the way taken.

    Exact steps get finer until two runs agree to that; where they do not, or for tolerances below
    1e-6, the stepper takes steps of 0.0005 `rtol`.
    """
    output = output_of(model)
    before: FloatArray | None = None
    nominal = 0.0 if output is None else model.output_nominals()[model.output_names.index(output)]
    for share, coarsest in LADDER if output and rtol >= TIGHTEST else ():
        try:
            found = run_exact(
                model, t, u, x0, tolerance=max(share * rtol, 1e-13), coarsest=coarsest, hold=hold,
                output=output or "", everything=before is not None,
            )  # fmt: skip
        except NotExact:
            break
        size = max(float(np.ptp(found.shown)), STILL * nominal)
        fine = before is not None and not found.forced
        if (
            before is not None
            and fine
            and np.max(np.abs(found.shown - before)) <= AGREE * rtol * size
        ):
            x, y = found.x, found.y
            if x is not None and y is not None:
                empty = np.empty((len(t), 0))
                steps = Steps(x, empty, y, None, found.steps, found.rejected, 0)
                return steps, EXACT
        before = found.shown
    share = max(STEP_SHARE * rtol, SMALLEST_STEP_RTOL)
    return run(model, t, u, x0, rtol=share, hold=hold), STEPPER
