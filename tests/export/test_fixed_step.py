"""The fixed step in C: its error, its form, refused models, and the command that writes it.

Beyond the rated voltage it is as good as stated, or limited, with a flag.
"""

import ctypes
import json
import re
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from fmpy.validation import validate_fmu

import psa_casadi as psa
from psa_casadi.cli.inputs import step_seconds
from psa_casadi.common.files import temporary_folder
from psa_casadi.common.units import FloatArray
from psa_casadi.examples.linearisation_trial import DriftingStack
from psa_casadi.export.fixed_step.code import PRECISIONS
from psa_casadi.export.fixed_step.export import (
    GOOD,
    VOLTAGES,
    FixedStep,
    Probe,
    fixed_step,
    played_inputs,
)
from psa_casadi.export.fmu.archive import write_archive
from psa_casadi.export.fmu.documentation import ENTRY as DOCUMENTATION_ENTRY
from psa_casadi.export.fmu.sources import FIXED_ENTRY
from psa_casadi.export.fmu.sources import STRICT as AS_EXPORTED
from psa_casadi.export.importer.fmu import CO_SIMULATION, Fmu, FmuError
from psa_casadi.export.importer.masters import Signals, co_simulate
from psa_casadi.report.words.text import check_sentence
from psa_casadi.simulation.compiler import (
    compiler_command,
    has_zig,
    run_compiler,
    shared_library,
    zig_command,
)
from tests.export.c_host.build import HEADERS, HERE
from tests.export.fmu_models import files_inside, rewritten
from tests.model.stack_models import stack
from tests.simulation.exact_cases import FEEDBACK, JUMP, KINK, error, with_effect
from tests.tiers import slow, slow_but

STEP = 1e-5
STRICT = (
    "-std=c99", "-O1", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-pedantic",
    "-Werror",
)  # fmt: skip
CALLS = {"exp", "log", "sqrt", "fabs", "sin", "cos", "tan", "atan", "tanh"}
OUTPUT = "displacement"


@cache
def made(precision: str = "double", step: float = STEP) -> FixedStep:
    """Return the fixed step of a stack; a short one is a single substep."""
    substeps = 1 if step == STEP else None
    model = stack("P-885.51").plant()
    return fixed_step(model, name="stack", step=step, precision=precision, substeps=substeps)


def play(fixed: FixedStep, voltage: FloatArray) -> FloatArray:
    """Return the displacement after each step of voltages (n,), the first one the start's."""
    model = fixed.plan.model
    u = played_inputs(model, np.zeros(len(voltage)))
    u[:, model.input_names.index("voltage")] = voltage
    return Probe(fixed.plan, fixed.texts).play(u)[:, model.output_names.index(OUTPUT)]


def uncommented(source: str) -> str:
    return re.sub(r"/\*.*?\*/", "", source, flags=re.DOTALL)


def compile_each(fixed: FixedStep, *commands: list[str]) -> None:
    """Compile the code of a fixed step by each of the commands."""
    (source,) = (name for name in fixed.texts if name.endswith(".c"))
    with temporary_folder() as folder:
        for name, text in fixed.texts.items():
            (folder / name).write_text(text, encoding="utf-8")
        for command in commands:
            run_compiler([*command, "-c", source, "-o", "object.o"], folder)


def errors(fixed: FixedStep) -> dict[str, float]:
    return {e.voltage: e.error for e in fixed.errors}


def test_the_base_errs_by_what_its_header_states() -> None:
    result = errors(made())
    assert set(result) == set(VOLTAGES)
    assert all(0.0 < e <= 2e-4 for e in result.values())
    assert max(result["sine"], result["ramps and holds"]) <= 1e-6
    header = made().texts["stack.h"]
    assert all(f"{name:16} {value:.1e}" in header for name, value in result.items())


