/* The sequences of sequences.h with the functions of FMI 2.0. */
#include "sequences.h"

#include <math.h>
#include <stdarg.h>
#include <stdint.h>
#include <string.h>

#include "fmi2Functions.h"
#include "fmi_data.h"

#define FINE(call) CHECK((call) == fmi2OK)
#define REFUSED(call) CHECK((call) == fmi2Error)

static const double STEP = 1e-4;

/* Reads what it is given, so that a sanitizer sees the strings; the text is a format. */
static void message(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                    fmi2String category, fmi2String text, ...) {
    char printed[1024];
    va_list arguments;
    (void)environment;
    va_start(arguments, text);
    CHECK(vsnprintf(printed, sizeof printed, text, arguments) > 10);
    va_end(arguments);
    CHECK(strlen(name) > 0 && strlen(category) > 0 && strlen(text) > 10 && status <= fmi2Error);
}

static fmi2Component instantiate(fmi2Type type) {
    const fmi2CallbackFunctions callbacks = {message, NULL, NULL, NULL, NULL};
    fmi2Component c = fmi2Instantiate("one", type, psa_token, NULL, &callbacks, fmi2False, fmi2True);
    CHECK(c);
    return c;
}

static void initialize(fmi2Component c) {
    FINE(fmi2SetupExperiment(c, fmi2True, 1e-6, 0.0, fmi2False, 0.0));
    FINE(fmi2EnterInitializationMode(c));
    FINE(fmi2ExitInitializationMode(c));
}

void *make_slave(void) {
    fmi2Component c = instantiate(fmi2CoSimulation);
    initialize(c);
    return c;
}

static void set_voltage(fmi2Component c, int step) {
    const unsigned vr = reference("voltage");
    const double value = voltage_of(step);
    FINE(fmi2SetReal(c, &vr, 1, &value));
}

void advance_slave(void *slave, int step) {
    set_voltage(slave, step);
    FINE(fmi2DoStep(slave, step * STEP, STEP, fmi2True));
}

double read_slave(void *slave) {
    const unsigned vr = reference("displacement");
    double value = 0.0;
    FINE(fmi2GetReal(slave, &vr, 1, &value));
    return value;
}

void free_slave(void *slave) {
    FINE(fmi2Terminate(slave));
    fmi2FreeInstance(slave);
}

void step_without_allocation(void *slave, int step) {
    const unsigned input = reference("voltage");
    const int order = 1;
    const double rate = 1e3;
    double every[PSA_VARIABLES];
    unsigned all[PSA_VARIABLES];
    for (unsigned k = 0; k < PSA_VARIABLES; ++k) all[k] = k + 1;
    FINE(fmi2SetRealInputDerivatives(slave, &input, 1, &order, &rate));
    advance_slave(slave, step);
    FINE(fmi2GetReal(slave, all, PSA_VARIABLES, every));
    differentiate(slave);
}

void differentiate(void *slave) {
    const unsigned known = reference("voltage"), unknown = reference("current");
    const int order = 1;
    const double seed = 1.0;
    double found = NAN;
    FINE(fmi2GetDirectionalDerivative(slave, &unknown, 1, &known, 1, &seed, &found));
    CHECK(isfinite(found));
    FINE(fmi2GetRealOutputDerivatives(slave, &unknown, 1, &order, &found));
    CHECK(isfinite(found));
}

void exchange_model(void) {
    fmi2Component c = instantiate(fmi2ModelExchange);
    fmi2EventInfo info;
    fmi2Boolean enter, terminate;
    const fmi2String formats = "%s%s%s%n %";
    double x[PSA_NX], rate[PSA_NX], nominal[PSA_NX], indicators[PSA_NZ + 1];
    REFUSED(fmi2SetDebugLogging(c, fmi2True, 1, &formats));
    initialize(c);
    FINE(fmi2NewDiscreteStates(c, &info));
    FINE(fmi2EnterContinuousTimeMode(c));
    for (int step = 0; step < 50; ++step) {
        FINE(fmi2SetTime(c, step * 1e-6));
        set_voltage(c, step);
        FINE(fmi2GetContinuousStates(c, x, PSA_NX));
        FINE(fmi2GetDerivatives(c, rate, PSA_NX));
        FINE(fmi2GetNominalsOfContinuousStates(c, nominal, PSA_NX));
        FINE(fmi2GetEventIndicators(c, indicators, PSA_NZ));
        for (int i = 0; i < PSA_NX; ++i) x[i] += 1e-9 * rate[i];
        FINE(fmi2SetContinuousStates(c, x, PSA_NX));
        FINE(fmi2CompletedIntegratorStep(c, fmi2True, &enter, &terminate));
    }
    REFUSED(fmi2GetContinuousStates(c, x, PSA_NX - 1));
    REFUSED(fmi2SetContinuousStates(c, NULL, PSA_NX));
    REFUSED(fmi2GetDerivatives(c, rate, PSA_NX + 1));
    REFUSED(fmi2GetEventIndicators(c, indicators, PSA_NZ + 1));
    REFUSED(fmi2GetNominalsOfContinuousStates(c, NULL, PSA_NX));
    REFUSED(fmi2CompletedIntegratorStep(c, fmi2True, NULL, NULL));
    REFUSED(fmi2SetTime(c, NAN));
    REFUSED(fmi2DoStep(c, 0.0, STEP, fmi2True));
    FINE(fmi2EnterEventMode(c));
    REFUSED(fmi2NewDiscreteStates(c, NULL));
    FINE(fmi2Reset(c));
    fmi2FreeInstance(c);
}

