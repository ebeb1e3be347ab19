"""What a fit of any model searches, on scales where 1 is an ordinary change."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.any_model.runs import Run, measured_spans
from psa_casadi.any_model.start import searched_states
from psa_casadi.identification.fitting.unknowns import (
    LINEAR_PRIOR,
    LOG_PRIOR,
    Unknowns,
    memory_prior,
)
from psa_casadi.model.compose import Model
from psa_casadi.variables import nominal_value


def zero_name(output: str) -> str:
    """Return the name of the coordinate that is an output's unknown zero."""
    return f"zero of {output}"


def coordinates_of(
    model: Model,
    free: Sequence[str],
    runs: Sequence[Run],
    zeros: Sequence[str] = (),
    *,
    known_start: bool = False,
) -> Unknowns:
    """Set up the coordinates around a model's values.

    Parameters on the scale that they declare; per experiment the initial states as deviations from
    the declared starts (unless these are known) over their usual size, and the zeros of sensors
    over the output's range.
    Weak priors: `LOG_PRIOR` and `LINEAR_PRIOR` for parameters, `LINEAR_PRIOR` usual sizes for
    states and zeros, `memory_prior` for memories of effects. The coordinate that a stack's fit has
    for its sensor's offset stays at 0.
    """
    s, values = model.structure, model.values
    parameters = [model.parameter(n) for n in free]
    log = np.array([p.log and values[p.name] > 0 for p in parameters], dtype=bool)
    memories = {q.name for c in model.effects for q in c.states if q.memory}
    names = memories if known_start else searched_states(s)
    states = [q for q in s.states if q.name in names]
    spans = measured_spans(runs)
    sizes = [nominal_value(q.nominal, values) for q in states]
    sizes += [float(spans[model.output_names.index(n)]) or 1.0 for n in zeros]
    own = [memory_prior(q) if q.name in memories else LINEAR_PRIOR for q in states]
    own += [LINEAR_PRIOR] * len(zeros)
    started = (*(q.name for q in states), *(zero_name(n) for n in zeros))
    return Unknowns(
        names=tuple(free),
        started=tuple(started for _ in runs),
        reference=np.array([values[n] for n in free]),
        scale=np.array([p.typical(values) for p in parameters]),
        log=log,
        low=np.array([p.bounds[0] for p in parameters]),
        high=np.array([p.bounds[1] for p in parameters]),
        start_scale=tuple(np.array(sizes) for _ in runs),
        first_voltage=tuple(0.0 for _ in runs),
        compliance=0.0,
        offset_scale=1.0,
        prior=np.concatenate(
            [np.where(log, LOG_PRIOR, LINEAR_PRIOR), *([*own, 1.0] for _ in runs)]
        ),
    )