@slow
def test_single_precision_rests_in_a_hold() -> None:
    """Half a second of rest after a ramp, where a rounded rate would go on for ever."""
    ramp = np.linspace(0.0, 87.3, 2000)
    voltage = np.concatenate([ramp, np.full(50_000, ramp[-1])])
    double, single = (play(made(precision), voltage) for precision in PRECISIONS)
    assert error(single, double) <= 2e-6
    assert np.ptp(single[-10_000:]) <= 1e-6 * np.ptp(single)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_the_code_has_no_warnings_no_library_but_math_and_no_loop(precision: str) -> None:
    result = made(precision)
    source, suffix = result.texts["stack.c"], PRECISIONS[precision].suffix
    included = re.findall(r"#include (.*)", result.texts["stack.h"] + source)
    assert included == ['"stack.h"', "<math.h>"]
    functions = {"advance", "outputs", "gain", "stack_init", "stack_step"}
    functions |= {name + suffix for name in CALLS}
    assert set(re.findall(r"(\w+)\(", uncommented(source))) <= functions
    assert not re.search(r"\b(for|while|do|if|goto|static \w+ \w+\[)\b", uncommented(source))
    commands = [compiler_command(), *([zig_command()] if has_zig() else [])]
    compile_each(result, *([*command, *STRICT] for command in commands))


@pytest.mark.parametrize("component", [KINK, FEEDBACK], ids=lambda c: str(c.name))
def test_what_kinks_or_feeds_back_to_the_hysteresis_is_stepped_as_a_whole(
    component: psa.Component,
) -> None:
    model = psa.compose((*psa.BASE, component), stack("P-885.51").values).plant()
    result = fixed_step(model, name="stack", step=STEP, substeps=8)
    assert all(0.0 < e <= 1e-3 for e in errors(result).values())
    wave = 60.0 * (1.0 - np.cos(np.arange(901) / 70.0))
    away = psa.simulate(model.without([component.name]), STEP * np.arange(901), wave)
    assert error(play(result, wave), away.outputs[OUTPUT][1:]) > 1e-2


#: Models that not every step fits: it is at the sample instants, no jump, no clock of 24 bits.
ODD: dict[str, Callable[[], psa.Model]] = {
    "stack": lambda: stack("P-885.51"),
    "jump": lambda: psa.compose((*psa.BASE, JUMP), stack("P-885.51").values),
    "part": lambda: psa.part_model("position_controller"),
    "ageing": lambda: with_effect("ageing"),
    "backlash": lambda: with_effect("backlash"),
}


@pytest.mark.parametrize(
    ("model", "wrong", "match"),
    [
        ("stack", {"name": "2x"}, "cannot name functions"),
        ("stack", {"step": 0.0}, "above 0"),
        ("stack", {"step": float("nan")}, "above 0"),
        ("stack", {"precision": "half"}, "double or single"),
        ("stack", {"hold": "cubic"}, "linear or zero"),
        ("backlash", {"substeps": 0}, "from 1 to 1000"),
        ("backlash", {"step": 2e-3, "substeps": 1}, "too\\s+long"),
        ("jump", {}, "'jump' does not fit.*equations jump"),
        ("ageing", {"precision": "single"}, "'ageing' does not fit.*double precision"),
        ("part", {"step": 2e-5}, r"sampled every 5e-05 s.*no multiple.*of 2\.5e-05 s"),
        ("part", {"step": 5e-5, "hold": "zero"}, "sample instants; --hold zero"),
    ],
)
def test_wrong_wishes_end_in_a_sentence(model: str, wrong: dict[str, object], match: str) -> None:
    table = {"name": "stack", "step": STEP, **wrong}
    with pytest.raises(psa.InputError, match=match):
        fixed_step(ODD[model](), **table)  # type: ignore[arg-type]  # wrong on purpose