/* Each word of a state that no number, count or index can be, under a checksum that is right. */
static void forge_states(void *slave, const char *bytes, size_t size) {
    const size_t stamp = 32;
    char *const forged = malloc(size);
    fmi2FMUstate state = NULL;
    CHECK(forged);
    for (size_t word = stamp; word + 8 <= size; word += 8) {
        uint64_t checksum = UINT64_C(14695981039346656037);
        memcpy(forged, bytes, size);
        memset(forged + word, 0xff, 8);
        for (size_t i = stamp; i < size; ++i)
            checksum = (checksum ^ (unsigned char)forged[i]) * UINT64_C(1099511628211);
        memcpy(forged + stamp - 8, &checksum, 8);
        if (fmi2DeSerializeFMUstate(slave, forged, size, &state)) continue;
        FINE(fmi2SetFMUstate(slave, state));
        (void)fmi2DoStep(slave, 0.0, STEP, fmi2True);
        FINE(fmi2FreeFMUstate(slave, &state));
    }
    free(forged);
}

void keep_states(void *slave) {
    fmi2FMUstate state = NULL, other = NULL;
    size_t size = 0;
    const double before = read_slave(slave);
    FINE(fmi2GetFMUstate(slave, &state));
    FINE(fmi2GetFMUstate(slave, &state)); /* into the same memory */
    FINE(fmi2SerializedFMUstateSize(slave, state, &size));
    char *const bytes = malloc(size);
    CHECK(bytes);
    REFUSED(fmi2SerializeFMUstate(slave, state, bytes, size - 1));
    REFUSED(fmi2SerializeFMUstate(slave, state, NULL, size));
    FINE(fmi2SerializeFMUstate(slave, state, bytes, size));
    for (size_t cut = 0; cut < size; cut += 97)
        REFUSED(fmi2DeSerializeFMUstate(slave, bytes, cut, &other));
    bytes[size / 2] = (char)(bytes[size / 2] ^ 4);
    REFUSED(fmi2DeSerializeFMUstate(slave, bytes, size, &other));
    bytes[size / 2] = (char)(bytes[size / 2] ^ 4);
    CHECK(!other);
    FINE(fmi2DeSerializeFMUstate(slave, bytes, size, &other));
    FINE(fmi2SetFMUstate(slave, other));
    CHECK(read_slave(slave) == before);
    REFUSED(fmi2SetFMUstate(slave, NULL));
    REFUSED(fmi2GetFMUstate(slave, NULL));
    forge_states(slave, bytes, size);
    FINE(fmi2SetFMUstate(slave, other));
    CHECK(read_slave(slave) == before);
    FINE(fmi2FreeFMUstate(slave, state)); /* fmusim passes the state for its address */
    FINE(fmi2FreeFMUstate(slave, &state));
    FINE(fmi2FreeFMUstate(slave, &state)); /* NULL now */
    FINE(fmi2FreeFMUstate(slave, &other));
    free(bytes);
}

