"""The data set as a folder: records, base model, possible causes, the truth apart, the score."""

import hashlib
import io
import json
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from psa_casadi.component import Component
from psa_casadi.effects import EFFECTS
from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.modelica.package import export_modelica
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import stack_model
from psa_casadi.variables import Parameter
from tests.studies.benchmarks.hidden_cases import (
    NOISES,
    ORDINARY,
    REACHED,
    STRONG,
    WEAK,
    Case,
    how_made,
)
from tests.studies.plants.again import play_again
from tests.studies.plants.base import simulate_base
from tests.studies.plants.excitations import draw_excitation
from tests.studies.plants.hide import SEARCH
from tests.studies.plants.make import Truth, make_record
from tests.studies.plants.sensor import room, temperature
from tests.studies.plants.stack import FloatArray
from tests.studies.plants.table import FOREIGN, KNOWN, called
from tests.studies.plants.visibility import FREE, base_columns

#: Shares of the kinds of cases; what is left over goes to the first.
SHARES = {"known": 0.5, "clean": 0.2, "foreign": 0.1, "weak": 0.1, "two": 0.1}
#: A lag of the sensor is taken over by the base's own: no gain makes it visible.
ASKED = tuple(name for name in KNOWN if name != "sensor_lag")
#: Drawn relative to their record (`in_terms_of`), which knows the first effect only.
_FIRST_ONLY = ("offset_drift", "self_heating", "voltage_saturation")
#: Draws of one effect before the next one takes its place.
_ATTEMPTS = 3


@dataclass(frozen=True)
class Half:
    """One record of a device: (N,) times [s], voltage [V], displacement read and without noise [m],
    temperature [degC]; the fitted base [m] and what moves it (N, 11), see `base_columns`.
    """

    times: FloatArray
    voltage: FloatArray
    read: FloatArray
    clean: FloatArray
    temperature: FloatArray
    base: FloatArray
    columns: FloatArray


@dataclass(frozen=True)
class Made:
    """A case with its record and the held-out one; `rho` is the smallest that was reached."""

    case: Case
    rho: float
    gains: dict[str, float]
    record: Half
    holdout: Half


def cases_of(seed: int, count: int) -> list[Case]:
    """Return so many cases in the order of the data set, which tells nothing of their kinds."""
    rng = np.random.default_rng(seed)
    numbers = {kind: round(share * count) for kind, share in SHARES.items()}
    numbers["known"] += count - sum(numbers.values())
    known, foreign = (_in_turn(rng, names, count) for names in (ASKED, FOREIGN))
    weak, pairs = _in_turn(rng, ASKED, count), [_pair(rng) for _ in range(numbers["two"])]
    seeds = iter(np.random.SeedSequence(seed).generate_state(count).tolist())
    cases = [
        Case("known", known[k], next(seeds), ORDINARY, noise=NOISES[k % len(NOISES)])
        for k in range(numbers["known"])
    ]
    cases += [
        Case("clean", None, next(seeds), noise=NOISES[k % 2]) for k in range(numbers["clean"])
    ]
    cases += [Case("foreign", foreign[k], next(seeds)) for k in range(numbers["foreign"])]
    cases += [Case("weak", weak[k], next(seeds), WEAK) for k in range(numbers["weak"])]
    cases += [Case("two", one, next(seeds), STRONG, (more,)) for one, more in pairs]
    return [cases[k] for k in rng.permutation(count)]


