"""The command: run the cases side by side, show what changed, and keep it on request."""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from tests.studies.golden.cases import CASES, Row
from tests.studies.golden.compare import SECONDS, history, keep, kept, table, totals, twelfth

#: One thread for each case; compiled as users have it, so that times compare.
_ALONE = {
    "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PSA_CASADI_THREADS": "1",
    "PSA_CASADI_CFLAGS": "",
}  # fmt: skip
_LONGEST = 3600.0


def answered(case: str) -> Row:
    """Return the answer of a case with its processor time [s]."""
    with tempfile.TemporaryDirectory() as folder:
        begin = time.process_time()
        row = CASES[case].answer(Path(folder))
    return {**row, SECONDS: row.get(SECONDS, f"{time.process_time() - begin:.1f}")}


def run(
    ids: Sequence[str], workers: int, report: Callable[[str, Row], object] = lambda *_: None
) -> dict[str, Row]:
    """Return the answers, each from a separate process; the row of a failed case has its error."""
    with ThreadPoolExecutor(workers) as pool:
        jobs = {pool.submit(_apart, case): case for case in ids}
        result = {}
        for job in as_completed(jobs):
            result[jobs[job]] = job.result()
            report(jobs[job], job.result())
    return {case: result[case] for case in ids}


def _apart(case: str) -> Row:
    command = [sys.executable, "-m", __package__ or "", "--answer", case]
    ended = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=_LONGEST,
        env={**os.environ, **_ALONE},
    )  # fmt: skip
    if ended.returncode:
        return {"failed": (ended.stderr.strip().splitlines() or ["crashed"])[-1], SECONDS: "0"}
    return dict(json.loads(ended.stdout.splitlines()[-1]))


def _print(lines: Iterable[tuple[str, ...]], *head: str) -> None:
    rows = [head or ("case", "what", "before", "now"), *lines]
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    for row in rows:
        start = "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=False))
        print(f"{start}  {row[3]}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 all as kept, or accepted; 1 answers changed."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.golden", description=__doc__)
    parser.add_argument("--accept", action="store_true", help="keep the answers")
    parser.add_argument("--only", default="", help="pattern of kind/name, as exam/k1 or ^measured/")
    parser.add_argument("--twelfth", action="store_true", help="the quick ones, one of twelve")
    parser.add_argument("--history", action="store_true", help="processor times, by commit")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--answer", choices=CASES, metavar="CASE", help="print one answer as JSON")
    inputs = parser.parse_args(arguments)
    if inputs.answer:
        print(json.dumps(answered(inputs.answer)))
        return 0
    if inputs.history:
        _print(history(), "date", "commit", "processor time", "same cases")
        return 0
    before, ids = kept(), [case for case in CASES if re.search(inputs.only, case)]
    if inputs.twelfth:
        ids = twelfth([i for i in ids if i in before], before)
    if not ids:
        parser.error(f"no case has the pattern '{inputs.only}'; there are {', '.join(CASES)}")
    ids.sort(key=lambda i: -float(before.get(i, {}).get(SECONDS, "1e9")))

    def report(case: str, row: Row) -> None:
        answer = next((row[n] for n in ("failed", "causes", "told", "code") if n in row), "")
        print(f"{case}: {row.get('verdict', '')} {answer} [{row[SECONDS]} s]", file=sys.stderr)
        if inputs.accept and "failed" not in row:
            keep({case: row})

    now = run(ids, inputs.workers, report)
    _print(table(before, now))
    print()
    _print(totals(before, now))
    return int(bool(table(before, now, times=False)) and not inputs.accept)


if __name__ == "__main__":
    raise SystemExit(main())
