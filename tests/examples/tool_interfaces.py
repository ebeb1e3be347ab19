"""What other tools understand, as far as the recipes use it: functions, arguments, blocks.

No tool that runs the Modelica scripts and the MATLAB script is at hand. Their statements are calls
and assignments that Python's grammar reads as well, once the signs that differ are replaced.
"""

import ast
import re
from dataclasses import dataclass

#: Functions of each tool with their arguments in order, from its documentation.
OPENMODELICA = {
    "loadModel": ("className", "priorityVersion", "notify", "languageStandard"),
    "loadFile": ("fileName", "encoding", "uses", "notify", "requireExactVersion"),
    "getErrorString": ("warningsAsErrors",),
    "getClassNames": ("class_", "recursive", "qualified", "sort"),
    "simulate": ("className", "startTime", "stopTime", "numberOfIntervals", "tolerance", "method",
                 "fileNamePrefix", "options", "outputFormat", "variableFilter", "cflags",
                 "simflags"),
    "importFMU": ("filename", "workdir", "loglevel", "fullPath", "debugLogging",
                  "generateInputConnectors", "generateOutputConnectors", "modelName"),
}  # fmt: skip
DYMOLA = {
    "openModel": ("path", "mustRead", "changeDirectory"),
    "simulateModel": ("problem", "startTime", "stopTime", "numberOfIntervals", "outputInterval",
                      "method", "tolerance", "fixedstepsize", "resultFile"),
    "importFMU": ("fileName", "includeAllVariables", "integrate", "promptReplacement",
                  "packageName"),
}  # fmt: skip
BLOCK_PARAMETERS = {
    "simulink_extras/FMU Import/FMU": {
        "FMUName", "FMUMode", "FMUSampleTime", "FMUInputMapping", "FMUOutputMapping"},
    "simulink/Sources/Sine Wave": {"Amplitude", "Bias", "Frequency", "Phase"},
    "simulink/Sources/Constant": {"Value"},
    "simulink/Sinks/To Workspace": {"VariableName"},
    "model": {"StopTime", "SolverType", "FixedStep"},
}  # fmt: skip


@dataclass(frozen=True)
class Call:
    """One call: the function's name, what stands in its place-bound and its named arguments."""

    function: str
    arguments: tuple[str, ...]
    named: dict[str, str]


def calls_of(text: str, language: str) -> list[Call]:
    """Return the calls of a script in order; raises SyntaxError for what is none."""
    comment, assign = ("//", ":=") if language == "modelica" else ("%", "=")
    lines = [line.partition(comment)[0].rstrip() for line in text.splitlines()]
    statements = [line for line in lines if line]
    if not all(line.endswith(";") for line in statements):
        raise SyntaxError("a statement does not end")
    source = "\n".join(line[:-1].replace(f" {assign} ", " = ") for line in statements)
    source = re.sub(r"\[model '(/[^']*)'\]", r"'model\1'", source)  # what MATLAB joins
    found = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    return [
        Call(
            _text(call.func),
            tuple(map(_text, call.args)),
            {str(k.arg): _text(k.value) for k in call.keywords},
        )
        for call in sorted(found, key=lambda call: (call.lineno, call.col_offset))
    ]


def _text(value: ast.expr) -> str:
    return str(value.value) if isinstance(value, ast.Constant) else ast.unparse(value)


def bound(call: Call, interface: dict[str, tuple[str, ...]]) -> dict[str, str]:
    """Return a call's arguments by their names; ValueError if the tool has no such function."""
    names = interface.get(call.function)
    if names is None or len(call.arguments) > len(names):
        raise ValueError(f"no function {call.function} of {len(call.arguments)} arguments")
    unknown = set(call.named) - set(names[len(call.arguments) :])
    if unknown:
        raise ValueError(f"{call.function} has no arguments {unknown}")
    return {**dict(zip(names, call.arguments, strict=False)), **call.named}
