"""The paper's identification as a whole: what it finds, what fails, and the model that follows.

Source: Yang and Zhu 2015, section 3. The linear part comes from the response to a step, the
hysteresis from loops below 1 Hz. The paper knows no drive: the voltage of the record, which is the
command, is taken for the stack's voltage, so that a slow amplifier counts as creep and mechanics.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from psa_casadi.errors import InputError, PsaError
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.identification.identify import Identification, with_provenance
from psa_casadi.identification.paper.conditions import loop_conditions, missing
from psa_casadi.identification.paper.forces import in_forces
from psa_casadi.identification.paper.hysteresis import Bends, HysteresisPart, hysteresis_part
from psa_casadi.identification.paper.linear import Loop, find_loops, find_steps, linear_part
from psa_casadi.identification.refitting import noise_levels
from psa_casadi.identification.start.ordinary import ordinary_values, starting_model
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.records.split import whole

#: The part of the rising branch, of the largest voltage, whose slope stands in for a step's.
_TIP = (0.8, 0.97)


@dataclass(frozen=True, eq=False)
class PaperIdentification:
    """What the paper's method finds; None where it finds nothing.

    `coefficients` are a_1 [s] to a_5 [s^5] and b_1 [s] of eq. (15). `k` [m/V], `A` [m/V], `delta`
    [m/(V.s)] and `bends` (n, beta, gamma) are in displacement units, eqs. (25), (26). `model` has
    them in forces; without a loop its f_H is 0, and what else was not found has ordinary values.
    `found` names the parameters that the method set; `sentences` say what failed or is doubtful.
    """

    coefficients: Mapping[str, float] | None
    k: float | None
    A: float | None
    delta: float | None
    bends: Bends | None
    model: Model
    found: tuple[str, ...]
    sentences: tuple[str, ...]


def paper_method(
    records: Sequence[Record], *, stiffness: float | None = None
) -> PaperIdentification:
    """Identify a stack as the paper does: moments of the smallest step, crossings of the loops.

    `stiffness` [N/m] fixes the scale of the forces as in `starting_model`. Of the loops the slowest
    are taken, all amplitudes together. Raises InputError where a record has no displacement.
    """
    steps, loops = find_steps(records), find_loops(records)
    step = steps[0] if steps else None
    linear = linear_part(step) if step is not None else None
    slowest = [loop for loop in loops if loop.frequency < 1.05 * loops[0].frequency]
    k = step.k if step is not None else _slope_at_tip(slowest)
    bend = hysteresis_part(slowest, k) if slowest and k is not None else HysteresisPart()
    translated = in_forces(
        starting_model(records, stiffness), k, linear.coefficients if linear else None, bend
    )
    sentences = (
        *missing(step, slowest),
        *(linear.sentences if linear else ()),
        *loop_conditions(slowest, linear),
        *bend.sentences,
        *translated.sentences,
    )
    return PaperIdentification(
        coefficients=linear.coefficients if linear else None,
        k=k,
        A=bend.A,
        delta=bend.delta,
        bends=bend.bends,
        model=translated.model,
        found=translated.found,
        sentences=sentences,
    )


def identify_by_paper(
    records: Sequence[Record],
    *,
    stiffness: float | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Identification:
    """Return the paper's identification with its residuals on all records, as `identify` does.

    Nothing is fitted but each record's memory and offset; so there are no intervals. The warnings
    are the method's own sentences. Raises InputError, SimulationError.
    """
    progress("moments and zero crossings")
    paper = paper_method(records, stiffness=stiffness)
    experiments = tuple(whole(r) for r in records)
    sigma, sentences = noise_levels(experiments), paper.sentences
    found = paper.found
    progress("the model on all records")
    try:
        best = fit(paper.model, experiments, [], sigma=sigma)
    except InputError:
        raise
    except PsaError:
        usual = paper.model.with_values(ordinary_values(paper.model, records))
        best = fit(usual, experiments, [], sigma=sigma)
        sentences, found = (*sentences, _RUNS_AWAY), ()
    nothing = determinacy(best, experiments)
    model = with_provenance(best.model, nothing, records, stiffness is not None)
    notes = (*model.provenance.notes, _note(found))
    provenance = replace(model.provenance, notes=notes)
    return Identification(
        model=replace(model, provenance=provenance),
        fit=best,
        determinacy=nothing,
        experiments=experiments,
        warnings=sentences,
        read_off=found,
    )


def _slope_at_tip(loops: Sequence[Loop]) -> float | None:
    """Return dx/du near the tip of the widest loop's rising branches [m/V], None without loops.

    Where eq. (8) is saturated, h' = 0 and x' = k u'; so it stands in for the slope of a step.
    """
    if not loops:
        return None
    widest = max(loops, key=lambda loop: float(np.ptp(loop.voltage)))
    u, x = widest.voltage, widest.displacement
    top = float(u[np.argmax(np.abs(u))])
    outward = np.gradient(u / top) > 0.0
    part = outward & (u / top > _TIP[0]) & (u / top < _TIP[1])
    if part.sum() < 3:
        return None
    return float(np.polyfit(u[part], x[part], 1)[0])


def _note(found: Sequence[str]) -> str:
    named = ", ".join(found) or "nothing"
    return (
        "Identified by the paper's method (Yang and Zhu 2015, section 3), which gives no intervals."
        f" It found {named}; all other parameters have ordinary values."
    )


_RUNS_AWAY = (
    "The model with these values cannot be simulated on the records (with A, beta and gamma like"
    " these the hysteresis grows without bound, or masses and dampings are out of proportion), so"
    " its loop, lags and masses were set back to ordinary values; use --method prediction-error."
)
