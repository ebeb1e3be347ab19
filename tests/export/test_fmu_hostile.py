"""FMUs with ill will: code that exits, crashes, hangs or fills memory, archives that lead outside.

Every end has a message; of a hostile archive nothing is unpacked.
"""

import os
import signal
import stat
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import fmpy
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import psa_casadi as psa
from psa_casadi.common.children import heard
from psa_casadi.common.files import temporary_folder
from psa_casadi.export.check import apart
from psa_casadi.export.check.binaries import FUNCTIONS
from psa_casadi.export.check.check import CheckRow
from psa_casadi.export.importer import archive as limits
from psa_casadi.export.importer.archive import Archive, archive_problems
from psa_casadi.simulation.compiler import OPTIMISE, compiler_command, run_compiler
from tests.contract.helpers import command
from tests.export.fmu_models import rewritten
from tests.export.ssp_master import SspArchive
from tests.test_files import ended
from tests.tiers import slow, slow_but

#: What the library does, and when: "MOMENT:DEED" in this variable; MOMENT is load, make or step.
DEED = "PSA_TEST_DEED"
#: A file of this name takes the number of the process when the deed is done.
PLACE = "PSA_TEST_PLACE"

_SOURCES = Path(__file__).parent / "hostile"
_SOURCE = (_SOURCES / "hostile.c").read_text("utf-8")


#: The functions that do nothing.
_STUBS = "".join(
    f"API int {name}(void) {{ return 0; }}\n"
    for name in sorted(FUNCTIONS[2] | FUNCTIONS[3])
    if f"{name}(" not in _SOURCE
)


@cache
def library() -> bytes:
    """Return the library, compiled once for both versions of FMI, and never loaded here."""
    with temporary_folder() as work:
        (work / "hostile.c").write_text(_SOURCE + _STUBS, encoding="utf-8")
        flags = ("-fPIC", "-fvisibility=hidden", "-shared", "hostile.c", "-o", "hostile.lib")
        run_compiler([*compiler_command(), *OPTIMISE, *flags], work)
        return (work / "hostile.lib").read_bytes()


def hostile_fmu(path: Path, fmi: int, content: bytes | None = None) -> Path:
    """Write the FMU, with another content of its library if there is one."""
    folder = fmpy.platform_tuple if fmi == 3 else fmpy.platform
    with zipfile.ZipFile(path, "w") as archive:
        archive.write(_SOURCES / f"fmi{fmi}.xml", "modelDescription.xml")
        archive.writestr(f"binaries/{folder}/h{fmpy.sharedLibraryExtension}", content or library())
    return path


pytestmark = pytest.mark.skipif(os.name != "posix", reason="the code is for POSIX")

#: The check during which each moment comes.
DURING = {
    "load": "binary loads", "make": "instances", "step": "life cycle",
    "leave": "process ends",
}  # fmt: skip
DEEDS = {
    "exit": "exit code 0 before",
    "_exit": "exit code 0 before",
    "exit3": "exit code 3 before the checks were done; the last it printed: licence not found",
    "abort": "the signal SIGABRT",
    "fault": "the signal SIGSEGV",
    "child": "exit code 0 before",
    "write": "disturbed the channel of the results: something else",
    "forge": "disturbed the channel of the results: something else",
    "close": "disturbed the channel of the results: it was closed",
}
MOMENTS = ("load", "make", "step")
#: Every deed at two moments, and in both versions, in turn; ends of all kinds at every moment.
CASES = [
    (2 + k % 2, MOMENTS[(k + late) % 3], deed) for k, deed in enumerate(DEEDS) for late in (0, 2)
]
QUICK = [(2, "load", "exit"), (2, "make", "exit"), (3, "step", "exit"), (2, "step", "fault"),
         (3, "step", "write"), (2, "step", "close")]  # fmt: skip


@pytest.fixture(autouse=True)
def _temporary_folder(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path_factory.mktemp("temporary")))


def _ended(
    tmp_path: Path, fmi: int, deed: str, monkeypatch: pytest.MonkeyPatch, **limits: Any
) -> tuple[CheckRow, list[str]]:
    """Return the last row, and the names of the rows before it; nothing may be left over."""
    monkeypatch.setenv(DEED, deed)
    path = hostile_fmu(tmp_path / "h.fmu", fmi)
    report = psa.check_fmu(path, **{"timeout": 60.0, **limits})
    assert list(Path(tempfile.gettempdir()).iterdir()) == []
    assert not report.passed
    return report.rows[-1], [row.name for row in report.rows[:-1]]


