"""What may be in the place of a cause, fitted before it is judged."""

from psa_casadi.diagnosis.screening import temperature
from psa_casadi.diagnosis.search.fits import with_cause, without
from psa_casadi.diagnosis.search.known import Known


def fit_rivals(known: Known) -> None:
    """Fit to their end the effects that may be in the place of each cause of the answer.

    By their estimated evidence beside the other causes they are not clearly less likely.
    """
    best = known.answer
    for cause in best.causes:
        names = best.names - {cause.name}
        if names not in known.found:
            known.note(without(best, cause))
        less = known.found.get(names)
        if less is None:
            continue
        view, item = known.view(less), known.scale.evidence(less)
        top = known.scale.evidence(best) - item
        near = top - known.task.limits.clearly * temperature(top)
        for name, evidence in view.estimated().items():
            if evidence > near and names | {name} not in known.found:
                known.note(with_cause(less, view.starts_of(name)))
        items = [h for h in known.found.values() if h.names > names and len(h.names - names) == 1]
        known.remember(less, *(n for h in items for n in h.names - names))
        open_ones = [h for h in items if not h.final]
        known.finish([h for h in open_ones if known.scale.evidence(h) - item > near])
    known.worthy = frozenset(n for n, h in known.found.items() if known.worth(h))
