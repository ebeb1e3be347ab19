"""Ctrl-C: one ends long work within two seconds and keeps what there is, a second one at once."""

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.interruption import interruptible_work
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.result import DiagnosisInterrupted
from psa_casadi.export.importer import masters
from psa_casadi.simulation.exact.run import run_exact
from psa_casadi.simulation.side_by_side import VARIABLE, side_by_side
from psa_casadi.simulation.simulate import input_samples
from tests.contract.helpers import PSA, command
from tests.report.report_cases import diagnosis
from tests.studies.plants.make import make_record
from tests.tiers import posix, slow

TIME: FloatArray = np.arange(600, dtype=float) * 5e-3
VOLTAGE = 50.0 - 50.0 * np.cos(4 * np.pi * TIME)
TABLE = [psa.EFFECTS["slow_creep"], psa.EFFECTS["offset_drift"]]


@pytest.fixture(autouse=True)
def _threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work runs in parallel, as for users; the other tests have one thread."""
    monkeypatch.setenv(VARIABLE, "2")


@pytest.fixture(scope="module")
def record() -> psa.Record:
    """A stack with a drift that the base does not have."""
    y = psa.simulate(psa.stack_model("P-885.51"), TIME, VOLTAGE).displacement
    noise = 3e-9 * np.random.default_rng(2).standard_normal(TIME.size)
    drifting = y + noise + 2e-7 * (TIME / TIME[-1]) ** 2
    return psa.Record(name="drifting", time=TIME, voltage=VOLTAGE, displacement=drifting)


def at(word: str) -> Callable[[str], None]:
    """Return a listener that interrupts where a step of the work starts."""

    def listen(step: str) -> None:
        if word in step:
            raise KeyboardInterrupt

    return listen


def cut(*inputs: object, **options: object) -> None:
    raise KeyboardInterrupt


WAYS: dict[str, Callable[[psa.Model, FloatArray, FloatArray, FloatArray], object]] = {
    "stepper": lambda model, t, u, x0: psa.run(model, t, u, x0, rtol=1e-9),
    "exact": lambda model, t, u, x0: run_exact(
        model, t, u, x0, tolerance=1e-12, coarsest=9, outputs=("measured_displacement",)
    ),
}


@pytest.mark.parametrize("way", WAYS)
def test_another_thread_ends_a_long_run_in_c(way: str) -> None:
    model, n = psa.stack_model("P-885.51"), 400_000
    t: FloatArray = np.arange(n, dtype=float) * 1e-4
    u = input_samples(model, n, {"voltage": 50.0 - 50.0 * np.cos(300.0 * t)})
    x0 = np.zeros(len(model.state_names))
    with interruptible_work() as work:
        threading.Timer(0.1, work.stop).start()
        begin = time.perf_counter()
        with pytest.raises(KeyboardInterrupt):
            WAYS[way](model, t, u, x0)
        assert time.perf_counter() - begin < 2.0


def test_an_interrupt_ends_the_other_threads_too() -> None:
    """The one who waits has the interrupt; the other would go on simulating for minutes."""
    model = psa.stack_model("P-885.51")

    def work(item: int) -> None:
        if item == 0:
            raise KeyboardInterrupt
        while True:
            psa.simulate(model, TIME, VOLTAGE)

    with pytest.raises(KeyboardInterrupt):
        side_by_side(work, [0, 1])


@pytest.mark.parametrize(("word", "effects"), [("screening effects", 0), ("judging", 1)])
def test_a_diagnosis_keeps_the_best_model_so_far(
    word: str, effects: int, record: psa.Record
) -> None:
    with pytest.raises(DiagnosisInterrupted) as stop:
        psa.diagnose([record], effects=TABLE, progress=at(word))
    model = stop.value.model
    assert model.provenance.interrupted
    assert len(model.effects) == effects
    error = psa.simulate(model, TIME, VOLTAGE).displacement - record.measured
    assert np.std(error) < 0.1 * record.range_m
    assert ("not judged" in str(stop.value)) == bool(effects)


def test_the_base_fit_is_not_swallowed(record: psa.Record) -> None:
    with pytest.raises(KeyboardInterrupt) as stop:
        psa.diagnose([record], effects=TABLE, progress=at("base fit from"))
    assert not isinstance(stop.value, DiagnosisInterrupted)  # nothing was fitted yet
    with pytest.raises(DiagnosisInterrupted, match="base model; its values are not final"):
        psa.diagnose([record], effects=TABLE, progress=at("to the end"))


@pytest.mark.parametrize(
    ("word", "search"), [("to the end", True), ("what further records", False)]
)
def test_an_identification_keeps_its_fit(word: str, search: bool, record: psa.Record) -> None:
    result = psa.identify([record], progress=at(word))
    assert result.interrupted
    assert result.fit.interrupted == result.model.provenance.interrupted == search
    assert not result.advice
    assert result.fit.rms < 0.1 * record.range_m


@pytest.mark.parametrize(
    ("name", "word", "message"),
    [
        ("diagnose", "screening", "there is no verdict; the best fit so far is the base model"),
        ("diagnose", "writing", "the diagnosis was finished before. Kept: {m}, {j}. Not"),
        ("identify", "to the end", "the search was cut off. Kept: {m} (marked as interrupted). N"),
        ("identify", "writing", "the fit was finished before. Kept: {m}. Not written: {r}."),
        ("identify", "starting", "there was no result yet, so nothing was kept."),
    ],
)
def test_a_command_names_what_it_kept(
    name: str, word: str, message: str, record: psa.Record, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    for home in ("diagnose", "identify"):
        module = import_module(f"psa_casadi.cli.{home}")
        monkeypatch.setattr(module, "working", lambda *inputs: nullcontext(at(word)))
    if word == "writing":
        finished = diagnosis("cause_named")
        module = import_module("psa_casadi.diagnosis.diagnose")
        monkeypatch.setattr(module, "diagnose", lambda *inputs, **options: finished)
    psa.write_record(tmp_path / "r.csv", record)
    m, j, r = (tmp_path / n for n in ("m.json", "d.json", "r.html"))
    inputs: list[str | Path] = [name, tmp_path / "r.csv", "-o", m, "--report", r, "--still"]
    if name == "diagnose":
        inputs += ["--json", j]
    ended = command(*inputs)
    assert ended.code == 130
    assert f"Interrupted: {message.format(m=m, j=j, r=r)}" in ended.err
    assert m.exists() == ("Kept" in message or "best fit" in message)
    assert not r.exists()
    if m.exists():
        cut = "finished" not in message
        assert psa.load_model(m).provenance.interrupted == cut


def test_a_solver_does_not_take_an_interrupt_for_a_failure() -> None:
    """IPOPT ends at an interrupt as at a failure, which other starts would make up for."""
    with interruptible_work() as work:
        work.stop()
        with pytest.raises(KeyboardInterrupt):
            psa.design_mechanism(psa.stack_model("PTBS200"), damping=0.7, starts=2)


def test_a_designed_voltage_is_kept_without_its_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(masters, "played_on_fmu", cut)
    time = np.arange(40) * 1e-3
    path = {"time [s]": time, "displacement [um]": 5.0 - 5.0 * np.cos(150.0 * time)}
    psa.write_record(tmp_path / "path.csv", path)
    voltage = tmp_path / "v.csv"
    work = ("design", "input", "--fast", "--stack", "P-885.51", "--target", tmp_path / "path.csv")
    ended = command(*work, "-o", voltage)
    assert ended.code == 130
    assert f"the voltage was designed before. Kept: {voltage}." in ended.err
    assert voltage.exists()


def test_written_files_are_named_however_late_the_interrupt(
    record: psa.Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(import_module("psa_casadi.cli.simulate"), "show_written", cut)
    psa.write_record(tmp_path / "r.csv", record)
    out = tmp_path / "out.csv"
    ended = command("simulate", "--stack", "P-885.51", "--input", tmp_path / "r.csv", "-o", out)
    assert ended.code == 130
    assert f"Interrupted: written before: {out}." in ended.err


@slow
@posix
def test_a_second_interrupt_ends_at_once(tmp_path: Path) -> None:
    record, model, page = (tmp_path / n for n in ("r.csv", "m.json", "r.html"))
    make_record("slow_creep", 3, record)
    process = subprocess.Popen(
        [*PSA, "diagnose", record, "-o", model, "--report", page, "--still"],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    assert process.stderr is not None
    assert any("screening" in line for line in process.stderr)
    time.sleep(0.05)
    begin = time.perf_counter()
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.02)
    process.communicate()
    assert time.perf_counter() - begin < 0.5
    assert process.returncode == 130
    assert {p.name for p in tmp_path.iterdir()} <= {"r.csv", "m.json"}
