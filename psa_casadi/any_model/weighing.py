"""Do the names that a search found stand: in every output, and against free functions?"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from psa_casadi.any_model.free_functions import Free
from psa_casadi.any_model.hypothesis import OdeHypothesis
from psa_casadi.any_model.identify import MISSED
from psa_casadi.any_model.search import Known
from psa_casadi.diagnosis.screening import temperature
from psa_casadi.diagnosis.task import thresholds
from psa_casadi.notes import Note, note


@dataclass(frozen=True)
class Weighed:
    """What causes, or a free function, remove of the base's held-out error above the noise.

    `together` of all outputs, each over its noise; `each` of those that the base clearly misses.
    """

    together: float
    each: Mapping[str, float]

    @property
    def least(self) -> tuple[str, float]:
        """The output of which the least is removed, "" for all together, and that share."""
        return min(self.named.items(), key=lambda item: item[1])

    @property
    def enough(self) -> bool:
        """Whether so much of every output is removed that names may stand where more is left."""
        return self.least[1] >= thresholds().enough

    @property
    def named(self) -> dict[str, float]:
        """Every share by the name of its output, "" for all together."""
        return {"": self.together, **self.each}


@dataclass(frozen=True)
class Beaten:
    """A free function that takes the names away, and the output (or "") where it removes more."""

    by: Free
    output: str
    names: float
    function: float


def weighed(
    root: OdeHypothesis, errors: Sequence[float], noise: Sequence[float], together: float
) -> Weighed:
    """Weigh a model by the `errors` that it leaves of every output, with its share `together`.

    An output counts by itself where there are several, and the base's held-out rms is above
    `MISSED` times the noise:

        share_j = (P_base,j - P_j) / (P_base,j - s_j^2)
    """
    rows = list(zip(root.fit.outputs, root.errors, errors, noise, strict=True))
    if len(rows) == 1:
        return Weighed(together, {})
    each = {
        o.column: (base**2 - left**2) / (base**2 - floor**2)
        for o, base, left, floor in rows
        if base > MISSED * floor
    }
    return Weighed(together, each)


def beaten_by(
    known: Known,
    best: OdeHypothesis,
    own: Weighed,
    free: Sequence[Free],
    noise: Sequence[float],
) -> Beaten | None:
    """Return the free function that takes the names away, if there is one.

    It is clearly likelier, removes more of some output by more than a form may cost, and of none so
    much less.
    """
    evidence, form = known.evidence(best), thresholds().form
    for f in free:
        clearly = thresholds().clearly * temperature(max(evidence, f.evidence))
        if f.evidence - thresholds().price <= known.of_fitted(best) + clearly:
            continue
        theirs = weighed(known.found[frozenset()], f.errors, noise, f.share).named
        more = {n: theirs[n] - share for n, share in own.named.items()}
        where = max(more, key=lambda n: more[n])
        if more[where] > form and min(more.values()) >= -form:
            return Beaten(f, where, own.named[where], theirs[where])
    return None


def why_not_named(names: tuple[str, ...], own: Weighed, beaten: Beaten | None) -> Note:
    """Return why causes that were found are not told."""
    if beaten:
        f = beaten.by
        why = note("free_beats", of=f.of, port=f.port.words, share=beaten.function)
        return note("own_withdrawn", names=names, share=beaten.names, output=beaten.output, why=why)
    output, share = own.least
    why = note("own_little", least=thresholds().enough)
    return note("own_withdrawn", names=names, share=share, output=output, why=why)


def left_out(known: Known, best: OdeHypothesis) -> tuple[Note, ...]:
    """Return which causes are clearly likelier than the best ones, and add too little to be told.

    Only where structure remains beside the best.
    """
    if not best.causes or not known.view(best).test.alarm:
        return ()
    clearly = thresholds().clearly * temperature(known.evidence(best))
    better = [h for h in known.found.values() if known.score(h) > known.score(best) + clearly]
    better = [h for h in better if known.slight(h) and known.stands(h)]
    top = max(better, key=known.score, default=None)
    if top is None:
        return ()
    names, small = (tuple(sorted(n)) for n in (top.names, known.slight(top)))
    more = known.evidence(top) - known.evidence(best)
    return (note("slight", names=names, more=more, small=small, least=thresholds().further),)
