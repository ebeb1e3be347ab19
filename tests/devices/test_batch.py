"""Many devices: real work on two, jobs from tables, what is kept, what a failure does."""

import json
import os
import pickle
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from datetime import date
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common import children, processes
from psa_casadi.common.interruption import raise_if_stopped
from psa_casadi.common.strict_json import json_text
from psa_casadi.devices import executors
from psa_casadi.devices.executors import outcomes
from psa_casadi.devices.jobs import DeviceOutcome, DeviceTask, jobs_given, key_of
from psa_casadi.documents.files import identification_file
from psa_casadi.population.population import population
from psa_casadi.simulation.side_by_side import threads
from tests.any_model import own_plants as plants
from tests.any_model.own_models import motor
from tests.contract.helpers import PSA, command
from tests.records.record_files import write
from tests.report.html_page import read_page
from tests.report.report_cases import identification
from tests.tiers import posix, slow

TIME = np.arange(240) * 1e-2
VOLTAGE = (50.0 - 50.0 * np.cos(4 * np.pi * TIME)) * np.exp(-0.2 * TIME)


def write_device(path: Path, force: float = 1.0, seed: int = 1) -> None:
    """Write the record of a stack whose force per volt has a factor."""
    model = psa.stack_model("P-885.51")
    y = psa.simulate(model.with_values({"k_L": force * model.values["k_L"]}), TIME, VOLTAGE)
    x = y.displacement + 3e-9 * np.random.default_rng(seed).standard_normal(TIME.size)
    psa.write_record(path, {"time [s]": TIME, "voltage [V]": VOLTAGE, "displacement [m]": x})


@pytest.fixture
def records(tmp_path: Path) -> Path:
    """Return a folder with two devices and a third that cannot be read."""
    folder = tmp_path / "records"
    (folder / "first").mkdir(parents=True)
    write_device(folder / "first" / "loops.csv")
    write_device(folder / "second.csv", 1.05, seed=2)
    (folder / "third.csv").write_text("time [s],voltage [V],displacement [um]\n0,a,1\n")
    return folder


def stamps(folder: Path) -> dict[str, int]:
    return {str(p): p.stat().st_mtime_ns for p in folder.rglob("*/*.json")}


def stand_in(
    monkeypatch: pytest.MonkeyPatch,
    work: Callable[[DeviceTask], DeviceOutcome | None] = lambda task: None,
) -> list[str]:
    """Let the work on a device be something short in this process; return who was worked on."""
    texts: list[str] = []

    def worked(task: DeviceTask, began: float) -> DeviceOutcome:
        texts.append(task.job.device)
        return work(task) or DeviceOutcome(task.job.device, "done", 0.0)

    monkeypatch.setattr(executors, "_worked", worked)
    return texts


def tasks(folder: Path, count: int) -> list[DeviceTask]:
    path = folder / "r.csv"
    path.touch()
    return [DeviceTask(psa.Job(f"d{k}", (str(path),)), psa.Options(), "run") for k in range(count)]


def test_few_are_submitted_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(monkeypatch)
    held: list[int] = []
    pending: set[Future[Any]] = set()

    class Counting(ThreadPoolExecutor):
        def submit(self, *task: Any, **more: Any) -> Future[Any]:
            future = super().submit(*task, **more)
            pending.add(future)
            held.append(len(pending))
            return future

    with Counting(4) as pool:
        ended = []
        for task, _ in outcomes(tasks(tmp_path, 30), pool, at_once=3):
            ended.append(task.job.device)
            pending.pop()  # one of those that ended is no longer held
    assert sorted(ended) == sorted(f"d{k}" for k in range(30))
    assert max(held) <= 3


def test_every_device_has_one_thread_and_its_failure_is_its_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts: set[int] = set()

    def work(task: DeviceTask) -> None:
        counts.add(threads())
        if task.job.device == "d1":
            raise ZeroDivisionError("by hand")
        if task.job.device == "d2":
            raise psa.InputError(["one", "two"])

    stand_in(monkeypatch, work)
    with ThreadPoolExecutor(2) as pool:
        ended = {t.job.device: o for t, o in outcomes(tasks(tmp_path, 4), pool, 4)}
    assert counts == {1}
    assert {n: o.status for n, o in ended.items()} == {
        "d0": "done", "d1": "failed", "d2": "refused", "d3": "done",
    }  # fmt: skip
    assert ended["d1"].problems == ("ZeroDivisionError: by hand",)
    assert ended["d2"].problems == ("one", "two")