@pytest.mark.parametrize(
    ("text", "seconds"), [("10us", 1e-5), ("1e-5s", 1e-5), (" 0.02 ms", 2e-5), ("50 ns", 5e-8)]
)
def test_a_step_has_its_unit(text: str, seconds: float) -> None:
    assert step_seconds(text) == pytest.approx(seconds, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("10", r"'10', without a unit; type --step 10s or 10ms or 10us\.$"),
        ("1e-5", "type --step 1e-5s or 1e-5ms"),
        ("3V", "a unit of time, such as 10us"),
        ("us", "a number with a unit"),
        ("1.2.3us", "a number with a unit"),
    ],
)
def test_the_unit_of_a_step_is_never_guessed(text: str, match: str) -> None:
    with pytest.raises(psa.InputError, match=match):
        step_seconds(text)


def limit(name: str) -> float:
    """Return the error that is allowed: these two move faster than any step of this length."""
    return 5e-3 if name in ("current_limit", "rate_dependent_hysteresis") else 1e-3


CASES = [
    *(("base", name) for name in psa.STACKS),
    *((name, sorted(psa.STACKS)[k % len(psa.STACKS)]) for k, name in enumerate(psa.EFFECTS)),
]


@slow
def test_every_effect_and_every_stack_is_exported_and_compared() -> None:
    """Effects at an ordinary size, on the stacks and in the precisions in turn, sensor included."""
    far = {}
    for k, (name, stack_name) in enumerate(CASES):
        clock = name in ("ageing", "mains_hum", "offset_drift")
        precision = "double" if k % 2 or clock else "single"
        model = with_effect(name, stack_name)
        result = fixed_step(model, name="stack", step=STEP, precision=precision)
        if not result.worst.error <= limit(name):
            far[name, stack_name] = (result.plan.substeps, result.worst)
    assert not far


LONG_STEP = 1e-4
LIMITED = (HERE / "told.c").read_text("utf-8")


def test_up_to_the_limit_it_is_good_and_beyond_it_stays_there() -> None:
    """900 V, 7.5 times the rated voltage, gave half a range of error; the limit is far above it."""
    result, share = made(step=LONG_STEP), np.linspace(0.0, 1.0, 401)
    limit, model = result.plan.limit, result.plan.model
    assert 1.25 * model.values["u_rated"] <= limit < 900.0
    jumps = limit * np.select([share < 0.1, share < 0.5, share < 0.8], [0.0, 1.0, -1.0], 1.0)
    t, u = LONG_STEP * np.arange(401, dtype=np.float64), np.column_stack([jumps, 0.0 * jumps])
    true = psa.run(model, t, u, np.zeros(len(model.state_names)), rtol=1e-10).y
    within = play(result, jumps)
    truth = true[1:, model.output_names.index(OUTPUT)]
    assert error(within, truth) <= max(GOOD, result.worst.error)
    for beyond in (1.001, 900.0 / limit, 1e9, 1e305):
        assert np.array_equal(play(result, beyond * jumps), within)


@pytest.mark.parametrize("precision", ["double", pytest.param("single", marks=slow)])
def test_the_step_returns_it_and_no_number_leaves_the_voltage(precision: str) -> None:
    result = made(precision, LONG_STEP)
    library = ctypes.CDLL(str(shared_library({**result.texts, "told.c": LIMITED}, ())))
    assert "Returns 1 if the voltage was beyond" in " ".join(result.texts["stack.h"].split())

    def limited(*voltage: float) -> tuple[int, float]:
        x = ctypes.c_double()
        inputs = (ctypes.c_double * len(voltage))(*voltage)
        return library.told(inputs, len(voltage), ctypes.byref(x)), x.value

    assert limited(0.0, 100.0, 900.0, 100.0, -900.0)[0] == 0b00101
    assert limited(60.0, 60.0, np.nan) == (0b001, limited(60.0, 60.0, 60.0)[1])
    assert limited(60.0, np.inf)[1] == limited(60.0, result.plan.limit)[1]


PERIOD, SAMPLES = 1e-4, 40_000
#: A machine of double precision adds in another order; one of single has 24 bits.
ROUNDING = {"double": 1e-9, "single": 1e-5}
FRAMES = (*STRICT, "-Wframe-larger-than=4096")


