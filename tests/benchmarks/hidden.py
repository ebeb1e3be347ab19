"""The benchmark `diagnose`: hidden causes on independent plants, and what was named."""

import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

import numpy as np

from psa_casadi.diagnosis.task import Method
from psa_casadi.report.words.tables import Table
from tests.benchmarks.hidden_cases import Case, Found, run_case, study
from tests.benchmarks.hidden_figure import BINS, RELIABILITY, in_class, picture
from tests.benchmarks.hidden_gain import gain_table
from tests.benchmarks.hidden_limits import limits_table
from tests.benchmarks.outcome import Outcome, Progress, TitledTable, share
from tests.plants.table import FOREIGN, HIDDEN_EFFECTS, KNOWN

#: Seeds for each effect, and the first of them.
SEEDS, QUICK_SEEDS, FIRST = 5, 1, 971001
#: Below the resonances a bent sensor and a load that bends are the same curve: these stay a pair.
ALIKE = ("load_stiffness", "sensor_nonlinearity")
_PAIR = " and ".join(ALIKE)


def run(progress: Progress, quick: bool) -> Outcome:
    """Draw and diagnose all cases on all cores; the seeds are the same in every run."""
    found = diagnose_all(study(KNOWN, FOREIGN, QUICK_SEEDS if quick else SEEDS, FIRST), progress)
    tables = result_tables(found)
    if not quick:
        lost = missed(found)
        known = diagnose_all([f.case for f in lost], progress, only=True)
        tables.append(limits_table(lost, known))
        tables.append(gain_table(KNOWN, FIRST, progress))
    return Outcome(tuple(tables), lambda: picture(found, KNOWN, FOREIGN))


def diagnose_all(
    cases: Sequence[Case],
    progress: Progress,
    method: Method | None = None,
    *,
    only: bool = False,
) -> list[Found]:
    """Diagnose the cases side by side; with `only`, by a table of the right effect alone."""
    found: list[Found] = []
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        jobs = [pool.submit(run_case, case, method, only=only) for case in cases]
        for job in as_completed(jobs):
            one = job.result()
            found.append(one)
            hidden = " and ".join(one.case.hidden) or "nothing"
            progress(
                f"{len(found)} of {len(cases)}: {one.case.kind}, {hidden} ({one.case.seed}), rho"
                f" {one.rho:.2f}: {one.verdict} {', '.join(one.within)} [{one.seconds:.0f} s]"
            )
    return found


def result_tables(found: Sequence[Found]) -> list[TitledTable]:
    """Return the figures asked for, what was said of each effect, and the reliability."""
    return [_summary(found), _by_effect(found), _reliability(found)]


def of_kind(found: Sequence[Found], kind: str, noise: str | None = None) -> list[Found]:
    """Return the cases of one kind whose effect is as visible as was asked for."""
    return [
        f
        for f in found
        if f.case.kind == kind and f.reached and (noise is None or f.case.noise == noise)
    ]


def missed(found: Sequence[Found]) -> list[Found]:
    """Return the cases of one effect, no bend, that is not named alone, or not at all if weak."""
    known = [f for f in of_kind(found, "known") if f.case.right not in ALIKE and not f.right_alone]
    return known + [f for f in of_kind(found, "weak") if f.case.right not in f.within]


def _share(found: Sequence[Found], holds: Callable[[Found], bool]) -> str:
    return share(sum(holds(f) for f in found), len(found))


def _wrong(f: Found) -> bool:
    return f.alone is not None and f.alone not in f.case.hidden


def _all_within(f: Found) -> bool:
    """Whether as many are named as are hidden, and all of these are in the named sets."""
    return len(f.named) == len(f.case.hidden) and set(f.case.hidden) <= set(f.within)


def _removed(found: Sequence[Found]) -> str:
    shares = [f.patched for f in found] or [np.nan]
    return f"{100.0 * np.median(shares):.0f} % of {len(found)}"


