"""The work on one device, in whatever process or thread it runs: on one thread, its error told."""

import threading
import time
from collections.abc import Sequence
from contextlib import suppress

from psa_casadi.component import Component
from psa_casadi.devices.jobs import DeviceOutcome, DeviceTask, Job, Options
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.errors import InputError, MachineError, PsaError
from psa_casadi.faces import diagnose as any_diagnose
from psa_casadi.faces import identify as any_identify
from psa_casadi.identification.identify import identify
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.interruption import Work, interruptible_work
from psa_casadi.model.compose import Model
from psa_casadi.model.model_file import dumps, loads
from psa_casadi.model.own_effects import known_effects, own_effects
from psa_casadi.progress import silent
from psa_casadi.records import Record, read_records, read_signals
from psa_casadi.records.signals import Signals
from psa_casadi.report.documents.files import Status, identification_file
from psa_casadi.simulation.side_by_side import compiled, one_thread
from psa_casadi.simulation.start import is_stack
from psa_casadi.strict_json import json_text

IDENTIFICATION, DIAGNOSIS, MODEL = "identification.json", "diagnosis.json", "model.json"
#: Works of this process by the run that they belong to, and runs that were stopped.
_RUNNING: dict[str, set[Work]] = {}
_STOPPED: set[str] = set()
_LOCK = threading.Lock()


def work_on(task: DeviceTask) -> DeviceOutcome:
    """Identify or diagnose a device; what goes wrong is its result.

    Raises KeyboardInterrupt where the run was stopped.
    """
    began = time.monotonic()
    status: Status = "refused"
    with interruptible_work() as work, one_thread():
        with _LOCK:
            if task.run in _STOPPED:
                raise KeyboardInterrupt
            _RUNNING.setdefault(task.run, set()).add(work)
        try:
            return _worked(task, began)
        except InputError as error:
            status, problems = "refused", error.problems
        except PsaError as error:
            status, problems = "refused", (str(error),)
        except Exception as error:  # noqa: BLE001 - no device may stop the others
            status, problems = "failed", (f"{type(error).__name__}: {error}",)
        finally:
            with _LOCK:
                _RUNNING[task.run].discard(work)
    return DeviceOutcome(task.job.device, status, time.monotonic() - began, problems=problems)


def stop(run: str) -> None:
    """End the works of a run in this process."""
    with _LOCK:
        _STOPPED.add(run)
        for work in _RUNNING.get(run, ()):
            work.stop()


def _worked(task: DeviceTask, began: float) -> DeviceOutcome:
    o = task.options
    effects = [c for module in o.modules for c in own_effects(module).values()]
    start = _started(o, effects)
    if start is not None and not is_stack(start):
        return _worked_own(task, start, began)
    records = read_records(
        task.job.files, need_excitation=True, columns=o.columns, sample_time=o.sample_time
    )
    _refuse_same(records)
    if o.work == "diagnose":
        d = diagnose(
            records, model=start, stiffness=o.stiffness, hysteresis=o.hysteresis,
            effects=tuple(known_effects(effects).values()),
        )  # fmt: skip
        name, text, model = DIAGNOSIS, d.to_json(), d.model
    else:
        found = identify(records, model=start, stiffness=o.stiffness, hysteresis=o.hysteresis)
        if found.interrupted:
            raise KeyboardInterrupt
        name, text, model = IDENTIFICATION, json_text(identification_file(found)), found.model
    return _done(task, began, ((name, text), (MODEL, dumps(model))), records)


def _worked_own(task: DeviceTask, model: Model, began: float) -> DeviceOutcome:
    """Work with a model of one's own; an imported FMU has no file of its model."""
    o = task.options
    records = read_signals(
        task.job.files, inputs=model.input_names, outputs=model.output_names,
        columns=o.columns, sample_time=o.sample_time,
    )  # fmt: skip
    _refuse_same(records)
    if o.work == "diagnose":
        d = any_diagnose(model, records, progress=silent, **o.words)
        name, text, last = DIAGNOSIS, d.to_json(), d.model
    else:
        found = any_identify(model, records, progress=silent, **o.words)
        if found.fit.interrupted:
            raise KeyboardInterrupt
        name, text, last = IDENTIFICATION, json_text(identification_file(found)), found.model
    files = [(name, text)]
    if not last.structure.foreign:
        files.append((MODEL, dumps(last)))
    return _done(task, began, tuple(files), records)


def _started(o: Options, effects: Sequence[Component]) -> Model | None:
    """Return the model to start from."""
    return loads(o.model, effects=effects) if isinstance(o.model, str) else o.model


def _refuse_same(records: Sequence[Record | Signals]) -> None:
    """Refuse records that hold the same data. Raises InputError."""
    seen: dict[str, str] = {}
    for r in records:
        if r.sha256 in seen:
            raise InputError(
                f"{r.source}: holds the same data as {seen[r.sha256]}; a record counts once: remove"
                " one of the two."
            )
        seen[r.sha256] = r.source


def _done(
    task: DeviceTask,
    began: float,
    files: tuple[tuple[str, str], ...],
    records: Sequence[Record | Signals],
) -> DeviceOutcome:
    return DeviceOutcome(
        task.job.device,
        "done",
        time.monotonic() - began,
        files=files,
        records=tuple((r.name, r.sha256) for r in records),
    )


def make_ready(job: Job, options: Options) -> None:
    """Compile what the first device will need; what fails is told by the device's own work.

    They lie in the cache of the user, where every process on this machine finds them.
    """
    with suppress(PsaError, MachineError):
        if isinstance(options.model, Model) and not is_stack(options.model):
            compiled([options.model])
            return
        records = read_records(job.files, columns=options.columns, sample_time=options.sample_time)
        start = starting_model(records, options.stiffness)
        models = [start]
        if options.work == "diagnose":
            own = [c for module in options.modules for c in own_effects(module).values()]
            table = known_effects(own).values()
            models += [start.with_effect(e) for e in table if not e.needs_column]
        compiled(models)
