r"""Run the code that README.md and the pages in `docs/` show: what a reader sees is executed.

Executable are fenced blocks marked `console` (their lines that begin with `$ `; those that end in a
backslash go on in the next one, all others are output and are left alone), `python` (a program) and
`c` (statements of a program that is compiled with the C files of the folder). Each block runs in an
empty directory, with the checkout's environment first in PATH, two blocks side by side; the output
of a command is printed when it has ended. A comment on a separate line before a block changes that:

    <!-- run: skip, WHY -->   the block is not run (it installs something, it never ends)
    <!-- run: in-tests -->    the block is run by a test, which looks at what it leaves besides
    <!-- run: needs-data -->  the block runs where the measured records are, in $PSA_CASADI_DATA
    <!-- run: continue -->    the block runs in the directory of the block before it
    <!-- before: COMMAND -->  runs first, to make files that the block takes for granted, as a
                              reader's record: $DEMO_RECORD is that of the demonstration
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

MARKS = ("skip", "in-tests", "needs-data", "continue")
LIMIT_S = 900
#: Blocks that run side by side; those that need the measured records are the longest by far.
AT_ONCE = 2

_FENCE = re.compile(r"^```(?P<language>\w*)\s*$")
_NOTE = re.compile(r"^<!--\s*(?P<kind>run|before):\s*(?P<text>.+?)\s*-->\s*$")
_COMMAND = re.compile(r"^\$ (.*(?:(?<=\\)\n.*)*)", re.MULTILINE)
#: How the text of a block in a language runs.
_PROGRAMS = {
    "python": "python - <<'END_OF_PROGRAM'\n{}\nEND_OF_PROGRAM",
    "c": "tee block.txt <<'END_OF_PROGRAM'\n{}\nEND_OF_PROGRAM\n"
    "{{ grep '^#' block.txt; echo 'int main(void) {{'; grep -v '^#' block.txt; echo '}}'; }}"
    " >main.c\n"
    "${{CC:-cc}} -std=c99 -Wall -Werror -I code main.c code/*.c -lm -o program && ./program",
}


@dataclass(frozen=True)
class Block:
    """What runs for one fenced block, its page, its first line, and its marks."""

    line: int
    commands: tuple[str, ...]
    marks: frozenset[str]
    page: str = "README.md"

    @property
    def place(self) -> str:
        """Page and line."""
        return f"{self.page} line {self.line}"


def find_blocks(text: str, page: str = "README.md") -> tuple[Block, ...]:
    """Return the blocks of commands and programs of a text, also those to be skipped.

    Raises:
        ValueError: a mark is unknown, a block is skipped for no reason, or has no end.
    """
    blocks: list[Block] = []
    marks: set[str] = set()
    before: list[str] = []
    lines = iter(enumerate(text.splitlines(), 1))
    for number, line in lines:
        if note := _NOTE.match(line):
            if note["kind"] == "before":
                before.append(note["text"])
            else:
                marks.add(_mark(number, note["text"]))
        elif fence := _FENCE.match(line):
            content: list[str] = []
            for _, inner in lines:
                if inner.startswith("```"):
                    break
                content.append(inner)
            else:
                raise ValueError(f"line {number}: this block has no end; close it with ```.")
            if result := commands_of(fence["language"], content):
                blocks.append(Block(number, (*before, *result), frozenset(marks), page))
            marks, before = set(), []
        elif line.strip():
            marks, before = set(), []
    return tuple(blocks)


def _mark(line: int, text: str) -> str:
    mark, _, why = (part.strip() for part in text.partition(","))
    if mark not in MARKS:
        raise ValueError(f"line {line}: '{mark}' is no mark; there are {MARKS}.")
    if mark == "skip" and not why:
        raise ValueError(f"line {line}: say why this is skipped: <!-- run: skip, WHY -->")
    return mark


def commands_of(language: str, lines: Sequence[str]) -> tuple[str, ...]:
    """Return what runs a block, nothing where its language is none that runs.

    Of a console these are the commands after `$ `, each with the lines it continues in.
    """
    if language in _PROGRAMS:
        return (_PROGRAMS[language].format("\n".join(lines)),)
    text = "\n".join(lines) if language == "console" else ""
    return tuple(_COMMAND.findall(text))


def run_block(block: Block, directory: Path) -> str | None:
    """Run the commands of a block in order; return a sentence about the first that fails."""
    binaries = sysconfig.get_path("scripts")
    environment = os.environ | {
        "PATH": os.pathsep.join((binaries, os.environ.get("PATH", os.defpath))),
        "PSA_CASADI_DATA": str(measured_data_directory()),
        "DEMO_RECORD": str(ROOT / "psa_casadi" / "data" / "demo.csv"),
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
            _print_whole(command, ended.stdout, f"ended after {LIMIT_S} s")
            return f"{block.place}: '{command}' ran longer than {LIMIT_S} s."
        code, took = done.returncode, time.monotonic() - started
        _print_whole(command, done.stdout, f"exit code {code}, {took:.1f} s")
        if code != 0:
            return f"{block.place}: '{command}' ended with exit code {code}."
    return None


def _print_whole(command: str, data: bytes | None, end: str) -> None:
    """Print a command and its output at once, so that two do not mix."""
    text = (data or b"").decode("utf-8", "replace")
    print(f"$ {command.partition(chr(10))[0]}\n{text}  [{end}]\n", end="", flush=True)


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
    """Run blocks, side by side but for those that share a directory; say which failed."""
    chains: list[list[Block]] = []
    for block in blocks:
        if block.marks & {"skip", "in-tests"}:
            continue
        if "continue" in block.marks and chains:
            chains[-1].append(block)
        else:
            chains.append([block])
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return [failure for failures in pool.map(run_chain, chains) for failure in failures]


def pages() -> list[Path]:
    """Return README.md and the pages in `docs/`."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks_of(page: Path) -> tuple[Block, ...]:
    """Return the blocks of a page of the project."""
    return find_blocks(page.read_text(encoding="utf-8"), page.relative_to(ROOT).as_posix())


def blocks_in_tests(page: str) -> tuple[Block, ...]:
    """Return the blocks of a page that a test runs."""
    return tuple(b for b in blocks_of(ROOT / page) if "in-tests" in b.marks)


def block_in_tests(page: str) -> Block:
    """Return the one block of a page that a test runs; raises ValueError without one, or of two."""
    (block,) = blocks_in_tests(page)
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
