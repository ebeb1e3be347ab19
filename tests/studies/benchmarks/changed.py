"""Changed records: by 1 % of their noise, by an added effect, cut and spoilt."""

import itertools
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import psa_casadi as psa
from psa_casadi import datasets
from psa_casadi.common.units import FloatArray
from psa_casadi.records.drive import reversals
from tests.studies.benchmarks.hidden_cases import Case, names_of, records_of, study
from tests.studies.benchmarks.records import noisy
from tests.studies.benchmarks.table import (
    Outcome,
    Progress,
    Row,
    TitledTable,
    on_all_cores,
    share,
)
from tests.studies.exam.play import write
from tests.studies.exam.record import Record as ExamRecord
from tests.studies.exam.records import RECORDS
from tests.studies.plants.base import simulate_base
from tests.studies.plants.hide import base_directions, hide
from tests.studies.plants.stack import draw_stack
from tests.studies.plants.table import FOREIGN, HIDDEN_EFFECTS, KNOWN, called

#: The first of the seeds of `stability`, which no other benchmark uses; the change of the data over
#: the rms of their noise; that of the measured records [m].
FIRST, CHANGE, _MEASURED_NOISE = 480201, 0.01, 67e-9
#: Cases of the study and draws of each; draws of records of the exam, step between those that a
#: quick run takes, and draws of measured rows.
CASES, DRAWS, EXAM_DRAWS, QUICK_EXAM, MEASURED_DRAWS = 40, 20, 3, 12, 9
_KINDS = ("known", "weak", "clean", "foreign", "left out", "two", "poor", "design", "ringing")
#: Measured records.
MEASURED = ("sine_1hz", "minor_loops", "both files")

#: A case of the study, a record of the exam, or a row of the measured ones.
Source = Case | ExamRecord | str
#: Verdict, names, and names with those that cannot be distinguished from them.
Answered = tuple[str, frozenset[str], frozenset[str]]


def stability(progress: Progress, quick: bool) -> Outcome:
    """Diagnose everything unchanged, then with added white noise of 1 % of its noise."""
    jobs: list[tuple[str, Source, int]] = [
        (c.kind, c, 3 if quick else DRAWS) for c in chosen_cases(6 if quick else CASES)
    ]
    exam = RECORDS[::QUICK_EXAM] if quick else RECORDS
    jobs += [("exam", record, 1 if quick else EXAM_DRAWS) for record in exam]
    jobs += [("measured", row, 1 if quick else MEASURED_DRAWS) for row in MEASURED]
    draws = [(source, k) for _, source, n in jobs for k in range(n + 1)]
    answers = iter(on_all_cores(answer_of, draws, progress, lambda a: f"{a[0]} {', '.join(a[1])}"))
    by_case = [(kind, list(itertools.islice(answers, n + 1))) for kind, _, n in jobs]
    rows = []
    for kind in (*dict.fromkeys(kind for kind, _ in by_case), "all"):
        cases = [draws for name, draws in by_case if kind in (name, "all")]
        pairs = [(first, other) for first, *others in cases for other in others]
        rows.append({
            "cases": kind, "number": len(cases),
            "same verdict and names": share(a[:2] == b[:2] for a, b in pairs),
            "same verdict, names in the set": share(
                a[0] == b[0] and a[1] <= b[2] for a, b in pairs
            ),
        })  # fmt: skip
    note = "Everything is diagnosed as it is, and with added white noise of 1 % of its noise."
    return Outcome([TitledTable("Data changed by 1 % of their noise", rows, note)])


