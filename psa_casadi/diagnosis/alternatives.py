"""A cause that may as well be of the sensor as of the plant: the other model, and what differs.

What belongs to the sensor or the environment stays out of an exported plant. Where the records
cannot tell such a cause from one of the plant, which of the two is exported is not theirs to say.
So there are two models, and the difference of their plants' displacements is told.
"""

from collections.abc import Sequence

import numpy as np

from psa_casadi.component import Component
from psa_casadi.diagnosis.evidence import diagnosis_evidence
from psa_casadi.diagnosis.judgement import told_from
from psa_casadi.diagnosis.result import Alternative
from psa_casadi.diagnosis.search.fits import to_end, with_cause
from psa_casadi.diagnosis.search.hypothesis import Hypothesis
from psa_casadi.diagnosis.search.steps import Step
from psa_casadi.errors import PsaError
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.identify import with_provenance
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.simulate import simulate_record
from psa_casadi.simulation.start import memory_names


def alternatives(
    named: Sequence[Step],
    final: Fit,
    experiments: Sequence[Experiment],
    table: Sequence[Component],
    *,
    stiffness_given: bool,
) -> tuple[Alternative, ...]:
    """Return, for each cause that may lie on the other side of the sensor, the model with that one.

    Of several such effects the likeliest that can be fitted and simulated.
    """
    effects = {e.name: e for e in table}
    found = []
    for step in named:
        other = [
            n
            for n in told_from(step)
            if n in effects and effects[n].in_plant != step.cause.in_plant
        ]
        for name in sorted(other, key=lambda n: -step.probability.get(n, 0.0)):
            fitted = _fitted(step, name, experiments)
            if fitted is None:
                continue
            try:
                differs = _difference(final, fitted.fit, experiments)
            except PsaError:
                continue
            told = determinacy(fitted.fit, experiments)
            records = [e.record for e in experiments]
            evidence = diagnosis_evidence(fitted.fit, told, experiments, fitted.predicted)
            model = with_provenance(
                fitted.fit.model, told, records, stiffness_given, evidence=evidence
            )
            found.append(
                Alternative(step.cause.name, name, model, fitted.fit.rms / final.rms, *differs)
            )
            break
    return tuple(found)


def _fitted(step: Step, name: str, experiments: Sequence[Experiment]) -> Hypothesis | None:
    """Return the hypothesis with another effect in a cause's place, fitted to its end."""
    known = step.instead.get(name)
    if known is None and step.beside is not None:
        starts = step.beside.starts_of(name)
        known = with_cause(step.beside.of, experiments, starts) if starts else None
    return known if known is None or known.final else to_end(known, experiments)


def _difference(one: Fit, other: Fit, experiments: Sequence[Experiment]) -> tuple[float, float]:
    """Return by how much the plants of two fits differ on the records: most [m], and % of range.

    About the mean difference of each record, as the sensor's zero is free.
    """
    most = span = 0.0
    for k, e in enumerate(experiments):
        moved = []
        for fit in (one, other):
            plant = fit.model.plant()
            names = memory_names(plant.structure)
            memory = {n: v for n, v in fit.starts()[k].items() if n in names}
            moved.append(simulate_record(plant, e.record, memory).outputs["displacement"])
        apart = moved[0] - moved[1]
        most = max(most, float(np.max(np.abs(apart - np.mean(apart)))))
        span = max(span, e.record.range_m)
    return most, 100.0 * most / span
