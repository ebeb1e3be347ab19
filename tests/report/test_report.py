import json
import re
import struct
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from psa_casadi.diagnosis.held_out import Budget, Share
from psa_casadi.diagnosis.result import Cause, Estimate, Verdict
from psa_casadi.effects import EFFECTS
from psa_casadi.export.check.check import CheckReport, CheckRow
from psa_casadi.report.plots.figures import save_figure
from psa_casadi.report.plots.findings import evidence_plot
from psa_casadi.report.words.phrases import Scale, length_scale, listing, number, plain, share_text
from psa_casadi.report.words.series import noise_density, series_of, spectrum, telling_window
from psa_casadi.report.words.tables import blind_table, check_table, error_table, parameter_table
from psa_casadi.report.words.text import check_sentence, effect_page, story
from psa_casadi.report.words.verdict_words import cause_size, verdict_sentence
from tests.report.html_page import figures, written
from tests.report.report_cases import ADDED, NOISE, diagnosis
from tests.tiers import slow

VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
SENTENCES = {
    "adequate": "Nothing beyond the noise is missing",
    "cause_named": "The cause is slow creep (plant, confidence 97 %: extremely likely)",
    "partly_explained": "The closest known cause is slow creep",
    "ambiguous": "do not decide whether it is slow creep or offset drift",
    "unexplained": "no effect in the table explains",
    "not_driven": "The displacement does not follow the voltage",
}


def png_size(path: Path) -> tuple[int, int]:
    data = path.read_bytes()
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    width, height = struct.unpack(">II", data[16:24])
    return width, height


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_verdict_is_told_as_page_and_text(tmp_path: Path, verdict: Verdict) -> None:
    d = diagnosis(verdict)
    text, page = written(d, tmp_path, origin="synthetic")
    assert page.loaded == []
    assert page.targets <= page.names
    assert not re.search(r"@import|url\(", text.split("<script>", 1)[0])
    assert len(text) < 3e6
    assert SENTENCES[verdict] in page.text
    assert "synthetic data" in page.text
    assert "measured" not in page.text
    assert d.experiments[0].record.sha256 in page.text
    assert "The record is slow <and> short." in page.text
    # at the top 1, views 3, evidence 1, record 6; signature and data 2
    assert len(figures(text)) == (13 if verdict in ADDED else 11)
    assert "The residual of the" in page.text
    shown = story(d, origin="synthetic")
    assert SENTENCES[verdict] in " ".join(shown.split())
    assert ("extended" in shown) == (verdict in ADDED)
    assert 8 <= len(shown.splitlines()) <= 20
    assert max(map(len, shown.splitlines())) <= 100
    json.loads(d.to_json())


@pytest.mark.parametrize("verdict", ["cause_named", "unexplained"])
def test_the_picture_has_its_size_and_shows_something(tmp_path: Path, verdict: Verdict) -> None:
    path = tmp_path / "d.png"
    save_figure(diagnosis(verdict, ("a", "b")), path, origin="synthetic")
    assert png_size(path) == (1600, 1000)
    assert path.stat().st_size > 50_000
    save_figure(diagnosis(verdict, ("a", "b")), tmp_path / "n.png", origin="synthetic", narrow=True)
    assert png_size(tmp_path / "n.png") == (720, 880)
    (tmp_path / "n.png").unlink()
    assert [p.name for p in tmp_path.iterdir()] == ["d.png"]


@slow
def test_long_records_stay_small(tmp_path: Path) -> None:
    text, _ = written(diagnosis("cause_named", tuple("abcdefgh"), 60_000), tmp_path)
    assert len(text.encode()) < 3e6


def test_the_window_shows_where_the_error_falls_most() -> None:
    (series,) = series_of(diagnosis("cause_named"))
    window = telling_window(series)
    base, extended = (np.nan_to_num(series.residual(c)) for c in series.curves)
    reached = series.curves[0].values
    assert series.held_out[window].all()
    assert 48 <= len(base[window]) <= len(base) // 8

    def shown(part: slice) -> float:
        errors = [float(np.sqrt(np.mean(e[part] ** 2))) for e in (base, extended)]
        return (errors[0] - errors[1]) / float(np.ptp(reached[part]))

    assert shown(window) > 2 * shown(slice(None))


def test_the_verdict_names_the_rival_of_a_later_cause_and_weights_as_what_they_are() -> None:
    d = diagnosis("partly_explained")
    memory = EFFECTS["hysteresis_memory"]
    size = Estimate(0.1, "1", (0.08, 0.12))
    second = Cause(memory.name, "plant", 0.6, {"memory_threshold": size} |
                   dict.fromkeys(memory.linear, size), ("backlash",), 0.2)  # fmt: skip
    d = replace(d, causes=(*d.causes, second), model=d.model.with_effect(memory))
    said = "hysteresis memory (plant, confidence 60 %: more likely than not; or backlash)"
    assert said in verdict_sentence(d)
    said = cause_size(d, second)
    assert "memory_threshold = 0.100" in said
    assert said.endswith("9 weights, which shape its loop together")
    assert "memory_cube_2" not in said
    assert cause_size(d, d.causes[0]).startswith("creep_gain = 0.0400")