def chosen_cases(count: int) -> list[Case]:
    """Return cases of every kind in turn, evenly from a study."""
    every = study(KNOWN, FOREIGN, 2, FIRST)
    rows = [[c for c in every if c.kind == kind] for kind in _KINDS]
    each = -(-count // len(rows))
    spread = [[of[len(of) * k // each] for k in range(each)] for of in rows]
    return [of[k] for k in range(each) for of in spread][:count]


def answer_of(source: Source, draw: int) -> Answered:
    """Diagnose records with white noise added to their readings; draw 0 adds none."""
    noise, records = _records(source)
    seed = MEASURED.index(source) if isinstance(source, str) else source.seed
    rng, level = np.random.default_rng([seed, draw]), CHANGE * noise if draw else 0.0
    d = psa.diagnose([noisy(r, level, rng) for r in records])
    named, within = names_of(d)
    return d.verdict, frozenset(named), frozenset(within)


def _records(source: Source) -> tuple[float, Sequence[psa.Record]]:
    """Return the rms of the noise of the readings [m], and the records."""
    if isinstance(source, Case):
        truth, records = records_of(source)
        return truth.sigma, records
    if isinstance(source, ExamRecord):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{source.name}.csv"
            write(source, path)
            record = psa.read_record(path)
        return 1e-2 * source.test.noise * record.range_m, [record]
    sine, loops = datasets.micromanipulator()
    rows = dict(zip(MEASURED, ([sine], [loops], [sine, loops]), strict=True))
    return _MEASURED_NOISE, rows[source]


#: The first of the seeds of `added`, which nothing else uses; samples of an excerpt; excerpts.
FIRST_ADDED, LENGTH, EXCERPTS = 620401, 2400, 2
#: Rms of what is added and the base cannot absorb, over what the extended model of the record as it
#: was measured leaves.
SIZE = 3.0
#: Samples in which the plant's voltage rises from zero to the start of an excerpt.
_LEAD = 400


#: Step between the cases that the figures with a reference were tuned on; others are reported.
TUNED = 3
#: Fewer samples are no reference.
_FEWEST = 400


class Answer(NamedTuple):
    """A verdict, the names, and these with those that cannot be distinguished from them."""

    verdict: str
    named: tuple[str, ...]
    within: tuple[str, ...]


class Added(NamedTuple):
    """A record with an added effect: the names without the effect, and the answers with it.

    The answers are without a reference, with the other records of the device as reference, and with
    the same test as reference.
    """

    record: str
    effect: str
    before: tuple[str, ...]
    answers: tuple[Answer, Answer, Answer]


def added(progress: Progress, quick: bool) -> Outcome:
    """Diagnose excerpts of the measured records, unchanged and with every effect added.

    A plant plays the record's voltage with the effect and without it; the difference, scaled to
    the record's stroke, is added to the measurement. Records of the same healthy device are
    diagnosed against each other, too: nothing has changed there.
    """
    effects = [e for e in KNOWN if HIDDEN_EFFECTS[e].room is None][:: 5 if quick else 1]
    pieces = excerpts_from_reversals(1 if quick else EXCERPTS)[: 1 if quick else None]
    plain = on_all_cores(by_itself, [(p,) for p, _ in pieces], progress)
    jobs = [
        (piece, others, effect, FIRST_ADDED + 100 * k + j, *alone)
        for k, ((piece, others), alone) in enumerate(zip(pieces, plain, strict=True))
        for j, effect in enumerate(effects)
    ]
    result = on_all_cores(with_effect, jobs, progress, lambda f: f"{f.record} with {f.effect}")
    each = [
        {"record": f.record, "named by itself": ", ".join(f.before) or "-", "added": f.effect,
         **{way: f"{a.verdict}: {', '.join(a.within) or '-'}"
            for way, a in zip(_WAYS, f.answers, strict=True)}}
        for f in result
    ]  # fmt: skip
    kept = [f for k, f in enumerate(result) if k % TUNED] if not quick else result
    pairs = on_all_cores(unchanged, _pairs(quick), progress, lambda f: str(f["record"]))
    healthy = TitledTable("Records of the same healthy device: nothing has changed", pairs)
    return Outcome((summary(kept), healthy, TitledTable("Each answer", each)))


def excerpts_from_reversals(each: int) -> list[tuple[psa.Record, tuple[psa.Record, ...]]]:
    """Return excerpts of the measured records, each from a reversal on, and what else there is."""
    rng = np.random.default_rng(FIRST_ADDED)
    pieces = []
    for record in datasets.micromanipulator():
        turns = [t for t in reversals(record.voltage) if t + LENGTH <= record.n]
        for start in np.sort(rng.choice(turns, each, replace=False)).tolist():
            piece = record.slice(start, start + LENGTH)
            parts = ((0, start), (start + LENGTH, record.n))
            others = tuple(record.slice(a, b) for a, b in parts if b - a >= _FEWEST)
            name = f"{record.name} from {record.time[start]:.1f} s"
            pieces.append((replace(piece, name=name), others))
    return pieces


def by_itself(record: psa.Record) -> tuple[tuple[str, ...], float]:
    """Return all that is named of a record, and what its extended model leaves, rms [m]."""
    d = psa.diagnose([record])
    return names_of(d)[1], d.extended_errors.holdout_rms_m


def with_effect(
    record: psa.Record, others: Sequence[psa.Record], effect: str, seed: int,
    before: tuple[str, ...], left: float,
) -> Added:  # fmt: skip
    """Diagnose a record with an added effect, without a reference and with two.

    The same test again is the record as it was measured with fresh noise.
    """
    more = difference(record, effect, seed, SIZE * left)
    again = noisy(record, _MEASURED_NOISE, np.random.default_rng([seed // 100, 1]))
    new = replace(record, displacement=np.asarray(record.displacement) + more)
    every = (psa.diagnose([new], reference=sound) for sound in ((), others, [again]))
    without, other, same = (Answer(d.verdict, *names_of(d)) for d in every)
    return Added(record.name, effect, before, (without, other, same))


def _pairs(quick: bool) -> list[tuple[str, psa.Record, psa.Record]]:
    """Return pairs of records of the same healthy device, of which the second is the reference."""
    sine, loops = datasets.micromanipulator()
    cuts = [sine.slice(k, k + 1500) for k in range(0, sine.n - 1500, 1500)]
    pairs = [(f"{a.name} against {b.name}", a, b) for a, b in itertools.permutations(cuts, 2)]
    pairs += [(f"{a.name} against {b.name}", a, b) for a, b in ((sine, loops), (loops, sine))]
    for record in RECORDS:
        if record.question.group == "clean":
            (whole,) = _records(record)[1]
            first, second = whole.slice(0, whole.n // 2), whole.slice(whole.n // 2, whole.n)
            pairs.append((f"{record.name}, first half", first, second))
            pairs.append((f"{record.name}, second half", second, first))
    return pairs[::12] if quick else pairs


def unchanged(name: str, new: psa.Record, reference: psa.Record) -> dict[str, object]:
    """Diagnose a record against another one of the same device; return a row of the answer."""
    try:
        d = psa.diagnose([new], reference=[reference])
    except psa.InputError:
        return {"record": name, "verdict": "refused", "named": "-"}
    return {"record": name, "verdict": d.verdict, "named": ", ".join(names_of(d)[0]) or "-"}


def difference(record: psa.Record, effect: str, seed: int, size: float) -> FloatArray:
    """Return what an effect adds to a plant's displacement at a record's voltage (n,) [m].

    The plant's voltage is the record's over its range; `size` [m] is the rms of what a base model
    cannot absorb.
    """
    rng = np.random.default_rng(seed)
    stack, v = draw_stack(rng), record.voltage
    command = stack.u_rated * (v - v.min()) / float(np.ptp(v))
    lead = command[0] * 0.5 * (1.0 - np.cos(np.pi * np.arange(_LEAD) / _LEAD))
    played = np.concatenate([lead, command])
    times: FloatArray = record.sample_time * np.arange(played.size, dtype=np.float64)
    run = simulate_base(stack, times, played)
    scale = record.range_m / float(np.ptp(run.displacement[_LEAD:]))
    hidden = hide(HIDDEN_EFFECTS[effect], run, rng, base_directions(run), size / scale, visible=1.0)
    return np.asarray(scale * hidden.added[_LEAD:], dtype=np.float64)


#: References.
_WAYS = ("without a reference", "other records", "the same test again")


def summary(cases: Sequence[Added]) -> TitledTable:
    """Return how often the effect is named, and how often an absent one."""
    new = [f for f in cases if called(f.effect) not in f.before]

    def row(figure: str, target: str, holds: Callable[[Added, int], bool]) -> Row:
        shares = {way: share(holds(f, k) for f in new) for k, way in enumerate(_WAYS)}
        return {"figure": figure, "target": target, **shares}

    def wrong(f: Added, way: int) -> set[str]:
        """Return the wrong names; without a reference the record's causes are right too."""
        return {*f.answers[way].named} - {called(f.effect), *(() if way else f.before)}

    def single_wrong(f: Added, way: int) -> bool:
        a = f.answers[way]
        return a.verdict == "cause_named" and len(a.named) == len(wrong(f, way)) == 1

    return TitledTable(
        "An effect added to a measured record",
        [
            row(
                "the effect in a named set",
                "70 of 87",
                lambda f, k: called(f.effect) in f.answers[k].within,
            ),
            row("a single wrong name", "at most 2 %", single_wrong),
            row("any cause that is not there", "-", lambda f, k: bool(wrong(f, k))),
            row("verdict: no change", "-", lambda f, k: f.answers[k].verdict == "adequate"),
        ],
        f"{len(cases) - len(new)} of {len(cases)} effects are named in the record without them and"
        f" do not count. The added rms, without what the base can absorb, is {SIZE:g} times the"
        f" residual of the record's extended model. Every {TUNED}rd case, on which the constants"
        " were chosen, is not counted.",
    )


#: The seed of `excerpts`, which no other benchmark uses; pieces; their samples.
SEED, PIECES, QUICK_PIECES, LENGTHS = 740501, 200, 6, (300, 2500)
#: Scales of the displacement, units mistaken by a power of ten among them; steps between samples
#: that are kept of long pieces, and how long these are; share of pieces whose displacement or
#: voltage is turned round.
_SCALES, _KEPT, _LONG, _TURNED = (1.0, 1.0, 1.0, 10.0, 1e3, 1e-3), (1, 1, 2, 5), 1500, 0.15


def excerpts(progress: Progress, quick: bool) -> Outcome:
    """Diagnose spoilt pieces of the measured records; only a verdict or a refusal is allowed.

    The pieces are cut anywhere, decimated, scaled by powers of ten, and turned round.
    """
    jobs = [(p,) for p in pieces(datasets.micromanipulator(), QUICK_PIECES if quick else PIECES)]
    ends = Counter(on_all_cores(end_of, jobs, progress))
    rows = [{"ended": end, "pieces": n} for end, n in sorted({"crashed": 0, **ends}.items())]
    return Outcome([TitledTable(f"{len(jobs)} spoilt pieces of measured records", rows)])


def pieces(records: Sequence[psa.Record], count: int) -> list[psa.Record]:
    """Return `count` pieces of records, in turn, each named after its changes."""
    rng, result = np.random.default_rng(SEED), []
    for k in range(count):
        whole = records[k % len(records)]
        length = int(rng.integers(LENGTHS[0], min(LENGTHS[1], whole.n)))
        first = int(rng.integers(0, whole.n - length + 1))
        keep = int(rng.choice(_KEPT)) if length > _LONG else 1
        scale = float(rng.choice(_SCALES))
        turn, sign = (float(rng.choice([-1.0, 1.0], p=[_TURNED, 1 - _TURNED])) for _ in "xv")
        part = whole.slice(first, first + length)
        name = f"{whole.name} {first}:{first + length}:{keep}, x {scale * turn:g}, v {sign:+g}"
        x = scale * turn * np.asarray(part.displacement)[::keep]
        voltage = sign * part.voltage[::keep]
        result.append(
            psa.Record(name=name, time=part.time[::keep], voltage=voltage, displacement=x)
        )
    return result


def end_of(piece: psa.Record) -> str:
    """Diagnose a piece; return the verdict, a refusal, or a crash: any other error."""
    try:
        d = psa.diagnose([piece])
    except psa.InputError as error:
        return f"refused: {str(error).split(';')[0][:80]}"
    except Exception as error:  # noqa: BLE001 - what is counted here
        return f"crashed: {type(error).__name__}: {error}"
    finite = all(np.all(np.isfinite(y)) for y in (*d.base, *d.extended))
    return d.verdict if finite and d.to_json() else "crashed: a prediction is not finite"
