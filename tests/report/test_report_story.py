"""The story of a diagnosis: each part of the page and of the terminal where there is something."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.cli.diagnosis_files import models
from psa_casadi.diagnosis.held_out import Budget, Share
from psa_casadi.diagnosis.result import BlindSpot
from psa_casadi.report.page.results import drawn, split_table
from psa_casadi.report.words.phrases import probability_text
from psa_casadi.report.words.tables import blindest, candidate_table
from tests.report.html_page import figures, numbers, written
from tests.report.report_cases import diagnosis, periodic, with_periodic

WRONG, WHY = "What the base model gets wrong", "Why this cause"


def headings(text: str) -> list[str]:
    return re.findall(r"<h2[^>]*>(.*?)</h2>", text)


def told(d: psa.Diagnosis) -> dict[str, str]:
    """Return the terminal's story, line by line under its labels."""
    found: dict[str, str] = {}
    label = ""
    for line in psa.story(d, origin="synthetic").splitlines():
        label = line[:10].strip() or label
        found[label] = f"{found.get(label, '')} {line[11:].strip()}".strip()
    return found


def test_the_page_tells_the_story_in_its_order(tmp_path: Path) -> None:
    text, page = written(diagnosis("cause_named"), tmp_path)
    assert headings(text) == [
        WRONG, WHY, "What was named", "What is gained", "What remains",
        "What these records could not have shown", "Next experiment", "Details: record by record",
        "Every effect that was tried: figures", "Parameters of the extended model",
        "Noise", "Records",
    ]  # fmt: skip
    top = text[: text.index("<h2")]
    assert "(plant, confidence 97\u00a0%: extremely likely)" in top
    assert top.count('class="drawing"') == 1
    # the noise is the floor of the errors' bars
    assert re.findall(r'<i style="width:([\d.]+)%', top) == ["100.0", "17.0", "10.0"]
    assert "--floor:10.0%" in top
    assert "falls by 83 % (95 % interval 79 to 86 %)" in page.text.replace("\u00a0", " ")
    assert "holds for these voltages only" in page.text
    for sentence in diagnosis("cause_named").misfit[0].sentences:
        assert sentence in page.text.replace("\u00a0", " ")
    assert diagnosis("cause_named").noise[0].sentence in page.text.replace("\u00a0", " ")


def test_what_the_records_do_not_determine_is_folded_away(tmp_path: Path) -> None:
    text, _ = written(diagnosis("cause_named"), tmp_path)
    shown = text[text.index("Parameters of the extended model</h2>") :]
    above, folded = shown.split("<details><summary>Not determined by these records", 1)
    assert "<td>k_L</td>" in above
    for name in ("tau", "m_P"):  # over seven decades, and not fitted
        assert f"<td>{name}</td>" not in above
        assert f"<td>{name}</td>" in folded.split("</details>")[0]


def test_the_view_is_drawn_before_and_after_the_extension(tmp_path: Path) -> None:
    d = diagnosis("cause_named")
    text, _ = written(d, tmp_path)
    (view,) = [f for f in figures(text) if _names(f) == ["base model", "extended model"]
               and "error_y" in f["data"][0]][:1]  # fmt: skip
    before, after = (numbers(trace["y"]) for trace in view["data"])
    assert np.ptp(before) > 5 * np.ptp(after)
    assert np.min(numbers(view["data"][0]["error_y"]["array"])) > 0
    base_only, _ = written(diagnosis("unexplained"), tmp_path)
    views = [f for f in figures(base_only) if f.get("data") and "error_y" in f["data"][0]]
    assert [_names(f) for f in views] == 3 * [["base model"]]


