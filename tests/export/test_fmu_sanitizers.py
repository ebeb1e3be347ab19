"""The C code of an FMU under the sanitizers and valgrind: every access, leak and race is found.

The sources are compiled into one program with the calling sequences of tests/c_host.
"""

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.export.c_host.build import VERSIONS, everywhere, linked, tool
from tests.tiers import slow

pytestmark = [pytest.mark.xdist_group("platforms"), slow]

#: Files of the sequences for each version of FMI.
FILES = {
    2: ("sequences.c", "sequences_fmi2.c"),
    3: ("sequences.c", "sequences_fmi3.c", "sequences_fmi3_refused.c"),
}
SANITIZERS = {
    "memory": ("-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
    "threads": ("-fsanitize=thread",),
}
#: Every allocation in the program is counted.
COUNTED = (
    "-DCOUNT_ALLOCATIONS", "-Wl,--wrap=malloc", "-Wl,--wrap=calloc", "-Wl,--wrap=realloc",
)  # fmt: skip


def complaints(command: Sequence[str | Path]) -> str:
    """Run a program; return what it and its guard said, empty if all sequences ended well."""
    options = {
        "ASAN_OPTIONS": "detect_leaks=1:detect_stack_use_after_return=1",
        "UBSAN_OPTIONS": "print_stacktrace=1",
        "TSAN_OPTIONS": "halt_on_error=1",
    }
    done = subprocess.run(
        [str(c) for c in command], env={**os.environ, **options},
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    fine = done.returncode == 0 and done.stdout == "all sequences done\n"
    return "" if fine else f"status {done.returncode}\n{done.stdout[-500:]}{done.stderr[-3000:]}"


@pytest.mark.parametrize(("kind", "fmi"), [("memory", 2), ("memory", 3), ("threads", 2)])
def test_sanitizers_find_nothing(kind: str, fmi: int) -> None:
    """What threads could share is in the files that both versions have."""
    compiler = [tool("gcc"), "-O1", "-g", *SANITIZERS[kind]]
    assert not complaints([linked(fmi, compiler, FILES[fmi], kind)])


@pytest.mark.parametrize("fmi", VERSIONS)
def test_nothing_is_allocated_after_instantiation(fmi: int) -> None:
    """Nor does one of 1,000 instances or 8 threads of small stacks differ from another by a bit."""
    compiler = [tool("gcc"), "-O2", "-DSTACK=16384", *COUNTED]
    assert not complaints([linked(fmi, compiler, FILES[fmi], "counted")])


def test_valgrind_finds_nothing() -> None:
    """It sees values that were never set, which the sanitizers do not."""
    fmi = 3
    guard = [tool("valgrind"), "--error-exitcode=9", "--leak-check=full", "--quiet"]
    compiler = [tool("gcc"), "-O1", "-g", "-DINSTANCES=20", "-DSTEPS=30"]
    program = linked(fmi, compiler, FILES[fmi], "watched")
    assert not complaints([*guard, "--show-leak-kinds=all", program])


#: The guard, the word it must say, and the fault: a file, what is in it, and what takes its place.
FAULTS = {
    "a read behind an array": (
        "memory", "AddressSanitizer: global-buffer-overflow",
        "values.c", "vr <= PSA_VARIABLES)", "vr <= 2 * PSA_VARIABLES)",
    ),
    "a leak": (
        "memory", "LeakSanitizer",
        "snapshot.c", "free(*snapshot);", "(void)snapshot;",
    ),
    "memory that threads share": (
        "threads", "ThreadSanitizer: data race",
        "log.c", "    char sentence[PSA_SENTENCE];", "    static char sentence[PSA_SENTENCE];",
    ),
    "an allocation in a step": (
        "counted", "allocations == made",
        "values.c", "    psa_input_at(&state->input, state->solver.since, u);\n",
        "    extern void *calloc(size_t, size_t);\n    if (!calloc(1, 1)) return PSA_ERROR;\n"
        "    psa_input_at(&state->input, state->solver.since, u);\n",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_found(fault: str, tmp_path: Path) -> None:
    """Each guard reports a fault of its kind that is put into the sources."""
    kind, word, file, old, new = FAULTS[fault]
    inside = tmp_path / "sources"
    inside.mkdir()
    for path in (everywhere(2) / "sources").iterdir():
        text = path.read_text()
        (inside / path.name).write_text(text.replace(old, new, 1) if path.name == file else text)
        assert path.name != file or old in text
    flags = COUNTED if kind == "counted" else SANITIZERS[kind]
    compiler = [tool("gcc"), "-O1", "-g", *flags]
    assert word in complaints([linked(2, compiler, FILES[2], "faulty", inside)])
