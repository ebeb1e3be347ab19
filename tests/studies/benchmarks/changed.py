"""Records changed a little or a lot: by 1 % of their noise, by an effect on top, cut and spoilt."""

import itertools
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import NamedTuple

import numpy as np

import psa_casadi as psa
from psa_casadi import datasets
from psa_casadi.records.drive import reversals
from psa_casadi.units import FloatArray
from tests.studies.benchmarks.hidden_cases import Case, names_of, records_of, study
from tests.studies.benchmarks.records import noisy
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, on_all_cores, share
from tests.studies.exam.play import write
from tests.studies.exam.record import Record as ExamRecord
from tests.studies.exam.records import RECORDS
from tests.studies.plants.base import simulate_base
from tests.studies.plants.hide import hide
from tests.studies.plants.stack import draw_stack
from tests.studies.plants.table import FOREIGN, HIDDEN_EFFECTS, KNOWN, called
from tests.studies.plants.visibility import base_directions

#: The first of the seeds of `stability`, which no other benchmark uses; the change of the data over
#: the rms of their noise; that of the measured records [m].
FIRST, CHANGE, _MEASURED_NOISE = 480201, 0.01, 67e-9
#: Cases of the study and draws of each; draws of records of the exam, of which a quick run takes
#: one of so many, and of measured rows.
CASES, DRAWS, EXAM_DRAWS, QUICK_EXAM, MEASURED_DRAWS = 40, 20, 3, 12, 9
_KINDS = ("known", "weak", "clean", "foreign", "left out", "two", "poor", "design", "ringing")
#: Rows of `docs/evidence.md`.
MEASURED = ("sine_1hz", "minor_loops", "both files")

#: A case of the study, a record of the exam, or a row of the measured ones; and what was said of
#: it: verdict, names, and the whole set.
Source = Case | ExamRecord | str
Said = tuple[str, frozenset[str], frozenset[str]]


def stability(progress: Progress, quick: bool) -> Outcome:
    """Diagnose everything as it is, then with white noise of 1 % of its own added."""
    jobs: list[tuple[str, Source, int]] = [
        (c.kind, c, 3 if quick else DRAWS) for c in chosen_cases(6 if quick else CASES)
    ]
    exam = RECORDS[::QUICK_EXAM] if quick else RECORDS
    jobs += [("exam", record, 1 if quick else EXAM_DRAWS) for record in exam]
    jobs += [("measured", row, 1 if quick else MEASURED_DRAWS) for row in MEASURED]
    draws = [(source, k) for _, source, n in jobs for k in range(n + 1)]
    output = lambda s: f"{s[0]} {', '.join(s[1])}"  # noqa: E731
    statement = iter(on_all_cores(said_of, draws, progress, output))
    table = {
        (kind, k): list(itertools.islice(statement, n + 1)) for k, (kind, _, n) in enumerate(jobs)
    }
    rows = []
    for kind in (*dict.fromkeys(kind for kind, _ in table), "all"):
        items = [of for (name, _), of in table.items() if kind in (name, "all")]
        pairs = [(first, s) for first, *changed in items for s in changed]
        rows.append({
            "cases": kind, "number": len(items),
            "same verdict and names": share(s[:2] == first[:2] for first, s in pairs),
            "same verdict, names in the set": share(
                s[0] == first[0] and first[1] <= s[2] for first, s in pairs
            ),
            "cases without a change": sum(len({s[:2] for s in of}) == 1 for of in items),
        })  # fmt: skip
    note = "Everything is diagnosed as it is, and with white noise of 1 % of its own added."
    return Outcome([TitledTable("Data changed by 1 % of their noise", rows, note)])