def test_an_interrupt_ends_the_threads_and_names_what_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = threading.Event()

    def work(task: DeviceTask) -> None:
        if task.job.device == "d0":
            return
        try:
            while True:  # as a simulation in C does, until the flag is set
                raise_if_stopped()
                time.sleep(0.01)
        finally:
            ended.set()

    texts = stand_in(monkeypatch, work)
    jobs = [t.job for t in tasks(tmp_path, 8)]

    def progress(text: str) -> None:
        if "d0: done" in text:
            raise KeyboardInterrupt

    out = tmp_path / "out"
    with ThreadPoolExecutor(2) as pool, pytest.raises(KeyboardInterrupt, match="1 of 8 devices"):
        psa.batch(jobs, out, executor=pool, at_once=3, progress=progress)
    assert ended.wait(2.0)
    assert len(texts) < 8
    stand_in(monkeypatch)
    with ThreadPoolExecutor(2) as pool:
        assert psa.batch(jobs, out, executor=pool).kept == 1


def test_what_failed_is_tried_again_and_what_was_refused_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def work(task: DeviceTask) -> None:
        if task.job.device == "d0":
            raise psa.InputError("no record")
        if task.job.device == "d1":
            raise MemoryError

    jobs = [t.job for t in tasks(tmp_path, 3)]
    stand_in(monkeypatch, work)
    with ThreadPoolExecutor(1) as pool:
        psa.batch(jobs, tmp_path / "out", executor=pool)
        texts = stand_in(monkeypatch)
        psa.batch(jobs, tmp_path / "out", executor=pool)
        assert texts == ["d1"]
        psa.batch(jobs, tmp_path / "out", executor=pool, options=psa.Options(stiffness=5e7))
    assert sorted(texts) == ["d0", "d1", "d1", "d2"]
    with pytest.raises(psa.InputError, match="give 'identify' or 'diagnose'"):
        psa.Options(work="diagnos")  # type: ignore[arg-type]


def identified(task: DeviceTask) -> DeviceOutcome:
    text = json_text(identification_file(identification()))
    return DeviceOutcome(task.job.device, "done", 0.0, files=(("identification.json", text),))


