"""The fixed step on a Cortex-M4 in qemu, against this machine; its cost in instructions."""

import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.export.fixed_step.export import FixedStep, Probe, fixed_step, played_inputs
from psa_casadi.simulation.compiler import run_compiler, zig_command
from tests.export.c_host.build import tool
from tests.model.stack_models import stack
from tests.tiers import slow

pytestmark = slow

HERE = Path(__file__).parent / "c_host" / "cortex_m4"
STEPS = 600
#: A tick of the 25 MHz clock over an instruction, which takes 32 ns of the emulator's time.
INSTRUCTIONS_PER_TICK = 40.0 / 32.0
#: How far the two machines may differ, over the range: their exponentials round differently.
LIMITS = {"double": 1e-12, "single": 2e-6}


#: What moves in which units, the output, and the most instructions in single precision.
CASES = {
    "stack": ("voltage", "displacement", 1.0, 5_000),
    "position_controller": ("reference", "command", 2.0**-24, 200),
    "feed_forward": ("wanted", "voltage", 2.0**-23, 8_000),
    "adaptive_feed_forward": ("wanted", "voltage", 2.0**-23, 12_000),
    "hysteresis_compensator": ("command", "compensated_command", 1.0, 5_000),
}
STEP = 1e-5


@cache
def fixed(name: str, precision: str) -> FixedStep:
    model = stack("P-885.51")
    made = model.plant() if name == "stack" else psa.part_for(name, model, period=STEP)
    return fixed_step(made, name="stack", step=STEP, precision=precision)


def moving() -> FloatArray:
    """Return what set_input in board.c gives, (n,), with the start in front."""
    k = np.arange(STEPS)
    moves = np.where(k % 150 == 149, -60.0, np.where(k % 100 < 70, 1.0, -1.0))
    return np.concatenate([[0.0], np.cumsum(moves)])


def on_the_board(name: str, precision: str, folder: Path) -> tuple[FloatArray, FloatArray]:
    """Return the output after each step and the instructions that it took, (n,) each."""
    qemu = tool("qemu-system-arm")
    for file, text in fixed(name, precision).texts.items():
        (folder / file).write_text(text, encoding="utf-8")
    inputs, output, size, _ = CASES[name]
    items = [f"-DGIVEN={inputs}", f"-DSHOWN={output}", f"-DSIZE={size!r}f"]
    target = ["-target", "thumb-freestanding-eabihf", "-mcpu=cortex_m4+vfp4d16sp"]
    flags = ["-std=c99", "-O2", "-fno-math-errno", "-g0"]
    places = [f"-I{HERE}", "-I.", str(HERE / "board.c"), "stack.c"]
    linked = ["-Wl,-T," + str(HERE / "board.ld"), "-Wl,-e,vectors", "-o", "board.elf"]
    run_compiler([*zig_command(), *target, *flags, *items, *places, *linked], folder)
    machine = ["-M", "mps2-an386", "-display", "none", "-monitor", "none", "-serial", "null"]
    clock = ["-icount", "shift=5", "-semihosting-config", "enable=on,target=native"]
    command = [qemu, *machine, *clock, "-kernel", str(folder / "board.elf")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr[-500:]
    lines = (done.stdout + done.stderr).split("\n")[:STEPS]
    assert all("!" not in line for line in lines), "a step from a saved state has other bits"
    kind = ">f8" if precision == "double" else ">f4"
    pairs = [line.split() for line in lines]
    bits = b"".join(bytes.fromhex(q) for q, _ in pairs)
    ticks = np.array([int(n, 16) for _, n in pairs], dtype=np.float64)
    return np.frombuffer(bits, dtype=kind).astype(np.float64), ticks * INSTRUCTIONS_PER_TICK


@pytest.mark.parametrize(
    ("name", "precision"), [("stack", "double"), *((name, "single") for name in CASES)]
)
def test_a_cortex_m4_gives_the_same_numbers_at_constant_cost(
    name: str, precision: str, tmp_path: Path
) -> None:
    board, instructions = on_the_board(name, precision, tmp_path)
    inputs, output, size, most = CASES[name]
    step = fixed(name, precision)
    model = step.plan.model
    u = played_inputs(model, np.zeros(STEPS + 1))
    u[:, model.input_names.index(inputs)] = size * moving()
    host = Probe(step.plan, step.texts).play(u)[:, model.output_names.index(output)]
    assert np.ptp(host) > 5e-6
    assert np.max(np.abs(board - host)) <= LIMITS[precision] * np.ptp(host)
    print(f"{name}, {precision}: {instructions.mean():.0f} instructions, {instructions.max():.0f}")
    assert instructions.max() <= 1.5 * instructions.mean()
    assert 50 < instructions.mean() < (120_000 if precision == "double" else most)
