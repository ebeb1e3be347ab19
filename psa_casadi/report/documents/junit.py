"""What `--junit` writes: a command as a suite of tests, as CI servers read it (JUnit XML)."""

from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

from psa_casadi.characters import plain
from psa_casadi.export.check.check import CheckReport
from psa_casadi.report.words.tables import check_table


@dataclass(frozen=True)
class Case:
    """One test: its name, its result, and why it failed, "" where it passed."""

    name: str
    result: str
    failure: str = ""


def check_cases(report: CheckReport) -> list[Case]:
    """Return every check of an FMU as a test."""
    table = check_table(report)
    rows = [dict(zip(table.head, row, strict=True)) for row in table.rows]
    texts = [
        f"found {row['found']}, allowed {row['allowed']}" if "found" in row else row["clause"]
        for row in rows
    ]
    cases = []
    for row, text, r in zip(rows, texts, report.rows, strict=True):
        sentence = ": ".join(filter(None, (text, row["remark"])))
        cases.append(Case(row["check"], sentence, "" if r.passed else sentence))
    return cases


def junit_text(command: str, subject: str, cases: Sequence[Case], seconds: float) -> str:
    """Return JUnit XML: one suite of the `command` on its `subject`, which took `seconds`.

    The elements and attributes are those that Jenkins' schema and GitLab's and GitHub's readers
    share: counts in `testsuites` and `testsuite`, `failure` with a message, `system-out`.
    """
    counts = {
        "name": plain(f"psa {command} {subject}"),
        "tests": str(len(cases)),
        "failures": str(sum(bool(c.failure) for c in cases)),
        "errors": "0",
        "time": f"{seconds:.3f}",
    }
    suites = ElementTree.Element("testsuites", counts)
    suite = ElementTree.SubElement(suites, "testsuite", {**counts, "skipped": "0"})
    for case in cases:
        table = {"classname": plain(f"psa.{command}.{subject}"), "name": plain(case.name)}
        test = ElementTree.SubElement(suite, "testcase", table)
        if case.failure:
            failure = {"message": plain(case.failure), "type": "failure"}
            ElementTree.SubElement(test, "failure", failure).text = plain(case.failure)
        ElementTree.SubElement(test, "system-out").text = plain(case.result)
    ElementTree.indent(suites)
    return ElementTree.tostring(suites, encoding="unicode", xml_declaration=True) + "\n"
