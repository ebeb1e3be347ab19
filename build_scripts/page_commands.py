r"""Run the commands that README.md and the pages in `docs/` show: what a reader sees is executed.

Executable are the lines that begin with `$ ` in a fenced block marked `console`. Lines that end in
a backslash go on in the next one; all other lines are output and are left alone. Each block runs
in an empty directory of its own, with the checkout's environment first in PATH, two blocks side by
side; what a command says is shown when it has ended. A comment on its own line before a block
changes that:

    <!-- run: skip -->        the block is not run (installation, for example)
    <!-- run: in-tests -->    the block is run by a test, which looks at what it leaves besides
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
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from build_scripts.measured_data import ROOT, measured_data_directory, must_be_present

MARKS = ("skip", "in-tests", "needs-data", "continue", "python")
LIMIT_S = 900
#: Blocks that run side by side; those that need the measured records are the longest by far.
AT_ONCE = 2

_FENCE = re.compile(r"^```(?P<language>\w*)\s*$")
_MARK = re.compile(r"^<!--\s*run:\s*(?P<mark>[\w-]+)\s*-->\s*$")


@dataclass(frozen=True)
class Block:
    """The commands of one fenced block, its page, the line it begins in, and its marks."""

    line: int
    commands: tuple[str, ...]
    marks: frozenset[str]
    page: str = "README.md"

    @property
    def place(self) -> str:
        """Page and line, as they are told."""
        return f"{self.page} line {self.line}"


def find_blocks(text: str, page: str = "README.md") -> tuple[Block, ...]:
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
                blocks.append(Block(number, find_commands(content), frozenset(marks), page))
            elif fence["language"] == "python" and "python" in marks:
                program = "\n".join(("python - <<'END_OF_PROGRAM'", *content, "END_OF_PROGRAM"))
                blocks.append(Block(number, (program,), frozenset(marks), page))
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
        started = time.monotonic()
        try:
            done = subprocess.run(
                ["bash", "-euo", "pipefail", "-c", command],
                cwd=directory,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                timeout=LIMIT_S,
                check=False,
            )
        except subprocess.TimeoutExpired as ended:
            _tell(command, ended.stdout, f"ended after {LIMIT_S} s")
            return f"{block.place}: '{command}' ran longer than {LIMIT_S} s."
        code, took = done.returncode, time.monotonic() - started
        _tell(command, done.stdout, f"exit code {code}, {took:.1f} s")
        if code != 0:
            return f"{block.place}: '{command}' ended with exit code {code}."
    return None


def _tell(command: str, said: bytes | None, end: str) -> None:
    """Print a command and what it said at once, so that two do not mix."""
    text = (said or b"").decode("utf-8", "replace")
    print(f"$ {command.partition(chr(10))[0]}\n{text}  [{end}]\n", end="", flush=True)


def chains_of(blocks: Sequence[Block]) -> list[list[Block]]:
    """Return the blocks to run, those together that share a directory."""
    chains: list[list[Block]] = []
    for block in blocks:
        if block.marks & {"skip", "in-tests"} or not block.commands:
            continue
        if "continue" in block.marks and chains:
            chains[-1].append(block)
        else:
            chains.append([block])
    return chains


def run_chain(chain: Sequence[Block]) -> list[str]:
    """Run blocks one after the other in a new directory; return a sentence for each that failed."""
    failures: list[str] = []
    with tempfile.TemporaryDirectory() as directory:
        for block in chain:
            if "needs-data" in block.marks and not measured_data_directory().is_dir():
                sentence = f"{block.place}: the measured records are not here."
                print(f"{sentence} Set PSA_CASADI_DATA to their directory.")
                failures.extend([sentence] if must_be_present() else [])
                continue
            failure = run_block(block, Path(directory))
            failures.extend([failure] if failure else [])
    return failures


def run_blocks(blocks: Sequence[Block]) -> list[str]:
    """Run blocks, chains of them side by side; return one sentence for each that failed."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        chains = pool.map(run_chain, chains_of(blocks))
        return [failure for failures in chains for failure in failures]


def pages() -> list[Path]:
    """Return README.md and the pages in `docs/`."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks_of(page: Path) -> tuple[Block, ...]:
    """Return the blocks of a page of the project."""
    return find_blocks(page.read_text(encoding="utf-8"), page.relative_to(ROOT).as_posix())


def block_in_tests(page: str) -> Block:
    """Return the one block of a page that a test runs; raises ValueError without one, or of two."""
    (block,) = (b for b in blocks_of(ROOT / page) if "in-tests" in b.marks)
    return block


def main() -> int:
    """Run the commands of all pages; return 1 if any failed or README.md has none."""
    blocks = [block for page in pages() for block in blocks_of(page)]
    if not any(block.commands for block in blocks if block.page == "README.md"):
        print("README.md shows no command: mark blocks of commands as ```console.")
        return 1
    failures = run_blocks(blocks)
    print("\n".join(failures) or f"every command of {len(pages())} pages ran.")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