def chosen_cases(count: int) -> list[Case]:
    """Return cases of every kind in turn, evenly from a study."""
    every = study(KNOWN, FOREIGN, 2, FIRST)
    rows = [[c for c in every if c.kind == kind] for kind in _KINDS]
    each = -(-count // len(rows))
    spread = [[item[len(item) * k // each] for k in range(each)] for item in rows]
    return [item[k] for k in range(each) for item in spread][:count]


def said_of(source: Source, draw: int) -> Said:
    """Return what is said of records with their readings changed by white noise; draw 0 is not."""
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
#: Samples in which the plant's voltage rises from zero to where an excerpt begins.
_LEAD = 400


#: Every so many cases the figures with a reference were tuned on; the others are reported.
TUNED = 3
#: Fewer samples are no reference.
_FEWEST = 400


class Named(NamedTuple):
    """What was said: the verdict, the names, and these with what they cannot be told from."""

    verdict: str
    named: tuple[str, ...]
    within: tuple[str, ...]

    def wrong(self, right: Sequence[str]) -> tuple[str, ...]:
        """Return the names that are not right."""
        return tuple(n for n in self.named if n not in right)

    def alone(self, right: Sequence[str]) -> bool:
        """Whether one wrong cause is named as the only one, with nothing left."""
        single = self.verdict == "cause_named" and len(self.named) == 1
        return single and self.named == self.wrong(right)


class Added(NamedTuple):
    """What was said of an excerpt as it was measured, and with an effect on top.

    `own` are the names and their sets without the effect. `said` is what was said with it: without
    a reference, against what else was recorded of the device, against the same test recorded again.
    """

    record: str
    effect: str
    own: tuple[str, ...]
    said: tuple[Named, Named, Named]


def added(progress: Progress, quick: bool) -> Outcome:
    """Diagnose excerpts of the measured records as they are and with every effect on top.

    A plant plays the record's own voltage with the effect and without it; the difference, scaled to
    the record's stroke, is added to what was measured. What the record has by itself stays; with a
    reference it is known. And records of the same healthy device against each other: nothing has
    changed there.
    """
    effects = [e for e in KNOWN if HIDDEN_EFFECTS[e].room is None][:: 5 if quick else 1]
    pieces = excerpts_from_reversals(1 if quick else EXCERPTS)[: 1 if quick else None]
    plain = on_all_cores(by_itself, [(p,) for p, _ in pieces], progress)
    jobs = [
        (piece, others, effect, FIRST_ADDED + 100 * k + j, *item)
        for k, ((piece, others), item) in enumerate(zip(pieces, plain, strict=True))
        for j, effect in enumerate(effects)
    ]
    result = on_all_cores(with_effect, jobs, progress, lambda f: f"{f.record} with {f.effect}")
    each = [
        {"record": f.record, "named by itself": ", ".join(f.own) or "-", "added": f.effect,
         **{how: f"{s.verdict}: {', '.join(s.within) or '-'}"
            for how, s in zip(_WAYS, f.said, strict=True)}}
        for f in result
    ]  # fmt: skip
    kept = [f for k, f in enumerate(result) if k % TUNED] if not quick else result
    pairs = on_all_cores(unchanged, _pairs(quick), progress, lambda f: str(f["record"]))
    titled_table = TitledTable(
        "Records of the same healthy device: nothing has changed", pairs,
        "A wrong name is any name. Measured records, and halves of the clean records of the exam.",
    )  # fmt: skip
    return Outcome((summary(kept), titled_table, TitledTable("What was said of each", each)))


def excerpts_from_reversals(each: int) -> list[tuple[psa.Record, tuple[psa.Record, ...]]]:
    """Return excerpts of the measured records, each from a reversal on, and what else there is."""
    rng = np.random.default_rng(FIRST_ADDED)
    items = []
    for record in datasets.micromanipulator():
        turns = [t for t in reversals(record.voltage) if t + LENGTH <= record.n]
        for start in np.sort(rng.choice(turns, each, replace=False)).tolist():
            piece = record.slice(start, start + LENGTH)
            parts = ((0, start), (start + LENGTH, record.n))
            others = tuple(record.slice(a, b) for a, b in parts if b - a >= _FEWEST)
            name = f"{record.name} from {record.time[start]:.1f} s"
            items.append((replace(piece, name=name), others))
    return items


def by_itself(record: psa.Record) -> tuple[tuple[str, ...], float]:
    """Return all that is named of a record, and what its extended model leaves, rms [m]."""
    d = psa.diagnose([record])
    return names_of(d)[1], d.extended_errors.holdout_rms_m


def with_effect(
    record: psa.Record, others: Sequence[psa.Record], effect: str, seed: int,
    texts: tuple[str, ...], left: float,
) -> Added:  # fmt: skip
    """Diagnose a record with an effect on top of what it has by itself, without a reference and so.

    The same test again is the record as it was measured with as much noise anew.
    """
    more = difference(record, effect, seed, SIZE * left)
    again = noisy(record, _MEASURED_NOISE, np.random.default_rng([seed // 100, 1]))
    new = replace(record, displacement=np.asarray(record.displacement) + more)
    every = (psa.diagnose([new], reference=sound) for sound in ((), others, [again]))
    without, other, same = (Named(d.verdict, *names_of(d)) for d in every)
    return Added(record.name, effect, texts, (without, other, same))


def _pairs(quick: bool) -> list[tuple[str, psa.Record, psa.Record]]:
    """Return pairs of records of the same healthy device, of which the second is the reference."""
    sine, loops = datasets.micromanipulator()
    cuts = [sine.slice(k, k + 1500) for k in range(0, sine.n - 1500, 1500)]
    items = [(f"{a.name} against {b.name}", a, b) for a, b in itertools.permutations(cuts, 2)]
    items += [(f"{a.name} against {b.name}", a, b) for a, b in ((sine, loops), (loops, sine))]
    for record in RECORDS:
        if record.question.group == "clean":
            (whole,) = _records(record)[1]
            first, second = whole.slice(0, whole.n // 2), whole.slice(whole.n // 2, whole.n)
            items.append((f"{record.name}, first half", first, second))
            items.append((f"{record.name}, second half", second, first))
    return items[::12] if quick else items


def unchanged(name: str, new: psa.Record, reference: psa.Record) -> dict[str, object]:
    """Diagnose a record against another one of the same device; a row of what is said."""
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
    hidden = hide(
        HIDDEN_EFFECTS[effect], run, rng, base_directions(run), size / scale, 1.0, visible=1.0
    )
    return np.asarray(scale * hidden.added[_LEAD:], dtype=np.float64)


#: What is known beside the record.
_WAYS = ("without a reference", "other records", "the same test again")


def summary(found: Sequence[Added]) -> TitledTable:
    """Return how often the effect is named, and how often another one that is not there."""
    new = [f for f in found if called(f.effect) not in f.own]

    def row(figure: str, text: str, of: Callable[[Added, Named], bool]) -> dict[str, object]:
        ways = {how: share([of(f, f.said[k]) for f in new]) for k, how in enumerate(_WAYS)}
        return {"figure": figure, "asked": text, **ways}

    def right(f: Added, s: Named) -> tuple[str, ...]:
        return (called(f.effect), *(f.own if s is f.said[0] else ()))

    return TitledTable(
        "An effect added to a measured record",
        [
            row("the effect in a named set", "70 of 87", lambda f, s: called(f.effect) in s.within),
            row("a single wrong name", "at most 2 %", lambda f, s: s.alone(right(f, s))),
            row("any cause that is not there", "-", lambda f, s: bool(s.wrong(right(f, s)))),
            row("said to be as it was", "-", lambda f, s: s.verdict == "adequate"),
        ],
        f"{len(found) - len(new)} of {len(found)} effects are named of the record by itself and do"
        f" not count. What is added is {SIZE:g} times what the extended model of the record leaves,"
        f" beside what the base can absorb. Every {TUNED}rd case, on which the constants were"
        " chosen, is not counted.",
    )


#: The seed of `excerpts`, which no other benchmark uses; pieces; their samples.
SEED, PIECES, QUICK_PIECES, LENGTHS = 740501, 200, 6, (300, 2500)
#: Scales of the displacement, units mistaken by a power of ten among them; every so many samples
#: are kept of long pieces.
_SCALES, _KEPT, _LONG = (1.0, 1.0, 1.0, 10.0, 1e3, 1e-3), (1, 1, 2, 5), 1500
#: Share of pieces whose displacement is turned round, and of those whose voltage is.
_TURNED = 0.15


class Ended(NamedTuple):
    """How the diagnosis of a piece ended: a verdict, `refused` or `crashed`, and what was said."""

    piece: str
    how: str
    said: str
    seconds: float


def excerpts(progress: Progress, quick: bool) -> Outcome:
    """Diagnose spoilt pieces of the measured records.

    Cut anywhere, at any length, decimated, scaled by powers of ten, with either column's sign
    turned: each must end with a verdict, or be refused in a sentence, and its model must predict
    the piece.
    """
    every = pieces(datasets.micromanipulator(), QUICK_PIECES if quick else PIECES)
    output = lambda e: f"{e.piece}: {e.how}"  # noqa: E731
    return Outcome([ends(on_all_cores(ended_of, [(piece,) for piece in every], progress, output))])


def pieces(records: Sequence[psa.Record], count: int) -> list[psa.Record]:
    """Return so many pieces of records, in turn, each named for what was done to it."""
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
        displayed = scale * turn * np.asarray(part.displacement)[::keep]
        voltage = sign * part.voltage[::keep]
        result.append(
            psa.Record(name=name, time=part.time[::keep], voltage=voltage, displacement=displayed)
        )
    return result


def ended_of(piece: psa.Record) -> Ended:
    """Diagnose a piece; any error but a refusal in words is a crash."""
    begin = process_time()
    try:
        d = psa.diagnose([piece])
        finite = all(np.all(np.isfinite(y)) for y in (*d.base, *d.extended))
        how: str = d.verdict if finite and d.to_json() else "crashed"
        text = ", ".join(c.effect for c in d.causes)
    except psa.InputError as error:
        how, text = "refused", str(error)
    except Exception as error:  # noqa: BLE001 - what is counted here
        how, text = "crashed", f"{type(error).__name__}: {error}"
    return Ended(piece.name, how, text, process_time() - begin)


def ends(found: Sequence[Ended]) -> TitledTable:
    """Return how the pieces ended, and what was said of those that were refused or crashed."""
    counts = Counter(e.how for e in found)
    counts["crashed"] += 0
    failed = [e for e in found if e.how in ("refused", "crashed")]
    counter = Counter((f"{e.how} because", e.said.split(";")[0][:80]) for e in failed)
    lines = [(how, n, "") for how, n in sorted(counts.items())]
    lines += [(how, n, text) for (how, text), n in sorted(counter.items())]
    slowest = max(found, key=lambda e: e.seconds)
    return TitledTable(
        f"{len(found)} spoilt pieces of measured records",
        [{"ended": how, "pieces": n, "said": text} for how, n, text in lines],
        f"The slowest took {slowest.seconds:.0f} s of processor time: {slowest.piece}.",
    )
