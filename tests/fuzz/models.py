"""Model files and paths to follow: damaged texts and trees; what loads is saved and loads equal."""

import json
import zlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from random import Random
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from psa_casadi.components import BASE, SIMPLIFIED
from psa_casadi.design.tracking.targets import read_target
from psa_casadi.effects import EFFECTS
from psa_casadi.export.fmu.description import model_description
from psa_casadi.export.fmu.evidence import evidence_texts
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.evidence import (
    Covariance,
    ErrorBudget,
    ErrorShare,
    Evidence,
    HeldOut,
    RecordRun,
    ReferenceRun,
    SeenRange,
)
from psa_casadi.model.model_file import dumps, load_model, save_model
from psa_casadi.model.parts import PARTS, part_model
from psa_casadi.model.stacks import STACKS, stack_model
from psa_casadi.variables import Interval, Provenance
from tests.fuzz.mutators import damaged_bytes, damaged_json, damaged_table
from tests.fuzz.target import FALSE_PASS, Found, Target

ROOM = "files"
#: One of so many models that load is also described as an FMU, which takes a hundred times longer.
_DESCRIBED = 16


@cache
def model_trees() -> tuple[Any, ...]:
    """Return the content of sound model files: stacks, effects, parts, mechanisms, identified."""
    origin = Provenance(
        identified_from=(("a.csv", "0" * 64),),
        package_version="0.1.0",
        free=("A", "C_p"),
        intervals={"A": Interval(0.1, 0.2)},
        force_scale="measured",
        notes=("µm", ""),
    )
    gains = {c.gain: 1e-3 for c in EFFECTS.values() if c.gain}
    base = compose(BASE, name="stack", description="a stack")
    models = [
        base,
        base.with_values({}, provenance=origin),
        base.with_values({}, provenance=origin, evidence=_evidence(base)),
        compose(SIMPLIFIED),
        compose((*BASE, *EFFECTS.values()), gains),
        *(base.with_effect(e) for e in EFFECTS.values()),
        *(stack_model(name) for name in STACKS),
        *(part_model(name) for name in PARTS),
        base.with_starts({base.state_names[0]: 1e-9, "voltage": 3.0}),
    ]
    found = [json.loads(dumps(m)) for m in models]
    return (*found, {"format": "psa_casadi.diagnosis/1", "verdict": "adequate", "causes": []})


def _evidence(model: Model) -> Evidence:
    """Return evidence with every part that it may have, in three samples."""
    run = RecordRun(
        "a.csv",
        "0" * 64,
        dict.fromkeys(model.state_names, 0.0),
        1e-7,
        60,
        1,
        2e-8,
        3e-8,
        ((9, 20),),
    )
    share = ErrorShare("slow_creep", 0.9, Interval(0.8, 1.0))
    return Evidence(
        by="psa diagnose",
        fitted_m=2e-8,
        seen=SeenRange(Interval(0.0, 80.0), 5e3, 0.6, Interval(290.0, 300.0)),
        covariance=Covariance(("A", "tau"), ((1e-4, 1e-9), (1e-9, 1e-8))),
        runs=(run,),
        reference=ReferenceRun(
            "a.csv", (0.0, 0.1, 0.2), {"voltage": (0.0, 50.0, 10.0)}, (1e-7, None, 3e-6)
        ),
        held_out=HeldOut(3e-8, Interval(2e-8, 4e-8), 9e-8, 0.2, 0),
        budget=ErrorBudget(1e-7, 2e-8, 1e-8, 0.1, (share,), share),
        outside=("offset_drift",),
        unnamed=("a static curve",),
    )


def _model(rng: Random) -> bytes:
    return damaged_json(rng.choice(model_trees()), rng)


def _load(data: bytes, folder: Path) -> Iterator[Found]:
    first, second = folder / "first.json", folder / "second.json"
    first.write_bytes(data)
    model = load_model(first)
    save_model(model, second)
    again = load_model(second)
    for what in ("values", "provenance", "evidence", "name", "description", "components"):
        if getattr(again, what) != getattr(model, what):
            yield Found(FALSE_PASS, f"a model that was loaded is saved with other {what}")
    if again.own_starts() != model.own_starts():
        yield Found(FALSE_PASS, "a model that was loaded is saved with other starts")
    if dumps(again) != second.read_text(encoding="utf-8"):
        yield Found(FALSE_PASS, "a model that was loaded is saved in another way the second time")
    if zlib.crc32(data) % _DESCRIBED == 0:
        yield from _undescribed(model)
        yield from _unfiled(model.plant())


def _undescribed(model: Model) -> Iterator[Found]:
    """Yield what is wrong with the descriptions of the model as FMUs."""
    for fmi in (2, 3):
        text = model_description(model.plant(), "m", "{token}", ["model.c"], fmi)
        try:
            root = ET.fromstring(text.encode("utf-8"))
        except (ET.ParseError, UnicodeEncodeError) as error:
            yield Found(FALSE_PASS, f"the description for FMI {fmi} is no XML: '{error}'")
            continue
        for attribute in ("start", "nominal", "min", "max"):
            values = [float(e.get(attribute, "0").split()[0]) for e in root.iter()]
            if not np.isfinite(values).all():
                yield Found(FALSE_PASS, f"the description for FMI {fmi} has a bad {attribute}")


def _unfiled(model: Model) -> Iterator[Found]:
    """Yield what is wrong with the files of a model's evidence in an FMU."""
    for name, text in evidence_texts(model, 2).items():
        if not name.endswith((".ssv", ".srmd", ".exp")):
            continue
        try:
            root = ET.fromstring(text.encode("utf-8"))
        except (ET.ParseError, UnicodeEncodeError) as error:
            yield Found(FALSE_PASS, f"{name} is no XML: '{error}'")
            continue
        if not all(np.isfinite(float(e.get("value", "0"))) for e in root.iter()):
            yield Found(FALSE_PASS, f"{name} has a value that is no number")


@cache
def _paths() -> tuple[str, ...]:
    rows = [(k / 100, round(5 - 5 * np.cos(k / 2), 3)) for k in range(12)]
    plain = "\n".join(f"{t},{y}" for t, y in rows)
    return (
        f"time [s],displacement [um]\n{plain}\n",
        f"displacement [nm];time [ms]\n{plain.replace(',', ';').replace('.', ',')}\n",
    )


def _path(rng: Random) -> bytes:
    text = rng.choice(_paths())
    if rng.random() < 0.7:
        return damaged_table(text, rng).encode("utf-8", "replace")
    return damaged_bytes(text.encode(), rng)


def _follow(data: bytes, folder: Path) -> Iterator[Found]:
    file = folder / "target.csv"
    file.write_bytes(data)
    target = read_target(file)
    if not (np.isfinite(target.time).all() and np.isfinite(target.displacement).all()):
        yield Found(FALSE_PASS, "a path that was read is not finite")
    elif target.time.size < 10 or not (np.diff(target.time) > 0.0).all():
        yield Found(FALSE_PASS, "the time of a path that was read stands still or is short")
    elif not (0.0 < target.span < np.inf):
        yield Found(FALSE_PASS, "a path that was read has no finite span")


TARGETS = (
    Target("models", ROOM, ".json", _model, _load, 3.0, prepare=model_trees),
    Target("paths", ROOM, ".csv", _path, _follow, 1.0),
)