@pytest.mark.parametrize("name", ["device.json", "identification.json"])
@pytest.mark.parametrize("length", [0, 300, None])
def test_a_damaged_result_is_named_and_made_again(
    name: str, length: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, observed = tmp_path / "out", stand_in(monkeypatch, identified)
    jobs = [t.job for t in tasks(tmp_path, 5)]
    with ThreadPoolExecutor(1) as pool:
        assert len(psa.batch(jobs, out, executor=pool).findings) == 5
        whole = (out / "d1" / name).read_bytes()
        # cut, or a digit is another one: still a file that can be read
        other = whole.replace(b"1", b"2", 1) if name != "device.json" else b"{}"
        (out / "d1" / name).write_bytes(other if length is None else whole[:length])
        output = command("compare", out, "-o", tmp_path / "p.html").out
        assert f"d1: failed: {out / 'd1' / name}: is damaged" in output
        assert "d1" in (tmp_path / "p.html").read_text("utf-8")
        again = psa.batch(jobs, out, executor=pool)
    assert (again.kept, again.counts, len(again.findings)) == (4, {"done": 5}, 5)
    assert observed[5:] == ["d1"]
    assert (out / "d1" / "identification.json").stat().st_size > 300


def test_a_table_of_jobs_is_read(records: Path) -> None:
    write(records / "jobs.csv", "device,batch,date,files", "first,B1,2026-03-14,",
          "A2,B2,2026-04-01T12:00,second.csv;first/loops.csv",
          "A2,B2,2026-04-01,third.csv")  # fmt: skip
    first, second = jobs_given(records)
    assert (first.batch, first.day) == ("B1", date(2026, 3, 14))
    assert [Path(f).name for f in first.files] == ["loops.csv"]
    assert [Path(f).name for f in second.files] == ["second.csv", "loops.csv", "third.csv"]
    (records / "jobs.csv").unlink()
    (records / "third.csv").rename(records / "third.csv.gz")
    assert [job.device for job in jobs_given(records)] == ["first", "second", "third"]


@pytest.mark.parametrize(
    ("table", "problem"),
    [
        ("name,files\na,b\n", "has the columns device, batch, date, files"),
        ("device\n../up\n", "no folder can have this name"),
        ("device\nnul\n", "no folder can have this name"),
        ("device,date\nfirst,14.3.26\n", "line 2: the date is '14.3.26'; write it as 2026-03-14"),
        ("device,files\na,nowhere.csv\n", "there is no file"),
        ("device,batch\nfirst,1\nfirst,2\n", "another batch or date"),
        ("device,files\nSecond,second.csv\nsecond,second.csv\n", "is there twice"),
        ("device,batch\nfirst,1,2\n", "3 cells for 2 columns"),
        ("device\n", "there is no device"),
        ("device\nfourth\n", "has no records"),
    ],
)
def test_mistakes_in_a_table_are_reported(table: str, problem: str, records: Path) -> None:
    (records / "jobs.csv").write_text(table)
    with pytest.raises(psa.InputError) as error:
        jobs_given(records / "jobs.csv")
    assert problem in str(error.value)


def test_an_executor_that_takes_no_more_is_an_error(tmp_path: Path) -> None:
    pool = ThreadPoolExecutor(1)
    pool.shutdown()
    with pytest.raises(psa.MachineError, match="takes no more work"):
        list(outcomes(tasks(tmp_path, 1), pool, 1))


def test_an_executor_that_is_lost_is_no_result_of_a_device(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in(monkeypatch)
    jobs = [t.job for t in tasks(tmp_path, 3)]

    class Lost(ThreadPoolExecutor):
        def submit(self, *task: Any, **more: Any) -> Future[Any]:
            if task[1].job.device == "d0":
                return super().submit(*task, **more)
            future: Future[Any] = Future()
            future.cancel()  # as a client of Dask does when its scheduler is gone
            future.set_running_or_notify_cancel()
            return future

    out = tmp_path / "out"
    with Lost(1) as pool, pytest.raises(psa.MachineError, match="executor was lost"):
        psa.batch(jobs, out, executor=pool, at_once=1)
    assert [p.name for p in out.iterdir()] == ["d0"]
    with ThreadPoolExecutor(1) as other:
        assert psa.batch(jobs, out, executor=other).kept == 1


@slow
@pytest.mark.parametrize("address", ["junk", "tls://127.0.0.1:1"])
def test_an_address_of_no_scheduler_is_an_error_in_a_sentence(
    address: str, records: Path, tmp_path: Path
) -> None:
    pytest.importorskip("distributed")
    process = batch_command(records, tmp_path / "out", "--dask", address)
    _, output = process.communicate(timeout=35)
    assert process.returncode == 1
    assert output.splitlines()[1:] == [output.splitlines()[-1]]
    assert f"The scheduler at {address} cannot be reached" in output


def test_dask_that_is_missing_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr(executors, "import_module", missing)
    with pytest.raises(psa.InputError, match=r"pip install 'psa-casadi\[dask\]'"):
        executors.dask_client("local").__enter__()


@slow
def test_a_process_that_dies_takes_one_device_with_it(
    records: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def sent(call: tuple[Any, DeviceTask], stream: IO[bytes]) -> None:
        if call[1].job.device == "d1":  # its process dies while it gets the task
            (child,) = children._CHILDREN
            os.kill(child.pid, signal.SIGKILL)
        pickle.dump(call, stream)

    job = next(j for j in jobs_given(records) if j.device == "first")
    items = [DeviceTask(psa.Job(f"d{k}", job.files), psa.Options(), "run") for k in range(3)]
    monkeypatch.setattr(processes, "pickle", SimpleNamespace(**{**vars(pickle), "dump": sent}))
    executor = processes.Processes(1)
    try:
        table = {t.job.device: outcome for t, outcome in outcomes(items, executor, 1)}
    finally:
        executor.end()
    assert [table[f"d{k}"].status for k in range(3)] == ["done", "failed", "done"]
    assert "ended (signal 9)" in table["d1"].problems[0]


@slow
@pytest.mark.parametrize("kind", ["processes", "dask"])
def test_other_executors_do_it_too(kind: str, records: Path, tmp_path: Path) -> None:
    if kind == "dask":
        pytest.importorskip("distributed")
        pool: Any = executors.dask_client("local", 2)
    else:
        pool = ProcessPoolExecutor(2, mp_context=get_context("spawn"))
    with pool as executor:
        result = psa.batch(records, tmp_path / "out", executor=executor)
    assert result.counts == {"done": 2, "refused": 1}
    assert psa.load_model(tmp_path / "out" / "first" / "model.json").provenance.free


@slow
def test_devices_are_diagnosed(records: Path, tmp_path: Path) -> None:
    (records / "third.csv").unlink()
    result = psa.batch(records, tmp_path / "out", options=psa.Options(work="diagnose"), workers=2)
    assert result.counts == {"done": 2}
    first, second = psa.read_findings([tmp_path / "out" / n for n in ("first", "second")])
    assert first.verdict == second.verdict == "adequate"
    assert first.trace is not None
    error = np.array(first.trace.measured) - np.array(first.trace.model)
    assert 2e-9 < np.nanstd(error) < 5e-9  # 3 nm were put in


def batch_command(folder: Path, out: Path, *more: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [*PSA, "batch", str(folder), "-o", str(out), "--workers", "1", *more],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip


@slow
@posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_run_that_was_ended_goes_on(number: signal.Signals, tmp_path: Path) -> None:
    folder, out = tmp_path / "records", tmp_path / "out"
    folder.mkdir()
    for k in range(3):
        write_device(folder / f"d{k}.csv", 1.0 + 0.01 * k, seed=k)
    process = batch_command(folder, out)
    assert process.stderr is not None
    for line in process.stderr:
        if "done)" in line:
            break
    process.send_signal(number)
    _, output = process.communicate(timeout=20)
    assert process.returncode == (130 if number is signal.SIGINT else -9)
    if number is signal.SIGINT:
        assert "of 3 devices are done. Kept: " in output
    before = stamps(out)
    again = batch_command(folder, out)
    statement, _ = again.communicate(timeout=120)
    assert again.returncode == 0
    assert "of them were there before" in statement
    assert before.items() <= stamps(out).items()
    assert len(list(out.glob("*/device.json"))) == 3
    assert not list(out.rglob(".psa_casadi-*"))


# Devices that are no stacks: another model, fitted to the records of each


def write_motor(path: Path, seed: int, inertia: float = 3e-5, friction: float = 0.0) -> None:
    record = plants.motor(seed, friction, inertia=inertia)
    table = np.column_stack([record.time, *record.columns.values()])[:800]
    names = ["time [s]", "voltage [V]", "w [rad/s]", "i [A]"]
    np.savetxt(path, table, delimiter=",", header=",".join(names), comments="")


def test_a_heavy_motor_is_an_outlier_of_a_population(tmp_path: Path) -> None:
    folder = tmp_path / "records"
    folder.mkdir()
    for k in range(6):
        write_motor(folder / f"m{k}.csv", seed=k + 1, inertia=3.3e-5 if k == 4 else 3e-5)
    (folder / "none.csv").write_text("time,voltage\n" + "\n".join(f"{k},1" for k in range(40)))
    options = psa.Options(model=motor(), words={"starts": 1, "known_start": True})
    done = psa.batch(folder, tmp_path / "results", options=options, workers=2)
    assert done.counts == {"done": 6, "refused": 1}
    assert "no output of the model 'motor'" in " ".join(done.devices[-1].problems)
    content = json.loads((tmp_path / "results" / "m1" / "identification.json").read_text("utf-8"))
    alone = psa.identify(motor(), folder / "m1.csv", starts=1, known_start=True)
    for name, parameter in content["parameters"].items():
        assert parameter["value"] == pytest.approx(alone.model.values[name], rel=1e-6)
    saved = psa.load_model(tmp_path / "results" / "m1" / "model.json")
    assert saved.values == pytest.approx(alone.model.values, rel=1e-6)
    summary = (tmp_path / "results" / "summary.csv").read_text("utf-8").splitlines()
    assert "J [kg.m2]" in summary[0]
    assert not [n for n in summary[0].split(",") if "[m]" in n or "[times" in n]  # nothing in them
    result = population(done.findings)
    assert {(o.device, o.parameter) for o in result.outliers} == {("m4", "J")}
    psa.write_population(result, tmp_path / "page.html")
    assert "1 of 6 devices stands out: m4." in read_page(tmp_path / "page.html")[1].text
    again = psa.batch(folder, tmp_path / "results", options=options, workers=1)
    assert again.kept == 7
    jobs = [psa.Job("m1", (str(folder / "m1.csv"),))]
    other = psa.Options(model=motor().with_values({"b": 2e-5}), words=options.words)
    assert key_of(jobs[0], other) != key_of(jobs[0], options)


@slow
def test_devices_that_are_no_stacks_are_diagnosed(tmp_path: Path) -> None:
    jobs = []
    for name, friction in (("dry", 0.012), ("oiled", 0.0)):
        write_motor(tmp_path / f"{name}.csv", 2, friction=friction)
        jobs.append(psa.Job(name, (str(tmp_path / f"{name}.csv"),)))
    fewer = ["hysteresis", "stop", "curve", "delay", "bend", "lag", "saturation"]
    options = psa.Options(work="diagnose", model=motor(), words={"leave_out": fewer})
    done = psa.batch(jobs, tmp_path / "results", options=options, workers=1)
    assert [f.verdict for f in done.findings] == ["cause_named", "adequate"]
    assert [c.effect for c in done.findings[0].causes] == ["friction_in_speed"]
