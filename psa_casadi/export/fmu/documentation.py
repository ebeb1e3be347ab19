"""documentation/index.html: what is inside the FMU, in words, from the model's declarations."""

import html
import math
import re
from collections.abc import Mapping, Sequence

import numpy as np

from psa_casadi.export.common.icon import ICONS, drawing_of, svg
from psa_casadi.export.common.markup import (
    force_scale,
    generation_tool,
    page,
    table_of,
    time_scale,
    what_it_is,
)
from psa_casadi.export.common.publication import LICENSE_ENTRY
from psa_casadi.export.common.variable_table import Variable, starts_at_voltage, variable_table
from psa_casadi.export.fmu.reference_run import FOLDER, NOTES, SHARE, STEPS_PER_PERIOD, HeldStep
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import STACKS, Figure
from psa_casadi.units import convert

ENTRY = "documentation/index.html"

_USE = """\
Co-simulation integrates with an error-controlled, L-stable method to the tolerance that the
importer gives (1e-6 if it gives none). Model exchange leaves that to the importer; the event
indicators say where derivatives have a kink, which a solver with loose tolerances may ignore.
Parameters are tunable: they can be set between steps. Directional derivatives with respect to
states, inputs and parameters are exact."""


_SAMPLING = """\
The sampled states change at the instants k {period}, k a whole number, on the absolute time axis
(now every {value}), and are held in between. In model exchange the instants are time events. In
co-simulation the steps of the solver end at them, wherever the communication points are; an instant
that is a communication point belongs to the step that starts there: outputs read at that point
already follow from the inputs set there, which may be set again before the step."""


_SETTLED = """ An export with --start-voltage V --history V1,V2 starts settled at a voltage, with
the memory that the voltages before it have left."""
_STARTING = """An input that is set to another value before the first step is a step at the first
instant: the states do not follow it into a new rest. `psa simulate` starts as this FMU does with
the same --start-voltage and --history; without them it starts settled at its first voltage."""
_SET_START = """ The parameter start_voltage does that: set to another value than {voltage:.6g} V
before the initialization ends, it lets the voltage and all states begin as after a rise from 0 V to
it within 1 s, settled but for what remembers the rise (hysteresis, creep), with the parameters and
other inputs of then. A state or the voltage that was set itself keeps what it was set to, in
whatever order. The start values of the tables, with the history behind them, are those of
{voltage:.6g} V."""
#: Movement within the time that the model needs to settle, over the nominal size, that is none.
_AT_REST = 1e-6


_STEP = """\
An importer that holds the inputs over a communication step, as FMI 3.0 has it, and FMI 2.0 where no
input derivatives are set, gives the model a signal that is late by half a step: while an output
moves at a rate, it errs by half a step times that rate. On the reference run, where '{output}'
moves at up to {rate:.3g} of its range per second, a step of {step:.3g} s keeps the error to
{error:.2g} % of its range. For a sine over the whole range take {steps} steps a period, at f in Hz
a step of {period:g} s / f, for an error of {share:g} %; the error grows as the step does. With
input derivatives (FMI 2.0) it is of second order, and steps may be as long as the signal is
straight."""


_INPUTS = """\
Over a communication step each input moves at the rate that the importer gave it for the step (FMI
2.0: fmi2SetRealInputDerivatives); without one it is held, and a smooth signal arrives half a step
late. FMI 3.0 has no such rates. With the parameter input_line = 1, which can be set
until the initialization ends, an input goes on along the line
through the last two values it was given (over a step longer than the last one, by as much as over
that). Steps of 1/(200 f) then err by 0.1 % of the range of a sine of frequency f, and the error
falls with the square of the step. What is left is that
the signal bends: at the end of a step the line is off by the square of the step times the second
derivative, most where the signal turns, and hysteresis remembers that it went too far. The first
step is held, and so is the one after event mode. Values before and after a jump have no line in
common: enter event mode at a jump, or leave the option at 0. Between 0 and 1 that share of the
slope counts. Model exchange knows no steps and ignores the option."""


