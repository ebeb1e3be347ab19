"""The benchmark `method`: the two pictures of docs/method.md, from one record with two causes."""

from collections.abc import Sequence
from functools import partial
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import psa_casadi as psa
from psa_casadi.diagnosis.pack import STACK, Task
from psa_casadi.diagnosis.search.best_first import best_first
from psa_casadi.diagnosis.search.hypothesis import Hypothesis
from psa_casadi.diagnosis.search.state import SearchState
from psa_casadi.identification.search import fit_base
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.records.split import divided
from psa_casadi.report.words.phrases import length_scale, plain
from tests.studies.benchmarks.records import hidden_record
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

#: What is hidden, how strongly, and the seed.
HIDDEN, RHO, SEED = ("slow_creep", "hysteresis_memory"), (1.0, 3.0), 141592
_SHOWN = 12
_BLUE, _GREY, _ORANGE = "#0072b2", "#9aa1a8", "#d55e00"


def run(progress: Progress, quick: bool) -> Outcome:
    """Search one record, and say where its error goes."""
    how: Any = {"visible": RHO, "more": HIDDEN[1:], "more_visible": RHO}
    _, record = hidden_record(HIDDEN[0], SEED, **how)
    if quick:
        record = record.slice(0, 3000)
    experiments = divided([record], [])
    base = fit_base(starting_model([record], None), experiments, progress=progress)
    there = {c.name for c in base.model.components}
    table = [e for e in psa.EFFECTS.values() if not e.inputs or record.temperature is not None]
    table = [e for e in table if set(e.needs) <= there]
    known = best_first(base, Task(tuple(table), STACK, progress=progress))
    d = psa.diagnose([record], progress=progress)
    rows = [
        {"hypothesis": _named(h), "score": f"{known.scale.score(h):.0f}",
         "may be the answer": "yes" if h.names in known.admissible else "no"}
        for h in _best(known)
    ]  # fmt: skip
    title = f"The search on a record with {' and '.join(map(plain, HIDDEN))}"
    return Outcome((TitledTable(title, rows),), partial(picture, known, d))


def picture(known: SearchState, d: psa.StackDiagnosis) -> Figure:
    """Return scores of the hypotheses, and the shares of the budget."""
    figure = Figure(figsize=(4.8, 7.2), layout="constrained")  # as wide as a phone
    above, below = figure.subplots(2, 1, height_ratios=(2.2, 1.0))
    _scores(above, known)
    _shares(below, d)
    return figure


def _scores(axes: Axes, known: SearchState) -> None:
    rows = _best(known)[::-1]
    colours = [
        _BLUE if h is known.answer else _ORANGE if h.names in known.admissible else _GREY
        for h in rows
    ]
    scores = [max(known.scale.score(h), 0.0) for h in rows]
    axes.barh([fill(_named(h), 26) for h in rows], scores, color=colours)
    axes.set_xlabel("score [ln units]")
    axes.set_title("blue: answer; orange: may be it; grey: fails", loc="right", fontsize=10)
    axes.tick_params(labelsize=9)


def _shares(axes: Axes, d: psa.StackDiagnosis) -> None:
    b = d.budget
    shares = {plain(s.what): s for s in b.causes}
    if b.unnamed is not None and d.patch is not None:
        shares[f"unnamed: {d.patch.kind}"] = b.unnamed
    values = np.array([s.share for s in shares.values()])
    ends = np.clip([s.interval for s in shares.values()], 0.0, 1.0)
    reach = 100.0 * np.abs(ends.T - values)
    axes.barh(list(shares), 100.0 * values, color=_BLUE, xerr=reach, capsize=4)
    left = 100.0 * (b.remains_rms_m / max(b.excess_rms_m, 1e-300)) ** 2
    axes.barh(["remains"], [left], color=_GREY)
    axes.invert_yaxis()
    scale = length_scale(b.excess_rms_m)
    axes.set_xlabel("share of the excess [%]")
    title = f"Of {scale.text(b.excess_rms_m)} above the noise of {scale.text(b.noise_rms_m)}"
    axes.set_title(title, loc="right", fontsize=10)
    axes.tick_params(labelsize=9)


def _best(known: SearchState) -> Sequence[Hypothesis]:
    return sorted(known.hypotheses.values(), key=lambda h: -known.scale.score(h))[:_SHOWN]


def _named(h: Hypothesis) -> str:
    return " + ".join(plain(c.name) for c in h.causes) or "base"
