"""What an FMU carries as evidence: whether it is the model's, and what it takes to repeat it."""

from collections.abc import Iterator, Sequence

import numpy as np

from psa_casadi.common.errors import InputError
from psa_casadi.export.check.agreement import ERROR_LIMIT, Playback
from psa_casadi.export.check.rows import BREAKDOWNS, Check, CheckRow, stopped
from psa_casadi.export.common.parameter_sets import MOST_SAMPLES
from psa_casadi.export.fmu import evidence as carried
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.masters import Signals
from psa_casadi.identification.prepare import as_read, prepared
from psa_casadi.model.compose import Model
from psa_casadi.model.evidence import RecordRun
from psa_casadi.records.record import Record

_NONE = (
    "the model holds no evidence of its records and errors; identify or diagnose it with this"
    " version of psa_casadi, and export it again"
)


def wrong_evidence(archive: Archive, model: Model) -> Iterator[str]:
    """The files of evidence are what the model's evidence makes them."""
    folder = archive.directory
    samples = min(len(list((folder / carried.SETS).glob("sample_*.ssv"))), MOST_SAMPLES)
    expected = carried.evidence_texts(model, samples)
    for name, text in sorted(expected.items()):
        if not (folder / name).is_file():
            yield f"{name} is missing"
        elif (folder / name).read_bytes() != text.encode("utf-8"):
            yield f"{name} differs from the model"
    if model.evidence is not None and model.evidence.reference is not None:
        yield from (
            f"{n} is missing"
            for n in (carried.OUTPUTS, carried.VALIDATION)
            if not (folder / n).is_file()
        )
    result = {p.relative_to(folder).as_posix() for p in (folder / carried.SETS).glob("*")}
    yield from (f"{name} is not among the model's" for name in sorted(result - set(expected)))


def repeated(
    archive: Archive, model: Model | None, records: Sequence[Record]
) -> tuple[CheckRow | Playback, ...]:
    """Return the checks of `psa check --evidence`: rows that need no run, and runs to play."""
    evidence = model.evidence if model else None
    if model is None or evidence is None:
        return (Check("evidence", lambda: (_NONE,)).row(),)
    result: list[CheckRow | Playback] = []
    if records:
        known = {r.sha256 for r in evidence.runs}
        of = ", ".join(f"{r.record} ({r.sha256[:12]}...)" for r in evidence.runs)
        strange = [
            f"{r.name} has sha256 {r.sha256[:12]}..., the model states {of}"
            for r in records
            if r.sha256 not in known
        ]
        result.append(Check("records as stated", lambda: strange).row())
    try:
        if evidence.reference is not None:
            times, values = carried.run_inputs(model)
            text = (archive.directory / carried.OUTPUTS).read_text(encoding="utf-8")
            names = text.partition("\n")[0].split(",")
            table = np.loadtxt(text.splitlines()[1:], delimiter=",", ndmin=2)
            if table.shape != (len(times), len(names)) or "displacement" not in names:
                raise InputError(f"{carried.OUTPUTS} has not a row of outputs for each time")
            inputs = Signals(model.input_names, times, values)
            expected = table[:, names.index("displacement")]
            start = carried.run_start(model)
            result.append(Playback("reference run", inputs, start, "displacement", expected))
    except BREAKDOWNS as error:
        result.append(stopped("reference run", f"the check stopped: {error}"))
    for record in records:
        runs = (r for r in evidence.runs if r.sha256 == record.sha256)
        result += [_of_record(archive, model, record, run) for run in runs]
    return tuple(result)


def _of_record(
    archive: Archive, model: Model, record: Record, run: RecordRun
) -> Playback | CheckRow:
    """Return the run of a record, or the row with the reason why there is none."""
    kind = "held-out" if run.held_out else "fitted"
    name = f"{kind} error of {record.name}"
    present = {c.name for c in model.components}
    outside = model.evidence.outside if model.evidence else ()
    if missing := [n for n in outside if n not in present]:
        remark = f"not compared: the FMU leaves out {', '.join(missing)}, with which it was fitted"
        return CheckRow(name, 0.0, ERROR_LIMIT, True, remark)
    ready = prepared(record)[0] if run.averaged > 1 else as_read(record)
    if ready.n != run.samples:
        return stopped(name, f"the record has {ready.n} samples, {run.samples} are stated")
    text = "measured_displacement"
    times = ready.time - ready.time[0]
    columns = {n: getattr(ready, n, None) for n in archive.names("input")}
    inputs = {n: c for n, c in columns.items() if c is not None}
    judged = np.full(run.samples, not run.held_out)  # the samples that the stated error is over
    for first, stop in run.held_out:
        judged[first:stop] = True
    return Playback(
        name,
        Signals(tuple(inputs), times, np.array(list(inputs.values())).T),
        {n: v for n, v in run.start.items() if n in model.state_names},
        text if text in archive.names("output") else "displacement",
        np.where(judged, ready.measured - run.offset_m, np.nan),
        run.held_out_m if run.held_out else run.fitted_m,
    )
