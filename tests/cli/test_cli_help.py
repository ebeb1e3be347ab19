"""What the help of every command shows is what was written, whole enough to be copied."""

import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

import psa_casadi as psa
from psa_casadi.cli.app import app
from psa_casadi.datasets import DATASETS
from psa_casadi.examples.index import examples


def commands(own: Any, *path: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield a command of click, which some versions of typer hold in a room of their own."""
    yield path, own
    for name, inner in getattr(own, "commands", {}).items():
        yield from commands(inner, *path, name)


EVERY = dict(commands(typer.main.get_command(app)))


def written(own: Any) -> list[str]:
    """Return the texts of a command's help, with single spaces."""
    shown = (p for p in own.params if not getattr(p, "hidden", False))
    texts = [own.help, own.epilog, *(getattr(p, "help", None) for p in shown)]
    return [" ".join(text.replace("\b", "").split()) for text in texts if text]


@pytest.mark.parametrize("path", EVERY, ids=" ".join)
def test_the_help_shows_its_texts_whole_in_80_columns(path: tuple[str, ...]) -> None:
    shown = CliRunner().invoke(app, [*path, "--help"], env={"COLUMNS": "80"}).output
    joined = " ".join(shown.split())
    assert "\\" not in shown
    assert [text for text in written(EVERY[path]) if text not in joined] == []
    assert [p.name for p in EVERY[path].params if not getattr(p, "help", "")] == []
    lines = [line.strip() for line in shown.splitlines()]
    if not hasattr(EVERY[path], "commands"):
        (example,) = (line for line in lines if line.startswith("Example: "))
        assert example.startswith(f"Example: psa {' '.join(path)} ")
        assert f"\b\n{example}" == EVERY[path].epilog
    assert [line for line in lines if len(line) > 78 and "Example: " not in line] == []
    assert [line for line in lines if line.endswith("...") and "Usage: " not in line] == []


@pytest.mark.parametrize(
    ("line", "names"),
    [
        ("psa stacks ", psa.STACKS),
        ("psa simulate --stack P", ["P-885.51", "PTBS200"]),
        ("psa effects slow", ["slow_creep"]),
        ("psa diagnose a.csv --leave-out ", psa.EFFECTS),
        ("psa design experiment --separate sensor_r", ["sensor_ripple"]),
        ("psa export fmu --part ", psa.PARTS),
        (
            "psa datasets steering_mirror_",
            [n for n in DATASETS if n.startswith("steering_mirror_")],
        ),
        ("psa examples use_in_", [n for n in examples() if n.startswith("use_in_")]),
        ("psa diagnose a.csv --expect adequate,cau", ["adequate,cause_named"]),
    ],
)
def test_a_shell_completes_the_names_that_there_are(line: str, names: Any) -> None:
    asked = {"_PSA_COMPLETE": "complete_bash", "COMP_WORDS": line}
    shown = subprocess.run(
        [sys.executable, "-m", "psa_casadi.cli"],
        env=os.environ | asked | {"COMP_CWORD": str(len(line.split(" ")) - 1)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert set(shown.stdout.split()) == set(names)
