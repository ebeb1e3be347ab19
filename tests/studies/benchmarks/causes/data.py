"""The data set as a folder: records, base model, possible causes, the truth apart, the score."""

import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jinja2 import Template

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from tests.studies.benchmarks.hidden_cases import (
    NOISES,
    REACHED,
    STRONG,
    WEAK,
    Case,
    how_made,
)
from tests.studies.benchmarks.table import on_all_cores
from tests.studies.plants.base import simulate_base
from tests.studies.plants.excitations import draw_excitation
from tests.studies.plants.hide import FREE, SEARCH, base_columns
from tests.studies.plants.make import Truth, make_record, play_again
from tests.studies.plants.sensor import room, temperature
from tests.studies.plants.table import FOREIGN, KNOWN, called

#: Shares of the kinds of cases; what is left over goes to the first.
SHARES = {"known": 0.5, "clean": 0.2, "foreign": 0.1, "weak": 0.1, "two": 0.1}
#: The base model absorbs a lag of the sensor: no gain makes it visible.
VISIBLE = tuple(name for name in KNOWN if name != "sensor_lag")
#: Drawn relative to their record (`in_terms_of`), which has the first effect only.
_FIRST_ONLY = ("offset_drift", "self_heating", "voltage_saturation")
#: Draws of one effect before the next one takes its place.
_ATTEMPTS = 3


class Half(NamedTuple):
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


def cases_of(seed: int, count: int) -> list[Case]:
    """Return `count` cases in the order of the data set, which is random."""
    rng = np.random.default_rng(seed)
    numbers = {kind: round(share * count) for kind, share in SHARES.items()}
    numbers["known"] += count - sum(numbers.values())
    known, foreign = (_in_turn(rng, names, count) for names in (VISIBLE, FOREIGN))
    weak, pairs = _in_turn(rng, VISIBLE, count), [_pair(rng) for _ in range(numbers["two"])]
    seeds = iter(np.random.SeedSequence(seed).generate_state(count).tolist())
    cases = []
    for kind, number in numbers.items():
        for k in range(number):
            case_seed = next(seeds)
            match kind:
                case "known":
                    cases.append(Case("known", known[k], case_seed, noise=NOISES[k % len(NOISES)]))
                case "clean":
                    cases.append(Case("clean", None, case_seed, noise=NOISES[k % 2]))
                case "foreign":
                    cases.append(Case("foreign", foreign[k], case_seed))
                case "weak":
                    cases.append(Case("weak", weak[k], case_seed, WEAK))
                case _:
                    one, more = pairs[k]
                    cases.append(Case("two", one, case_seed, STRONG, (more,)))
    return [cases[k] for k in rng.permutation(count)]


