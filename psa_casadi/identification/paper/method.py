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
from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.identification.identify import Identification, with_provenance
from psa_casadi.identification.paper.hysteresis import Bends, HysteresisPart, hysteresis_part
from psa_casadi.identification.paper.linear import (
    LinearPart,
    Loop,
    Step,
    find_loops,
    find_steps,
    linear_part,
    mechanics_of,
)
from psa_casadi.identification.refitting import noise_levels
from psa_casadi.identification.start.ordinary import ordinary_values, starting_model
from psa_casadi.model.compose import Model
from psa_casadi.notes import Note, note, texts
from psa_casadi.records.record import Record
from psa_casadi.records.split import whole

#: The paper's loops are slower than this [Hz], and their lag should stay below this angle [rad].
_SLOW, _QUASI_STATIC = 1.0, 0.01


def conditions(step: Step | None, loops: Sequence[Loop], linear: LinearPart | None) -> list[Note]:
    """Note what the records lack: a step, a loop, loops that are slow, from 0 V, without gaps."""
    notes = [note("no_step", loops=bool(loops))] if step is None else []
    notes += [] if loops else [note("no_loop")]
    notes += linear.notes if linear else ()
    if not loops:
        return notes
    frequency = loops[0].frequency
    if frequency > 1.001 * _SLOW:
        notes.append(note("fast_loops", frequency=frequency))
    if linear is not None:
        delay = linear.coefficients["a_1"] - linear.coefficients["b_1"]
        angle = 2.0 * np.pi * frequency * delay
        if angle > _QUASI_STATIC:
            notes.append(note("lagging_step", delay=1e3 * delay, angle=angle, frequency=frequency))
    away = [o.name for o in loops if abs(o.first_volts) > 0.02 * float(np.ptp(o.voltage))]
    gaps = [f"{loop.name} ({loop.missing})" for loop in loops if loop.missing]
    notes += [note("not_from_rest", names=away)] if away else []
    notes += [note("bridged", names=gaps)] if gaps else []
    return notes


def in_forces(
    start: Model,
    k: float | None,
    coefficients: Mapping[str, float] | None,
    bend: HysteresisPart,
) -> tuple[Model, tuple[str, ...], list[Note]]:
    """Return `start` with everything that was found, k_P and k_B being those of `start`.

    Beside it the names of the parameters that were found, and what could not be taken over.
    k_L = k/C with C = 1/k_P + 1/k_B [m/N]; lag, masses and dampings are factors of the denominator.
    Without a loop f_H is 0; without factors the parts are damped critically, c >= 2 sqrt(k m),
    since nothing is known to ring. A value out of its bounds is refused, n is clipped.
    """
    p = start.values
    compliance = static_compliance(p)
    critical = {f"c_{q}": 2.0 * float(np.sqrt(p[f"k_{q}"] * p[f"m_{q}"])) for q in "PB"}
    still = dict.fromkeys(("A", "beta", "gamma", "delta"), 0.0)
    usual = start.with_values({**still, **{c: max(v, p[c]) for c, v in critical.items()}})
    motion, notes = (
        ({}, ()) if coefficients is None else mechanics_of(coefficients, p["k_P"], p["k_B"])
    )
    wanted = {**motion, **_loop(bend, compliance, p["h_ref"])}
    if k is not None:
        wanted["k_L"] = k / compliance
    kept, refused = _inside(usual, wanted)
    found = tuple(name for name in start.parameter_names if name in kept)
    return usual.with_values(kept), found, [*notes, *refused]


def _loop(bend: HysteresisPart, compliance: float, h_ref: float) -> dict[str, float]:
    """Return the loop in forces, {} where it is not complete.

    h = C f_H gives A/C and delta/C. As eq. (8) is in r = |f_H|/h_ref here, beta becomes
    beta C^(n-1) h_ref^n, and gamma likewise.
    """
    if bend.A is None or bend.delta is None or bend.bends is None:
        return {}
    n = bend.bends.n
    unit = compliance ** (n - 1.0) * h_ref**n
    return {
        "A": bend.A / compliance,
        "delta": bend.delta / compliance,
        "n": n,
        "beta": bend.bends.beta * unit,
        "gamma": bend.bends.gamma * unit,
    }


def _inside(model: Model, wanted: Mapping[str, float]) -> tuple[dict[str, float], list[Note]]:
    """Return the values that the parameters' bounds allow, and a note for each other one."""
    kept, refused = {}, []
    for name, value in wanted.items():
        p = model.parameter(name)
        low, high = p.bounds
        within = low <= value <= high
        if within or (name == "n" and np.isfinite(value)):
            kept[name] = float(np.clip(value, low, high))
        if not within:
            instead = kept.get(name, model.values[name])
            refused.append(
                note(
                    "out_of_range",
                    name=name,
                    value=value,
                    unit=p.unit,
                    low=low,
                    high=high,
                    instead=instead,
                )
            )
    return kept, refused


#: The part of the rising branch, of the largest voltage, whose slope stands in for a step's.
_TIP = (0.8, 0.97)


@dataclass(frozen=True, eq=False)
class PaperIdentification:
    """What the paper's method finds; None where it finds nothing.

    `coefficients` are a_1 [s] to a_5 [s^5] and b_1 [s] of eq. (15). `k` [m/V], `A` [m/V], `delta`
    [m/(V.s)] and `bends` (n, beta, gamma) are in displacement units, eqs. (25), (26). `model` has
    them in forces; without a loop its f_H is 0, and what else was not found has ordinary values.
    `found` names the parameters that the method set; `notes` tell what failed or is doubtful.
    """

    coefficients: Mapping[str, float] | None
    k: float | None
    A: float | None
    delta: float | None
    bends: Bends | None
    model: Model
    found: tuple[str, ...]
    notes: tuple[Note, ...]

    @property
    def sentences(self) -> tuple[str, ...]:
        """What failed or is doubtful, in words."""
        return texts(self.notes)


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
    model, found, notes = in_forces(
        starting_model(records, stiffness), k, linear.coefficients if linear else None, bend
    )
    return PaperIdentification(
        coefficients=linear.coefficients if linear else None,
        k=k,
        A=bend.A,
        delta=bend.delta,
        bends=bend.bends,
        model=model,
        found=found,
        notes=(*conditions(step, slowest, linear), *bend.notes, *notes),
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
    sigma, doubts, found = noise_levels(experiments), paper.notes, paper.found
    progress("the model on all records")
    try:
        best = fit(paper.model, experiments, [], sigma=sigma)
    except InputError:
        raise
    except PsaError:
        usual = paper.model.with_values(ordinary_values(paper.model, records))
        best = fit(usual, experiments, [], sigma=sigma)
        doubts, found = (*doubts, note("runs_away")), ()
    nothing = determinacy(best, experiments)
    model = with_provenance(best.model, nothing, records, stiffness is not None)
    notes = (*model.provenance.notes, str(note("paper", names=found)))
    provenance = replace(model.provenance, notes=notes)
    return Identification(
        model=replace(model, provenance=provenance),
        fit=best,
        determinacy=nothing,
        experiments=experiments,
        doubts=doubts,
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
