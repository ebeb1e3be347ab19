"""The fixed step in C: its error, its form, what it refuses, and the command that writes it.

Beyond the rated voltage it is as good as it says, or limited and told.
"""

import ctypes
import re
from functools import cache

import numpy as np
import pytest
from typer.testing import CliRunner

import psa_casadi as psa
from psa_casadi.cli.app import app
from psa_casadi.cli.inputs import step_seconds
from psa_casadi.export.fixed_step.export import GOOD, FixedStep, fixed_step
from psa_casadi.export.fixed_step.expressions import PRECISIONS
from psa_casadi.export.fixed_step.probe import VOLTAGES, Probe, played_inputs
from psa_casadi.files import temporary_folder
from psa_casadi.simulation.compiler import (
    compiler_command,
    has_zig,
    run_compiler,
    shared_library,
    zig_command,
)
from tests.model.stack_models import stack
from tests.simulation.exact_cases import FEEDBACK, JUMP, KINK, FloatArray, error, with_effect
from tests.tiers import slow

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


def play(found: FixedStep, voltage: FloatArray) -> FloatArray:
    """Return the displacement after each step of voltages (n,), the first one the start's."""
    model = found.plan.model
    u = played_inputs(model, np.zeros(len(voltage)))
    u[:, model.input_names.index("voltage")] = voltage
    return Probe(found.plan, found.texts).play(u)[:, model.output_names.index(OUTPUT)]


def errors(found: FixedStep) -> dict[str, float]:
    return {e.voltage: e.error for e in found.errors}


def test_the_base_errs_by_what_its_header_says() -> None:
    found = errors(made())
    assert set(found) == set(VOLTAGES)
    assert all(0.0 < e <= 2e-4 for e in found.values())
    assert max(found["sine"], found["ramps and holds"]) <= 1e-6
    header = made().texts["stack.h"]
    assert all(f"{name:16} {value:.1e}" in header for name, value in found.items())


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
    found = made(precision)
    source, suffix = found.texts["stack.c"], PRECISIONS[precision].suffix
    assert re.findall(r"#include (.*)", found.texts["stack.h"] + source) == [
        '"stack.h"',
        "<math.h>",
    ]
    own = {"advance", "outputs", "gain", "stack_init", "stack_step"}
    code = re.sub(r"/\*.*?\*/", "", source, flags=re.DOTALL)
    assert set(re.findall(r"(\w+)\(", code)) <= own | {name + suffix for name in CALLS}
    assert not re.search(r"\b(for|while|do|if|goto|static \w+ \w+\[)\b", code)
    commands = [compiler_command(), *([zig_command()] if has_zig() else [])]
    with temporary_folder() as folder:
        for name, text in found.texts.items():
            (folder / name).write_text(text, encoding="utf-8")
        for command in commands:
            run_compiler([*command, *STRICT, "-c", "stack.c", "-o", "stack.o"], folder)


def test_an_effect_that_does_not_fit_is_named() -> None:
    model = psa.compose((*psa.BASE, JUMP), stack("P-885.51").values)
    with pytest.raises(psa.InputError, match=r"'jump' does not fit.*equations jump"):
        fixed_step(model, name="stack", step=STEP)


@pytest.mark.parametrize("component", [KINK, FEEDBACK], ids=lambda c: str(c.name))
def test_what_kinks_or_feeds_back_to_the_hysteresis_is_stepped_as_a_whole(
    component: psa.Component,
) -> None:
    model = psa.compose((*psa.BASE, component), stack("P-885.51").values).plant()
    found = fixed_step(model, name="stack", step=STEP, substeps=8)
    assert all(0.0 < e <= 1e-3 for e in errors(found).values())
    wave = 60.0 * (1.0 - np.cos(np.arange(901) / 70.0))
    away = psa.simulate(model.without([component.name]), STEP * np.arange(901), wave)
    assert error(play(found, wave), away.outputs[OUTPUT][1:]) > 1e-2


def test_a_clock_in_single_precision_is_refused() -> None:
    with pytest.raises(psa.InputError, match=r"'ageing' does not fit.*double precision"):
        fixed_step(with_effect("ageing"), name="stack", step=STEP, precision="single")


