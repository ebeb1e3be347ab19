"""The binaries of other platforms, run here by emulators through a small C importer."""

from pathlib import Path

import numpy as np
import pytest

from build_scripts.compile_everywhere import complaint
from psa_casadi.export.fmu.platforms import PLATFORMS, host_platform
from psa_casadi.export.fmu.sources import exported_texts
from psa_casadi.simulation.compiler import OPTIMISE, zig_command
from tests.export.c_host.build import (
    EMULATED,
    STEPS,
    VERSIONS,
    FloatArray,
    Runner,
    binary,
    emulated,
    everywhere,
    linked,
    native,
)
from tests.export.fmu_models import model_named
from tests.tiers import slow

#: Each of them compiles two archives for nine platforms: one process shall do it.
pytestmark = [pytest.mark.xdist_group("platforms"), slow]

HALF = STEPS // 2
LIMIT = 1e-12


def difference(found: FloatArray, expected: FloatArray) -> float:
    """Return the largest difference, each column relative to its largest value."""
    return float(np.max(np.abs(found - expected) / np.max(np.abs(expected), axis=0)))


@pytest.mark.parametrize("fmi", VERSIONS)
def test_native_run_has_a_response(fmi: int) -> None:
    """The comparisons below compare something: the stack moves by most of its stroke."""
    displacement, _, charge = native().run(fmi).T
    assert 5e-6 < np.ptp(displacement) < 20e-6
    assert 0.9 * 1.5e-6 * 80.0 < np.ptp(charge) < 1.1 * 1.5e-6 * 95.0


@pytest.mark.parametrize("fmi", VERSIONS)
@pytest.mark.parametrize("name", EMULATED)
def test_emulated_binary_gives_the_native_result(name: str, fmi: int) -> None:
    assert difference(emulated(name).run(fmi), native().run(fmi)) < LIMIT


@pytest.mark.parametrize("fmi", VERSIONS)
def test_state_from_a_file_continues_bit_for_bit(fmi: int, tmp_path: Path) -> None:
    kept = tmp_path / "state"
    whole, first = native().run(fmi), native().run(fmi, steps=(0, HALF), keep=kept)
    second = native().run(fmi, steps=(HALF, STEPS), state=kept)
    assert np.vstack([first, second]).tobytes() == whole.tobytes()


def _moved(fmi: int, source: Runner, target: Runner, state: Path) -> None:
    """Run the first half on one platform and the second on another, from the first's state."""
    first = source.run(fmi, steps=(0, HALF), keep=state)
    second = target.run(fmi, steps=(HALF, STEPS), state=state)
    assert difference(np.vstack([first, second]), native().run(fmi)) < LIMIT


@pytest.mark.parametrize("fmi", VERSIONS)
@pytest.mark.parametrize("name", EMULATED)
def test_state_moves_between_platforms(name: str, fmi: int, tmp_path: Path) -> None:
    other = emulated(name)
    _moved(fmi, native(), other, tmp_path / "there")
    _moved(fmi, other, native(), tmp_path / "back")


@pytest.mark.parametrize(
    ("one", "other"), [("aarch64-linux", "x86_64-windows"), ("x86-linux", "aarch32-linux")]
)
@pytest.mark.parametrize("fmi", VERSIONS)
def test_state_moves_between_two_emulated_platforms(
    fmi: int, one: str, other: str, tmp_path: Path
) -> None:
    """The second pair has short pointers, and aligns doubles in memory to four and to eight."""
    _moved(fmi, emulated(one), emulated(other), tmp_path / "state")


def test_sources_and_states_on_32_bits(tmp_path: Path) -> None:
    """Pointers and longs are short; doubles lie in memory as on 32-bit Windows.

    There they are aligned to eight bytes. Both versions have the same state.
    """
    fmi = 3
    narrow, wide = emulated("x86-linux"), native()
    target = ["-target", narrow.platform.target or "", *narrow.platform.flags, "-malign-double"]
    compiler = [*zig_command(), *target, *OPTIMISE, "-g0"]
    program = linked(fmi, compiler, ("host.c", f"host_fmi{fmi}.c"), "host32")
    whole, kept = wide.run(fmi), tmp_path / "state"
    assert difference(narrow.run(fmi, program=program), whole) < LIMIT
    narrow.run(fmi, program=program, steps=(0, HALF), keep=kept)
    assert difference(wide.run(fmi, steps=(HALF, STEPS), state=kept), whole[HALF:]) < LIMIT
    wide.run(fmi, steps=(0, HALF), keep=kept)
    second = narrow.run(fmi, program=program, steps=(HALF, STEPS), state=kept)
    assert difference(second, whole[HALF:]) < LIMIT


@pytest.mark.parametrize("fmi", VERSIONS)
def test_damaged_state_is_refused(fmi: int, tmp_path: Path) -> None:
    kept = tmp_path / "state"
    native().run(fmi, steps=(0, HALF), keep=kept)
    whole = kept.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    for damaged in (b"", whole[:-1], whole + b"\0", bytes(flipped), bytes(len(whole))):
        kept.write_bytes(damaged)
        with pytest.raises(AssertionError, match="loading the state failed"):
            native().run(fmi, steps=(HALF, STEPS), state=kept)


@pytest.mark.parametrize("name", ["x86_64-windows", "x86-windows"])
def test_a_model_with_every_effect_links_for_windows(name: str) -> None:
    """Its functions are the largest; beyond a page they would need what no runtime there has.

    `build_scripts.compile_everywhere` compiles each effect and each stack for all platforms.
    """
    texts = exported_texts(model_named("every_effect"), "psa")[1]
    assert complaint("every effect", texts, PLATFORMS[name]) == ""
    large = "void psa_large(int i) { volatile char page[5000]; page[i] = 1; }"
    texts["large.c"] = f"__declspec(dllexport) {large}\n"
    assert "undefined symbol" in complaint("large", texts, PLATFORMS[name])


@pytest.mark.parametrize("fmi", VERSIONS)
def test_archive_has_a_binary_for_every_platform(fmi: int) -> None:
    folders = {p.name for p in (everywhere(fmi) / "binaries").iterdir()}
    assert folders == {p.binaries(fmi) for p in PLATFORMS.values()}
    assert all(binary(fmi, p).stat().st_size > 10_000 for p in PLATFORMS.values())
    old = {"linux64", "linux32", "win64", "win32", "darwin64"}  # all the names that FMI 2 has
    assert (old if fmi == 2 else set(PLATFORMS)) <= folders
    assert {"riscv64-linux", "aarch32-linux", "aarch64-linux"} <= folders
    assert host_platform().binaries(fmi) in folders
