"""Every text and curve of the pages of results, against the golden files in `told`.

`python -m tests.report.test_told` accepts the texts as they are now: look at the difference in git.
"""

import difflib
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.diagnosis.corrections import Estimate
from psa_casadi.diagnosis.held_out import Errors, Share, StackBudget
from psa_casadi.diagnosis.result import BlindSpot, Cause, Verdict
from psa_casadi.identification.advice import Advice
from psa_casadi.identification.determinacy import Combination
from psa_casadi.identification.identify import StackIdentification
from psa_casadi.report.words.text import identification_text
from tests.report.html_page import figures, numbers, written
from tests.report.report_cases import VERDICTS, diagnosis, identification, with_periodic

FOLDER = Path(__file__).parent / "told"
Result = psa.StackDiagnosis | StackIdentification


def shares(*each: float, together: float = 0.97) -> StackBudget:
    """Return an error budget of slow creep, hysteresis memory and hum, in this order."""
    names = ("slow_creep", "hysteresis_memory", "mains_hum")
    rows = tuple(Share(n, s, (s - 0.05, s + 0.05)) for n, s in zip(names, each, strict=False))
    whole = Share("together", together, (0.92, 1.0)) if len(rows) > 1 else rows[0]
    return StackBudget(whole, rows, None, 4e-8, 5e-9, 7e-9, 0.04)


def with_memory() -> psa.StackDiagnosis:
    """Return a diagnosis whose second cause has a rival, and weights."""
    d, memory = diagnosis("partly_explained"), psa.EFFECTS["hysteresis_memory"]
    size = Estimate(0.1, "1", (0.08, 0.12))
    values = {"memory_threshold": size} | dict.fromkeys(memory.linear, size)
    second = Cause(memory.name, "plant", 0.6, values, ("backlash",), 0.2)
    return replace(d, causes=(*d.causes, second), model=d.model.with_effect(memory))


def blind() -> psa.StackDiagnosis:
    """Return a diagnosis with seven blind spots, each further away than the one before."""
    d, spots = diagnosis("adequate"), []
    for k, effect in enumerate(list(psa.EFFECTS.values())[:7]):
        extended = d.model.with_effect(effect)
        gain = extended.parameter(effect.gain or "")
        size = (k + 2) * gain.typical({**extended.values, gain.name: 0.0})
        spots.append(BlindSpot(effect.name, size, gain.unit, "why"))
    return replace(d, blind_to=tuple(spots))


def rival(*names: str) -> psa.StackDiagnosis:
    d = diagnosis("ambiguous")
    return replace(d, causes=(replace(d.causes[0], cannot_be_told_from=names),))


def graded() -> StackIdentification:
    """Return a fit whose parameters are known well, weakly, not at all, and only in pairs."""
    fitted = identification()
    model, determinacy = fitted.model, fitted.determinacy
    errors = {n: 0.01 * model.values[n] for n in ("k_L", "tau", "R_s", "c_P")}
    errors["tau"] *= 20.0
    errors["A"] = 0.3 * model.parameter("A").typical(model.values)
    matrix = np.eye(len(determinacy.names))
    for (a, b), r in {(0, 1): -0.97, (2, 3): 0.99, (0, 3): 0.94}.items():
        matrix[a, b] = matrix[b, a] = r
    known = replace(determinacy, undetermined=("R_s",), on_bound=("c_P",))
    known = replace(known, standard_errors=errors, correlations=matrix)
    return replace(fitted, determinacy=known)


def not_fitted() -> StackIdentification:
    empty: dict[str, Any] = dict.fromkeys(("covariance", "correlations"), np.zeros((0, 0)))
    empty |= dict.fromkeys(("names", "undetermined", "on_bound"), ())
    empty |= {"intervals": {}, "standard_errors": {}}
    return replace(identification(), determinacy=replace(identification().determinacy, **empty))


def wide(d: psa.StackDiagnosis) -> psa.StackDiagnosis:
    """Return a diagnosis whose base errs by micrometres."""
    return replace(
        d, errors=(replace(d.errors[0], base=2.5e-6, extended=5e-8),),
        base_errors=Errors(2e-6, 2.5e-6, 9e-6, 5.0),
        extended_errors=Errors(4e-8, 5e-8, 1e-7, 0.1),
    )  # fmt: skip


#: Results whose texts are kept in full.
WHOLE: dict[str, Callable[[], Result]] = {
    **{v: partial(diagnosis, v) for v in VERDICTS},
    "fit": lambda: replace(identification(), doubts=(), starts=(), combinations=(), advice=()),
}
Other = tuple[str, Callable[[], Result]]


def other(verdict: Verdict, **changes: Any) -> Other:
    """Return a verdict, and what makes a diagnosis of it that has other fields."""
    return verdict, lambda: replace(diagnosis(verdict), **changes)