@pytest.mark.parametrize(
    ("fmi", "moment", "deed"), slow_but(QUICK, dict.fromkeys((*QUICK, *CASES)))
)
def test_every_way_to_end_has_its_remark(
    fmi: int, moment: str, deed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, before = _ended(tmp_path, fmi, f"{moment}:{deed}", monkeypatch)
    assert (row.name, row.passed) == (DURING[moment], False)
    assert DEEDS[deed] in row.remark
    assert "units defined" in before, "rows that were finished before are kept"
    assert ("instances" in before) == (moment == "step")


def test_the_command_fails_with_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It ended with exit code 0, and without a word."""
    monkeypatch.setenv(DEED, "load:exit")
    path = hostile_fmu(tmp_path / "h.fmu", 2)
    ended = command("check", path, "--timeout", "30", "--memory", "512")
    assert ended.code == 1
    assert "binary loads" in ended.out.splitlines()[-1]
    head, *lines = ended.out.splitlines()
    remarks = " ".join(" ".join(line[head.index("remark") :] for line in lines).split())
    assert "the FMU ended its process with exit code 0 before the checks were done" in remarks
    assert "RUNS THE CODE" in command("check", "--help").out


@slow
@pytest.mark.parametrize("deed", ["abort", "exit3", "write"])
def test_a_bad_end_after_all_checks(
    deed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, before = _ended(tmp_path, 2, f"leave:{deed}", monkeypatch)
    assert row.name == "process ends"
    assert "memory" in before
    assert "before the checks were done" not in row.remark


@pytest.mark.parametrize("moment", slow_but(["step"], ["load", "make", "step", "leave"]))
def test_a_hang_ends_at_the_time_limit(
    moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The limit is checked once the hang has started, however slow the machine is."""
    place, limits = tmp_path / "place", list[float]()

    def heard_at_last(child: "subprocess.Popen[bytes]", *, limit: float) -> object:
        limits.append(limit)
        while child.poll() is None and not (place.exists() and place.read_text()):
            time.sleep(0.02)
        return heard(child, limit=0.1)

    monkeypatch.setattr(apart, "heard", heard_at_last)
    monkeypatch.setenv(PLACE, str(place))
    row, _ = _ended(tmp_path, 2, f"{moment}:hang", monkeypatch, timeout=40.0)
    assert 0.0 < limits[0] <= 40.0
    assert row.name == DURING[moment]
    text = "did not come back within the time limit of 40 s of the whole check (--timeout sets it)"
    assert text in row.remark
    assert ended(int(place.read_text()))


@slow
def test_a_process_of_the_fmu_is_ended_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PLACE, str(tmp_path / "place"))
    _ended(tmp_path, 2, "step:child", monkeypatch)
    assert ended(int((tmp_path / "place").read_text()))


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits memory")
@pytest.mark.parametrize("fmi", slow_but([2], [2, 3]))
def test_memory_ends_at_its_limit(
    fmi: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, _ = _ended(tmp_path, fmi, "step:memory", monkeypatch, memory=200 << 20)
    assert row.name == "life cycle"
    assert "reached the memory limit of 200 MiB (--memory sets it)" in row.remark


def test_what_is_printed_is_no_result_and_no_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    path = hostile_fmu(tmp_path / "h.fmu", 2)
    quiet = [(row.name, row.passed) for row in psa.check_fmu(path).rows]
    monkeypatch.setenv(DEED, "load:print")
    assert [(row.name, row.passed) for row in psa.check_fmu(path).rows] == quiet
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("request_", slow_but([signal.SIGTERM], [signal.SIGTERM, signal.SIGINT]))
def test_a_request_to_end_leaves_nothing_behind(request_: signal.Signals, tmp_path: Path) -> None:
    path, place, folder = tmp_path / "h.fmu", tmp_path / "place", Path(tempfile.gettempdir())
    hostile_fmu(path, 2)
    with subprocess.Popen(
        [sys.executable, "-m", "psa_casadi.cli", "check", str(path)],
        env={**os.environ, DEED: "step:hang", PLACE: str(place), "TMPDIR": str(folder)},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    ) as process:  # fmt: skip
        while process.poll() is None and not (place.exists() and place.read_text()):
            time.sleep(0.02)
        assert any(folder.iterdir())
        process.send_signal(request_)
        assert process.wait(30) not in (0, 1, 2)
    assert list(folder.iterdir()) == []
    assert ended(int(place.read_text()))


Change = Callable[[zipfile.ZipFile], None]


def _archive(path: Path) -> Path:
    return hostile_fmu(path, 2, b"a library that is never loaded")


def _named(*names: str) -> Change:
    def add(archive: zipfile.ZipFile) -> None:
        for name in names:
            entry = zipfile.ZipInfo("x")
            entry.filename = entry.orig_filename = name  # as it is, with what ZipInfo would mend
            archive.writestr(entry, b"text")

    return add


def _of_kind(mode: int) -> Change:
    def add(archive: zipfile.ZipFile) -> None:
        entry = zipfile.ZipInfo("resources/elsewhere")
        entry.create_system, entry.external_attr = 3, (mode | 0o777) << 16
        archive.writestr(entry, "/etc/passwd")

    return add


def _zeros(archive: zipfile.ZipFile) -> None:
    archive.writestr("resources/z", bytes(20 << 20), zipfile.ZIP_DEFLATED, 9)


NAMES: dict[str, tuple[Change, str]] = {
    "a folder above": (_named("resources/../../outside"), "leads outside"),
    "absolute": (_named("/tmp/outside"), "leads outside"),
    "a drive": (_named("C:/outside"), "leads outside"),
    "backslashes": (_named("..\\outside"), "leads outside"),
    "control characters": (_named("resources/a\x1b[2Jb"), "control characters"),
    "other case": (_named("resources/a", "resources/A"), "names 2 entries"),
    "a link": (_of_kind(stat.S_IFLNK), "is a link or a device"),
    "a device": (_of_kind(stat.S_IFCHR), "is a link or a device"),
}
SIZES: dict[str, tuple[Change, str]] = {
    "a bomb": (_zeros, "times as large"),
    "many entries": (_named(*(f"resources/{k}" for k in range(40))), "more than 30"),
}


@pytest.mark.parametrize("what", NAMES | SIZES)
def test_such_an_archive_is_neither_unpacked_nor_run(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "MOST_ENTRIES", 30)
    change, remark = (NAMES | SIZES)[what]
    path = _archive(tmp_path / "h.fmu")
    assert not any(archive_problems(path).values())
    with zipfile.ZipFile(path, "a") as archive:
        change(archive)
    report = psa.check_fmu(path)
    row = "archive names" if what in NAMES else "archive size"
    assert [(r.name, remark in r.remark) for r in report.failures] == [(row, True)]
    assert all(r.name.startswith("archive") for r in report.rows)
    assert all(r.remark.isprintable() for r in report.rows)
    for reader in (Archive, SspArchive):
        with pytest.raises(psa.InputError, match=r"h\.fmu"):
            reader(path)
    assert [p.name for p in tmp_path.iterdir()] == ["h.fmu"]


def test_entries_and_a_description_beyond_their_limits_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _archive(tmp_path / "h.fmu")
    monkeypatch.setattr(limits, "LONGEST_TEXT", 100)
    with pytest.raises(psa.InputError, match=r"modelDescription\.xml has more than"):
        Archive(path)
    monkeypatch.setattr(limits, "MOST_BYTES", 100)
    (problem,) = archive_problems(path)["archive size"]
    assert "more than 100" in problem


def _damaged(path: Path, how: str) -> None:
    content = bytearray(path.read_bytes())
    if how == "cut off":
        del content[-40:]
    elif how == "checksum":
        content[content.index(b"fmiModelDescription") + 30] ^= 1
    else:
        for place, shift in ((content.index(b"PK\3\4"), 6), (content.index(b"PK\1\2"), 8)):
            content[place + shift] |= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("how", "row", "match"),
    [
        ("cut off", "archive intact", "the archive is damaged"),
        ("checksum", "archive intact", "'modelDescription.xml' is damaged"),
        ("encrypted", "archive names", "'modelDescription.xml' is encrypted"),
    ],
)
def test_damage(how: str, row: str, match: str, tmp_path: Path) -> None:
    path = _archive(tmp_path / "h.fmu")
    _damaged(path, how)
    report = psa.check_fmu(path)
    assert [(r.name, match in r.remark) for r in report.failures] == [(row, True)], report.rows
    assert len(report.rows) == 3


def test_a_description_that_names_a_library_elsewhere(tmp_path: Path) -> None:
    path = _archive(tmp_path / "h.fmu")
    outside = (b'Identifier="h"', b'Identifier="../../h"')
    rewritten(path, path, {"modelDescription.xml": lambda text: text.replace(*outside)})
    with pytest.raises(psa.InputError, match="is no name in C"):
        Archive(path)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.data())
def test_any_change_of_bytes_is_reported_or_harmless(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("scratch") / "a.zip"
    content = bytearray(_archive(path).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(1, len(content)))])
    archive_problems(path)