def _in_turn(rng: np.random.Generator, names: tuple[str, ...], count: int) -> list[str]:
    turns = -(-count // len(names))
    return [names[k] for _ in range(turns) for k in rng.permutation(len(names))][:count]


def _pair(rng: np.random.Generator) -> tuple[str, str]:
    more = str(rng.choice([name for name in VISIBLE if name not in _FIRST_ONLY]))
    return str(rng.choice([name for name in VISIBLE if name != more])), more


def write_case(folder: Path, number: int, case: Case) -> tuple[str, dict[str, object]]:
    """Make and write one case; return its name and its truth.

    If what is hidden is not as visible as the case demands, another device is drawn, and
    after three of them the next effect is taken.
    """
    seeds = np.random.SeedSequence(case.seed).generate_state(4 * _ATTEMPTS).tolist()
    for tried, seed in enumerate(seeds):
        drawn = replace(case, effect=_later(case.effect, tried // _ATTEMPTS), seed=seed)
        if drawn.effect in drawn.more:
            continue
        with tempfile.TemporaryDirectory() as temporary:
            path = Path(temporary) / "record.csv"
            truth = make_record(drawn.effect, seed, path, **how_made(drawn))
            rho = min([truth.visible, *(h.visible for h in truth.more)])
            if drawn.effect is not None and rho < REACHED * drawn.rho[0]:
                continue
            _write_halves(folder, f"{number:03d}", *_halves(drawn, truth, path))
        return f"{number:03d}", {
            "kind": drawn.kind,
            "hidden": list(drawn.hidden),
            "listed": drawn.kind != "foreign",
            "gains": {called(name): gain for name, _, gain in truth.hidden},
            "times_the_noise": round(rho, 4),
            "noise": drawn.noise,
        }
    raise RuntimeError(f"No device drawn from seed {case.seed} shows {case.hidden} well enough.")


def _later(effect: str | None, steps: int) -> str | None:
    if effect is None or steps == 0:
        return effect
    names = FOREIGN if effect in FOREIGN else VISIBLE
    return names[(names.index(effect) + steps) % len(names)]


def _halves(case: Case, truth: Truth, path: Path) -> tuple[Half, Half]:
    """Return the record at a path, and the held-out one; the base is fitted to the first."""
    rng, again = np.random.default_rng([case.seed, 3]), path.with_name("holdout.csv")
    walk = _thermometer(truth, rng)
    times, voltage = draw_excitation(rng, truth.excitation, truth.stack.u_rated)
    clean = play_again(truth, case.seed + 1, again, (times, voltage))
    first, base = truth.base_displacement, simulate_base(truth.stack, times, voltage).displacement
    columns = base_columns(truth.stack, truth.times, truth.voltage, first)
    later = base_columns(truth.stack, times, voltage, base)
    read = _read(path)
    moves = _fitted(columns, read - first)
    return Half(
        truth.times, truth.voltage, read, truth.displacement, room(truth.times, walk),
        first + columns @ moves, columns,
    ), Half(
        times, voltage, _read(again), clean, room(times, walk), base + later @ moves, later
    )  # fmt: skip


def _thermometer(truth: Truth, rng: np.random.Generator) -> dict[str, float]:
    """What the room does: every record has a thermometer, and not only where it is the cause."""
    for name, parameters, _ in truth.hidden:
        if name == "temperature":
            return dict(parameters)
    return temperature.draw(rng, simulate_base(truth.stack, truth.times, truth.voltage, SEARCH))


def _read(path: Path) -> FloatArray:
    """Return the readings of the sensor, (N,) [m], nan where one is missing."""
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    return 1e-6 * np.asarray(table[:, 2], dtype=np.float64)


def _fitted(columns: FloatArray, rest: FloatArray) -> FloatArray:
    """Return the Gauss-Newton step of the base from the device's values, (11,)."""
    there, size = np.isfinite(rest), np.linalg.norm(columns, axis=0)
    step = np.linalg.lstsq((columns / size)[there], rest[there], rcond=1e-8)[0]
    return np.asarray(step / size, dtype=np.float64)


#: Letters of the equations that are no parameters.
LETTERS = {
    "v": "voltage that is applied, the column `voltage` [V]",
    "u": "voltage on the stack [V]",
    "i": "current of the drive [A]",
    "f_L, f_H": "linear and hysteresis force [N]",
    "f_out": "force behind the lag [N]",
    "f_load": "external force, 0 in all records [N]",
    "y, x": "displacement of the wafers, of the end [m]",
    "x_m": "displacement that the sensor reads, the column `displacement` [m]",
    "'": "derivative by time",
}


def base_content(model: psa.Model) -> dict[str, Any]:
    """Return the base model: equations, letters, parameters with an example's values."""
    return {
        "equations": [
            {"part": c.name, "equation": c.equation_text, "source": c.source}
            for c in model.components
        ],
        "letters": LETTERS,
        "parameters": [_parameter(p) for c in model.components for p in c.parameters],
        "values": "Every case has other values, not published. Those here are an example.",
        "start": "Every record starts at rest: all states are 0.",
    }


def causes_content() -> list[dict[str, Any]]:
    """Return the possible causes: definition in words and as equation, parameters, source."""
    return [_cause(e) for e in psa.EFFECTS.values()]


def _cause(effect: psa.Component) -> dict[str, Any]:
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


def _parameter(p: psa.Parameter) -> dict[str, Any]:
    low, high = p.bounds
    return {
        "name": p.name, "unit": p.unit, "example": p.value, "bounds": [low, high],
        "meaning": p.description,
    }  # fmt: skip


def json_lines(content: Any) -> str:
    """Return content as the text of a JSON file."""
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


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
    cases = [(folder, k, case) for k, case in enumerate(cases_of(seed, count), start=1)]
    truth = dict(on_all_cores(write_case, cases, progress, lambda c: f"case {c[0]}", jobs))
    content = {
        "format": FORMAT, "version": VERSION, "licence": LICENCE, "seed": seed,
        "cases": list(truth), "causes": list(psa.EFFECTS),
    }  # fmt: skip
    _put(folder / "data.json", json_lines(content))
    _put(folder / "truth" / "truth.json", json_lines({"format": FORMAT, "cases": truth}))
    write_sums(folder)


def write_model(folder: Path) -> None:
    """Write what all cases share: base model, causes, README, score, schema of answers."""
    model = psa.stack_model("demo")
    (folder / "model").mkdir(parents=True, exist_ok=True)
    psa.export_fmu(model, folder / "model" / "base.fmu")
    psa.export_modelica(model, folder / "model" / "Base.mo")
    base, causes = base_content(model), causes_content()
    _put(folder / "model" / "base.json", json_lines(base))
    _put(folder / "model" / "causes.json", json_lines(causes))
    page = Template(Path(__file__).with_name("model.md.j2").read_text("utf-8"))
    _put(folder / "model" / "model.md", page.render(base=base, causes=causes).rstrip() + "\n")
    for name in ALONG:
        shutil.copyfile(Path(__file__).with_name(name), folder / name)


def _write_halves(folder: Path, name: str, record: Half, held: Half) -> None:
    case = folder / "cases" / name
    _table(case / "record.csv", record, displacement=record.read)
    _table(case / "holdout.csv", held)
    _table(case / "base_record.csv", record, base_displacement=record.base)
    _table(case / "base_holdout.csv", held, base_displacement=held.base)
    np.savez(
        case / "base.npz", names=np.array(COLUMNS), record=record.columns.astype(np.float32),
        holdout=held.columns.astype(np.float32),
    )  # fmt: skip
    true = {"displacement": held.read, "displacement_without_noise": held.clean}
    _table(folder / "truth" / f"{name}.csv", held, **true)


def _table(path: Path, half: Half, **more: FloatArray) -> None:
    """Write times, voltage, temperature and displacements [m]; an empty cell is no reading."""
    columns = {"time [s]": (half.times, 6), "voltage [V]": (half.voltage, 3)}
    columns |= {f"{name.replace('_', ' ')} [um]": (1e6 * x, 6) for name, x in more.items()}
    columns["temperature [degC]"] = (half.temperature, 3)
    cells = {
        head: [f"{x:.{digits}f}" if np.isfinite(x) else "" for x in values.tolist()]
        for head, (values, digits) in columns.items()
    }
    _put(path, pd.DataFrame(cells).to_csv(index=False, lineterminator="\n"))


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
