"""The benchmark `diagnose`: hidden causes on independent plants, and what was named."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binomtest

from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.held_out import Gain, gain_of
from psa_casadi.diagnosis.task import Method
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment, judging
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.simulate import simulate_record
from tests.studies.benchmarks.hidden_cases import (
    ORDINARY,
    Case,
    Found,
    limits_table,
    run_case,
    study,
)
from tests.studies.benchmarks.records import hidden_record, played_again
from tests.studies.benchmarks.table import (
    Outcome,
    Progress,
    TitledTable,
    on_all_cores,
    share,
    table_of,
)
from tests.studies.plants.table import FOREIGN, HIDDEN_EFFECTS, KNOWN, called

_NONE = ("unexplained", "adequate")
#: Classes of stated probability: above the one, up to the next.
BINS: tuple[float, ...] = (0.02, 0.2, 0.5, 0.8, 0.95, 1.0)
#: Kinds of cases of the reliability: the cause is in the table; also where its entry was left out.
RELIABILITY = (("known", "weak"), ("known", "weak", "left out"))
_DRAWN = (
    ("o", "C0", "the cause is in the table"),
    ("s", "C1", "with the cases whose own entry was left out"),
)


def picture(found: Sequence[Found], known: Sequence[str], foreign: Sequence[str]) -> Figure:
    """Return hidden against named, and how often a stated probability is right.

    Cases whose plant could not make the effect as visible as was asked for do not count.
    """
    figure = Figure(figsize=(11.0, 15.0), layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=(3.2, 1.0))
    _confusion(above, [f for f in found if f.reached], known, foreign)
    _draw_reliability(below, found)
    return figure


def in_class(
    found: Sequence[Found], kinds: Sequence[str], low: float, high: float
) -> list[tuple[float, bool]]:
    """Return the probabilities in (low, high] that an effect is the cause, and whether it is.

    Every effect of every case of these kinds in which a cause is named counts, where what is hidden
    is as visible as was asked for.
    """
    return [
        (p, effect == f.case.right)
        for f in found
        if f.named and f.reached and f.case.kind in kinds
        for effect, p in f.probability.items()
        if low < p <= high
    ]


def _confusion(
    axes: Axes, found: Sequence[Found], known: Sequence[str], foreign: Sequence[str]
) -> None:
    """Draw the shares of each row; the first cause counts."""
    rows = (*known, *foreign, "nothing")
    columns = (*dict.fromkeys(called(name) for name in known), *_NONE)
    shares = np.zeros((len(rows), len(columns)))
    for f in found:
        if f.case.kind in ("known", "weak", "clean", "foreign"):
            said = f.named[0] if f.named else str(f.verdict)
            if said in columns:
                shares[rows.index(f.case.effect or "nothing"), columns.index(said)] += 1.0
    count = shares.sum(axis=1, keepdims=True)
    shares = 100.0 * shares / np.where(count > 0, count, 1.0)
    axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=100.0)
    for i, j in zip(*np.nonzero(shares), strict=True):
        axes.text(
            j, i, f"{shares[i, j]:.0f}", ha="center", va="center", fontsize=8,
            color="white" if shares[i, j] > 55.0 else "black",
        )  # fmt: skip
    names = [f"{r.replace('_', ' ')} ({int(n)})" for r, n in zip(rows, count[:, 0], strict=True)]
    axes.set_xticks(range(len(columns)), [c.replace("_", " ") for c in columns], rotation=90)
    axes.set_yticks(range(len(rows)), names)
    axes.tick_params(labelsize=8)
    axes.axhline(len(known) - 0.5, color="0.5", linewidth=0.8)
    axes.axvline(len(columns) - len(_NONE) - 0.5, color="0.5", linewidth=0.8)
    axes.set_xlabel("named first")
    axes.set_ylabel("hidden in the record (cases)")
    axes.set_title("What was hidden and what was named, percent of each row's cases")


def _draw_reliability(axes: Axes, found: Sequence[Found]) -> None:
    """Draw how often effects are the cause against their probability.

    The 95 % intervals take them for independent, which those of one case are not.
    """
    axes.plot([0.0, 100.0], [0.0, 100.0], color="0.7", linewidth=0.8, label="right as stated")
    for side, kinds, (marker, colour, label) in zip((-1, 1), RELIABILITY, _DRAWN, strict=True):
        for low, high in itertools.pairwise(BINS):
            own = in_class(found, kinds, low, high)
            if not own:
                continue
            right = sum(true for _, true in own)
            stated = 100.0 * float(np.mean([p for p, _ in own])) + 0.4 * side
            share = 100.0 * right / len(own)
            ends = binomtest(right, len(own)).proportion_ci(method="wilson")
            reach = [[share - 100.0 * ends.low], [100.0 * ends.high - share]]
            axes.errorbar(stated, share, reach, fmt=marker, color=colour, capsize=3.0)
            axes.annotate(
                f"{right} of {len(own)}", (stated, share), fontsize=8, color=colour,
                xytext=(8.0 * side, -4.0), textcoords="offset points",
                ha="left" if side > 0 else "right",
            )  # fmt: skip
        axes.plot([], [], marker=marker, color=colour, linestyle="", label=label)
    axes.set_xlim(-6.0, 112.0)
    axes.set_ylim(-8.0, 108.0)
    axes.set_xlabel("stated probability of an effect, mean of its class, %")
    axes.set_ylabel("it is the cause, % (95 % interval)")
    axes.set_title("How often a stated probability is right")
    axes.legend(loc="upper left", fontsize=8)


FloatArray = npt.NDArray[np.float64]

#: Further records of a device, and how many of them are held out together.
PLAYS, HELD_OUT = 96, 12


@dataclass(frozen=True)
class Covered:
    """Reductions of the error [%] over further records, and the intervals that should hold them.

    `blocks` is the interval from the diagnosed record's own blocks, for the reduction over all
    further records; `experiments` are those from so many further records, `others` the reductions
    over the rest of them.
    """

    effect: str
    reduction: float
    blocks: tuple[float, float]
    experiments: tuple[tuple[float, float], ...]
    others: tuple[float, ...]


def intervals_table(found: Sequence[Covered]) -> TitledTable:
    """Return how many intervals hold the reduction over records that they do not know."""
    blocks = [(f.blocks, f.reduction) for f in found]
    records = [p for f in found for p in zip(f.experiments, f.others, strict=True)]
    pairs = {
        "eight blocks of one record's held-out quarter": blocks,
        f"{HELD_OUT} held-out records": records,
    }

    def held(name: str) -> str:
        inside = [low <= true <= high for (low, high), true in pairs[name]]
        return share(sum(inside), len(inside))

    def width(name: str) -> str:
        widths = [high - low for (low, high), _ in pairs[name]]
        return f"{np.median(widths) if widths else np.nan:.1f} %"

    return table_of(
        "Intervals of the gain (95 %)",
        pairs,
        {"interval from": str, "hold the truth": held, "median width": width},
        f"The truth is the reduction of the rms over those of {PLAYS} further records of the same"
        " device, with other voltages and fresh noise, that the interval does not know.",
    )


def covered(effect: str, seed: int) -> Covered | None:
    """Diagnose one record of an effect; None where nothing is named, so that nothing is gained."""
    truth, record = hidden_record(effect, seed, visible=ORDINARY)
    found = diagnose([record])
    if not found.causes:
        return None
    models = (found.base_fit.model, found.extended_fit.model)
    plays = [_play(played_again(truth, seed + k), models) for k in range(1, PLAYS + 1)]
    groups = [range(k, k + HELD_OUT) for k in range(0, PLAYS, HELD_OUT)]
    rests = [[p for k, p in enumerate(plays) if k not in group] for group in groups]
    return Covered(
        effect,
        _gain(plays).holdout_rms_reduction_percent,
        found.gain.interval,
        tuple(_gain([plays[k] for k in group]).interval for group in groups),
        tuple(_gain(rest).holdout_rms_reduction_percent for rest in rests),
    )


_Play = tuple[Experiment, FloatArray, FloatArray]


def _play(record: Record, models: tuple[Model, Model]) -> _Play:
    """Predict a further record with both models, the offset from the first tenth."""
    experiment = judging(record)
    y = np.asarray(record.displacement)
    predicted = []
    for model in models:
        moved = simulate_record(model, record).displacement
        predicted.append(moved + float(np.mean((y - moved)[experiment.known])))
    return experiment, predicted[0], predicted[1]


def _gain(plays: Sequence[_Play]) -> Gain:
    """Return the gain over some further records."""
    return gain_of([p[0] for p in plays], [p[1] for p in plays], [p[2] for p in plays])


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
        jobs = [(effect, FIRST + 100 * k) for k, effect in enumerate(KNOWN, start=1)]
        gains = on_all_cores(
            covered, jobs, lambda one: f"gain of {one.effect}" if one else "", progress
        )
        tables += [limits_table(lost, known), intervals_table([one for one in gains if one])]
    return Outcome(tables, lambda: picture(found, KNOWN, FOREIGN))


def diagnose_all(
    cases: Sequence[Case],
    progress: Progress,
    method: Method | None = None,
    *,
    only: bool = False,
) -> list[Found]:
    """Diagnose the cases side by side; with `only`, by a table of the right effect alone."""
    return on_all_cores(run_case, [(case, method, only) for case in cases], str, progress)


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
    def said(kind: str) -> Callable[[str], str]:
        own = of_kind(found, kind)
        return lambda effect: "; ".join(_said(f) for f in own if f.case.effect == effect)

    return table_of(
        "What was said of each",
        dict.fromkeys(f.case.effect for f in found if f.case.effect),
        {
            "hidden": str, "rho 0.3 to 3": said("known"), "rho 0.1 to 0.3": said("weak"),
            "own entry left out": said("left out"), "foreign": said("foreign"),
        },
        "+ right name alone, (+) right name in a set of that size, ? unexplained, - adequate; other"
        " names are wrong ones, in brackets where structure remained or others were as likely.",
    )  # fmt: skip


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
        cells = [f"{100 * low:.0f} to {100 * high:.0f} %"]
        for own in groups:
            means = [f"{100.0 * float(np.mean(x)):.0f} %" for x in zip(*own, strict=True)]
            cells += [*(means or ["", ""]), f"{len(own)}"]
        rows += [tuple(cells)] if groups[-1] else []
    head = ("stated probability", "mean", "right", "effects", "mean", "right", "effects")
    return TitledTable(
        "Probability against frequency",
        Table(head, tuple(rows)),
        "Effects to which more than 2 % were given in the first step, where a cause was named."
        " First where the hidden effect is in the table, which the probability takes for granted,"
        " then with the cases whose own entry was left out.",
    )
