"""The page of a design holds all it is given and nothing from the net."""

import re
from pathlib import Path

import pytest

from psa_casadi.errors import InputError
from psa_casadi.report.page.designs import write_design_page
from psa_casadi.report.page.document import Picture
from psa_casadi.report.plots.panel import Panel
from psa_casadi.report.words.design_words import Titled
from psa_casadi.report.words.tables import Table


def test_a_page_holds_summary_tables_and_figures(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    table = Titled("Errors <&>", Table(("a", "b"), (("x", "1.5"),)), "how to read it")
    picture = Picture("A curve", Panel().line([0, 1], [2, 3]))
    write_design_page(
        path, title="A design", summary=["the result", "a detail"], tables=[table],
        figures=[picture], badges=["10 samples"],
    )  # fmt: skip
    page = path.read_text(encoding="utf-8")
    for text in ("A design", "the result", "a detail", "Errors &lt;&amp;&gt;", "how to read it",
                 "A curve", "10 samples", "<td>x</td>"):  # fmt: skip
        assert text in page, text
    assert not re.search(r'<(script|link|img)[^>]+(src|href)="http', page)


def test_a_page_that_cannot_be_written_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        write_design_page(tmp_path / "no" / "page.html", title="A design", summary=["it"])
