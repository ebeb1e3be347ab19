/* The sequences of sequences.h with the functions of FMI 3.0. */
#include "sequences.h"

#include <math.h>
#include <string.h>

#include "fmi3Functions.h"
#include "fmi_data.h"

#define FINE(call) CHECK((call) == fmi3OK)
#define REFUSED(call) CHECK((call) == fmi3Error)

static const double STEP = 1e-4;

/* Reads what it is given, so that a sanitizer sees the strings. */
static void message(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category,
                    fmi3String text) {
    (void)environment;
    CHECK(strlen(category) > 0 && strlen(text) > 10 && status <= fmi3Error);
}

/* Counts the intermediate updates, and asks to return early at the first where that is allowed. */
static void update(fmi3InstanceEnvironment environment, fmi3Float64 time, fmi3Boolean requested,
                   fmi3Boolean set, fmi3Boolean finished, fmi3Boolean possible, fmi3Boolean *early,
                   fmi3Float64 *until) {
    (void)requested, (void)set, (void)finished;
    ++*(int *)environment;
    *early = possible;
    *until = time;
}

static void initialize(fmi3Instance c) {
    FINE(fmi3EnterInitializationMode(c, fmi3True, 1e-6, 0.0, fmi3False, 0.0));
    FINE(fmi3ExitInitializationMode(c));
}

static fmi3Instance slave_with(fmi3LogMessageCallback logger, fmi3Boolean events) {
    return fmi3InstantiateCoSimulation("one", psa_token, NULL, fmi3False, fmi3True, events, fmi3False,
                                       NULL, 0, NULL, logger, NULL);
}

void *make_slave(void) {
    fmi3Instance c = slave_with(message, fmi3False);
    CHECK(c);
    initialize(c);
    return c;
}

static void set_voltage(fmi3Instance c, int step) {
    const unsigned vr = reference("voltage");
    const double value = voltage_of(step);
    FINE(fmi3SetFloat64(c, &vr, 1, &value, 1));
}

static fmi3Status do_step(fmi3Instance c, double point, double size) {
    fmi3Boolean event, terminate, early;
    double reached;
    return fmi3DoStep(c, point, size, fmi3True, &event, &terminate, &early, &reached);
}

void advance_slave(void *slave, int step) {
    set_voltage(slave, step);
    FINE(do_step(slave, step * STEP, STEP));
}

double read_slave(void *slave) {
    const unsigned vr = reference("displacement");
    double value = 0.0;
    FINE(fmi3GetFloat64(slave, &vr, 1, &value, 1));
    return value;
}

void free_slave(void *slave) {
    FINE(fmi3Terminate(slave));
    fmi3FreeInstance(slave);
}

void step_without_allocation(void *slave, int step) {
    double every[PSA_VARIABLES];
    unsigned all[PSA_VARIABLES];
    for (unsigned k = 0; k < PSA_VARIABLES; ++k) all[k] = k + 1;
    advance_slave(slave, step);
    FINE(fmi3GetFloat64(slave, all, PSA_VARIABLES, every, PSA_VARIABLES));
    differentiate(slave);
}

void differentiate(void *slave) {
    const unsigned known = reference("voltage"), unknown = reference("current");
    const fmi3Int32 order = 1;
    const double seed = 1.0;
    double forward = NAN, back = NAN, rate = NAN;
    FINE(fmi3GetDirectionalDerivative(slave, &unknown, 1, &known, 1, &seed, 1, &forward, 1));
    FINE(fmi3GetAdjointDerivative(slave, &unknown, 1, &known, 1, &seed, 1, &back, 1));
    CHECK(fabs(forward - back) <= 1e-12 * fabs(forward) && forward > 0.0);
    FINE(fmi3GetOutputDerivatives(slave, &unknown, 1, &order, &rate, 1));
    CHECK(isfinite(rate));
    REFUSED(fmi3GetDirectionalDerivative(slave, &unknown, 1, &known, 1, &seed, 2, &forward, 1));
    REFUSED(fmi3GetAdjointDerivative(slave, &unknown, 1, &known, 1, &seed, 1, &back, 0));
    REFUSED(fmi3GetAdjointDerivative(slave, NULL, 1, &known, 1, &seed, 1, &back, 1));
    REFUSED(fmi3GetOutputDerivatives(slave, &unknown, 1, NULL, &rate, 1));
}

static void update_events(fmi3Instance c) {
    fmi3Boolean need, terminate, nominals, values, defined;
    double next;
    FINE(fmi3EvaluateDiscreteStates(c));
    FINE(fmi3UpdateDiscreteStates(c, &need, &terminate, &nominals, &values, &defined, &next));
    REFUSED(fmi3UpdateDiscreteStates(c, NULL, NULL, NULL, NULL, NULL, NULL));
}

