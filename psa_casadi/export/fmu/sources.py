"""The C sources of an exported model: hand-written logic, generated functions and data.

An FMU with a fixed step has the same sources and description, changed where the step is: parameters
are constants, as the step is made for their values, and there is no model exchange.
"""

import hashlib
import itertools
import json
import math
import re
import uuid
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path

import casadi as ca
import numpy as np

from psa_casadi.export.common.markup import at_rest, xml_text
from psa_casadi.export.common.publication import SOURCES_NOTICE, code_license
from psa_casadi.export.common.templates import filled
from psa_casadi.export.common.variable_table import starts_at_voltage, variable_table
from psa_casadi.export.fixed_step.code import bounded, function_code, limit_words
from psa_casadi.export.fixed_step.export import STEPS, FixedStep, main_output
from psa_casadi.export.fmu.description import model_description
from psa_casadi.export.fmu.evidence import seen_inputs
from psa_casadi.model.component import Expression
from psa_casadi.model.compose import Model, Structure
from psa_casadi.simulation.compiler import (
    OPTIMISE,
    c_arguments,
    c_code,
    c_slopes,
    generate_c,
    sources_directory,
)

#: The hand-written files of `fmu_src` that every FMU consists of, C files first.
LOGIC = (
    "derivatives.c", "instance.c", "instants.c", "linear.c", "log.c", "model_adjoint.c",
    "model_casadi.c", "model_directional.c", "sampling.c", "snapshot.c", "snapshot_fault.c",
    "solver.c", "start.c", "step_derivatives.c", "validity.c", "values.c",
    "fmi_data.h", "instance.h", "instants.h", "linear.h", "model.h", "solver.h",
)  # fmt: skip
#: The files of `fmu_src` that speak one version of FMI.
FACES = {
    2: ("fmi2.c", "fmi2_interfaces.c", "fmi2_face.h"),
    3: ("fmi3.c", "fmi3_clocks.c", "fmi3_interfaces.c", "fmi3_values.c", "fmi3_face.h"),
}
#: The headers of the FMI standard, from fmpy.
FMI_HEADERS = {
    2: ("fmi2FunctionTypes.h", "fmi2Functions.h", "fmi2TypesPlatform.h"),
    3: ("fmi3FunctionTypes.h", "fmi3Functions.h", "fmi3PlatformTypes.h"),
}

#: The files whose text is CasADi's, and differs from one version of it to another.
FROM_CASADI = ("model.c", "model_config.h", "model_derivatives.c", "fmi_config.h")

#: Warnings under which all sources compile cleanly. No function takes more of the stack than a
#: page: threads of importers have small ones, and for Windows it would need a function of the C
#: runtime that no library here carries.
STRICT = ("-Wframe-larger-than=4096", "-Wall", "-Wextra", "-Werror", "-pedantic")


def source_files(
    model: Model, identifier: str, token: str, fmi: int = 2, fixed: FixedStep | None = None
) -> dict[str, str]:
    """Return the text of every file in the folder sources, by its name; `fmi` is 2 or 3.

    `fixed` is the step of an FMU with a fixed step.
    """
    structure = model.structure
    derivatives = _derivatives(structure)
    logic = (*LOGIC, *FACES[fmi])
    texts = {n: (sources_directory() / n).read_text(encoding="utf-8") for n in logic}
    headers = files("fmpy") / "c-code"
    texts |= {n: (headers / n).read_text(encoding="utf-8") for n in FMI_HEADERS[fmi]}
    texts |= generate_c(structure, sensitivities=False)
    texts["model_derivatives.c"] = c_code("model_derivatives.c", derivatives)
    texts[_HEADER] = _config(model, derivatives, fixed)
    texts["fmi_data.c"] = _data(model, identifier, token)
    if fixed:
        texts["fmi_data.c"] += function_code(fixed.plan, "psa_fixed_step")
    names = compiled_files(texts)
    texts["README.txt"] = filled(
        "README.txt", name=identifier, flags=" ".join(OPTIMISE), files=" ".join(names)
    )
    texts[SOURCES_NOTICE] = code_license()
    build = "buildDescription.xml"  # which FMI 2 ignores
    texts[build] = xml_text(build, identifier=identifier, names=names)
    return {n: t.replace("\r\n", "\n") for n, t in texts.items()}