def test_an_effect_without_a_name_is_said_to_be_in_the_extended_model(tmp_path: Path) -> None:
    share = Share("slow_creep", 0.57, (0.5, 0.6))
    spent = Budget(4e-8, 5e-9, share, (share,), None, 2.6e-8, 0.16)
    d = replace(diagnosis("cause_named"), verdict="unexplained", causes=(), budget=spent)
    assert d.kept == ("slow_creep",)
    lines = told(d)
    assert "no cause is named; slow creep removes 57 % of the error above" in lines["verdict"]
    assert "kept in the extended model without being a cause" in lines["verdict"]
    assert "extended" in lines
    assert "cause" not in lines
    assert "slow creep removes 57 %" in lines["budget"]
    assert not models(d, Path("MODEL.json"))
    text, page = written(d, tmp_path)
    assert "Every effect that was tried" in headings(text)
    assert "Error on held-out samples, rms; the displacement's range is" in page.text
    assert "base model 50.0 nm extended model 8.50 nm noise 5.00 nm" in page.text
    assert diagnosis("cause_named").kept == ()


def test_causes_that_stand_in_for_each_other_are_told_together() -> None:
    """The first of them has no name; the probabilities of rivals are those of its step."""
    whole = Share("together", 0.97, (0.92, 1.0))
    each = (Share("hysteresis_memory", 0.04, (0.01, 0.07)), Share("slow_creep", 0.05, (0.0, 0.1)))
    d = diagnosis("ambiguous")
    lines = told(replace(d, budget=Budget(4e-8, 5e-9, whole, each, None, 7e-9, 0.04)))
    assert (
        "hysteresis memory and slow creep together remove 97 % (92 to 100 %); each can do most of"
        " what another does, so that beside the others hysteresis memory removes 4 % (1 to 7 %) and"
        " slow creep removes 5 % (0 to 10 %)"
    ) in lines["budget"]
    assert lines["rivals"].endswith("cannot distinguish it from offset drift")
    adds = Share("slow_creep", -0.1, (-0.2, 0.0))  # on held-out samples
    for none in ((adds,), (adds, adds)):
        lines = told(replace(d, budget=Budget(4e-8, 5e-9, adds, none, None, 4e-8, 0.2)))
        assert "together" not in lines["budget"]
    alone = replace(each[1], share=0.6)
    lines = told(replace(d, budget=Budget(4e-8, 5e-9, whole, (alone,), None, 7e-9, 0.04)))
    assert "together" not in lines["budget"]
    assert lines["rivals"].endswith("cannot distinguish it from offset drift (8 %)")


def test_of_many_rivals_five_are_named() -> None:
    d = diagnosis("ambiguous")
    many = tuple(f"effect_{k}" for k in range(9))
    lines = told(replace(d, causes=(replace(d.causes[0], cannot_be_told_from=many),)))
    assert lines["rivals"].endswith("effect 3, effect 4 or 4 more")
    assert "slow creep, effect 0, effect 1, effect 2, effect 3 or 5 more" in lines["verdict"]


def _names(figure: dict[str, object]) -> list[str]:
    rows = figure.get("data", [])
    assert isinstance(rows, list)
    return [row.get("name", "") for row in rows]


def test_the_signature_stands_beside_the_data(tmp_path: Path) -> None:
    text, page = written(diagnosis("cause_named"), tmp_path)
    assert "slow creep, as it looks and as the data look" in page.text
    assert psa.EFFECTS["slow_creep"].looks_like in page.text
    assert "Simulated on the stack P-885.51 with creep_gain = 0.0300" in page.text
    signature = next(f for f in figures(text) if _names(f) == ["samples", "binned means"])
    assert np.ptp(numbers(signature["data"][1]["y"])) > 50
    # the record has no holds, so another view of it is shown and said to be so
    assert "No record has holds to compare" in page.text
    text, page = written(diagnosis("unexplained"), tmp_path)
    assert "as it looks" not in page.text
    assert headings(text)[1] == "Every effect that was tried"


def test_parts_without_data_are_absent(tmp_path: Path) -> None:
    d = replace(diagnosis("cause_named"), misfit=(), remainder=(), noise=())
    text, page = written(d, tmp_path)
    assert WRONG not in headings(text)
    assert "Noise" not in headings(text)
    assert WHY in headings(text)
    assert "Where the error lies" not in page.text
    lines = told(d)
    assert "wrong" not in lines
    assert lines["noise"] == "5.00 nm rms"
    adequate = told(diagnosis("adequate"))
    assert {"extended", "cause", "rivals"}.isdisjoint(adequate)


