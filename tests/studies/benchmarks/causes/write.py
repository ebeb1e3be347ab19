"""The data set as a folder: records, base model, possible causes, the truth apart, the score."""

import hashlib
import io
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.modelica.package import export_modelica
from psa_casadi.model.stacks import stack_model
from tests.studies.benchmarks.causes.draw import Half, Made, cases_of, make
from tests.studies.benchmarks.causes.words import base_content, causes_content, json_lines, markdown
from tests.studies.benchmarks.hidden_cases import Case
from tests.studies.plants.stack import FloatArray
from tests.studies.plants.visibility import FREE

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