def compiled_files(texts: Iterable[str]) -> list[str]:
    """Return the names that are C files, sorted."""
    return sorted(n for n in texts if n.endswith(".c"))


def _derivatives(structure: Structure) -> tuple[ca.Function, ca.Function]:
    """Return the products of d(x', y, z)/d(t, x, u, p) with a vector, exact, in both directions.

    psa_directional: (t, x, u, p, dt, dx, du, dp) to the derivatives of x', y and z along the seeds.
    psa_adjoint: (t, x, u, p, wx, wy, wz) to the gradient of wx.x' + wy.y + wz.z by t, x, u, p.
    Sampled states are held; they stand in p (see `c_arguments`).
    """
    s = structure
    point = c_arguments(s)
    results: list[Expression] = [c_slopes(s), s.y, ca.vertcat(ca.SX(0, 1), *s.switches.values())]
    both = ca.vertcat(*results), ca.vertcat(*point)

    def function(
        name: str, others: str, like: list[Expression], into: list[Expression]
    ) -> ca.Function:
        """Return the product with vectors shaped `like` some columns, cut `into` others."""
        seeds = [ca.SX.sym(n, v.numel()) for n, v in zip(others.split(), like, strict=True)]
        product = ca.densify(ca.jtimes(*both, ca.vertcat(*seeds), into is point))
        ends = itertools.accumulate((part.numel() for part in into), initial=0)
        parts = ca.cse(ca.vertsplit(product, list(ends)))
        return ca.Function(name, [*point, *seeds], parts, {"cse": True})

    return (
        function("psa_directional", "dt dx du dp", point, results),
        function("psa_adjoint", "wx wy wz", results, point),
    )


def _config(model: Model, functions: Sequence[ca.Function], fixed: FixedStep | None) -> str:
    place = model.input_names.index("voltage") if starts_at_voltage(model) else -1
    defined = {
        f"PSA_DERIVATIVES_SZ_{n}": max(least, *(getattr(f, f"sz_{n.lower()}")() for f in functions))
        for n, least in (("ARG", 8), ("RES", 4), ("IW", 1), ("W", 1))
    }
    defined["PSA_VOLTAGE"] = f"({place})"
    if fixed:
        defined["PSA_FIXED_STEP"] = repr(fixed.plan.step)
    if fixed and bounded(fixed.plan):
        defined["PSA_FIXED_LIMIT"] = repr(fixed.plan.limit)
    return filled("config.h", guard="PSA_FMI_CONFIG_H", defined=defined, arrays={})


def _number(value: float) -> str:
    if math.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(float(value))


def switch_scales(model: Model, nominals: Sequence[float]) -> list[float]:
    """Return sum_j |dz/dx_j| nominal_j of every switch z at rest: its noise at a tolerance of 1."""
    s = model.structure
    slopes = ca.jacobian(ca.vertcat(ca.SX(0, 1), *s.switches.values()), s.x)
    rows = np.abs(at_rest(model, slopes)).reshape(len(s.switches), len(s.states))
    return [float(row @ np.array(nominals)) for row in rows]


