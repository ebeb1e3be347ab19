"""Records with hidden causes, and what a diagnosis makes of one of them.

The plants that make the records (`tests/studies/plants`) share no code with the package and have
other equations than its effects. The strength of an effect is rho: rms of what
the base's parameters cannot absorb, over the rms of the noise.
"""

import itertools
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

import psa_casadi as psa
from psa_casadi.diagnosis.result import Verdict
from psa_casadi.diagnosis.task import Method
from tests.studies.benchmarks.records import hidden_record, played_again
from tests.studies.benchmarks.table import Progress, on_all_cores
from tests.studies.plants.excitations import DesignKind, ExcitationKind, PoorKind
from tests.studies.plants.make import Truth
from tests.studies.plants.noise import NoiseKind
from tests.studies.plants.table import called

Kind = Literal[
    "known", "weak", "clean", "left out", "foreign", "two", "poor", "design", "ringing",
    "three", "six",
]  # fmt: skip

#: Ranges of rho, from which a case's is drawn evenly in its logarithm.
ORDINARY, WEAK, STRONG = (0.3, 3.0), (0.1, 0.3), (1.0, 3.0)
#: A hidden effect counts from this share of the smallest rho of its case.
REACHED = 0.9
#: Classes of voltages that show less than a rich one.
POOR: tuple[PoorKind, ...] = ("sine", "triangle", "steps", "slow", "loops")
#: Other designs of record; and those with resonances in their band or near it, all clean: there
#: the static effects of the plants are no physics.
DESIGNS: tuple[DesignKind, ...] = ("bipolar", "short", "long", "sines", "staircase", "small")
RINGING: tuple[DesignKind, ...] = ("fast", "sweep", "short")
#: Samples of each of several records of a device.
_CUT = 2400
#: Noises of the cases of one effect, in turn: most sensors' is white, many have a filter.
NOISES: tuple[NoiseKind, ...] = ("white", "ar", "white", "quantised", "drop-outs")


@dataclass(frozen=True)
class Case:
    """Records of one device: what is hidden, with which noise and voltage, from which seed."""

    kind: Kind
    effect: str | None
    seed: int
    rho: tuple[float, float] = ORDINARY
    more: tuple[str, ...] = ()
    noise: NoiseKind = "white"
    excitation: ExcitationKind = "rich"
    records: int = 1

    @property
    def right(self) -> str | None:
        """What the project's table calls the hidden effect."""
        return None if self.effect is None else called(self.effect)

    @property
    def hidden(self) -> tuple[str, ...]:
        """What it calls all that is hidden."""
        return tuple(called(e) for e in (*((self.effect,) if self.effect else ()), *self.more))


@dataclass(frozen=True)
class CaseResult:
    """The answer of a diagnosis to a case.

    `rho` was reached, of several causes the smallest, 0 where nothing is hidden; `named` are the
    causes, `within` these with what cannot be distinguished from them; `blind` the effects that the
    record cannot show. `probability` is that of each effect in the first step; `seconds` the
    processor time; `patched` the share of the base's held-out excess that the unnamed correction
    and the effects that are kept without a name remove.
    """

    case: Case
    rho: float
    verdict: Verdict
    named: tuple[str, ...]
    within: tuple[str, ...]
    blind: tuple[str, ...]
    probability: Mapping[str, float]
    seconds: float
    patched: float = 0.0

    def __str__(self) -> str:
        """Return case and answer in a line."""
        hidden = " and ".join(self.case.hidden) or "nothing"
        case = f"{self.case.kind}, {hidden} ({self.case.seed}), rho {self.rho:.2f}"
        return f"{case}: {self.verdict} {', '.join(self.within)} [{self.seconds:.0f} s]"

    @property
    def reached(self) -> bool:
        """Whether the visibility of the case is reached; true where nothing is hidden."""
        return self.case.effect is None or self.rho >= REACHED * self.case.rho[0]

    @property
    def alone(self) -> str | None:
        """The cause that was named alone and without a remainder, if there is one."""
        one = self.verdict == "cause_named" and len(self.named) == 1
        return self.named[0] if one else None

    @property
    def wrong_alone(self) -> bool:
        """Whether a single wrong cause is named, without a remainder."""
        return self.alone not in (None, *self.case.hidden)

    @property
    def right_alone(self) -> bool:
        """Whether the hidden effect is the one name, with no other as likely."""
        return self.named == (self.case.right,) == self.within

    @property
    def in_set(self) -> bool:
        """Whether all that is hidden is in the named sets."""
        return set(self.case.hidden) <= set(self.within)