#: Results whose golden file is the difference from one of those above.
OTHERWISE: dict[str, Other] = {
    "two records": ("cause_named", lambda: diagnosis("cause_named", ("rig_a", "rig_b"))),
    "a periodic voltage": ("cause_named", lambda: with_periodic(diagnosis("cause_named"))),
    "counts": ("cause_named", lambda: with_periodic(diagnosis("cause_named"), counts=True)),
    "one unit": ("cause_named", lambda: wide(diagnosis("cause_named"))),
    "no views": other("cause_named", misfit=(), remainder=(), noise=()),
    "kept without a name": (
        "unexplained",
        lambda: replace(
            diagnosis("cause_named"), verdict="unexplained", causes=(), budget=shares(0.57)
        ),
    ),
    "stand-ins": other("ambiguous", budget=shares(0.05, 0.04)),
    "adds error": other("ambiguous", budget=shares(-0.1)),
    "adds error twice": other("ambiguous", budget=shares(-0.1, -0.1, together=-0.1)),
    "many rivals": ("ambiguous", lambda: rival(*(f"effect_{k}" for k in range(9)))),
    "no rival": (
        "cause_named",
        lambda: replace(
            diagnosis("cause_named"), candidates=diagnosis("cause_named").candidates[:1]
        ),
    ),
    "a second cause": ("partly_explained", with_memory),
    "shares of several": (
        "partly_explained",
        lambda: replace(with_memory(), budget=shares(0.6, 0.3, together=0.9)),
    ),
    "blind spots": ("adequate", blind),
    "fit with doubts": (
        "fit",
        lambda: replace(
            identification(), doubts=("Tom & <Jerry> disagree.",),
            combinations=(Combination("group", ("k_L", "A")),),
            advice=(Advice("ringing", ("m_P",)),),
        ),
    ),
    "fit of graded parameters": ("fit", graded),
    "fit of nothing": ("fit", not_fitted),
}  # fmt: skip


def curves(text: str) -> Iterator[str]:
    """Yield what each figure of a page shows: its axes, and every trace with its range."""
    for figure in figures(text):
        axes = {k: a for k, a in figure.get("layout", {}).items() if k[1:].startswith("axis")}
        titles = [a["title"]["text"] for a in axes.values() if a.get("title", {}).get("text")]
        yield f"figure: {'; '.join(titles)}"
        for trace in figure.get("data", []):
            spread = ", with their spread" if "error_y" in trace else ""
            yield f"  {trace.get('name', '')} ({trace['type']}): {_range(trace)}{spread}"


def _range(trace: dict[str, Any]) -> str:
    if isinstance(trace.get("text"), list):
        return "; ".join(map(str, trace["text"]))
    values = trace.get("y", trace.get("z"))
    if isinstance(values, list) and values and isinstance(values[0], str):
        return "; ".join(values)
    result = numbers(values)
    if not np.isfinite(result).any():
        return f"{result.size} points"
    return f"{result.size} points from {np.nanmin(result):.3g} to {np.nanmax(result):.3g}"


def lines_of(result: Result) -> list[str]:
    """Return the lines of a result's story and page, which loads nothing, and its curves."""
    if isinstance(result, StackIdentification):
        lines = identification_text(result).splitlines()
    else:
        lines = [repr(result), *psa.story(result, origin="synthetic").splitlines()]
        assert max(map(len, lines[1:])) <= 100
    with TemporaryDirectory() as folder:
        text, page = written(result, Path(folder), origin="synthetic")
    assert page.targets <= page.names
    assert not re.search(r"@import|url\(", text.split("<script>", 1)[0])
    assert len(text) < 3e6
    lines += [" ".join(words.split()) for words in page.words]
    lines += re.findall(r'style="([^"]*)"', text.partition("<h2")[0])
    kept = [x for x in (*lines, *curves(text)) if x.strip() and "Written " not in x]
    return [re.sub(r"\b[0-9a-f]{64}\b", "SHA-256", line.rstrip()) for line in kept]


def place(name: str) -> Path:
    """Return the file of what was accepted for a case."""
    return FOLDER / f"{name.replace(' ', '_')}.txt"


@cache
def lines_now(name: str) -> list[str]:
    """Return the lines of a case, or how they differ from those of another one."""
    if name in WHOLE:
        return lines_of(WHOLE[name]())
    like, make = OTHERWISE[name]
    changes = difflib.unified_diff(lines_now(like), lines_of(make()), n=0, lineterm="")
    return [line for line in list(changes)[2:] if not line.startswith("@@")]


_NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?(?:e-?\d+)?")


def is_same(line: str, accepted: str) -> bool:
    """Whether lines have equal words, and numbers that differ by at most 1 in the last digit."""
    if _NUMBER.sub("#", line) != _NUMBER.sub("#", accepted):
        return False
    pairs = zip(_NUMBER.findall(line), _NUMBER.findall(accepted), strict=True)
    return all(a == b or abs(_value(a) - _value(b)) <= 1.01 * _last_digit(b) for a, b in pairs)


def _value(number: str) -> float:
    return float(number.replace(",", ""))


def _last_digit(number: str) -> float:
    digits, _, power = number.replace(",", "").partition("e")
    return float(10.0 ** (int(power or 0) - len(digits.partition(".")[2])))


@pytest.mark.parametrize("name", [*WHOLE, *OTHERWISE])
def test_texts_are_as_they_were_accepted(name: str) -> None:
    accepted = place(name).read_text("utf-8").splitlines()
    texts = lines_now(name)
    if len(texts) != len(accepted) or not all(map(is_same, texts, accepted)):
        change = "\n".join(difflib.unified_diff(accepted, texts, "accepted", "now", lineterm=""))
        pytest.fail(f"{change}\nIf this is meant: python -m tests.report.test_told")


def test_other_words_and_numbers_are_noticed() -> None:
    assert is_same("falls by 84 % (0.0512 um)", "falls by 83 % (0.0511 um)")
    assert not is_same("falls by 85 %", "falls by 83 %")
    assert not is_same("1.00e-3 N", "1.00e-4 N")
    assert not is_same("slow creep", "slow_creep")


if __name__ == "__main__":
    for case in (*WHOLE, *OTHERWISE):
        place(case).write_text("\n".join(lines_now(case)) + "\n", encoding="utf-8")