def code_of(model: psa.Model, precision: str) -> FixedStep:
    step = model.values[model.structure.period] if model.structure.period else 1e-5
    return fixed_step(model, name="part", step=step, precision=precision)


def played(model: psa.Model, precision: str, inputs: FloatArray) -> FloatArray:
    """Return the outputs (n, ny) of the code on inputs (n, nu), one call for each."""
    result = code_of(model, precision)
    return Probe(result.plan, result.texts).play(np.vstack([inputs[:1], inputs]))


@cache
def values() -> dict[str, float]:
    """Return a stack's values; without delta, by which a slow ramp differs from its stairs."""
    return psa.stack_values(psa.stack_model("P-885.51").with_values({"delta": 0.0}), PERIOD)


def wanted() -> FloatArray:
    """Return a displacement [m]: nested loops, a rest, a jump, and loops again."""
    t = PERIOD * np.arange(SAMPLES)
    w = 5e-6 * (1.0 - np.cos(19.0 * t)) * (0.6 + 0.4 * np.cos(2.3 * t))
    w[SAMPLES // 3 : SAMPLES // 2] = w[SAMPLES // 3]
    return np.asarray(w)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_feed_forward_and_observer_are_the_python_objects(precision: str) -> None:
    forward, observer = psa.FeedForward(values()), psa.HysteresisObserver(values())
    volts = np.array([forward.step(w) for w in wanted().tolist()])
    force = np.array([observer.step(u) for u in volts.tolist()])
    for block, inputs, expected in ((forward, wanted(), volts), (observer, volts, force)):
        result = played(block.model, precision, inputs[:, None])[:, 0]
        assert np.ptp(expected) > 20.0
        assert np.abs(result - expected).max() <= ROUNDING[precision] * np.ptp(expected)


@pytest.mark.parametrize("stack", ["P-885.51", "PTBS200"])
def test_a_place_that_rests_but_for_its_last_digits_keeps_its_voltage(stack: str) -> None:
    """With delta < 0 a voltage that creeps on solves the same equation of the next instant."""
    forward = psa.FeedForward(psa.stack_values(psa.stack_model(stack), PERIOD))
    path = np.minimum(2e-7 * np.arange(300), 1e-5)
    path *= 1.0 + 1e-12 * np.random.default_rng(0).standard_normal(path.size)
    volts = np.array([forward.step(w) for w in path.tolist()])
    assert np.ptp(volts[60:]) < 1e-6 * np.ptp(volts)


@cache
def closed_loop() -> tuple[psa.AdaptiveFeedForward, FloatArray, FloatArray]:
    """Return a tracked feed-forward that has run, its inputs (n, 2) and its voltages (n,)."""
    model = psa.stack_model("P-885.51").with_values({"delta": 0.0})
    off = model.with_values({"A": 0.9 * model.values["A"], "k_L": 1.1 * model.values["k_L"]})
    block = psa.AdaptiveFeedForward(psa.identifier_for(off, PERIOD, noise=2e-8).values)
    plant, x, rows, voltage = DriftingStack(model.values, PERIOD), 0.0, [], []
    path = wanted()[: SAMPLES // 3]
    noise = 2e-9 * np.random.default_rng(0).normal(size=path.size)
    for w, off_by in zip(path.tolist(), noise.tolist(), strict=True):
        rows.append((w, x + off_by))
        voltage.append(block.step(*rows[-1]))
        x = plant.step(voltage[-1])
    return block, np.array(rows), np.array(voltage)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_learning_blocks_are_the_python_objects(precision: str) -> None:
    block, inputs, voltage = closed_loop()
    limit = {"double": 1e-8, "single": 2e-4}[precision]
    online = psa.OnlineIdentification(block.model.values)
    arguments = np.column_stack([voltage, inputs[:, 1]])
    for row in arguments.tolist():
        online.step(*row)
    result = played(block.model, precision, inputs)
    assert np.abs(result[:, 0] - voltage).max() <= limit * np.ptp(voltage)
    for learner, output in ((block, result), (online, played(online.model, precision, arguments))):
        last = dict(zip(learner.model.output_names, output[-1], strict=True))
        learnt = {n: learner.estimate.parameters[n] for n in ("A", "n", "k_L")}
        assert {n: last[f"{n}_hat"] for n in learnt} == pytest.approx(learnt, rel=50.0 * limit)


@pytest.mark.parametrize(
    ("name", "precision"),
    slow_but(
        [("hysteresis_compensator", "single"), ("adaptive_feed_forward", "double")],
        [(name, precision) for name in psa.PARTS for precision in PRECISIONS],
    ),
)
def test_every_part_is_c_of_small_frames_and_no_loop(name: str, precision: str) -> None:
    result = code_of(psa.part_model(name), precision)
    assert result.worst.error <= 1e-3
    code = uncommented(result.texts["part.c"])
    assert result.plan.substeps > 1 or not re.search(r"\b(for|while|goto)\b", code)
    compile_each(result, *([*compiler_command(), *FRAMES, level] for level in ("-O0", "-O2")))


def test_a_controller_acts_at_every_few_steps_of_its_plant() -> None:
    """A sampled part called four times a period changes its command at the fourth call."""
    part = psa.part_model("position_controller")
    result = fixed_step(part, name="part", step=1.25e-5)
    u = np.column_stack([np.linspace(0.0, 1e-6, 401), np.zeros(401)])
    command = Probe(result.plan, result.texts).play(u)[:, 0]
    moved = np.flatnonzero(np.diff(command)) + 2  # the number of the call that changes it
    assert len(moved) > 90
    assert not np.any(moved % 4)


COUNT = 401
VERSIONS = (2, pytest.param(3, marks=slow))


_FOLDER = TemporaryDirectory()


@cache
def archived(fmi: int) -> Path:
    """Return an FMU of a stack with a fixed step."""
    path = Path(_FOLDER.name) / f"{fmi}.fmu"
    return psa.export_fmu(stack("P-885.51"), path, name="fixed", fmi=fmi, step=STEP)


@cache
def exported(fmi: int) -> Fmu:
    return Fmu(archived(fmi))


@pytest.mark.parametrize("every", [pytest.param(1, marks=slow), 5])
def test_communication_steps_are_one_step_or_several(every: int) -> None:
    """FMI 2 passes on the slope of the inputs."""
    times = STEP * np.arange(COUNT, dtype=np.float64)[::every]
    voltage = 100.0 * VOLTAGES["tones"][1](np.linspace(0.0, 1.0, COUNT))[::every]
    inputs = Signals(("voltage",), times, voltage[:, None])
    result = co_simulate(exported(2), times, inputs, ("displacement",))[:, 0]
    model = stack("P-885.51").plant()
    true = psa.simulate(model, times, voltage, as_exported=True, rtol=1e-8, hold="linear")
    assert error(result, true.outputs["displacement"]) <= 5e-5


@pytest.mark.parametrize("fmi", VERSIONS)
def test_other_communication_steps_and_parameters_are_refused(fmi: int) -> None:
    with exported(fmi).start(CO_SIMULATION) as slave:
        slave.step(0.0, 3 * STEP)
        for size in (0.5 * STEP, 1.5 * STEP, 1.01 * STEP):
            with pytest.raises(FmuError, match="no multiple of 1e-05 s, the fixed step"):
                slave.step(3 * STEP, size)
        slave.step(3 * STEP, 0.3)
        assert slave.get(["time"])[0] == pytest.approx(0.3 + 3 * STEP, abs=1e-12)
        with pytest.raises(FmuError, match="'k_L' is constant"):
            slave.set({"k_L": 5.0})
        assert slave.get(["k_L"])[0] == stack("P-885.51").values["k_L"]


@pytest.mark.parametrize("fmi", VERSIONS)
def test_the_description_names_the_step_and_constants(fmi: int, tmp_path: Path) -> None:
    path = archived(fmi)
    again = psa.export_fmu(
        stack("P-885.51"), tmp_path / "again.fmu", name="fixed", fmi=fmi, step=STEP
    )
    assert path.read_bytes() == again.read_bytes()
    assert list(validate_fmu(str(path))) == []
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path / "unpacked")
    root = ET.parse(tmp_path / "unpacked" / "modelDescription.xml").getroot()
    page = (tmp_path / "unpacked" / DOCUMENTATION_ENTRY).read_bytes()
    assert b"A communication step is a multiple of it" in page
    assert b"Parameters are tunable" not in page
    assert root.find("ModelExchange") is None
    assert "fixed step of 1e-05 s" in root.attrib["description"]
    stepping, variables = root.find("CoSimulation"), root.find("ModelVariables")
    assert stepping is not None
    assert stepping.get("fixedInternalStepSize") == ("1e-05" if fmi == 3 else None)
    claimed = stepping.get("canHandleVariableCommunicationStepSize")
    assert claimed == (None if fmi == 2 else "true")
    assert variables is not None
    constants = {v.get("name") for v in variables if v.get("variability") == "constant"}
    assert constants == set(stack("P-885.51").plant().values)
    sources = sorted((tmp_path / "unpacked" / "sources").glob("*.c"))
    options = ["-std=c99", *AS_EXPORTED, f"-I{HEADERS}", f"-I{sources[0].parent}", "-c"]
    for source in (s for s in sources if s.name in ("instance.c", "fmi_data.c", "values.c")):
        run_compiler([*compiler_command(), *options, str(source), "-o", "object.o"], tmp_path)
    with pytest.raises(psa.InputError, match="takes fixed steps of 1e-05 s and carries no evid"):
        psa.check_fmu(path, evidence=True)


@slow
def test_the_check_measures_the_errors_that_the_fmu_states() -> None:
    """On the voltages behind them; what means nothing there is left out, and named."""
    report = psa.check_fmu(archived(3))
    assert report.passed, report.failures
    assert report.compared
    figures = {row.name: row.figure for row in report.rows}
    errors: dict[str, float] = json.loads(files_inside(archived(3))[FIXED_ENTRY])["errors"]
    for voltage, stated in errors.items():
        assert figures[f"fixed step, {voltage}"] == pytest.approx(stated, rel=0.06, abs=1e-8)
    names = {"life cycle", "snapshots", "line of the input", "start of a run", "settled start"}
    assert names < figures.keys()
    assert {"equations", "model exchange", "parameter changes"} < set(report.left_out)
    assert "adjoint derivatives" in report.left_out
    assert figures.keys().isdisjoint(report.left_out)
    assert "Left out, as its step is fixed: model exchange inst" in check_sentence(report)


@slow
def test_the_check_notices_smaller_errors_than_there_are(tmp_path: Path) -> None:
    def boast(content: bytes) -> bytes:
        stated = json.loads(content)
        stated["errors"] = {name: 0.8 * error for name, error in stated["errors"].items()}
        return json.dumps(stated).encode()

    changed = rewritten(archived(2), tmp_path / "b.fmu", {FIXED_ENTRY: boast})
    failed = {row.name for row in psa.check_fmu(changed).failures}
    assert {"reproducible", "fixed step, tones", "fixed step, jumps"} <= failed
    assert "fixed step, ramps and holds, 10 at once" not in failed
    for nothing in (b"{}", b'{"errors": {"sine": "x"}}', b"no JSON"):
        write_archive(tmp_path / "c.fmu", {**files_inside(changed), FIXED_ENTRY: nothing})
        with pytest.raises(psa.InputError, match=r"fixed_step\.json.*xport the FMU again"):
            psa.check_fmu(tmp_path / "c.fmu")
