"""Benchmark `design`: experiments that separate causes, inputs that follow paths, linearisation."""

from importlib import import_module

from tests.studies.benchmarks.table import Outcome, Progress

#: Each part measures its own tables: `tables(progress, quick)`.
_PARTS = ("design_separation", "design_tracking", "design_linearisation")


def run(progress: Progress, quick: bool) -> Outcome:
    """Measure every part; with `quick` on fewer and smaller cases."""
    found = []
    for part in _PARTS:
        found += import_module(f"tests.studies.benchmarks.{part}").tables(progress, quick)
    return Outcome(tuple(found))
