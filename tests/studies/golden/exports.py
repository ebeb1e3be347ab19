"""What is exported of a few models: hashes of the texts, and numbers of the FMU in fmpy."""

import hashlib
import re
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path

import fmpy
import numpy as np

import psa_casadi as psa
from tests.any_model.own_models import motor

#: What differs between two exports of one model, or between versions, and does not matter.
_UNSTABLE = (
    re.compile(r"/\*.*?\*/", re.S),
    re.compile(r"\{?[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}\}?"),
    re.compile(re.escape(psa.__version__)),
    re.compile(r"\d{4}-\d\d-\d\dT[0-9:.+Z]*"),
)
_DATED = ("guid", "instantiationToken", "generationTool", "generationDateAndTime", "version")


def _every_effect() -> psa.Model:
    gains = {c.gain: 1e-3 for c in psa.EFFECTS.values() if c.gain}
    return psa.compose((*psa.BASE, *psa.EFFECTS.values()), gains, name="every_effect")


_MODELS: dict[str, Callable[[], psa.Model]] = {
    "small": lambda: psa.compose(psa.SIMPLIFIED),
    "creep": lambda: psa.compose((*psa.BASE, psa.EFFECTS["slow_creep"]), {"creep_gain": 0.05}),
    "every-effect": _every_effect,
    "own": motor,
}


def _hash(texts: Iterable[str]) -> str:
    """Return the hash of texts, without what is unstable and without white space at line ends."""
    whole = "\0".join(texts)
    for pattern in _UNSTABLE:
        whole = pattern.sub("", whole)
    lines = [line.rstrip() for line in whole.splitlines() if line.strip()]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def _description(text: str) -> str:
    """Return a model description in canonical form, without what is dated."""
    root = ET.fromstring(text)
    for name in _DATED:
        root.attrib.pop(name, None)
    return ET.canonicalize(ET.tostring(root, "unicode"), strip_text=True)


def _played(path: Path, inputs: Mapping[str, float]) -> str:
    """Return the FMU's outputs at five times, each input a growing sine of its size."""
    time = np.linspace(0.0, 0.05, 501)
    arguments = np.zeros(len(time), dtype=[("time", float), *((name, float) for name in inputs)])
    arguments["time"] = time
    for name, size in inputs.items():
        arguments[name] = size * time / time[-1] * (1.0 - np.cos(2.0 * np.pi * 60.0 * time))
    result = fmpy.simulate_fmu(
        str(path), fmi_type="CoSimulation", stop_time=0.05, step_size=1e-4, output_interval=1e-4,
        relative_tolerance=1e-8, input=arguments,
    )  # fmt: skip
    names = [n for n in result.dtype.names or () if n != "time"]
    return " ".join(f"{result[n][k]:.9g}" for n in names for k in (100, 200, 300, 400, 500))


def _fmu(name: str, fmi: int, folder: Path) -> dict[str, str]:
    model = _MODELS[name]()
    path = psa.export_fmu(model, folder / "model.fmu", fmi=fmi)
    with zipfile.ZipFile(path) as archive:
        sources = [n for n in sorted(archive.namelist()) if n.startswith("sources/")]
        texts = [f"{n}\n{archive.read(n).decode()}" for n in sources]
        description = archive.read("modelDescription.xml").decode()
    size = 20.0 if "voltage" in model.input_names else 5.0
    inputs = {n: size if n == "voltage" else 0.0 for n in model.input_names}
    output = fmpy.read_model_description(str(path))
    known = {v.name for v in output.modelVariables if v.causality == "input"}
    return {
        "description": _hash([_description(description)]),
        "code": _hash(texts),
        "numbers": _played(path, {n: s for n, s in inputs.items() if n in known}),
        "errors": "-",
    }


def _modelica(name: str, folder: Path) -> dict[str, str]:
    path = psa.export_modelica(_MODELS[name](), folder / "Package.mo")
    code = _hash([path.read_text("utf-8")])
    return {"description": "-", "code": code, "numbers": "-", "errors": "-"}


def _c(name: str, folder: Path) -> dict[str, str]:
    made = psa.export_c(_MODELS[name](), folder, step=1e-4, name="model")
    texts = [made.header.read_text("utf-8"), made.source.read_text("utf-8")]
    errors = " ".join(f"{e.error:.3g}" for e in made.errors)
    text = f"{made.substeps} substeps"
    return {"description": text, "code": _hash(texts), "numbers": "-", "errors": errors}


EXPORTS: dict[str, Callable[[Path], dict[str, str]]] = {
    **{f"{n}-fmi{v}": partial(_fmu, n, v) for n in _MODELS for v in (2, 3)},
    **{f"{n}-modelica": partial(_modelica, n) for n in _MODELS},
    **{f"{n}-c": partial(_c, n) for n in ("small", "creep", "own")},
}