def documentation(
    model: Model,
    *,
    reference_run: bool = True,
    step: HeldStep | None = None,
    more: Mapping[str, str] | None = None,
    use: str = _USE,
) -> str:
    """Return a page of its own, without any file beside it: equations, sources, tables.

    `reference_run` says whether the archive holds one, with its notes; `step` is the communication
    step that was measured on it. `more` are further files to name: what they are, by their place.
    `use` tells how the FMU integrates.
    Raises InputError for a character that HTML cannot carry.
    """
    table = variable_table(model)
    name = html.escape(model.name)
    drawing = svg(ICONS[drawing_of(model)]).partition("\n")[2].strip()
    scale = force_scale(model)
    parts = [
        f"<h1>{drawing}{name}</h1>",
        f"<p>{html.escape(what_it_is(model))}</p>",
        f'<p class="note">{html.escape(scale)}</p>' if scale else "",
        *(f"<p>{html.escape(note)}</p>" for note in model.provenance.notes),
        _publication(model),
        "<h2>Use</h2>",
        f"<p>{html.escape(use)}</p>",
        f"<p>{_INPUTS}</p>" if model.input_names else "",
        _sampling(model, table),
        _step(step),
        "<h2>Start</h2>",
        f"<p>{html.escape(_start(model))}</p>",
        *_interface(model, table),
        "<h2>Equations</h2>",
        equations(model),
        "<h2>Parameters</h2>",
        _parameters(model, table),
        "<h2>Files</h2>",
        _files(reference_run, more or {}),
        f"<p>Written by {html.escape(generation_tool())}.</p>",
    ]
    return page(model.name, parts, "The page on the model")


def _publication(model: Model) -> str:
    """Return author, version, copyright and licence, as far as the model states them."""
    said = (f"{name}: {text}" for name, text in model.publication.stated.items())
    line = "; ".join(html.escape(text) for text in said)
    return f"<p>{line}</p>" if line else ""


def _shown(value: float | None, variable: Variable, digits: int = 6) -> str:
    """Return a value in the unit it is best read in."""
    if value is None:
        return ""
    unit = variable.display_unit or variable.unit
    shown = f"{convert(value, variable.unit, unit):.{digits}g}"
    return shown if unit == "1" else f"{shown} {unit}"


def _sampling(model: Model, table: Sequence[Variable]) -> str:
    period = next((v for v in table if v.name == model.structure.period), None)
    if period is None:
        return ""
    return f"<p>{_SAMPLING.format(period=period.name, value=_shown(period.start, period))}</p>"


def _start(model: Model) -> str:
    """Say where an instance starts in which nothing was set, and whether it stays there."""
    s = model.structure
    voltage = next((i.start for i in s.inputs if i.name == "voltage"), None)
    held = "" if voltage is None else f" at {voltage:.6g} V"
    if not model.own_starts():
        where = f"It starts relaxed{held}: no state remembers anything."
        where += _SETTLED if voltage is not None else ""
    else:
        where = f"It starts{held} with the start values of the tables, which its model states."
    groups = [[v.start for v in group] for group in (s.states, s.inputs)]
    sampled = [[v.start for v in s.sampled]] if s.sampled else []
    rates = np.array(s.f(0.0, *groups, model.parameter_vector(), *sampled)[0]).ravel()
    spent = np.abs(rates) * time_scale(model) / model.state_nominals()
    moves = "stays there" if np.max(spent, initial=0.0) < _AT_REST else "moves from there"
    settling = _SET_START.format(voltage=voltage) if starts_at_voltage(model) else ""
    return f"{where} While its inputs keep their start values it {moves}. {_STARTING}{settling}"


