/* The sequences of sequences.h with the functions of FMI 3.0: those that must all be refused. */
#include "sequences.h"

#include <math.h>

#include "fmi3Functions.h"
#include "fmi_data.h"

#define FINE(call) CHECK((call) == fmi3OK)
#define REFUSED(call) CHECK((call) == fmi3Error)

static const unsigned FAR = ~0U;

/* Functions of types, clocks and modes that the model does not have; `c` may be NULL. */
static void foreign(fmi3Instance c) {
    size_t size = 0;
    fmi3Float32 single = 0.0F;
    fmi3Int32 integer = 0;
    fmi3UInt64 counter = 0, resolution = 0;
    fmi3Boolean flag = fmi3False;
    fmi3Clock clock = fmi3ClockInactive;
    fmi3Float64 seconds = 0.0;
    fmi3IntervalQualifier qualifier = fmi3IntervalNotYetKnown;
    fmi3String string = NULL;
    fmi3Binary bytes = NULL;
    REFUSED(fmi3GetFloat32(c, &FAR, 1, &single, 1));
    REFUSED(fmi3SetFloat32(c, &FAR, 1, &single, 1));
    REFUSED(fmi3GetInt32(c, &FAR, 1, &integer, 1));
    REFUSED(fmi3SetInt32(c, &FAR, 1, &integer, 1));
    REFUSED(fmi3GetBoolean(c, &FAR, 1, &flag, 1));
    REFUSED(fmi3SetBoolean(c, &FAR, 1, NULL, 1));
    REFUSED(fmi3GetString(c, &FAR, 1, &string, 1));
    REFUSED(fmi3SetString(c, &FAR, 1, &string, 1));
    REFUSED(fmi3GetBinary(c, &FAR, 1, &size, &bytes, 1));
    REFUSED(fmi3SetBinary(c, &FAR, 1, &size, &bytes, 1));
    REFUSED(fmi3GetClock(c, &FAR, 1, &clock));
    REFUSED(fmi3SetClock(c, &FAR, 1, &clock));
    REFUSED(fmi3GetIntervalDecimal(c, &FAR, 1, &seconds, &qualifier));
    REFUSED(fmi3SetIntervalDecimal(c, &FAR, 1, &seconds));
    REFUSED(fmi3GetIntervalFraction(c, &FAR, 1, &counter, &resolution, &qualifier));
    REFUSED(fmi3GetShiftDecimal(c, &FAR, 1, &seconds));
    REFUSED(fmi3SetShiftFraction(c, &FAR, 1, &counter, &resolution));
    REFUSED(fmi3ActivateModelPartition(c, 0, 0.0));
    REFUSED(fmi3EnterConfigurationMode(c));
    REFUSED(fmi3ExitConfigurationMode(c));
    REFUSED(fmi3GetNumberOfVariableDependencies(c, FAR, NULL));
    REFUSED(fmi3GetVariableDependencies(c, FAR, NULL, NULL, NULL, NULL, 1));
}

void call_without_instance(void) {
    double value = 1.0;
    size_t size;
    fmi3FMUState state = NULL;
    fmi3Boolean flag;
    foreign(NULL);
    REFUSED(fmi3SetDebugLogging(NULL, fmi3True, 0, NULL));
    REFUSED(fmi3EnterInitializationMode(NULL, fmi3False, 0.0, 0.0, fmi3False, 0.0));
    REFUSED(fmi3ExitInitializationMode(NULL));
    REFUSED(fmi3EnterEventMode(NULL));
    REFUSED(fmi3EnterStepMode(NULL));
    REFUSED(fmi3Terminate(NULL));
    REFUSED(fmi3Reset(NULL));
    REFUSED(fmi3GetFloat64(NULL, &FAR, 1, &value, 1));
    REFUSED(fmi3SetFloat64(NULL, &FAR, 1, &value, 1));
    REFUSED(fmi3GetFMUState(NULL, &state));
    REFUSED(fmi3SetFMUState(NULL, state));
    REFUSED(fmi3FreeFMUState(NULL, &state));
    REFUSED(fmi3SerializedFMUStateSize(NULL, state, &size));
    REFUSED(fmi3SerializeFMUState(NULL, state, NULL, 0));
    REFUSED(fmi3DeserializeFMUState(NULL, NULL, 0, &state));
    REFUSED(fmi3GetDirectionalDerivative(NULL, &FAR, 1, &FAR, 1, &value, 1, &value, 1));
    REFUSED(fmi3GetAdjointDerivative(NULL, &FAR, 1, &FAR, 1, &value, 1, &value, 1));
    REFUSED(fmi3EvaluateDiscreteStates(NULL));
    REFUSED(fmi3UpdateDiscreteStates(NULL, &flag, &flag, &flag, &flag, &flag, &value));
    REFUSED(fmi3EnterContinuousTimeMode(NULL));
    REFUSED(fmi3CompletedIntegratorStep(NULL, fmi3True, &flag, &flag));
    REFUSED(fmi3SetTime(NULL, 0.0));
    REFUSED(fmi3SetContinuousStates(NULL, &value, 1));
    REFUSED(fmi3GetContinuousStateDerivatives(NULL, &value, 1));
    REFUSED(fmi3GetEventIndicators(NULL, &value, 1));
    REFUSED(fmi3GetContinuousStates(NULL, &value, 1));
    REFUSED(fmi3GetNominalsOfContinuousStates(NULL, &value, 1));
    REFUSED(fmi3GetNumberOfEventIndicators(NULL, &size));
    REFUSED(fmi3GetNumberOfContinuousStates(NULL, &size));
    REFUSED(fmi3GetOutputDerivatives(NULL, &FAR, 1, NULL, &value, 1));
    REFUSED(fmi3DoStep(NULL, 0.0, 1e-4, fmi3True, &flag, &flag, &flag, &value));
    fmi3FreeInstance(NULL);
}

