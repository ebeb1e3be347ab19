"""What the data set says of the base model and of the possible causes, as JSON and Markdown."""

import json
from typing import Any

from psa_casadi.component import Component
from psa_casadi.effects import EFFECTS
from psa_casadi.model.compose import Model
from psa_casadi.variables import Parameter

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