def _start_values(model: Model) -> dict[str, float]:
    """Return the outputs at the start, by name."""
    s = model.structure
    groups = [[v.start for v in group] for group in (s.states, s.inputs)]
    sampled = [[v.start for v in s.sampled]] if s.sampled else []
    y = np.array(s.f(0.0, *groups, model.parameter_vector(), *sampled)[1]).ravel()
    return dict(zip(model.output_names, y.tolist(), strict=True))


def _step(step: HeldStep | None) -> str:
    if step is None:
        return ""
    text = _STEP.format(
        output=step.output, rate=step.rate, step=step.step, error=100.0 * step.error,
        steps=STEPS_PER_PERIOD, period=1.0 / STEPS_PER_PERIOD, share=100.0 * SHARE,
    )  # fmt: skip
    return f"<h2>Communication step</h2>\n<p>{html.escape(text)}</p>"


def _interface(model: Model, table: Sequence[Variable]) -> list[str]:
    kinds = (
        ("input", "Inputs"), ("output", "Outputs"), ("state", "States"),
        ("sampled", "Sampled states"),
    )  # fmt: skip
    parts = []
    outputs = _start_values(model)
    for kind, title in kinds:
        chosen = [v for v in table if v.kind == kind]
        rows = [
            (v.name, v.unit, _shown(v.nominal, v, 3), _shown(outputs.get(v.name, v.start), v),
             v.description)
            for v in chosen
        ]  # fmt: skip
        if rows:
            heads = ("name", "unit", "usual size", "at the start", "")
            parts += [f"<h2>{title}</h2>", table_of(heads, rows, (2, 3))]
    indicators = [(v.name, v.description) for v in table if v.kind == "indicator"]
    if indicators:
        parts += ["<h2>Event indicators</h2>", table_of(("name", ""), indicators)]
    return parts


def equations(model: Model) -> str:
    """Return the table of a model's components, with their equations and sources."""
    rows = [(c.name, c.description, c.equation_text, c.source) for c in model.components]
    return table_of(("component", "what it is", "equation", "source"), rows)


def _figures(model: Model) -> dict[str, Figure]:
    """Return the sources of the values that are still those of the named stack."""
    for stack in STACKS.values():
        if re.sub(r"\W", "_", stack.name) == model.name:
            values = model.values
            return {n: f for n, f in stack.values.items() if values.get(n) == f.value}
    return {}


def _parameters(model: Model, table: Sequence[Variable]) -> str:
    intervals, figures = model.provenance.intervals, _figures(model)
    rows = []
    for v in (v for v in table if v.kind == "parameter"):
        found = intervals.get(v.name)
        interval = f"{_shown(found.low, v)} to {_shown(found.high, v)}" if found else ""
        low, high = (_shown(b, v) if math.isfinite(b) else "" for b in v.bounds or ())
        figure = figures.get(v.name)
        source = ("assumed: " if figure.assumed else "") + figure.source if figure else ""
        name_and_value = (v.name, _shown(v.start, v), interval)
        rows.append((*name_and_value, f"{low} to {high}", v.description, source))
    heads = ("name", "value", "95 % interval", "allowed", "meaning", "source of the value")
    kept = [i for i, _ in enumerate(heads) if i < 2 or any(r[i] for r in rows)]
    chosen = [[r[i] for i in kept] for r in rows]
    return table_of([heads[i] for i in kept], chosen, (1,))


def _files(reference_run: bool, more: Mapping[str, str]) -> str:
    entries = [
        ("sources/README.txt", "how to compile the sources: one line, no other library"),
        (LICENSE_ENTRY, "the terms of the model, and the notices of the C code"),
    ]
    if reference_run:
        entries += [
            (NOTES, "a run to try an importer on, with the outputs to expect"),
            (f"{FOLDER}/parameters.ssv", "the parameter values as a parameter set (SSP 1.0)"),
        ]
    entries += more.items()
    items = (
        f'<li><a href="../{place}"><code>{place}</code></a>: {meaning}</li>'
        for place, meaning in entries
    )
    return "<ul>\n" + "\n".join(items) + "\n</ul>"