def _data(model: Model, identifier: str, token: str) -> str:
    """Return fmi_data.c; arrays have one element more than the model, as C has no empty ones."""
    s, table = model.structure, variable_table(model)

    def starts(*kinds: str) -> list[float]:
        return [v.start or 0.0 for kind in kinds for v in table if v.kind == kind]

    def numbers(values: Sequence[float]) -> list[str]:
        return [*map(_number, values), "0.0"]

    usual = [abs(q) for q in model.state_nominals()]
    nominals = [abs(v.nominal or 1.0) for v in table if v.kind == "state"]
    kinds = [("SETTLES" if q.settles else "STAYS") if q.memory else "NONE" for q in s.states]
    gains = {c.gain for c in model.effects}
    items = [f"{{{', '.join(map(_number, row))}}}" for row in seen_inputs(model)]
    return filled(
        "fmi_data.c",
        token=token,
        identifier=identifier,
        table=[(v, *map(_number, v.bounds or (-math.inf, math.inf))) for v in table],
        arrays=(
            ("double", "start_states", "NX", numbers(starts("state"))),
            ("double", "start_inputs", "NU", numbers(starts("input"))),
            ("double", "start_parameters", "HELD", numbers(starts("parameter", "sampled"))),
            ("double", "state_nominals", "NX", numbers(usual or [1.0])),
            ("double", "told_nominals", "NX", numbers(nominals or [1.0])),
            ("int", "memory", "NX", [*(f"PSA_MEMORY_{kind}" for kind in kinds), "0"]),
            ("int", "gains", "NP", [*(str(int(n in gains)) for n in model.parameter_names), "0"]),
            ("double", "switch_scales", "NZ", numbers(switch_scales(model, nominals))),
            ("psa_range", "seen", "NU", [*items, "{0.0, 0.0, 0.0}"]),
        ),
        duration=_number(model.evidence.seen.duration if model.evidence else math.inf),
    )


#: Where an FMU carries the step [s], its substeps and the measured errors by voltage.
FIXED_ENTRY = "resources/fixed_step.json"
_HEADER = "fmi_config.h"


def fixed_entry(fixed: FixedStep) -> bytes:
    """Return the text of `FIXED_ENTRY`; errors have two digits, as they have elsewhere."""
    errors = {e.voltage: float(f"{e.error:.1e}") for e in fixed.errors}
    content = {"step": fixed.plan.step, "substeps": fixed.plan.substeps, "errors": errors}
    if bounded(fixed.plan):
        content["voltage_limit"] = fixed.plan.limit
    return (json.dumps(content, indent=2) + "\n").encode("utf-8")


def use_of(fixed: FixedStep) -> str:
    """Return the description of the steps for the page of the FMU."""
    text = filled(
        "fixed_use.txt", plan=fixed.plan, errors=fixed.errors, steps=STEPS,
        output=main_output(fixed.plan.model), limit=limit_words(fixed.plan.limit),
    )  # fmt: skip
    return " ".join(text.split())


def fixed_step_of(directory: Path) -> float | None:
    """Return the fixed step [s] of an unpacked FMU, None if it has none."""
    header = directory / "sources" / _HEADER
    try:
        text = header.read_text("utf-8")
        result = re.search(r"^#define PSA_FIXED_STEP (\S+)$", text, re.MULTILINE)
        return float(result[1]) if result else None
    except (OSError, ValueError):  # no text, or no number: it is no file of ours
        return None


def exported_texts(
    model: Model,
    identifier: str,
    fmi: int = 2,
    fixed: FixedStep | None = None,
    kept: Mapping[str, str] | None = None,
) -> tuple[str, dict[str, str], str]:
    """Return token, sources by file name, and description of an export.

    The token (GUID) is a hash of the description and the sources that were made with an empty one.
    `fixed` is the step of an FMU with a fixed step, `kept` are sources that are taken as they are.
    """

    def sources(token: str) -> dict[str, str]:
        return source_files(model, identifier, token, fmi, fixed) | dict(kept or {})

    bare = sources("")
    names = compiled_files(bare)
    plain = model_description(model, identifier, "", names, fmi)
    digest = hashlib.sha256(plain.encode("utf-8"))
    for name, text in sorted(bare.items()):
        digest.update(name.encode("utf-8") + b"\0" + text.encode("utf-8") + b"\0")
    token = "{" + str(uuid.UUID(bytes=digest.digest()[:16])) + "}"
    xml = model_description(model, identifier, token, names, fmi, fixed)
    return token, sources(token), xml
