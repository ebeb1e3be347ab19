"""The benchmark `diagnose`: hidden causes on independent plants, and what was named."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binomtest

import psa_casadi as psa
from psa_casadi.diagnosis.held_out import Gain, gain_of
from psa_casadi.records.split import Experiment, judging
from psa_casadi.units import FloatArray
from tests.studies.benchmarks.hidden_cases import ORDINARY, Found, diagnosed, study
from tests.studies.benchmarks.records import hidden_record, played_again
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, on_all_cores, share
from tests.studies.plants.table import FOREIGN, HIDDEN_EFFECTS, KNOWN, called

#: Seeds for each effect, and the first of them.
SEEDS, QUICK_SEEDS, FIRST = 5, 1, 971001
#: Below the resonances a bent sensor and a load that bends are the same curve: these stay a pair.
ALIKE = ("load_stiffness", "sensor_nonlinearity")
#: Classes of stated probability: above the one, up to the next.
BINS: tuple[float, ...] = (0.02, 0.2, 0.5, 0.8, 0.95, 1.0)
#: Kinds of cases of the reliability: the cause is in the table; also where its entry was left out.
RELIABILITY = (("known", "weak"), ("known", "weak", "left out"))


def run(progress: Progress, quick: bool) -> Outcome:
    """Draw and diagnose all cases on all cores; the seeds are the same in every run."""
    result = diagnosed(study(KNOWN, FOREIGN, QUICK_SEEDS if quick else SEEDS, FIRST), progress)
    tables = result_tables(result)
    if not quick:
        lost = missed(result)
        known = diagnosed([f.case for f in lost], progress, only=True)
        jobs = [(effect, FIRST + 100 * k) for k, effect in enumerate(KNOWN, start=1)]
        gains = on_all_cores(covered, jobs, progress, lambda one: one.effect if one else "nothing")
        tables += [limits_table(lost, known), intervals_table([one for one in gains if one])]
    return Outcome(tables, lambda: picture(result))


def result_tables(found: Sequence[Found]) -> list[TitledTable]:
    """Return the figures asked for, and the reliability."""
    return [_summary(found), _reliability(found)]


def _of(found: Sequence[Found], *kinds: str) -> list[Found]:
    """Return the cases of kinds whose effect is as visible as was asked for."""
    return [f for f in found if f.case.kind in kinds and f.reached]


def _unlike(found: Sequence[Found]) -> list[Found]:
    return [f for f in found if f.case.right not in ALIKE]


def missed(found: Sequence[Found]) -> list[Found]:
    """Return the cases of one effect, no bend, that is not named alone, or not at all if weak."""
    known = [f for f in _unlike(_of(found, "known")) if not f.right_alone]
    return known + [f for f in _of(found, "weak") if f.case.right not in f.within]


def _in_set(found: Sequence[Found]) -> str:
    return share(f.case.right in f.within for f in found)


def _alone(found: Sequence[Found]) -> str:
    return share(f.right_alone for f in found)


def _wrong(found: Sequence[Found]) -> str:
    return share(f.alone not in (None, *f.case.hidden) for f in found)


def _not_alone(found: Sequence[Found]) -> str:
    return share(f.alone is None for f in found)


def _named(found: Sequence[Found]) -> str:
    return share(bool(f.named) for f in found)


def _all_named(found: Sequence[Found]) -> str:
    return share(set(f.named) == set(f.case.hidden) for f in found)


def _all_in_sets(found: Sequence[Found]) -> str:
    """Return where as many are named as are hidden, and all of these are in the named sets."""
    return share(
        len(f.named) == len(f.case.hidden) and set(f.case.hidden) <= set(f.within) for f in found
    )


def _seen(found: Sequence[Found]) -> str:
    """Return where the right one is in the set, or said to be a blind spot."""
    return share(f.case.right in (*f.within, *f.blind) for f in found)


def _summary(found: Sequence[Found]) -> TitledTable:
    known, weak, clean, left_out, foreign, two, three, six, design = (
        _of(found, kind)
        for kind in
        ("known", "weak", "clean", "left out", "foreign", "two", "three", "six", "design")
    )  # fmt: skip
    poor, ringing = ([f for f in found if f.case.kind == k] for k in ("poor", "ringing"))
    white, coloured = ([f for f in clean if f.case.noise == n] for n in ("white", "ar"))
    one = [
        f for f in _of(found, "known", "weak", "poor", "design", "six") if f.case.right in f.named
    ]
    absent = [f for f in found if f.case.kind in ("foreign", "left out")]
    absent = [f for f in absent if f.verdict == "unexplained"]
    ahead = [f for f in absent if not HIDDEN_EFFECTS[str(f.case.effect)].random]
    ratios = [f.ratio for f in known if f.case.right in f.named] or [np.nan]
    sizes = [float(len(f.within)) for f in known if len(f.named) == 1] or [np.nan]
    seconds, bends = [f.seconds for f in found], f"the same, {' and '.join(ALIKE)} not counted"
    rows = (
        ("right name alone, rho 0.3 to 3", "-", _alone(known)),
        (bends, "95 %", _alone(_unlike(known))),
        ("right name in the named set, rho 0.3 to 3", "98 %", _in_set(known)),
        ("right name in the named set, rho 0.1 to 0.3", "85 %", _in_set(weak)),
        ("a single wrong name, rho 0.3 to 3", "at most 1 %", _wrong(known)),
        ("a single wrong name, rho 0.1 to 0.3", "at most 5 %", _wrong(weak)),
        ("clean, white noise: a cause named", "0", _named(white)),
        ("clean, AR(1) noise: a cause named", "0", _named(coloured)),
        ("clean: any alarm", "at most 1 %", share(f.verdict != "adequate" for f in clean)),
        ("own entry left out: not named alone", "97 %", _not_alone(left_out)),
        (bends, "97 %", _not_alone(_unlike(left_out))),
        ("foreign plants: not named alone", "97 %", _not_alone(foreign)),
        ("foreign or left out and unexplained: share that the unnamed correction removes, median",
         "70 %", _removed(absent)),
        ("the same, without the three whose plant adds a random signal", "-", _removed(ahead)),
        ("two causes: both named, no third", "90 %", _all_named(two)),
        ("two causes: both in the named sets, no third name", "-", _all_in_sets(two)),
        ("three causes: all named, no fourth", "70 %", _all_named(three)),
        ("three causes: all in the named sets, no fourth name", "-", _all_in_sets(three)),
        ("six records of a device: right name in the named set", "98 %", _in_set(six)),
        ("one cause: a second named beside the right one", "at most 3 %",
         share(len(f.named) > 1 for f in one)),
        ("poor voltages: a single wrong name", "-", _wrong(poor)),
        ("poor voltages: right in the set, or said to be blind", "-", _seen(poor)),
        ("other designs of record: a single wrong name", "-", _wrong(design)),
        ("other designs: right in the set, or said to be blind", "-", _seen(design)),
        ("clean, resonances in or near the band: a cause named", "at most 1 %", _named(ringing)),
        ("held-out rms over the noise's: median, 95th percentile", "1.05, 1.15",
         f"{np.median(ratios):.3f}, {np.quantile(ratios, 0.95):.3f}"),
        ("95 % credible set holds the cause, where one is named", "93 %",
         _in_set([f for f in (*known, *weak) if f.named])),
        ("size of the named set, mean", "at most 2.2", f"{np.mean(sizes):.2f}"),
        ("processor time of a diagnosis: median, 90th percentile", "8 s",
         f"{np.median(seconds):.1f} s, {np.quantile(seconds, 0.9):.0f} s"),
    )  # fmt: skip
    return TitledTable(
        "Hidden causes on independent plants",
        [dict(zip(("figure", "asked", "reached"), row, strict=True)) for row in rows],
        "rho: rms of the effect after the base's parameters are projected out, over the noise's."
        " Cases whose plant cannot reach the rho asked for within physical gains do not count. A"
        " load that bends is below the resonances the same curve as a bent sensor.",
    )


def _removed(found: Sequence[Found]) -> str:
    shares = [f.patched for f in found] or [np.nan]
    return f"{100.0 * np.median(shares):.0f} % of {len(found)}"


def in_class(
    found: Sequence[Found], kinds: Sequence[str], low: float, high: float
) -> list[tuple[float, bool]]:
    """Return the probabilities in (low, high] that an effect is the cause, and whether it is.

    Every effect of every case of these kinds in which a cause is named counts, where what is hidden
    is as visible as was asked for.
    """
    return [
        (p, effect == f.case.right)
        for f in _of(found, *kinds)
        if f.named
        for effect, p in f.probability.items()
        if low < p <= high
    ]


def _reliability(found: Sequence[Found]) -> TitledTable:
    """Compare the probability of being the cause with how often an effect is."""
    rows = []
    for low, high in itertools.pairwise(BINS):
        row = {"stated probability": f"{100 * low:.0f} to {100 * high:.0f} %"}
        for kinds in RELIABILITY:
            item, where = in_class(found, kinds, low, high), " (+ left out)" * (len(kinds) > 2)
            means = [f"{100.0 * float(np.mean(x)):.0f} %" for x in zip(*item, strict=True)]
            row |= dict(zip(("mean" + where, "right" + where), means or ["", ""], strict=True))
            row["effects" + where] = str(len(item))
        rows.append(row)
    return TitledTable(
        "Probability against frequency",
        rows,
        "Effects to which more than 2 % were given in the first step, where a cause was named."
        " First where the hidden effect is in the table, which the probability takes for granted,"
        " then with the cases whose own entry was left out.",
    )


def limits_table(founds: Sequence[Found], known: Sequence[Found]) -> TitledTable:
    """Return each case that was missed beside what is said where its effect is known."""
    rows = []
    for f, output in zip(founds, known, strict=True):
        right = str(f.case.right)
        others = [e for name, e in f.evidence.items() if name != right]
        ahead = f"{max(others) - f.evidence[right]:+.1f}" if others and right in f.evidence else "-"
        rows.append({
            "hidden": right, "seed": f.case.seed, "rho": f"{f.rho:.2f}",
            "said": f"{f.verdict}: {', '.join(f.within)}" if f.within else f.verdict,
            "known beforehand": f"{output.verdict}, {output.evidence.get(right, np.nan):.1f}",
            "rival": ahead,
        })  # fmt: skip
    return TitledTable(
        "What the missed records hold",
        rows,
        "Known beforehand: what is said where the right effect is the only one in the table, and"
        " its evidence [nats]; a cause has a price of 8. Rival: evidence of the strongest other"
        " effect less that of the right one, in the first step with the whole table.",
    )


def picture(found: Sequence[Found]) -> Figure:
    """Return hidden against named, and how often a stated probability is right.

    Cases whose plant could not make the effect as visible as was asked for do not count.
    """
    figure = Figure(figsize=(11.0, 15.0), layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=(3.2, 1.0))
    _confusion(above, _of(found, "known", "weak", "clean", "foreign"))
    _draw_reliability(below, found)
    return figure


def _confusion(axes: Axes, found: Sequence[Found]) -> None:
    """Draw the shares of each row; the first cause counts."""
    rows, none = (*KNOWN, *FOREIGN, "nothing"), ("unexplained", "adequate")
    columns = (*dict.fromkeys(called(name) for name in KNOWN), *none)
    shares = np.zeros((len(rows), len(columns)))
    for f in found:
        statement = f.named[0] if f.named else str(f.verdict)
        if statement in columns:
            shares[rows.index(f.case.effect or "nothing"), columns.index(statement)] += 1.0
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
    axes.axhline(len(KNOWN) - 0.5, color="0.5", linewidth=0.8)
    axes.axvline(len(columns) - len(none) - 0.5, color="0.5", linewidth=0.8)
    axes.set(xlabel="named first", ylabel="hidden in the record (cases)")
    axes.set_title("What was hidden and what was named, percent of each row's cases")


def _draw_reliability(axes: Axes, found: Sequence[Found]) -> None:
    """Draw how often effects are the cause against their probability.

    The 95 % intervals take them for independent, which those of one case are not.
    """
    axes.plot([0.0, 100.0], [0.0, 100.0], color="0.7", linewidth=0.8, label="right as stated")
    labels = ("the cause is in the table", "with the cases whose own entry was left out")
    for side, kinds, label in zip((-1, 1), RELIABILITY, labels, strict=True):
        classes = [in_class(found, kinds, *ends) for ends in itertools.pairwise(BINS)]
        draw_classes(axes, classes, side, label)
    axes.set(xlim=(-6.0, 112.0), ylim=(-8.0, 108.0))
    axes.set_xlabel("stated probability of an effect, mean of its class, %")
    axes.set_ylabel("it is the cause, % (95 % interval)")
    axes.set_title("How often a stated probability is right")
    axes.legend(loc="upper left", fontsize=8)


def draw_classes(
    axes: Axes, classes: Sequence[Sequence[tuple[float, bool]]], side: int, label: str
) -> None:
    """Draw for each class of stated probabilities how many are right [%], with 95 % intervals."""
    colour, fmt = f"C{(side + 1) // 2}", "os"[(side + 1) // 2]
    for item in filter(None, classes):
        stated, right = 100.0 * np.mean(item, axis=0)
        ends = binomtest(sum(t for _, t in item), len(item)).proportion_ci(method="wilson")
        reach = [[right - 100.0 * ends.low], [100.0 * ends.high - right]]
        place = (float(stated) + 0.4 * side, float(right))
        axes.errorbar(*place, reach, fmt=fmt, color=colour, capsize=3.0)
        axes.annotate(
            f"{sum(t for _, t in item)} of {len(item)}", place, fontsize=8, color=colour,
            xytext=(8.0 * side, -4.0), textcoords="offset points",
            ha="left" if side > 0 else "right",
        )  # fmt: skip
    axes.plot([], [], marker=fmt, color=colour, linestyle="", label=label)


#: Further records of a device, and how many of them are held out together.
PLAYS, HELD_OUT = 96, 12
Interval = tuple[float, float]


class Covered(NamedTuple):
    """Reductions of the error [%] over further records, and the intervals that should hold them.

    `blocks` is the interval from the diagnosed record's own blocks, for the reduction over all
    further records; `experiments` are those from so many further records, `others` the reductions
    over the rest of them.
    """

    effect: str
    reduction: float
    blocks: Interval
    experiments: tuple[Interval, ...]
    others: tuple[float, ...]


def intervals_table(found: Sequence[Covered]) -> TitledTable:
    """Return how many intervals hold the reduction over records that they do not know."""
    pairs = {
        "eight blocks of one record's held-out quarter": [(f.blocks, f.reduction) for f in found],
        f"{HELD_OUT} held-out records": [
            p for f in found for p in zip(f.experiments, f.others, strict=True)
        ],
    }
    rows = [
        {"interval from": name,
         "hold the truth": share(low <= true <= high for (low, high), true in item),
         "median width": f"{np.median([b - a for (a, b), _ in item] or [np.nan]):.1f} %"}
        for name, item in pairs.items()
    ]  # fmt: skip
    return TitledTable(
        "Intervals of the gain (95 %)",
        rows,
        f"The truth is the reduction of the rms over those of {PLAYS} further records of the same"
        " device, with other voltages and fresh noise, that the interval does not know.",
    )


def covered(effect: str, seed: int) -> Covered | None:
    """Diagnose one record of an effect; None where nothing is named, so that nothing is gained."""
    truth, record = hidden_record(effect, seed, visible=ORDINARY)
    result = psa.diagnose([record])
    if not result.causes:
        return None
    models = (result.base_fit.model, result.extended_fit.model)
    plays = [_play(played_again(truth, seed + k), models) for k in range(1, PLAYS + 1)]
    groups = [range(k, k + HELD_OUT) for k in range(0, PLAYS, HELD_OUT)]
    rests = [[p for k, p in enumerate(plays) if k not in group] for group in groups]
    return Covered(
        effect,
        _gain(plays).holdout_rms_reduction_percent,
        result.gain.interval,
        tuple(_gain([plays[k] for k in group]).interval for group in groups),
        tuple(_gain(rest).holdout_rms_reduction_percent for rest in rests),
    )


_Play = tuple[Experiment, list[FloatArray]]


def _play(record: psa.Record, models: Sequence[psa.Model]) -> _Play:
    """Predict a further record with both models, the offset from the first tenth."""
    experiment, y = judging(record), np.asarray(record.displacement)
    moved = [psa.simulate_record(model, record).displacement for model in models]
    return experiment, [x + float(np.mean((y - x)[experiment.known])) for x in moved]


def _gain(plays: Sequence[_Play]) -> Gain:
    """Return the gain over some further records."""
    experiments, predicted = zip(*plays, strict=True)
    return gain_of(experiments, *map(list, zip(*predicted, strict=True)))
