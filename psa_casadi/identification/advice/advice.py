"""Which further record would determine what the records at hand leave open."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psa_casadi.errors import PsaError
from psa_casadi.identification.advice.plans import Plan, plans
from psa_casadi.identification.advice.scenarios import SEARCHABLE, scenarios
from psa_casadi.identification.determinacy import (
    DETERMINED_WIDTH,
    Determinacy,
    prior_information,
    record_information,
    sizes_of,
    standard_errors,
)
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.units import FloatArray

#: A plan with its information in every scenario (s, k, k), and with what it determines.
_Option = tuple[Plan, FloatArray]
_Gain = tuple[Plan, FloatArray, tuple[str, ...]]

#: A record is advised where it brings a standard error below this: half of what still counts.
_SURE = 0.5 * DETERMINED_WIDTH
#: How often a record is repeated where once is not enough.
_REPEATS = (1, 2, 5, 10)


@dataclass(frozen=True, eq=False)
class Advice:
    """A sentence, the parameters that the advised record determines, and the record's voltage.

    The record has no displacement yet; it is None where the advice is none to measure one.
    """

    sentence: str
    parameters: tuple[str, ...]
    record: Record | None
    repeats: int = 1


def advice(
    fit: Fit,
    experiments: Sequence[Experiment],
    found: Determinacy,
    *,
    force_scale_given: bool = False,
) -> tuple[Advice, ...]:
    """Return further records that would determine what is open, the shortest first.

    Open are the undetermined parameters of the fit and the lags and masses (`SEARCHABLE`) that it
    did not search because the records say too little. Each of `plans` is predicted in the two
    `scenarios` that fill these in; its information is added to that of the records at hand (the
    residuals' colour lowers the latter, the residuals' level is the noise of the former). A record
    is advised if in both it brings the standard error of an open parameter to half of what counts
    as determined; masses that only show where the mechanics ring are named apart. Records that
    determine much come before others, those that need no faster sampling than the records at hand
    before others. What no single one determines may need several, or repeats.
    """
    return _Adviser(fit, experiments, found).all(force_scale_given)


class _Adviser:
    """The information at hand and in every plan, for the fit's parameters and the fixed lags."""

    def __init__(self, fit: Fit, experiments: Sequence[Experiment], found: Determinacy) -> None:
        self._fit, self._found, self._experiments = fit, found, experiments
        extra = [n for n in SEARCHABLE if n in fit.model.values and n not in found.names]
        self._names = (*found.names, *extra)
        self._noise = max(fit.rms, min(fit.sigma))
        known = self._at_hand(fit.model)
        ratio = self._inflation(known)
        errors = standard_errors(known / ratio + prior_information(fit.model, self._names))
        self._open = {
            n
            for k, n in enumerate(self._names)
            if n in found.undetermined or (n in extra and errors[k] > DETERMINED_WIDTH)
        }
        self._scenarios = scenarios(fit.model, self._open)
        self._known = np.array(
            [
                self._at_hand(m) / ratio + prior_information(m, self._names)
                for m in (self._scenarios if self._open else ())
            ]
        )

    def _at_hand(self, model: Model) -> FloatArray:
        """Return the information (k, k) of the records at hand, without priors."""
        fit = self._fit
        parts = [
            record_information(
                model,
                e.record,
                self._names,
                fit.sigma[r],
                start=fit.start(r),
                start_sizes=fit.unknowns.start_scale[r].tolist(),
                used=e.used,
            )
            for r, e in enumerate(self._experiments)
        ]
        information: FloatArray = np.sum(parts, axis=0)
        return information

    def _inflation(self, data: FloatArray) -> float:
        """Return by how much the residuals' level and colour widen the intervals, squared."""
        names, count = self._found.names, len(self._found.names)
        prior = prior_information(self._fit.model, names)
        white = standard_errors(data[:count, :count] + prior)
        sizes = np.abs(sizes_of(self._fit.model, names))
        errors = np.array([self._found.standard_errors[n] for n in names]) / sizes
        sure = errors < DETERMINED_WIDTH
        return max(float(np.median((errors / white)[sure] ** 2)), 1.0) if sure.any() else 1.0

    def all(self, force_scale_given: bool) -> tuple[Advice, ...]:
        """Return the whole advice in its order."""
        results: list[Advice] = []
        left, known, counts = set(self._open), self._known, dict[str, int]()
        options = self._options() if left else []
        for plan, information, gain in self._cover(options, left):
            known, counts[plan.words] = known + information, 1
            results.append(self._single(plan, gain, options))
        wanted = left & set(self._found.names)
        while wanted and (more := self._more(options, known, wanted)) is not None:
            plan, information, repeats = more
            known = known + repeats * information
            gain = self._gain(known, left)
            counts[plan.words] = counts.get(plan.words, 0) + repeats
            results.append(self._together(plan, gain, counts[plan.words], bool(results)))
            left, wanted = left - set(gain), wanted - set(gain)
        ringing = self._ringing(known, left) if results else ()
        if ringing:
            left -= set(ringing)
            text = f"If the mechanics ring, {_listing(ringing)} would be determined as well."
            results.append(Advice(text, ringing, None))
        if left:
            rest = tuple(n for n in self._names if n in left)
            results.append(Advice(_nothing(rest, len(options)), rest, None))
        if not force_scale_given:
            results.append(Advice(FORCE_ADVICE, (), None))
        return tuple(results)

    def _options(self) -> list[_Option]:
        """Return every plan that can be simulated, with its information in every scenario."""

        def one(plan: Plan) -> _Option | None:
            try:
                found = [
                    record_information(m, plan.record, self._names, self._noise)
                    for m in self._scenarios
                ]
            except PsaError:
                return None
            return plan, np.array(found)

        records = [e.record for e in self._experiments]
        found = side_by_side(one, plans(self._scenarios, records))
        return [option for option in found if option is not None]

    def _gain(self, information: FloatArray, left: set[str]) -> tuple[str, ...]:
        """Return the parameters of `left` that are sure with this information in every scenario."""
        errors = np.max([standard_errors(i) for i in information], axis=0)
        return tuple(n for k, n in enumerate(self._names) if n in left and errors[k] < _SURE)

    def _ringing(self, information: FloatArray, left: set[str]) -> tuple[str, ...]:
        """Return the masses of `left` that are sure where the mechanics ring, the last scenario."""
        return tuple(n for n in self._gain(information[-1:], left) if n[0] == "m")

    def _cover(self, options: Sequence[_Option], left: set[str]) -> list[_Gain]:
        """Choose plans that each determine something alone, and take it out of `left`."""
        gains = [(plan, i, self._gain(self._known + i, left)) for plan, i in options]
        chosen: list[_Gain] = []
        while useful := [g for g in gains if left & set(g[2])]:
            best = min(useful, key=lambda g: (-len(left & set(g[2])), *self._effort(g[0], 1)))
            chosen.append(best)
            left -= set(best[2])
        return sorted(chosen, key=lambda g: g[0].duration)

    def _effort(self, plan: Plan, repeats: int) -> tuple[float, float]:
        """Return how much faster a plan samples than the records do, and how long it takes."""
        now = 1.0 / min(e.record.sample_time for e in self._experiments)
        return max(plan.rate / now, 1.0), repeats * plan.duration

    def _more(
        self, options: Sequence[_Option], known: FloatArray, left: set[str]
    ) -> tuple[Plan, FloatArray, int] | None:
        """Return the plan that determines most of what is left, with the fewest repeats."""
        for repeats in _REPEATS:
            gains = [(p, i, self._gain(known + repeats * i, left), repeats) for p, i in options]
            useful = [g for g in gains if g[2]]
            if useful:
                best = min(useful, key=lambda g: (-len(g[2]), *self._effort(g[0], g[3])))
                return best[0], best[1], repeats
        return None

    def _single(self, plan: Plan, gain: tuple[str, ...], options: Sequence[_Option]) -> Advice:
        """Say what a plan determines, with the other fast kind where that does as well."""
        words = plan.words
        for other, information in options:
            same = other.rate == plan.rate and {other.kind, plan.kind} == {"step", "multisine"}
            if same and set(gain) <= set(self._gain(self._known + information, self._open)):
                words += f", or {other.words.split(' (sampled')[0]},"
        return Advice(_sentence(f"{words} would determine {_listing(gain)}."), gain, plan.record)

    def _together(self, plan: Plan, gain: tuple[str, ...], repeats: int, after: bool) -> Advice:
        """Say what a plan determines beside what was advised before it, or repeated."""
        times = "" if repeats == 1 else ", twice," if repeats == 2 else f", {repeats} times,"
        beside = "together with what is advised above, " if after else ""
        text = f"{beside}{plan.words}{times} would determine {_listing(gain)}."
        return Advice(_sentence(text), gain, plan.record, repeats)


FORCE_ADVICE = (
    "A stiffness or blocking force, from the data sheet or measured, would fix the scale of force;"
    " no record of voltage and displacement can."
)


def _nothing(names: Sequence[str], tried: int) -> str:
    them = "it" if len(names) == 1 else "them"
    return (
        f"None of the {tried} steps, multisines, loops and holds that were tried on the model, with"
        f" the noise of these records, is sure to determine {_listing(names)}; take {them} from"
        " elsewhere, or use what is known of the combinations."
    )


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:]


def _listing(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