/* Event mode between steps, and steps that end early. */
static void interrupted_steps(void) {
    int updates = 0;
    fmi3Boolean event, terminate, early;
    double point = 0.0;
    fmi3Instance c = fmi3InstantiateCoSimulation("two", psa_token, "", fmi3False, fmi3False, fmi3True,
                                                 fmi3True, NULL, 0, &updates, message, update);
    CHECK(c);
    initialize(c);
    for (int step = 0; step < 20; ++step) {
        set_voltage(c, step);
        update_events(c);
        FINE(fmi3EnterStepMode(c));
        FINE(fmi3DoStep(c, point, STEP, fmi3False, &event, &terminate, &early, &point));
        FINE(fmi3EnterEventMode(c));
    }
    CHECK(updates >= 20 && point > 0.0 && point < 20 * STEP);
    FINE(fmi3Terminate(c));
    fmi3FreeInstance(c);
}

void exchange_model(void) {
    fmi3Instance c = fmi3InstantiateModelExchange("one", psa_token, NULL, fmi3False, fmi3True, NULL, message);
    fmi3Boolean enter, terminate;
    size_t count = 0;
    double x[PSA_NX], rate[PSA_NX], nominal[PSA_NX], indicators[PSA_NZ + 1];
    CHECK(c);
    initialize(c);
    update_events(c);
    FINE(fmi3GetNumberOfContinuousStates(c, &count));
    CHECK(count == PSA_NX);
    FINE(fmi3GetNumberOfEventIndicators(c, &count));
    CHECK(count == PSA_NZ);
    REFUSED(fmi3GetNumberOfEventIndicators(c, NULL));
    FINE(fmi3EnterContinuousTimeMode(c));
    for (int step = 0; step < 50; ++step) {
        FINE(fmi3SetTime(c, step * 1e-6));
        set_voltage(c, step);
        FINE(fmi3GetContinuousStates(c, x, PSA_NX));
        FINE(fmi3GetContinuousStateDerivatives(c, rate, PSA_NX));
        FINE(fmi3GetNominalsOfContinuousStates(c, nominal, PSA_NX));
        FINE(fmi3GetEventIndicators(c, indicators, PSA_NZ));
        for (int i = 0; i < PSA_NX; ++i) x[i] += 1e-9 * rate[i];
        FINE(fmi3SetContinuousStates(c, x, PSA_NX));
        FINE(fmi3CompletedIntegratorStep(c, fmi3True, &enter, &terminate));
    }
    REFUSED(fmi3GetContinuousStates(c, x, PSA_NX - 1));
    REFUSED(fmi3SetContinuousStates(c, NULL, PSA_NX));
    REFUSED(fmi3GetContinuousStateDerivatives(c, rate, PSA_NX + 1));
    REFUSED(fmi3GetEventIndicators(c, indicators, PSA_NZ + 1));
    REFUSED(fmi3CompletedIntegratorStep(c, fmi3True, NULL, NULL));
    REFUSED(fmi3SetTime(c, NAN));
    REFUSED(do_step(c, 0.0, STEP));
    FINE(fmi3EnterEventMode(c));
    FINE(fmi3Reset(c));
    fmi3FreeInstance(c);
    interrupted_steps();
}

void keep_states(void *slave) {
    fmi3FMUState state = NULL, other = NULL;
    size_t size = 0;
    const double before = read_slave(slave);
    FINE(fmi3GetFMUState(slave, &state));
    FINE(fmi3GetFMUState(slave, &state)); /* into the same memory */
    FINE(fmi3SerializedFMUStateSize(slave, state, &size));
    fmi3Byte *const bytes = malloc(size);
    CHECK(bytes);
    REFUSED(fmi3SerializeFMUState(slave, state, bytes, size - 1));
    REFUSED(fmi3SerializeFMUState(slave, state, NULL, size));
    FINE(fmi3SerializeFMUState(slave, state, bytes, size));
    for (size_t cut = 0; cut < size; cut += 97)
        REFUSED(fmi3DeserializeFMUState(slave, bytes, cut, &other));
    bytes[size / 2] = (fmi3Byte)(bytes[size / 2] ^ 4);
    REFUSED(fmi3DeserializeFMUState(slave, bytes, size, &other));
    bytes[size / 2] = (fmi3Byte)(bytes[size / 2] ^ 4);
    CHECK(!other);
    FINE(fmi3DeserializeFMUState(slave, bytes, size, &other));
    FINE(fmi3SetFMUState(slave, other));
    CHECK(read_slave(slave) == before);
    REFUSED(fmi3SetFMUState(slave, NULL));
    REFUSED(fmi3GetFMUState(slave, NULL));
    FINE(fmi3FreeFMUState(slave, &state));
    FINE(fmi3FreeFMUState(slave, &state)); /* NULL now */
    FINE(fmi3FreeFMUState(slave, &other));
    free(bytes);
}
