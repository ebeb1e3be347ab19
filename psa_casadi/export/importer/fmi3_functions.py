"""Names of the C functions of FMI 3.0, without the prefix fmi3."""

_TYPES = (
    "Float32", "Float64", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64",
    "Boolean", "String", "Binary", "Clock",
)  # fmt: skip

#: The functions every FMI 3.0 binary must have, by interface.
COMMON = (
    "GetVersion", "SetDebugLogging", "InstantiateModelExchange", "InstantiateCoSimulation",
    "InstantiateScheduledExecution", "FreeInstance", "EnterInitializationMode",
    "ExitInitializationMode", "EnterEventMode", "Terminate", "Reset",
    *(f"Get{t}" for t in _TYPES), *(f"Set{t}" for t in _TYPES),
    "GetNumberOfVariableDependencies", "GetVariableDependencies",
    "GetFMUState", "SetFMUState", "FreeFMUState", "SerializedFMUStateSize", "SerializeFMUState",
    "DeserializeFMUState", "GetDirectionalDerivative", "GetAdjointDerivative",
    "EnterConfigurationMode", "ExitConfigurationMode", "GetIntervalDecimal", "GetIntervalFraction",
    "GetShiftDecimal", "GetShiftFraction", "SetIntervalDecimal", "SetIntervalFraction",
    "SetShiftDecimal", "SetShiftFraction", "EvaluateDiscreteStates", "UpdateDiscreteStates",
)  # fmt: skip
ONLY_MODEL_EXCHANGE = (
    "EnterContinuousTimeMode", "CompletedIntegratorStep", "SetTime", "SetContinuousStates",
    "GetContinuousStateDerivatives", "GetEventIndicators", "GetContinuousStates",
    "GetNominalsOfContinuousStates", "GetNumberOfEventIndicators", "GetNumberOfContinuousStates",
)  # fmt: skip
ONLY_CO_SIMULATION = ("EnterStepMode", "GetOutputDerivatives", "DoStep")
ONLY_SCHEDULED_EXECUTION = ("ActivateModelPartition",)
FUNCTIONS = COMMON + ONLY_MODEL_EXCHANGE + ONLY_CO_SIMULATION + ONLY_SCHEDULED_EXECUTION
