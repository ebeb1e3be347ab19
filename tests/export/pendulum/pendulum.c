#include <math.h>
#include <string.h>
#include "fmi2Functions.h"

enum { SETUP, INITIALIZATION, EVENT, CONTINUOUS };
typedef struct {
    int mode;
    const fmi2CallbackFunctions *host;
    double phi, w, torque, length, damping, gravity;
} body;

static double *place(body *b, fmi2ValueReference r) {
    double *const all[] = {&b->phi, &b->w, &b->torque, &b->length, &b->damping, &b->gravity};
    return r < 6 ? all[r] : 0;
}
static void rates(const body *b, double *d) {
    d[0] = b->w;
    d[1] = (b->torque - b->damping * b->w - b->gravity * b->length * sin(b->phi)) /
           (b->length * b->length);
}
static fmi2Status to(fmi2Component c, int mode) {
    ((body *)c)->mode = mode;
    return fmi2OK;
}
fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String where,
                              const fmi2CallbackFunctions *host, fmi2Boolean seen,
                              fmi2Boolean log) {
    (void)name, (void)seen, (void)log;
    if (type != fmi2ModelExchange || strcmp(guid, "plain") || strncmp(where, "file:", 5)) {
        return 0;
    }
    body *b = host->allocateMemory(1, sizeof *b);
    b->host = host;
    fmi2Reset(b);
    return b;
}
void fmi2FreeInstance(fmi2Component c) { ((body *)c)->host->freeMemory(c); }
fmi2Status fmi2Reset(fmi2Component c) {
    body *b = c;
    b->phi = 0.1, b->w = 0.0, b->torque = 0.0, b->length = 0.5, b->damping = 0.05;
    b->gravity = 9.81;
    return to(c, SETUP);
}
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean a, fmi2Real b, fmi2Real d,
                               fmi2Boolean e, fmi2Real f) {
    (void)c, (void)a, (void)b, (void)d, (void)e, (void)f;
    return fmi2OK;
}
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return to(c, INITIALIZATION); }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    const body *b = c;
    return b->length > 0.0 ? to(c, EVENT) : fmi2Error;
}
fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
    memset(info, 0, sizeof *info);
    return ((body *)c)->mode == EVENT ? fmi2OK : fmi2Error;
}
fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) {
    return ((body *)c)->mode == EVENT ? to(c, CONTINUOUS) : fmi2Error;
}
fmi2Status fmi2SetTime(fmi2Component c, fmi2Real t) {
    (void)t;
    return ((body *)c)->mode == CONTINUOUS ? fmi2OK : fmi2Error;
}
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference r[], size_t n,
                       const fmi2Real v[]) {
    for (size_t k = 0; k < n; k++) {
        if (!place(c, r[k]) || (((body *)c)->mode == CONTINUOUS && r[k] != 2)) {
            return fmi2Error;
        }
        *place(c, r[k]) = v[k];
    }
    return fmi2OK;
}
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Real v[]) {
    const body *b = c;
    double d[2];
    rates(b, d);
    for (size_t k = 0; k < n; k++) {
        v[k] = r[k] < 6 ? *place(c, r[k]) : r[k] < 8 ? d[r[k] - 6] : b->length * sin(b->phi);
    }
    return fmi2OK;
}
fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n) {
    body *b = c;
    b->phi = x[0], b->w = x[1];
    return n == 2 && b->mode == CONTINUOUS ? fmi2OK : fmi2Error;
}
fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    const body *b = c;
    x[0] = b->phi, x[1] = b->w;
    return n == 2 ? fmi2OK : fmi2Error;
}
fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real d[], size_t n) {
    rates(c, d);
    return n == 2 ? fmi2OK : fmi2Error;
}
fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    (void)c;
    for (size_t k = 0; k < n; k++) {
        x[k] = 1.0;
    }
    return fmi2OK;
}
fmi2Status fmi2Terminate(fmi2Component c) { return to(c, SETUP); }
fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean a, fmi2Boolean *event,
                                       fmi2Boolean *end) {
    (void)c, (void)a, *event = *end = fmi2False;
    return fmi2OK;
}
