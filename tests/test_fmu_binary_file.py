"""The reader of shared libraries, against an independent one, for every platform."""

from pathlib import Path

import lief
import pytest

from psa_casadi.errors import InputError
from psa_casadi.export.fmu.platforms import PLATFORMS
from psa_casadi.export.importer.binary_file import Binary, read_binary
from tests.c_host.build import VERSIONS, binary
from tests.tiers import slow

pytestmark = [pytest.mark.xdist_group("platforms"), slow]

FORMATS = {".so": "ELF", ".dll": "PE", ".dylib": "Mach-O"}
#: lief's words for the machines.
MACHINES = {
    "I386": "x86", "AMD64": "x86_64", "X86_64": "x86_64", "ARM": "aarch32", "AARCH64": "aarch64",
    "ARM64": "aarch64", "RISCV": "riscv64",
}  # fmt: skip


def _independent(path: Path) -> Binary:
    found = lief.parse(str(path))
    if isinstance(found, lief.ELF.Binary):
        required = found.symbols_version_requirement
        needs = {str(v.name) for r in required for v in r.get_auxiliary_symbols()}
        names = {str(s.name) for s in found.exported_symbols}
        machine = MACHINES[found.header.machine_type.name]
        return Binary("ELF", f"{machine}-linux", frozenset(names), frozenset(needs))
    if isinstance(found, lief.PE.Binary):
        export = found.get_export()
        assert export is not None
        machine = MACHINES[found.header.machine.name]
        names = {str(e.name) for e in export.entries}
        return Binary("PE", f"{machine}-windows", frozenset(names), frozenset())
    assert isinstance(found, lief.MachO.Binary)
    of_the_linker = {"__mh_dylib_header", "___dso_handle"}
    names = {str(s.name) for s in found.exported_symbols} - of_the_linker
    machine = MACHINES[found.header.cpu_type.name]
    exported = frozenset(n.removeprefix("_") for n in names)
    return Binary("Mach-O", f"{machine}-darwin", exported, frozenset())


@pytest.mark.parametrize("fmi", VERSIONS)
@pytest.mark.parametrize("name", PLATFORMS)
def test_exports_and_needs(name: str, fmi: int) -> None:
    path = binary(fmi, PLATFORMS[name])
    found = read_binary(path)
    assert found == _independent(path)
    assert found.platform == name
    assert found.format == FORMATS[PLATFORMS[name].suffix]
    assert f"fmi{fmi}DoStep" in found.exports
    assert bool(found.needs) == (found.format == "ELF")


@pytest.mark.parametrize("name", PLATFORMS)
def test_a_library_that_is_cut_off(name: str, tmp_path: Path) -> None:
    """Wherever it ends: before anything is loaded, which could end the process."""
    content = binary(2, PLATFORMS[name]).read_bytes()
    path = tmp_path / "cut"
    for size in (0, 3, *range(64, len(content), len(content) // 50), len(content) - 16):
        path.write_bytes(content[:size])
        with pytest.raises(InputError, match=r"cut off|known format"):
            read_binary(path)
