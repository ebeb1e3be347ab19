r"""Run the commands that README.md shows, so that what the reader sees is executed.

Executable are the lines that begin with `$ ` in a fenced block marked `console`. Lines that end in
a backslash go on in the next one; all other lines are output and are left alone. Each block runs
in an empty directory of its own, with the checkout's environment first in PATH. A comment on its
own line before a block changes that:

    <!-- run: skip -->        the block is not run (installation, for example)
    <!-- run: needs-data -->  the block runs where the measured records are, in $PSA_CASADI_DATA
    <!-- run: continue -->    the block runs in the directory of the block before it
    <!-- run: python -->      the block is marked `python` and runs as a program
"""

import os
import re
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from build_scripts.measured_data import ROOT, measured_data_directory, must_be_present

MARKS = ("skip", "needs-data", "continue", "python")
LIMIT_S = 900

_FENCE = re.compile(r"^```(?P<language>\w*)\s*$")
_MARK = re.compile(r"^<!--\s*run:\s*(?P<mark>[\w-]+)\s*-->\s*$")


@dataclass(frozen=True)
class Block:
    """The commands of one fenced block, the line it begins in, and its marks."""

    line: int
    commands: tuple[str, ...]
    marks: frozenset[str]


def find_blocks(text: str) -> tuple[Block, ...]:
    """Return the console blocks and the marked programs of a text, also those to be skipped.

    Raises:
        ValueError: a mark is unknown, or a block has no end.
    """
    blocks: list[Block] = []
    marks: set[str] = set()
    lines = iter(enumerate(text.splitlines(), 1))
    for number, line in lines:
        if mark := _MARK.match(line):
            if mark["mark"] not in MARKS:
                raise ValueError(f"line {number}: '{mark['mark']}' is no mark; there are {MARKS}.")
            marks.add(mark["mark"])
        elif fence := _FENCE.match(line):
            content: list[str] = []
            for _, inner in lines:
                if inner.startswith("```"):
                    break
                content.append(inner)
            else:
                raise ValueError(f"line {number}: this block has no end; close it with ```.")
            if fence["language"] == "console":
                blocks.append(Block(number, find_commands(content), frozenset(marks)))
            elif fence["language"] == "python" and "python" in marks:
                program = "\n".join(("python - <<'END_OF_PROGRAM'", *content, "END_OF_PROGRAM"))
                blocks.append(Block(number, (program,), frozenset(marks)))
            marks = set()
        elif line.strip():
            marks = set()
    return tuple(blocks)


def find_commands(lines: Sequence[str]) -> tuple[str, ...]:
    """Return the commands after `$ `, each with the lines it continues in."""
    commands: list[str] = []
    open_command = False
    for line in lines:
        if open_command:
            commands[-1] += "\n" + line
        elif line.startswith("$ "):
            commands.append(line[2:])
        else:
            continue
        open_command = line.endswith("\\")
    return tuple(commands)


def run_block(block: Block, directory: Path) -> str | None:
    """Run the commands of a block in order; return a sentence about the first that fails."""
    binaries = sysconfig.get_path("scripts")
    environment = os.environ | {
        "PATH": os.pathsep.join((binaries, os.environ.get("PATH", os.defpath))),
        "PSA_CASADI_DATA": str(measured_data_directory()),
    }
    for command in block.commands:
        print(f"$ {command.partition(chr(10))[0]}", flush=True)
        started = time.monotonic()
        try:
            code = subprocess.run(
                ["bash", "-euo", "pipefail", "-c", command],
                cwd=directory,
                env=environment,
                stdin=subprocess.DEVNULL,
                timeout=LIMIT_S,
                check=False,
            ).returncode
        except subprocess.TimeoutExpired:
            return f"README.md line {block.line}: '{command}' ran longer than {LIMIT_S} s."
        print(f"  [exit code {code}, {time.monotonic() - started:.1f} s]", flush=True)
        if code != 0:
            return f"README.md line {block.line}: '{command}' ended with exit code {code}."
    return None


def run_text(text: str) -> list[str]:
    """Run the blocks of a Markdown text and return one sentence for each that failed."""
    failures: list[str] = []
    with tempfile.TemporaryDirectory() as scratch:
        directory = Path(scratch)
        for number, block in enumerate(find_blocks(text)):
            if "skip" in block.marks or not block.commands:
                continue
            if "needs-data" in block.marks and not measured_data_directory().is_dir():
                sentence = f"README.md line {block.line}: the measured records are not here."
                print(f"{sentence} Set PSA_CASADI_DATA to their directory.")
                failures.extend([sentence] if must_be_present() else [])
                continue
            if "continue" not in block.marks:
                directory = Path(scratch, str(number))
                directory.mkdir()
            failure = run_block(block, directory)
            failures.extend([failure] if failure else [])
    return failures


def main() -> int:
    """Run README.md's commands; return 1 if any failed or there are none."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    if not any(block.commands for block in find_blocks(text)):
        print("README.md shows no command: mark blocks of commands as ```console.")
        return 1
    failures = run_text(text)
    print("\n".join(failures) or "every command of README.md ran.")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
