"""Models that are no stacks: what is named of hidden causes, errors before and after, a page."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

import psa_casadi as psa
from psa_casadi.records.signals import Signals
from psa_casadi.report.words.own_words import with_its_unit
from psa_casadi.report.words.phrases import number, plain
from psa_casadi.report.words.tables import Table
from tests.any_model import own_plants as plants
from tests.any_model.own_models import motor, oscillator, pair, tanks
from tests.report.browser import DARK, PHONE, find_browser, on_a_phone
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

_CASES: dict[str, tuple[Callable[[], psa.Model], Callable[[], Signals]]] = {
    "dry friction of a motor": (motor, lambda: plants.motor(1)),
    "a motor, nothing hidden": (motor, lambda: plants.motor(2, friction=0.0)),
    "Bouc-Wen hysteresis": (oscillator, lambda: plants.bouc_wen(1)),
    "a bent level sensor": (tanks, lambda: plants.tanks(3, "sensor")),
    "two oscillators, nothing hidden": (pair, lambda: plants.pair(4)),
    "a stiffness that breathes": (oscillator, lambda: plants.breathing(4)),
}
_WIDTH, _HEIGHT, _TALL = 900, 1000, 940


def run(progress: Progress, quick: bool) -> Outcome:
    """Return what is found of every hidden cause, and the picture of the first one's page."""
    rows, first = [], None
    for name in list(_CASES)[: 1 if quick else None]:
        progress(name)
        model, record = _CASES[name][0](), _CASES[name][1]()
        began = time.process_time()
        d = psa.diagnose(model, record)
        spent = time.process_time() - began
        first = first or d
        named = ", ".join(plain(c.effect) for c in d.causes)
        rows += [
            (name, d.verdict, named, e.output, *_errors(e.unit, e.base, e.extended, e.noise),
             number(spent, 2))
            for e in d.errors
        ]  # fmt: skip
    head = ("hidden", "verdict", "named", "output", "base, held-out rms", "extended", "noise")
    found = Table((*head, "processor time [s]"), tuple(rows))
    return Outcome(
        (TitledTable("Hidden causes of models that are no stacks", found),),
        None if first is None else lambda: picture(first),
    )


def _errors(unit: str, *values: float) -> tuple[str, ...]:
    return tuple(with_its_unit(v, unit) for v in values)


def picture(d: psa.OdeDiagnosis) -> Figure:
    """Return pictures of the page of a diagnosis: on a desk, and on a phone at night."""
    drawn, (desk, phone) = plt.subplots(
        1, 2, figsize=(7.4, 5.4), layout="constrained", width_ratios=(_WIDTH / _HEIGHT, 0.39)
    )
    with tempfile.TemporaryDirectory() as folder:
        browser, page = find_browser(Path(folder)), Path(folder) / "page.html"
        d.report(page)
        desk.imshow(plt.imread(browser.screenshot(page, _WIDTH, _HEIGHT)))
        shot = browser.screenshot(on_a_phone(page, _TALL), 500, _TALL, DARK)
        phone.imshow(plt.imread(shot)[:, :PHONE])
    for axes in (desk, phone):
        axes.set_axis_off()
    return drawn