static fmi3Instance make(fmi3String name, fmi3String token, const unsigned required[], size_t count) {
    return fmi3InstantiateCoSimulation(name, token, NULL, fmi3False, fmi3True, fmi3False, fmi3False,
                                       required, count, NULL, NULL, NULL);
}

static void refuse_values(fmi3Instance c) {
    const unsigned beyond = PSA_VARIABLES + 1, output = reference("displacement");
    const double value = 1.0, bad = NAN;
    double found;
    REFUSED(fmi3GetFloat64(c, &beyond, 1, &found, 1));
    REFUSED(fmi3GetFloat64(c, &FAR, 1, &found, 1));
    REFUSED(fmi3GetFloat64(c, &output, 1, &found, 0));
    REFUSED(fmi3GetFloat64(c, NULL, 1, &found, 1));
    REFUSED(fmi3GetFloat64(c, &output, 1, NULL, 1));
    FINE(fmi3GetFloat64(c, NULL, 0, NULL, 0));
    REFUSED(fmi3SetFloat64(c, &output, 1, &value, 1));
    REFUSED(fmi3SetFloat64(c, &output, 1, &bad, 1));
    REFUSED(fmi3SetFloat64(c, &FAR, 1, &value, 1));
    REFUSED(fmi3SetFloat64(c, &FAR, 1, &value, 9));
    REFUSED(fmi3GetDirectionalDerivative(c, &FAR, 1, &FAR, 1, &value, 1, &found, 1));
}

void call_illegally(void) {
    const fmi3String categories[] = {"nonsense", NULL};
    fmi3Boolean flag;
    double found;
    CHECK(!make(NULL, psa_token, NULL, 0));
    CHECK(!make("", psa_token, NULL, 0));
    CHECK(!make("a", NULL, NULL, 0));
    CHECK(!make("a", "no", NULL, 0));
    CHECK(!make("a", psa_token, NULL, 3));
    CHECK(!make("a", psa_token, &FAR, 1));
    CHECK(!fmi3InstantiateScheduledExecution("a", psa_token, NULL, fmi3False, fmi3False, NULL, NULL,
                                             NULL, NULL, NULL));
    fmi3Instance c = make("quiet", psa_token, NULL, 0);
    CHECK(c);
    REFUSED(fmi3DoStep(c, 0.0, 1e-4, fmi3True, &flag, &flag, &flag, &found));
    REFUSED(fmi3ExitInitializationMode(c));
    REFUSED(fmi3EnterInitializationMode(c, fmi3True, -1.0, 0.0, fmi3False, 0.0));
    REFUSED(fmi3EnterInitializationMode(c, fmi3False, 0.0, NAN, fmi3False, 0.0));
    REFUSED(fmi3SetDebugLogging(c, fmi3True, 2, categories));
    REFUSED(fmi3SetDebugLogging(c, fmi3True, 1, NULL));
    FINE(fmi3EnterInitializationMode(c, fmi3False, 0.0, 0.0, fmi3True, 1.0));
    FINE(fmi3ExitInitializationMode(c));
    foreign(c);
    refuse_values(c);
    REFUSED(fmi3DoStep(c, 0.5, 1e-4, fmi3True, &flag, &flag, &flag, &found));
    REFUSED(fmi3DoStep(c, 0.0, -1e-4, fmi3True, &flag, &flag, &flag, &found));
    REFUSED(fmi3DoStep(c, 0.0, NAN, fmi3True, &flag, &flag, &flag, &found));
    REFUSED(fmi3DoStep(c, 0.0, 1e-4, fmi3True, NULL, NULL, NULL, NULL));
    REFUSED(fmi3DoStep(c, 0.0, 2.0, fmi3True, &flag, &flag, &flag, &found));
    REFUSED(fmi3EnterEventMode(c));
    REFUSED(fmi3SetTime(c, 0.0));
    FINE(fmi3Terminate(c));
    REFUSED(fmi3Terminate(c));
    fmi3FreeInstance(c);
}