def _summary(found: Sequence[Found]) -> TitledTable:
    known, weak, clean = (of_kind(found, k) for k in ("known", "weak", "clean"))
    two, three, six = (of_kind(found, k) for k in ("two", "three", "six"))
    one = [f for k in ("known", "weak", "poor", "design", "six") for f in of_kind(found, k)]
    poor, ringing = ([f for f in found if f.case.kind == k] for k in ("poor", "ringing"))
    design = of_kind(found, "design")
    told = [f for f in known if f.named]
    absent = [f for f in found if f.case.kind in ("foreign", "left out")]
    absent = [f for f in absent if f.verdict == "unexplained"]
    known_ahead = [f for f in absent if not HIDDEN_EFFECTS[str(f.case.effect)].random]
    ratios = np.array([f.ratio for f in known if f.case.right in f.named] or [np.nan])
    sizes = [float(len(f.within)) for f in told if len(f.named) == 1] or [np.nan]
    seconds = np.array([f.seconds for f in found])
    rows = [
        ("right name alone, rho 0.3 to 3", "-",
         _share(known, lambda f: f.right_alone)),
        (f"the same, {_PAIR} not counted", "95 %",
         _share([f for f in known if f.case.right not in ALIKE],
                lambda f: f.right_alone)),
        ("right name in the named set, rho 0.3 to 3", "98 %",
         _share(known, lambda f: f.case.right in f.within)),
        ("right name in the named set, rho 0.1 to 0.3", "85 %",
         _share(weak, lambda f: f.case.right in f.within)),
        ("a single wrong name, rho 0.3 to 3", "at most 1 %", _share(known, _wrong)),
        ("a single wrong name, rho 0.1 to 0.3", "at most 5 %", _share(weak, _wrong)),
        ("clean, white noise: a cause named", "0",
         _share(of_kind(found, "clean", "white"), lambda f: bool(f.named))),
        ("clean, AR(1) noise: a cause named", "0",
         _share(of_kind(found, "clean", "ar"), lambda f: bool(f.named))),
        ("clean: any alarm", "at most 1 %", _share(clean, lambda f: f.verdict != "adequate")),
        ("own entry left out: not named alone", "97 %",
         _share(of_kind(found, "left out"), lambda f: f.alone is None)),
        (f"the same, {_PAIR} not counted", "97 %",
         _share([f for f in of_kind(found, "left out") if f.case.right not in ALIKE],
                lambda f: f.alone is None)),
        ("foreign plants: not named alone", "97 %",
         _share(of_kind(found, "foreign"), lambda f: f.alone is None)),
        ("foreign or left out and unexplained: share that the unnamed correction removes, median",
         "70 %", _removed(absent)),
        ("the same, without the three whose plant adds a random signal", "-",
         _removed(known_ahead)),
        ("two causes: both named, no third", "90 %",
         _share(two, lambda f: set(f.named) == set(f.case.hidden))),
        ("two causes: both in the named sets, no third name", "-", _share(two, _all_within)),
        ("three causes: all named, no fourth", "70 %",
         _share(three, lambda f: set(f.named) == set(f.case.hidden))),
        ("three causes: all in the named sets, no fourth name", "-", _share(three, _all_within)),
        ("six records of a device: right name in the named set", "98 %",
         _share(six, lambda f: f.case.right in f.within)),
        ("one cause: a second named beside the right one", "at most 3 %",
         _share([f for f in one if f.case.right in f.named], lambda f: len(f.named) > 1)),
        ("poor voltages: a single wrong name", "-", _share(poor, _wrong)),
        ("poor voltages: right in the set, or said to be blind", "-",
         _share(poor, lambda f: f.case.right in (*f.within, *f.blind))),
        ("other designs of record: a single wrong name", "-", _share(design, _wrong)),
        ("other designs: right in the set, or said to be blind", "-",
         _share(design, lambda f: f.case.right in (*f.within, *f.blind))),
        ("clean, resonances in or near the band: a cause named", "at most 1 %",
         _share(ringing, lambda f: bool(f.named))),
        ("held-out rms over the noise's: median, 95th percentile", "1.05, 1.15",
         f"{np.median(ratios):.3f}, {np.quantile(ratios, 0.95):.3f}"),
        ("95 % credible set holds the cause, where one is named", "93 %",
         _share([f for f in (*known, *weak) if f.named], lambda f: f.case.right in f.within)),
        ("size of the named set, mean", "at most 2.2", f"{np.mean(sizes):.2f}"),
        ("processor time of a diagnosis, 90th percentile", "8 s",
         f"{np.quantile(seconds, 0.9):.0f} s"),
    ]  # fmt: skip
    return TitledTable(
        "Hidden causes on independent plants",
        Table(("figure", "asked", "reached"), tuple(rows)),
        "rho: rms of the effect after the base's parameters are projected out, over the noise's."
        " Cases whose plant cannot reach the rho asked for within physical gains do not count. A"
        " load that bends is below the resonances the same curve as a bent sensor.",
    )


def _by_effect(found: Sequence[Found]) -> TitledTable:
    rows = []
    for effect in dict.fromkeys(f.case.effect for f in found if f.case.effect):
        cells = []
        for kind in ("known", "weak", "left out", "foreign"):
            own = [f for f in of_kind(found, kind) if f.case.effect == effect]
            cells.append("; ".join(_said(f) for f in own))
        rows.append((effect, *cells))
    head = ("hidden", "rho 0.3 to 3", "rho 0.1 to 0.3", "own entry left out", "foreign")
    return TitledTable(
        "What was said of each",
        Table(head, tuple(rows)),
        "+ right name alone, (+) right name in a set of that size, ? unexplained, - adequate; other"
        " names are wrong ones, in brackets where structure remained or others were as likely.",
    )


def _said(f: Found) -> str:
    if not f.named:
        return "-" if f.verdict == "adequate" else "?"
    if f.right_alone:
        return "+" if f.verdict == "cause_named" else "(+)"
    if f.case.right in f.within:
        return f"(+{len(f.within)})"
    names = ", ".join(f.named)
    return names if f.alone else f"({names})"


def _reliability(found: Sequence[Found]) -> TitledTable:
    """Compare the probability of being the cause with how often an effect is."""
    rows = []
    for low, high in itertools.pairwise(BINS):
        groups = [in_class(found, kinds, low, high) for kinds in RELIABILITY]
        if groups[-1]:
            cells = [c for own in groups for c in _right(own)]
            rows.append((f"{100 * low:.0f} to {100 * high:.0f} %", *cells))
    head = ("stated probability", "mean", "right", "effects", "mean", "right", "effects")
    return TitledTable(
        "Probability against frequency",
        Table(head, tuple(rows)),
        "Effects to which more than 2 % were given in the first step, where a cause was named."
        " First where the hidden effect is in the table, which the probability takes for granted,"
        " then with the cases whose own entry was left out.",
    )


def _right(own: Sequence[tuple[float, bool]]) -> tuple[str, str, str]:
    """Return mean probability, share of true ones and number of effects of one class."""
    if not own:
        return ("", "", "0")
    stated, true = (100.0 * float(np.mean(column)) for column in zip(*own, strict=True))
    return (f"{stated:.0f} %", f"{true:.0f} %", f"{len(own)}")
