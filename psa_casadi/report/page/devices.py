"""Pages of several devices: a few side by side, or a population with its outliers."""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from psa_casadi.common.display import frame
from psa_casadi.common.errors import InputError
from psa_casadi.common.files import atomic_write
from psa_casadi.documents.findings import Result, read_findings
from psa_casadi.model.component import Component
from psa_casadi.population.population import Difference, Finding, Population, differences
from psa_casadi.report.page.document import render
from psa_casadi.report.words import population_words as words
from psa_casadi.report.words.phrases import one_unit
from psa_casadi.report.words.tables import Table

#: More devices than this are a population.
MOST = 20
#: Columns of a comparison as text.
_WIDTH = 100
#: Parameters that have a plot; those in which devices stand out come first.
_MOST_PLOTS = 12


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Devices side by side: the results of each, and the parameters that several determine."""

    findings: tuple[Finding, ...]

    @cached_property
    def differences(self) -> tuple[Difference, ...]:
        """Every parameter that two devices or more determine, with p of "all have one value"."""
        return differences(self.findings)

    @property
    def sentence(self) -> str:
        """Which parameters differ beyond noise, how the verdicts do, and which fits miss."""
        return words.difference_sentence(self.findings, self.differences)

    @property
    def tables(self) -> tuple[Table, ...]:
        """Verdicts with held-out errors of every output, and the parameters, if any are shared."""
        tables = [words.verdict_table(self.findings, words.error_scale(self.findings))]
        if self.differences:
            tables.append(words.difference_table(self.findings, self.differences))
        return tuple(t for t in tables if len(t.head) > 1)  # of models alone only names

    def __repr__(self) -> str:
        """Return the sentence and the tables."""
        return "\n\n".join([self.sentence, *(t.fitted(_WIDTH) for t in self.tables)])

    def to_frame(self) -> Any:
        """Return parameters by device as a pandas DataFrame: value, interval, unit, p, differ."""
        names = "parameter", "device", "value", "low", "high", "unit", "p_adjusted", "differs"
        columns: dict[str, list[Any]] = {name: [] for name in names}
        for d in self.differences:
            for f in (self.findings[k] for k in d.estimates.places):
                p = f.parameters[d.estimates.name]
                ends = p.interval or (p.value, p.value)
                row = d.estimates.name, f.device, p.value, *ends, p.unit, d.p_adjusted, d.differs
                for name, value in zip(names, row, strict=True):
                    columns[name].append(value)
        return frame(columns)

    def report(self, path: str | os.PathLike[str]) -> None:
        """Write the page, one HTML file that needs no network. Raises InputError."""
        write_comparison(self.findings, path)


def compare(
    *results: str | os.PathLike[str] | Result, effects: Sequence[Component] = ()
) -> Comparison:
    """Compare two devices or more, stacks or of any other model.

    `results` are what `identify`, `diagnose` and `load_diagnosis` return, or files of these
    (`read_findings`); `effects` are a user's that MODEL.json names.

    Raises InputError for fewer than two, and for what cannot be read.
    """
    findings = read_findings(results, effects)
    _refuse_fewer(findings)
    return Comparison(findings)


def _refuse_fewer(findings: Sequence[Finding]) -> None:
    if len(findings) < 2:
        raise InputError(
            "One device is nothing to compare; give the files of two or more. (A model and a"
            " diagnosis of the same records are one device.)"
        )


def write_comparison(findings: Sequence[Finding], path: str | os.PathLike[str]) -> None:
    """Write the page of devices side by side (`read_findings`), whole or not at all.

    It shows verdicts, causes with confidence, error budgets, parameters with intervals and which
    differ beyond noise, and the errors over time and voltage of the records that models carry.

    Raises:
        InputError: there are fewer than two devices or too many, or `path` cannot be written to.
    """
    _refuse_fewer(findings)
    if len(findings) > MOST:
        raise InputError(
            f"{len(findings)} devices have no room side by side; give {MOST} at most, or the folder"
            " of results of `psa batch` for the page of a population."
        )
    rows, scale = differences(findings), words.error_scale(findings)
    with one_unit(scale):
        page = render(
            "comparison.html",
            f"Comparison of {len(findings)} devices",
            findings=findings,
            rows=rows,
            scale=scale,
            warnings=[f"{f.device}: {w}" for f in findings for w in f.warnings],
            scales=len({f.force_scale for f in findings if f.force_scale}),
        )
    atomic_write(path, page)


def write_population(
    population: Population,
    path: str | os.PathLike[str],
    *,
    without: Sequence[tuple[str, str, str]] = (),
) -> None:
    """Write the page of a population, whole or not at all.

    `without` are devices that have no result: name, status, and why.

    Raises InputError when `path` cannot be written to.
    """
    p, batches = population, {f.batch for f in population.findings if f.batch}
    badges = [f"{len(p.findings)} devices"]
    badges += [f"{len(batches)} batch{'es' if len(batches) > 1 else ''}"] if batches else []
    counts = Counter(o.parameter for o in p.outliers)
    spreads = sorted(p.spreads, key=lambda s: -counts[s.estimates.name])[:_MOST_PLOTS]
    page = render(
        "population.html",
        "Population of devices",
        badges,
        p=p,
        **words.population_tables(p),
        spread_order=spreads,
        without=Table(("device", "ended", "why"), tuple(without)) if without else None,
    )
    atomic_write(path, page)