def how_made(case: Case) -> dict[str, Any]:
    """Return the arguments of `make_record` for a case, but for effect and seed."""
    return {
        "noise": case.noise, "excitation": case.excitation, "more": case.more,
        "visible": case.rho if case.effect else None,
        "more_visible": case.rho if case.more else None,
    }  # fmt: skip


def records_of(case: Case) -> tuple[Truth, list[psa.Record]]:
    """Make the records of a case as files, and read them."""
    truth, record = hidden_record(case.effect, case.seed, **how_made(case))
    if case.records == 1:
        return truth, [record]
    more = (played_again(truth, case.seed + 10_000 * k) for k in range(1, case.records))
    return truth, [r.slice(0, min(_CUT, r.n)) for r in (record, *more)]


def run_case(case: Case, method: Method | None = None) -> CaseResult:
    """Make the records of a case, diagnose the files, and compare."""
    truth, records = records_of(case)
    left_out = case.right if case.kind == "left out" else None
    table = [e for n, e in psa.EFFECTS.items() if n != left_out]
    begin = time.process_time()
    d = psa.diagnose(records, effects=table, method=method)
    seconds = time.process_time() - begin
    kept = d.budget.together.share if d.kept and not d.causes else 0.0
    named, within = names_of(d)
    return CaseResult(
        case=case,
        rho=float(min([truth.visible, *(h.visible for h in truth.more)])),
        verdict=d.verdict,
        named=named,
        within=within,
        blind=tuple(b.effect for b in d.blind_to),
        probability={c.effect: c.probability for c in d.candidates},
        seconds=seconds,
        patched=kept + (d.budget.unnamed.share if d.budget.unnamed is not None else 0.0),
    )


def diagnosed(
    cases: Sequence[Case], progress: Progress, method: Method | None = None
) -> list[CaseResult]:
    """Diagnose cases side by side."""
    return on_all_cores(run_case, [(case, method) for case in cases], progress)


def names_of(d: psa.StackDiagnosis) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the named causes, and these with what cannot be distinguished from them."""
    named = tuple(c.effect for c in d.causes)
    similar = (n for c in d.causes for n in c.cannot_be_told_from)
    return named, tuple(dict.fromkeys((*named, *similar)))


def study(known: tuple[str, ...], foreign: tuple[str, ...], seeds: int, first: int) -> list[Case]:
    """Return the cases of a study: every effect with `seeds` seeds, and others to match.

    No two cases have a seed, and so stack, voltage and noise, in common.
    """
    seed, rng = itertools.count(first), np.random.default_rng(first)
    each, few, half = range(seeds), range(max(1, seeds // 4)), range(max(1, seeds // 2))

    def drawn(kind: Kind, voltages: Sequence[ExcitationKind], count: int) -> list[Case]:
        """Return cases of one random effect each, with the voltages in turn."""
        turns = itertools.islice(itertools.cycle(voltages), count)
        return [Case(kind, str(rng.choice(known)), next(seed), excitation=v) for v in turns]

    def several(kind: Kind, causes: int) -> Case:
        one, *more = map(str, rng.choice(known, causes, replace=False))
        return Case(kind, one, next(seed), STRONG, tuple(more))

    cases = [
        Case("known", e, next(seed), noise=NOISES[k % len(NOISES)]) for e in known for k in each
    ]
    weak = [e for e in known for _ in few]
    cases += [
        Case("weak", e, next(seed), WEAK, noise=NOISES[k % len(NOISES)]) for k, e in enumerate(weak)
    ]
    for noise in NOISES[:2]:
        cases += [Case("clean", None, next(seed), noise=noise) for _ in range(10 * seeds)]
    cases += [Case("left out", e, next(seed)) for e in known for _ in few]
    cases += [Case("foreign", e, next(seed)) for e in foreign for _ in half]
    cases += [several("two", 2) for _ in range(3 * seeds)]
    cases += drawn("poor", POOR, 4 * seeds) + drawn("design", DESIGNS, 6 * seeds)
    for k in range(3 * seeds):
        cases.append(Case("ringing", None, next(seed), excitation=RINGING[k % len(RINGING)]))
    cases += [several("three", 3) for _ in range(4 * seeds)]
    six = drawn("six", ["rich"], 3 * seeds)
    return cases + [replace(case, records=6) for case in six]