def _in_turn(rng: np.random.Generator, names: tuple[str, ...], count: int) -> list[str]:
    turns = -(-count // len(names))
    return [names[k] for _ in range(turns) for k in rng.permutation(len(names))][:count]


def _pair(rng: np.random.Generator) -> tuple[str, str]:
    more = str(rng.choice([name for name in ASKED if name not in _FIRST_ONLY]))
    return str(rng.choice([name for name in ASKED if name != more])), more


def make(case: Case, folder: Path) -> Made:
    """Make the two records of a case; a folder takes what the plants write on the way.

    Where a device does not show what is hidden as well as was asked for, another one is drawn, and
    after three of them the next effect is taken.
    """
    seeds = np.random.SeedSequence(case.seed).generate_state(4 * _ATTEMPTS).tolist()
    for tried, seed in enumerate(seeds):
        drawn = replace(case, effect=_later(case.effect, tried // _ATTEMPTS), seed=seed)
        if drawn.effect in drawn.more:
            continue
        truth = _device(drawn, folder)
        rho = min([truth.visible, *(h.visible for h in truth.more)])
        if drawn.effect is None or rho >= REACHED * drawn.rho[0]:
            return _made(drawn, truth, rho, folder)
    raise RuntimeError(f"No device drawn from seed {case.seed} shows {case.hidden} well enough.")


def _later(effect: str | None, steps: int) -> str | None:
    if effect is None or steps == 0:
        return effect
    names = FOREIGN if effect in FOREIGN else ASKED
    return names[(names.index(effect) + steps) % len(names)]


def _device(case: Case, folder: Path) -> Truth:
    return make_record(case.effect, case.seed, folder / "record.csv", **how_made(case))


def _made(case: Case, truth: Truth, rho: float, folder: Path) -> Made:
    rng = np.random.default_rng([case.seed, 3])
    walk = _thermometer(truth, rng)
    played = draw_excitation(rng, truth.excitation, truth.stack.u_rated)
    clean = play_again(truth, case.seed + 1, folder / "holdout.csv", played)
    first = truth.times, truth.voltage, _read(folder / "record.csv"), truth.displacement
    record = _half(truth, first, truth.base_displacement, walk, None)
    base = simulate_base(truth.stack, *played).displacement
    second = *played, _read(folder / "holdout.csv"), clean
    fitted = _fitted(record, truth.base_displacement)
    gains = {called(name): gain for name, _, gain in truth.hidden}
    return Made(case, rho, gains, record, _half(truth, second, base, walk, fitted))


def _thermometer(truth: Truth, rng: np.random.Generator) -> dict[str, float]:
    """What the room does: every record has a thermometer, and not only where it is the cause."""
    for name, parameters, _ in truth.hidden:
        if name == "temperature":
            return dict(parameters)
    return temperature.draw(rng, simulate_base(truth.stack, truth.times, truth.voltage, SEARCH))


def _read(path: Path) -> FloatArray:
    """Return what the sensor said, (N,) [m], nan where nothing."""
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    return 1e-6 * np.asarray(table[:, 2], dtype=np.float64)


def _half(
    truth: Truth,
    signals: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    base: FloatArray,
    walk: dict[str, float],
    fitted: FloatArray | None,
) -> Half:
    """Return a record with its base, which is fitted to it unless the fit is given."""
    times, voltage, read, clean = signals
    columns = base_columns(truth.stack, times, voltage, base)
    bare = Half(times, voltage, read, clean, room(times, walk), base, columns)
    moves = _fitted(bare, base) if fitted is None else fitted
    return replace(bare, base=base + columns @ moves)


def _fitted(half: Half, base: FloatArray) -> FloatArray:
    """Return the Gauss-Newton step of the base from the device's own values, (11,)."""
    told = np.isfinite(half.read)
    size = np.linalg.norm(half.columns, axis=0)
    found = np.linalg.lstsq((half.columns / size)[told], (half.read - base)[told], rcond=1e-8)[0]
    return np.asarray(found / size, dtype=np.float64)


#: Letters of the equations beside the parameters.
LETTERS = {
    "v": "voltage that is applied, the column `voltage` [V]",
    "u": "voltage on the stack [V]",
    "i": "current of the drive [A]",
    "f_L, f_H": "linear and hysteresis force [N]",
    "f_out": "force behind the lag [N]",
    "f_load": "external force, 0 in all records [N]",
    "y, x": "displacement of the wafers, of the end [m]",
    "x_m": "displacement as the sensor says it, the column `displacement` [m]",
    "'": "derivative by time",
}


def base_content(model: Model) -> dict[str, Any]:
    """Return the base model: equations, letters, parameters with an example's values."""
    return {
        "equations": [
            {"part": c.name, "equation": c.equation_text, "source": c.source}
            for c in model.components
        ],
        "letters": LETTERS,
        "parameters": [_parameter(p) for c in model.components for p in c.parameters],
        "values": "Every case has other values, which are not told. Those here are an example's.",
        "start": "Every record begins at rest: all states are 0.",
    }


def causes_content() -> list[dict[str, Any]]:
    """Return the possible causes: definition in words and as equation, parameters, source."""
    return [_cause(e) for e in EFFECTS.values()]


def _cause(effect: Component) -> dict[str, Any]:
    return {
        "name": effect.name,
        "sits_in": effect.belongs_to,
        "definition": effect.description,
        "equation": effect.equation_text,
        "what_it_looks_like": effect.looks_like,
        "removed_at_zero": effect.gain,
        "parameters": [_parameter(p) for p in effect.parameters],
        "source": effect.source,
    }


def _parameter(p: Parameter) -> dict[str, Any]:
    low, high = p.bounds
    return {
        "name": p.name, "unit": p.unit, "example": p.value, "bounds": [low, high],
        "meaning": p.description,
    }  # fmt: skip


def json_lines(content: Any) -> str:
    """Return content as the text of a JSON file."""
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def markdown(model: Model) -> str:
    """Return base model and causes as one page for people."""
    base = base_content(model)
    lines = ["# The base model", "", base["values"], base["start"], ""]
    lines += [f"* {e['part']}: `{e['equation']}`" for e in base["equations"]]
    lines += ["", "Letters:", ""]
    lines += [f"* `{letter}`: {meaning}" for letter, meaning in LETTERS.items()]
    lines += ["", "Parameters (an example's values):", ""]
    lines += [_line(p) for p in base["parameters"]]
    lines += ["", "# Possible causes", ""]
    for cause in causes_content():
        lines += [f"## {cause['name']}", ""]
        lines += [f"Sits in: {cause['sits_in']}. {cause['definition']}.", ""]
        lines += [f"`{cause['equation']}`", "", f"Looks like: {cause['what_it_looks_like']}.", ""]
        lines += [*(_line(p) for p in cause["parameters"]), "", f"Source: {cause['source']}", ""]
    return "\n".join(lines)


def _line(p: dict[str, Any]) -> str:
    low, high = p["bounds"]
    return f"* `{p['name']}` [{p['unit']}]: {p['meaning']}; {p['example']:g}, {low:g} to {high:g}"


FORMAT, VERSION = "psa_causes.data/1", "1.0"
LICENCE = "BSD-3-Clause, psa_casadi authors (the licence of the project that made it)"
#: What of this folder goes with the data.
ALONG = ("README.md", "score.py", "answer.schema.json")
#: What moves the base, in the order of the arrays in `base.npz`.
COLUMNS = ("1", "displacement", "rate", "voltage", *(f"d/dln {name}" for name in FREE))


def write(
    folder: Path, seed: int, count: int, progress: Callable[[str], None], jobs: int = 1
) -> None:
    """Write the data set; the same seed and count give the same bytes on the same machine."""
    write_model(folder)
    cases = list(enumerate(cases_of(seed, count), start=1))
    truth = {}
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for name, said in pool.map(write_case, [folder] * count, cases):
            truth[name] = said
            progress(f"case {name} of {count}")
    content = {
        "format": FORMAT,
        "version": VERSION,
        "licence": LICENCE,
        "seed": seed,
        "cases": list(truth),
        "causes": [c["name"] for c in causes_content()],
    }
    _put(folder / "data.json", json_lines(content))
    _put(folder / "truth" / "truth.json", json_lines({"format": FORMAT, "cases": truth}))
    write_sums(folder)


def write_model(folder: Path) -> None:
    """Write what all cases share: base model, causes, README, score, schema of answers."""
    model = stack_model("demo")
    (folder / "model").mkdir(parents=True, exist_ok=True)
    export_fmu(model, folder / "model" / "base.fmu")
    export_modelica(model, folder / "model" / "Base.mo")
    _put(folder / "model" / "base.json", json_lines(base_content(model)))
    _put(folder / "model" / "causes.json", json_lines(causes_content()))
    _put(folder / "model" / "model.md", markdown(model))
    for name in ALONG:
        shutil.copyfile(Path(__file__).with_name(name), folder / name)


def write_case(folder: Path, numbered: tuple[int, Case]) -> tuple[str, dict[str, object]]:
    """Make and write one case; return its name and its truth."""
    number, case = numbered
    name = f"{number:03d}"
    with tempfile.TemporaryDirectory() as temporary:
        made = make(case, Path(temporary))
    own = folder / "cases" / name
    record, held = made.record, made.holdout
    _table(own / "record.csv", record, ("displacement", record.read))
    _table(own / "holdout.csv", held)
    _table(own / "base_record.csv", record, ("base displacement", record.base))
    _table(own / "base_holdout.csv", held, ("base displacement", held.base))
    _arrays(own / "base.npz", record, held)
    true = ("displacement", held.read), ("displacement without noise", held.clean)
    _table(folder / "truth" / f"{name}.csv", held, *true)
    return name, _truth(made)


def _truth(made: Made) -> dict[str, object]:
    case = made.case
    return {
        "kind": case.kind,
        "hidden": list(case.hidden),
        "listed": case.kind != "foreign",
        "gains": made.gains,
        "times_the_noise": round(made.rho, 4),
        "noise": case.noise,
    }


def _table(path: Path, half: Half, *more: tuple[str, FloatArray]) -> None:
    """Write times, voltage, temperature and displacements; an empty cell is no reading."""
    head = ["time [s]", "voltage [V]", *(f"{name} [um]" for name, _ in more), "temperature [degC]"]
    columns = [
        (half.times, "{:.6f}"),
        (half.voltage, "{:.3f}"),
        *((1e6 * values, "{:.6f}") for _, values in more),
        (half.temperature, "{:.3f}"),
    ]
    cells = [
        [form.format(x) if np.isfinite(x) else "" for x in values.tolist()]
        for values, form in columns
    ]
    lines = [",".join(head), *(",".join(row) for row in zip(*cells, strict=True))]
    _put(path, "\n".join(lines) + "\n")


def _arrays(path: Path, record: Half, held: Half) -> None:
    stream = io.BytesIO()
    np.savez(
        stream,
        names=np.array(COLUMNS),
        record=record.columns.astype(np.float32),
        holdout=held.columns.astype(np.float32),
    )
    path.write_bytes(stream.getvalue())


def write_sums(folder: Path) -> None:
    """Write SHA256SUMS of all files, as `sha256sum -c` reads it."""
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p.name != "SHA256SUMS")
    lines = [
        f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.relative_to(folder).as_posix()}\n"
        for p in files
    ]
    _put(folder / "SHA256SUMS", "".join(lines))


def _put(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text.encode())
