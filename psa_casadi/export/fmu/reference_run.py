"""A run inside the FMU to try an importer on: inputs, parameters and the outputs to expect.

The files lie in extra/org.fmi-standard.fmi-ls-ref/ of FMI 2 and FMI 3 archives. On this run is
measured how short a communication step must be where an importer holds the inputs over it. A
held signal is late by half a step h on average: an output that moves at the rate dy/dt errs by
h/2 |dy/dt|. So the step for an error of a share e of the range R follows from the signal alone,

    h = 2 e R / max |dy/dt|,  for a sine of frequency f over the whole range  h = 2 e / (pi f),

as long as h is short against the dynamics of the model: lags, resonances, the slope of a loop.

Sources: FMI Layered Standard References (FMI-LS-REF) 1.0.0-beta.1 and the Experiments Format of the
Modelica Association; Astrom and Wittenmark 1997, Computer-Controlled Systems (a hold delays by half
a period).
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from psa_casadi.common.units import FloatArray
from psa_casadi.export.common.markup import number, time_scale, xml_text
from psa_casadi.export.common.parameter_sets import parameter_set
from psa_casadi.export.common.templates import filled
from psa_casadi.model.compose import Model
from psa_casadi.model.variables import nominal_value
from psa_casadi.simulation.stepper import run

FOLDER = "extra/org.fmi-standard.fmi-ls-ref"
NOTES = "documentation/fmi-ls-ref.txt"
INPUTS, OUTPUTS, PARAMETERS, EXPERIMENTS = "in.csv", "ref.csv", "parameters.ssv", "smoke_test.exp"
_NAMES = {"inputs": INPUTS, "outputs": OUTPUTS, "parameters": PARAMETERS}

#: Relative tolerance that the experiment asks for, and the one the outputs were computed to.
TOLERANCE = 1e-6
OWN_TOLERANCE = 1e-12
#: Knots of a test signal: six segments from 0 up to 1.
SHAPE = (0.0, 0.8, 0.3, 1.0, 0.1, 0.6, 0.6)
_STEPS_PER_SEGMENT = 100
_DIGITS = 7

#: MIME type, role and meaning of a file in the archive, for the manifest.
Related = tuple[str, str, str]
#: MIME types of the files.
CSV, SSV, EXP = "text/csv", "application/x-ssp-parameter-set", "application/x-ma-hs-experiments"


def reference_entries(model: Model, more: Mapping[str, Related]) -> dict[str, bytes]:
    """Return the files of the reference run by their place in the archive.

    The manifest lists the files `more` too, which it does not make. Raises SimulationError if the
    model cannot be simulated with its values.
    """
    times, inputs = reference_inputs(model)
    start = np.array([s.start for s in model.structure.states])
    outputs = rounded(run(model, times, inputs, start, rtol=OWN_TOLERANCE).y)
    meaning = f"straight segments of every input of {model.name}"
    files = {"Parameters": PARAMETERS, "Stimuli": INPUTS, "References": OUTPUTS}
    texts = {
        INPUTS: csv_table(("time", *model.input_names), times, inputs),
        OUTPUTS: csv_table(("time", *model.output_names), times, outputs),
        PARAMETERS: parameter_set(model),
        EXPERIMENTS: experiments("smoke test", times, [("segments", meaning, files)]),
        "fmi-ls-manifest.xml": _manifest(more),
    }
    notes = filled(
        "fmi-ls-ref.txt", name=model.name, segment=segment(model), stop=times[-1], step=times[1],
        own=OWN_TOLERANCE, digits=_DIGITS, **_NAMES,
    )  # fmt: skip
    entries = {f"{FOLDER}/{name}": text.encode("utf-8") for name, text in texts.items()}
    return {**entries, NOTES: notes.encode("utf-8")}


def segment(model: Model) -> float:
    """Return the length of a segment [s]: 10 ms, or the multiple of it that lets it settle."""
    return 1e-2 * max(1, math.ceil(time_scale(model) / 1e-2))


def reference_inputs(model: Model) -> tuple[FloatArray, FloatArray]:
    """Return times (n,) and inputs (n, nu): from start to start + nominal, each shape shifted.

    A temperature moves by a tenth of its nominal.
    """
    count = _STEPS_PER_SEGMENT * (len(SHAPE) - 1)
    step = segment(model) / _STEPS_PER_SEGMENT
    times = np.array([round(k * step, 12) for k in range(count + 1)])
    places = np.arange(count + 1) / _STEPS_PER_SEGMENT
    columns = []
    for i, declared in enumerate(model.structure.inputs):
        shape = shifted(i)
        size = nominal_value(declared.nominal, model.values) * (0.1 if declared.start else 1.0)
        columns.append(declared.start + size * np.interp(places, range(len(SHAPE)), shape))
    return times, rounded(np.array(columns).T.reshape(count + 1, -1))


def shifted(place: int) -> FloatArray:
    """Return the knots of a test signal for the input at a place: `SHAPE`, shifted."""
    return np.concatenate([SHAPE[:1], np.roll(SHAPE[1:], 2 * place)])


def rounded(columns: FloatArray) -> FloatArray:
    """Return columns (n, k) with `_DIGITS` digits of each one's largest value.

    Digits below that differ from machine to machine.
    """
    peaks = np.max(np.abs(columns), axis=0, initial=0.0)
    places = [_DIGITS - 1 - math.floor(math.log10(p)) if p > 0.0 else 0 for p in peaks]
    rows = [[round(float(v), d) + 0.0 for v, d in zip(r, places, strict=True)] for r in columns]
    return np.array(rows).reshape(columns.shape)


def csv_table(names: Sequence[str], times: FloatArray, columns: FloatArray) -> str:
    """Return a CSV table with a header."""
    rows = [",".join(names)]
    for time, values in zip(times, columns, strict=True):
        rows.append(",".join(f"{v:.12g}" for v in (time, *values)))
    return "\n".join([*rows, ""])


def experiments(
    name: str, times: FloatArray, listed: Iterable[tuple[str, str, Mapping[str, str]]]
) -> str:
    """Return a file of experiments over the same times (n,) [s].

    Each has a name, a meaning, and files by what they are: "Parameters", "Stimuli" and
    "References", in this order.
    """
    common = {
        "startTime": number(times[0]),
        "stopTime": number(times[-1]),
        "tolerance": number(TOLERANCE),
        "stepSize": number(times[1] - times[0]),
    }
    return xml_text("experiments.xml", name=name, listed=list(listed), common=common)


def _manifest(more: Mapping[str, Related]) -> str:
    """Return fmi-ls-manifest.xml, which lists the files: their kind, role and meaning."""
    listed = []
    for place, (kind, role, meaning) in more.items():
        inside = place.startswith(f"{FOLDER}/")
        source = place.removeprefix(f"{FOLDER}/") if inside else f"../../{place}"
        listed.append({"type": kind, "source": source, "role": role, "description": meaning})
    return xml_text("fmi-ls-manifest.xml", more=listed, notes=NOTES, run=EXPERIMENTS, **_NAMES)


#: Error that the step must meet, over the range of the output.
SHARE = 1e-3
#: Steps in a period of a sine over the whole range: pi / (2 SHARE), and a quarter more for a loop.
STEPS_PER_PERIOD = 2000
_FIRST, _MOST = 4, 64
_HELD_TOLERANCE = 1e-6


@dataclass(frozen=True)
class HeldStep:
    """The step [s] with which an output's error on the reference run is `error` of its range.

    It is the longest one that divides the rows of the run and keeps the error within `SHARE`, or
    the shortest one tried where none does. `rate` is the steepest motion in ranges per second.
    """

    output: str
    step: float
    error: float
    rate: float


def held_step(model: Model) -> HeldStep | None:
    """Return the step for the displacement, or for the first output of a model that has none.

    None if the model has no input or no output, or the output does not move.
    """
    if not (model.input_names and model.output_names):
        return None
    output = "displacement" if "displacement" in model.output_names else model.output_names[0]
    column = model.output_names.index(output)
    times, inputs = reference_inputs(model)
    start = np.array([s.start for s in model.structure.states])
    truth = run(model, times, inputs, start, rtol=_HELD_TOLERANCE).y[:, column]
    span = float(np.ptp(truth))
    if span == 0.0:
        return None
    rate = float(np.max(np.abs(np.diff(truth)))) / float(times[1]) / span

    def error(parts: int) -> float:
        grid = np.linspace(times[0], times[-1], parts * (len(times) - 1) + 1)
        fine = np.array([np.interp(grid, times, c) for c in inputs.T]).T
        result = run(model, grid, fine, start, rtol=_HELD_TOLERANCE, hold="zero").y[::parts, column]
        return float(np.max(np.abs(result - truth))) / span

    parts, worst = _FIRST, error(_FIRST)
    wanted = min(_MOST, max(1, math.ceil(parts * worst / SHARE)))
    while wanted != parts:
        parts, worst = wanted, error(wanted)
        if worst > SHARE and parts < _MOST:
            wanted = min(_MOST, parts + max(1, parts // 8))
    return HeldStep(output, float(times[1]) / parts, worst, rate)
