"""The `psa` commands of the recipes, run in the current folder; equal exports are made once."""

import shlex
import shutil
import tempfile
from functools import cache
from pathlib import Path

from typer.testing import CliRunner

from psa_casadi.cli.app import app
from psa_casadi.export.fmu.platforms import chosen_platforms

_FOLDER = tempfile.TemporaryDirectory()


def run_command(command: str) -> None:
    """Run a command of `psa` in the current folder, for the platform of this machine only.

    What binaries of other platforms do is shown by tests/export/test_fmu_platforms.py.
    """
    words = shlex.split(command)
    assert words[0] == "psa"
    if "--platforms" in words:
        at = words.index("--platforms")
        assert chosen_platforms(words[at + 1].split(","))
        del words[at : at + 2]
    if words[1] != "export" or "--model" in words:
        _invoke(words)
        return
    at = words.index("-o") + 1
    shutil.copy(_exported(tuple(words[:at]), words[at]), words[at])


def _invoke(words: list[str]) -> None:
    result = CliRunner().invoke(app, words[1:])
    assert result.exit_code == 0, f"{shlex.join(words)}: {result.output}"


@cache
def _exported(words: tuple[str, ...], name: str) -> Path:
    """Run an export that reads no file, once for all pages that have the command."""
    path = Path(tempfile.mkdtemp(dir=_FOLDER.name)) / name
    _invoke([*words, str(path)])
    return path