void call_without_instance(void) {
    const unsigned vr = 1;
    const int order = 1;
    double value = 1.0;
    size_t size;
    fmi2FMUstate state = NULL;
    fmi2EventInfo info;
    fmi2Status status;
    fmi2Boolean flag;
    REFUSED(fmi2SetDebugLogging(NULL, fmi2True, 0, NULL));
    REFUSED(fmi2SetupExperiment(NULL, fmi2False, 0.0, 0.0, fmi2False, 0.0));
    REFUSED(fmi2EnterInitializationMode(NULL));
    REFUSED(fmi2ExitInitializationMode(NULL));
    REFUSED(fmi2Terminate(NULL));
    REFUSED(fmi2Reset(NULL));
    REFUSED(fmi2GetReal(NULL, &vr, 1, &value));
    REFUSED(fmi2SetReal(NULL, &vr, 1, &value));
    REFUSED(fmi2GetInteger(NULL, &vr, 0, NULL));
    REFUSED(fmi2SetString(NULL, &vr, 0, NULL));
    REFUSED(fmi2GetFMUstate(NULL, &state));
    REFUSED(fmi2SetFMUstate(NULL, state));
    REFUSED(fmi2FreeFMUstate(NULL, &state));
    REFUSED(fmi2SerializedFMUstateSize(NULL, state, &size));
    REFUSED(fmi2SerializeFMUstate(NULL, state, NULL, 0));
    REFUSED(fmi2DeSerializeFMUstate(NULL, NULL, 0, &state));
    REFUSED(fmi2GetDirectionalDerivative(NULL, &vr, 1, &vr, 1, &value, &value));
    REFUSED(fmi2EnterEventMode(NULL));
    REFUSED(fmi2NewDiscreteStates(NULL, &info));
    REFUSED(fmi2EnterContinuousTimeMode(NULL));
    REFUSED(fmi2CompletedIntegratorStep(NULL, fmi2True, &flag, &flag));
    REFUSED(fmi2SetTime(NULL, 0.0));
    REFUSED(fmi2SetContinuousStates(NULL, &value, 1));
    REFUSED(fmi2GetDerivatives(NULL, &value, 1));
    REFUSED(fmi2GetEventIndicators(NULL, &value, 1));
    REFUSED(fmi2GetContinuousStates(NULL, &value, 1));
    REFUSED(fmi2GetNominalsOfContinuousStates(NULL, &value, 1));
    REFUSED(fmi2SetRealInputDerivatives(NULL, &vr, 1, &order, &value));
    REFUSED(fmi2GetRealOutputDerivatives(NULL, &vr, 1, &order, &value));
    REFUSED(fmi2DoStep(NULL, 0.0, STEP, fmi2True));
    REFUSED(fmi2CancelStep(NULL));
    REFUSED(fmi2GetStatus(NULL, fmi2DoStepStatus, &status));
    fmi2FreeInstance(NULL);
}

void call_illegally(void) {
    const unsigned beyond = PSA_VARIABLES + 1, far = ~0U, output = reference("displacement");
    const fmi2String categories[] = {"nonsense", NULL};
    const double value = 1.0, bad = INFINITY;
    const int order = 2;
    double found;
    CHECK(!fmi2Instantiate(NULL, fmi2CoSimulation, psa_token, NULL, NULL, fmi2False, fmi2False));
    CHECK(!fmi2Instantiate("a", fmi2CoSimulation, NULL, NULL, NULL, fmi2False, fmi2False));
    CHECK(!fmi2Instantiate("a", fmi2CoSimulation, "no", NULL, NULL, fmi2False, fmi2False));
    CHECK(!fmi2Instantiate("a", (fmi2Type)7, psa_token, NULL, NULL, fmi2False, fmi2False));
    fmi2Component c = fmi2Instantiate("", fmi2CoSimulation, psa_token, NULL, NULL, fmi2False, fmi2False);
    CHECK(!c);
    c = fmi2Instantiate("quiet", fmi2CoSimulation, psa_token, NULL, NULL, fmi2False, fmi2True);
    CHECK(c);
    REFUSED(fmi2DoStep(c, 0.0, STEP, fmi2True));
    REFUSED(fmi2ExitInitializationMode(c));
    REFUSED(fmi2SetupExperiment(c, fmi2True, -1.0, 0.0, fmi2False, 0.0));
    REFUSED(fmi2SetupExperiment(c, fmi2False, 0.0, NAN, fmi2False, 0.0));
    REFUSED(fmi2SetDebugLogging(c, fmi2True, 2, categories));
    REFUSED(fmi2SetDebugLogging(c, fmi2True, 1, NULL));
    initialize(c);
    REFUSED(fmi2GetReal(c, &beyond, 1, &found));
    REFUSED(fmi2GetReal(c, &far, 1, &found));
    REFUSED(fmi2GetReal(c, NULL, 1, &found));
    REFUSED(fmi2GetReal(c, &output, 1, NULL));
    FINE(fmi2GetReal(c, NULL, 0, NULL));
    REFUSED(fmi2SetReal(c, &output, 1, &value));
    REFUSED(fmi2SetReal(c, &far, 1, &value));
    REFUSED(fmi2SetReal(c, &output, 1, &bad));
    REFUSED(fmi2SetRealInputDerivatives(c, &far, 1, &order, &value));
    REFUSED(fmi2SetRealInputDerivatives(c, &output, 1, NULL, &value));
    REFUSED(fmi2GetRealOutputDerivatives(c, &output, 1, &order, &found));
    REFUSED(fmi2GetDirectionalDerivative(c, &far, 1, &far, 1, &value, &found));
    REFUSED(fmi2GetDirectionalDerivative(c, &output, 1, NULL, 1, &value, &found));
    REFUSED(fmi2DoStep(c, 1.0, STEP, fmi2True));
    REFUSED(fmi2DoStep(c, 0.0, -STEP, fmi2True));
    REFUSED(fmi2DoStep(c, NAN, STEP, fmi2True));
    REFUSED(fmi2CancelStep(c));
    REFUSED(fmi2SetTime(c, 0.0));
    REFUSED(fmi2GetStatus(c, fmi2DoStepStatus, NULL));
    FINE(fmi2Terminate(c));
    REFUSED(fmi2DoStep(c, 0.0, STEP, fmi2True));
    REFUSED(fmi2Terminate(c));
    fmi2FreeInstance(c);
}
