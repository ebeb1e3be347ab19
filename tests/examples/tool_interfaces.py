"""What other tools understand, as far as the recipes use it: functions, arguments, blocks."""

from tests.examples.script_calls import Call

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


def bound(call: Call, interface: dict[str, tuple[str, ...]]) -> dict[str, str]:
    """Return a call's arguments by their names; ValueError if the tool has no such function."""
    names = interface.get(call.function)
    if names is None or len(call.arguments) > len(names):
        raise ValueError(f"no function {call.function} of {len(call.arguments)} arguments")
    unknown = set(call.named) - set(names[len(call.arguments) :])
    if unknown:
        raise ValueError(f"{call.function} has no arguments {unknown}")
    return {**dict(zip(names, call.arguments, strict=False)), **call.named}
