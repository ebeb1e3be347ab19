"""Names of the C functions of FMI 2.0, without the prefix fmi2."""

#: The functions every FMI 2.0 binary must have, by interface.
COMMON = (
    "GetTypesPlatform", "GetVersion", "SetDebugLogging", "Instantiate", "FreeInstance",
    "SetupExperiment", "EnterInitializationMode", "ExitInitializationMode", "Terminate", "Reset",
    "GetReal", "GetInteger", "GetBoolean", "GetString", "SetReal", "SetInteger", "SetBoolean",
    "SetString", "GetFMUstate", "SetFMUstate", "FreeFMUstate", "SerializedFMUstateSize",
    "SerializeFMUstate", "DeSerializeFMUstate", "GetDirectionalDerivative",
)  # fmt: skip
ONLY_MODEL_EXCHANGE = (
    "EnterEventMode", "NewDiscreteStates", "EnterContinuousTimeMode", "CompletedIntegratorStep",
    "SetTime", "SetContinuousStates", "GetDerivatives", "GetEventIndicators", "GetContinuousStates",
    "GetNominalsOfContinuousStates",
)  # fmt: skip
ONLY_CO_SIMULATION = (
    "SetRealInputDerivatives", "GetRealOutputDerivatives", "DoStep", "CancelStep", "GetStatus",
    "GetRealStatus", "GetIntegerStatus", "GetBooleanStatus", "GetStringStatus",
)  # fmt: skip
FUNCTIONS = COMMON + ONLY_MODEL_EXCHANGE + ONLY_CO_SIMULATION