def test_the_harmonic_split_is_a_table_and_the_hum_a_spectrum(tmp_path: Path) -> None:
    text, page = written(with_periodic(diagnosis("cause_named")), tmp_path)
    assert "Where the error lies among the drive's harmonics: loops" in page.text
    assert "loops: spectrum of the residual" in page.text
    assert any(_names(f) == ["base model", "extended model", "noise"] and "error_y"
               not in f["data"][0] for f in figures(text))  # fmt: skip
    _, _, before, after = periodic()
    table = split_table(before, after, counts=False)
    assert table is not None
    rows = {row[0]: row for row in table.rows}
    even = rows["even"]
    # 4e-8 cos^2 holds a harmonic of amplitude 2e-8
    assert float(even[1]) == pytest.approx(20.0 / np.sqrt(2.0), rel=0.1)
    assert even[3] == "0"
    assert drawn([before])[0][1] == "spectrum"


def test_counts_stay_counts(tmp_path: Path) -> None:
    _, page = written(with_periodic(diagnosis("cause_named"), counts=True), tmp_path)
    assert "base [counts rms]" in page.text


def test_the_terminal_tells_what_is_wrong_and_how_sure_the_cause_is() -> None:
    d = diagnosis("cause_named")
    lines = told(d)
    assert list(lines) == [
        "verdict", "what now", "then", "wrong", "records", "noise", "base", "extended", "cause",
        "rivals", "remains", "blind to", "next", "note",
    ]  # fmt: skip
    seen, share = d.misfit[0].sentences[1].split("; this view explains ")
    assert lines["wrong"] == f"{seen} ({share.rstrip('.')[:4]} of the excess)."
    assert lines["noise"] == f"5.00 nm rms, from {d.noise[0].source}"
    assert lines["cause"].startswith("slow creep (plant, 97 %): creep_gain = 0.0400")
    assert lines["rivals"].endswith("the next is offset drift (8 %)")
    assert "cannot distinguish it from offset drift (8 %)" in told(diagnosis("ambiguous"))["rivals"]
    assert lines["verdict"].endswith("the held-out error falls by 83 % (95 % interval 79 to 86 %).")
    assert lines["blind to"] == "current limit and sensor delay"


@pytest.mark.parametrize("width", range(60, 100, 3))
def test_a_percent_sign_stays_with_its_number(width: int) -> None:
    for line in psa.story(diagnosis("ambiguous"), width=width).splitlines():
        assert not line.strip().startswith("%")
        assert len(line) <= width


def test_blind_spots_are_named_the_furthest_first_and_five_at_most() -> None:
    names = list(psa.EFFECTS)[:7]
    # each is so many times its ordinary size away
    model = diagnosis("adequate").model
    spots = []
    for k, name in enumerate(names):
        extended = model.with_effect(psa.EFFECTS[name])
        gain = extended.parameter(psa.EFFECTS[name].gain or "")
        size = (k + 2) * gain.typical({**extended.values, gain.name: 0.0})
        spots.append(BlindSpot(name, size, gain.unit, "why"))
    d = replace(diagnosis("adequate"), blind_to=tuple(spots))
    assert [b.effect for b in blindest(d)] == names[::-1]
    plain = [n.replace("_", " ") for n in names[::-1]]
    assert told(d)["blind to"] == f"{', '.join(plain[:5])} and 2 more"


def test_probabilities_are_in_table_and_bars_where_a_cause_is_named(tmp_path: Path) -> None:
    table = candidate_table(diagnosis("cause_named"))
    assert table.head[-1] == "probability"
    assert [row[-1] for row in table.rows] == ["91 %", "8 %", "< 1 %"]
    assert len(candidate_table(diagnosis("unexplained")).head) == 3
    text, page = written(diagnosis("cause_named"), tmp_path)
    assert "1,250; named, 97 %" in text
    assert "the probability that it is the cause" in page.text
    assert "1,250; 93 %" in written(diagnosis("unexplained"), tmp_path)[0]
    assert probability_text(1.0) == "> 99 %"