def test_a_sampled_part_acts_at_its_period() -> None:
    part = psa.part_model("position_controller")
    with pytest.raises(psa.InputError, match=r"sampled every 5e-05 s.*no multiple.*of 2\.5e-05 s"):
        fixed_step(part, name="part", step=2e-5)
    with pytest.raises(psa.InputError, match="sample instants; --hold zero"):
        fixed_step(part, name="part", step=5e-5, hold="zero")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"name": "2x"}, "cannot name functions"),
        ({"step": 0.0}, "above 0"),
        ({"step": float("nan")}, "above 0"),
        ({"precision": "half"}, "double or single"),
        ({"hold": "cubic"}, "linear or zero"),
        ({"substeps": 0}, "from 1 to 1000"),
        ({"step": 2e-3, "substeps": 1}, "too\\s+long"),
    ],
)
def test_wrong_wishes_end_in_a_sentence(wrong: dict[str, object], said: str) -> None:
    given = {"name": "stack", "step": STEP, **wrong}
    model = with_effect("backlash") if "substeps" in wrong else stack("P-885.51")
    with pytest.raises(psa.InputError, match=said):
        fixed_step(model, **given)  # type: ignore[arg-type]  # wrong on purpose


@pytest.mark.parametrize(
    ("text", "seconds"), [("10us", 1e-5), ("1e-5s", 1e-5), (" 0.02 ms", 2e-5), ("50 ns", 5e-8)]
)
def test_a_step_has_its_unit(text: str, seconds: float) -> None:
    assert step_seconds(text) == pytest.approx(seconds, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("10", r"'10', without a unit; type --step 10s or 10ms or 10us\.$"),
        ("1e-5", "type --step 1e-5s or 1e-5ms"),
        ("3V", "a unit of time, such as 10us"),
        ("us", "a number with a unit"),
        ("1.2.3us", "a number with a unit"),
    ],
)
def test_the_unit_of_a_step_is_never_guessed(text: str, said: str) -> None:
    with pytest.raises(psa.InputError, match=said):
        step_seconds(text)
    arguments = ["export", "c", "--stack", "P-885.51", "-o", "x", "--step", text]
    assert CliRunner().invoke(app, arguments).exit_code == 2


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
        found = fixed_step(model, name="stack", step=STEP, precision=precision)
        if not found.worst.error <= limit(name):
            far[name, stack_name] = (found.plan.substeps, found.worst)
    assert not far


LONG_STEP = 1e-4
TOLD = """#include "stack.h"
#if !defined(_WIN32)
__attribute__((visibility("default")))
#endif
int told(const double *voltage, int count, double *x) {
    stack_state state;
    stack_input input = {0};
    stack_output output;
    int all = 0;
    stack_init(&state);
    for (int k = 0; k < count; ++k) {
        input.voltage = voltage[k];
        all = 2 * all + stack_step(&state, &input, &output);
    }
    *x = output.displacement;
    return all;
}
"""


def test_up_to_the_limit_it_is_good_and_beyond_it_stays_there() -> None:
    """900 V, 7.5 times the rated voltage, gave half a range of error; the limit is far above it."""
    found, share = made(step=LONG_STEP), np.linspace(0.0, 1.0, 401)
    limit, model = found.plan.limit, found.plan.model
    assert 1.25 * model.values["u_rated"] <= limit < 900.0
    jumps = limit * np.select([share < 0.1, share < 0.5, share < 0.8], [0.0, 1.0, -1.0], 1.0)
    t, u = LONG_STEP * np.arange(401, dtype=np.float64), np.column_stack([jumps, 0.0 * jumps])
    true = psa.run(model, t, u, np.zeros(len(model.state_names)), rtol=1e-10).y
    within = play(found, jumps)
    shown = true[1:, model.output_names.index(OUTPUT)]
    assert error(within, shown) <= max(GOOD, found.worst.error)
    for beyond in (1.001, 900.0 / limit, 1e9, 1e305):
        assert np.array_equal(play(found, beyond * jumps), within)


@pytest.mark.parametrize("precision", ["double", pytest.param("single", marks=slow)])
def test_the_step_tells_it_and_no_number_leaves_the_voltage(precision: str) -> None:
    found = made(precision, LONG_STEP)
    library = ctypes.CDLL(str(shared_library({**found.texts, "told.c": TOLD}, ())))
    assert "Returns 1 if the voltage was beyond" in " ".join(found.texts["stack.h"].split())

    def told(*voltage: float) -> tuple[int, float]:
        x = ctypes.c_double()
        given = (ctypes.c_double * len(voltage))(*voltage)
        return library.told(given, len(voltage), ctypes.byref(x)), x.value

    assert told(0.0, 100.0, 900.0, 100.0, -900.0)[0] == 0b00101
    assert told(60.0, 60.0, np.nan) == (0b001, told(60.0, 60.0, 60.0)[1])
    assert told(60.0, np.inf)[1] == told(60.0, found.plan.limit)[1]