def test_the_share_of_a_named_cause_among_several_is_told_beside_that_of_it_alone() -> None:
    d = diagnosis("partly_explained")
    own, other = (Share(n, s, (s - 0.05, s + 0.05)) for n, s in (("slow_creep", 0.6), ("hum", 0.3)))
    spent = Budget(4e-8, NOISE, own, (own, other), None, 1e-9, 0.1)
    first = d.candidates[0]
    assert share_text(first, d) == "93 %"
    hum = replace(d.causes[0], effect="hum")
    d = replace(d, budget=spent, causes=(*d.causes, hum))
    assert share_text(first, d) == "93 %; with others 60 %"
    assert share_text(d.candidates[2], d) == "0 % (screened)"


def test_the_bars_of_named_causes_come_first_with_their_confidence() -> None:
    d = diagnosis("partly_explained")
    last = d.candidates[-1].effect
    d = replace(d, causes=(*d.causes, replace(d.causes[0], effect=last, confidence=0.5)))
    bars, figures_ = evidence_plot(d, 2).data
    assert bars["y"][::-1] == [plain(n) for n in (d.candidates[0].effect, last)]
    assert [t.split("; ")[1] for t in figures_["text"]][::-1] == ["named, 97 %", "named, 50 %"]
    shares = evidence_plot(diagnosis("unexplained"), 2).data[1]["text"]
    assert not any("named" in t for t in shares)


def test_the_spectrum_of_white_noise_lies_on_the_noise_floor() -> None:
    (series,) = series_of(diagnosis("cause_named", samples=20_000))
    frequency, density = spectrum(series.time, series.residual(series.curves[1]))
    assert frequency[-1] == pytest.approx(500.0, rel=2e-3)
    assert float(np.sqrt(np.mean(density[5:] ** 2))) == pytest.approx(
        noise_density(series), rel=0.05
    )
    assert noise_density(series) == pytest.approx(NOISE * np.sqrt(2e-3), rel=0.02)


def test_tables_show_display_units_and_say_what_is_not_known() -> None:
    d = diagnosis("cause_named")
    rows = {row[0]: row for row in parameter_table(d.model).rows}
    assert rows["tau"][1:4] == ("0.1000", "not determined", "ms")
    assert rows["k_L"][2:5] == ("9.90 to 10.1", "N/V", "fit")
    assert rows["m_P"][4] == "not fitted"
    assert [row[1] for row in blind_table(d).rows] == ["at no size", "0.00200 s"]
    both, one = (error_table(x, Scale("nm", 1e9)).rows for x in (d, diagnosis("adequate")))
    assert [row[0] for row in both] == ["base", "extended", "noise"]
    assert both[1][2] == "8.50"
    assert [row[0] for row in one] == ["base", "noise"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"), (1234.5, "1230"), (12.345, "12.3"), (-0.00123456, "-0.00123"), (9.996, "10.0"),
        (1e300, "1.00e300"), (2.5e-7, "2.50e-7"), (6e7, "6.00e7"), (float("inf"), "not finite"),
    ],
)  # fmt: skip
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert number(value) == text


def test_lengths_and_lists_are_handy() -> None:
    assert length_scale(3e-5).text(1.8e-5) == "18.0 µm"
    assert length_scale(2e-8).text(1.8e-8) == "18.0 nm"
    assert length_scale(4000.0, counts=True).text(12.0) == "12.0 counts"
    assert [listing(["a", "b", "c"][:n]) for n in range(4)] == ["", "a", "a and b", "a, b and c"]


@pytest.mark.parametrize("name", EFFECTS)
def test_the_page_of_an_effect_tells_all_of_it(name: str) -> None:
    effect = EFFECTS[name]
    page = " ".join(effect_page(effect).split())
    for part in (effect.equation_text, effect.source, effect.looks_like, effect.belongs_to):
        assert part
        assert " ".join(part.split()) in page
    for parameter in effect.parameters:
        assert parameter.name in page
    assert page.count("(0 removes the effect)") == 1


def test_the_check_of_an_fmu_names_what_failed() -> None:
    good = CheckRow("units", 0.0, 0.0, True, "")
    bad = CheckRow("equations", float("nan"), 1e-9, False, "it stopped")
    report = CheckReport(Path("x.fmu"), (good, bad), compared=False)
    row = check_table(report).rows[1]
    assert " ".join(row) == "equations not finite 1.00e-9 FAIL it stopped"
    assert check_sentence(report).startswith("x.fmu did not pass: equations.")
    assert "no model" in check_sentence(report)
    assert "passed all 1 checks" in check_sentence(CheckReport(Path("x.fmu"), (good,), True))
