"""The work on one device, in any process or thread: on one thread, with its error as result."""

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from psa_casadi.devices.jobs import DeviceOutcome, DeviceTask, Job, Options
from psa_casadi.errors import InputError, MachineError, PsaError
from psa_casadi.faces import diagnose, identify
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.interruption import Work, interruptible_work
from psa_casadi.model.compose import Model
from psa_casadi.model.model_file import dumps, loads
from psa_casadi.model.own_effects import known_effects, own_effects
from psa_casadi.progress import silent
from psa_casadi.records import Record, read_records, read_signals
from psa_casadi.records.signals import Signals
from psa_casadi.report.documents.files import Status
from psa_casadi.simulation.side_by_side import compiled, one_thread
from psa_casadi.simulation.start import is_stack

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
    o, job = task.options, task.job
    effects = [c for module in o.modules for c in own_effects(module).values()]
    start = loads(o.model, effects=effects) if isinstance(o.model, str) else o.model
    table: dict[str, Any] = {"columns": o.columns, "sample_time": o.sample_time}
    inputs: tuple[Any, ...]
    words: dict[str, Any]
    records: Sequence[Record | Signals]
    if start is None or is_stack(start):
        records = read_records(job.files, need_excitation=True, **table)
        inputs = (records,)
        words = {"model": start, "stiffness": o.stiffness, "hysteresis": o.hysteresis}
        if o.work == "diagnose":
            words["effects"] = tuple(known_effects(effects).values())
    else:
        table |= {"inputs": start.input_names, "outputs": start.output_names}
        records = read_signals(job.files, **table)
        inputs, words = (start, records), dict(o.words)
    _refuse_same(records)
    work: Callable[..., Any] = diagnose if o.work == "diagnose" else identify
    result = work(*inputs, progress=silent, **words)
    if o.work == "identify" and (result.interrupted or result.fit.interrupted):
        raise KeyboardInterrupt
    files = [(DIAGNOSIS if o.work == "diagnose" else IDENTIFICATION, result.to_json())]
    if not result.model.structure.foreign:  # an imported FMU has no file of its model
        files.append((MODEL, dumps(result.model)))
    return DeviceOutcome(
        job.device, "done", time.monotonic() - began, tuple(files),
        records=tuple((r.name, r.sha256) for r in records),
    )  # fmt: skip


def _refuse_same(records: Sequence[Record | Signals]) -> None:
    """Refuse records that hold the same data. Raises InputError."""
    texts: dict[str, str] = {}
    for r in records:
        if r.sha256 in texts:
            raise InputError(
                f"{r.source}: holds the same data as {texts[r.sha256]}; a record counts once:"
                " remove one of the two."
            )
        texts[r.sha256] = r.source


def make_ready(job: Job, options: Options) -> None:
    """Compile what the first device will need; what fails is reported by the device's work.

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
            effects = [c for module in options.modules for c in own_effects(module).values()]
            known = known_effects(effects).values()
            models += [start.with_effect(e) for e in known if not e.needs_column]
        compiled(models)
