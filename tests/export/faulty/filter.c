/* x' = k (u - x), y = x + u: an FMU of FMI 2.0 that has one FAULT by its number, or none with 0.
   What is called it appends to the file that FMU_CALLS names in the environment, if there is one. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"

enum { X, DER, U, Y, K, COUNT };
static const char *const NAMES[COUNT] = {"x", "der(x)", "u", "y", "k"};
typedef struct {
    double v[COUNT];
    int event;
} body;

static void say(const char *format, ...) {
    const char *place = getenv("FMU_CALLS");
    FILE *file = place ? fopen(place, "a") : NULL;
    if (file) {
        va_list words;
        va_start(words, format);
        vfprintf(file, format, words);
        va_end(words);
        fclose(file);
    }
}

static double shared;
static void *volatile lost;

static void start(body *b) {
    memset(b, 0, sizeof *b);
    b->v[K] = FAULT == 1 ? 2.5 : 2.0;
}
static void rates(body *b) {
    b->v[DER] = b->v[K] * (b->v[U] - b->v[X]);
    b->v[Y] = b->v[X] + b->v[U];
}
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String place,
                              const fmi2CallbackFunctions *calls, fmi2Boolean a, fmi2Boolean b) {
    (void)name, (void)type, (void)guid, (void)place, (void)calls, (void)a, (void)b;
    if (FAULT == 11) {
        return NULL;
    }
    body *made = malloc(sizeof *made);
    if (FAULT == 5) {
        lost = malloc(4096);
        memset(lost, 1, 4096);
    }
    start(made);
    return made;
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean a, size_t n, const fmi2String s[]) {
    (void)c, (void)a, (void)n, (void)s;
    return fmi2OK;
}
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean a, fmi2Real b, fmi2Real d,
                               fmi2Boolean e, fmi2Real f) {
    (void)c, (void)a, (void)b, (void)e;
    say("SetupExperiment from %g, stop %s\n", d, e ? "defined" : "not defined");
    (void)f;
    return fmi2OK;
}
fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    say("EnterInitializationMode\n");
    return c ? fmi2OK : fmi2Error;
}
fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    say("ExitInitializationMode\n");
    return c ? fmi2OK : fmi2Error;
}
fmi2Status fmi2Terminate(fmi2Component c) {
    say("Terminate\n");
    return c ? fmi2OK : fmi2Error;
}
fmi2Status fmi2Reset(fmi2Component c) {
    say("Reset\n");
    if (FAULT != 3) {
        start(c);
    }
    return fmi2OK;
}
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference r[], size_t n,
                       const fmi2Real v[]) {
    body *b = c;
    for (size_t k = 0; k < n; k++) {
        say("Set %s = %.6g\n", NAMES[r[k]], v[k]);
        if (!(FAULT == 2 && r[k] == K) && !(FAULT == 12 && b->event && r[k] == U)) {
            b->v[r[k]] = v[k];
        }
    }
    return fmi2OK;
}
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Real v[]) {
    body *b = c;
    rates(b);
    for (size_t k = 0; k < n; k++) {
        v[k] = b->v[r[k]];
        say("Get %s\n", NAMES[r[k]]);
    }
    return fmi2OK;
}
#define OTHER(kind, type)                                                                          \
    fmi2Status fmi2Get##kind(fmi2Component c, const fmi2ValueReference r[], size_t n, type v[]) {  \
        (void)c, (void)r, (void)v;                                                                 \
        return n ? fmi2Error : fmi2OK;                                                             \
    }                                                                                              \
    fmi2Status fmi2Set##kind(fmi2Component c, const fmi2ValueReference r[], size_t n,              \
                             const type v[]) {                                                     \
        (void)c, (void)r, (void)v;                                                                 \
        return n ? fmi2Error : fmi2OK;                                                             \
    }
OTHER(Integer, fmi2Integer)
OTHER(Boolean, fmi2Boolean)
OTHER(String, fmi2String)
fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *s) {
    *s = malloc(sizeof(body));
    memcpy(*s, c, sizeof(body));
    return fmi2OK;
}
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate s) {
    if (FAULT != 6) {
        memcpy(c, s, sizeof(body));
    }
    return fmi2OK;
}
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *s) {
    (void)c;
    free(*s);
    *s = NULL;
    return fmi2OK;
}
fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate s, size_t *n) {
    (void)c, (void)s;
    *n = sizeof(body);
    return fmi2OK;
}
fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate s, fmi2Byte b[], size_t n) {
    (void)c;
    memcpy(b, s, n);
    return fmi2OK;
}
fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte b[], size_t n,
                                   fmi2FMUstate *s) {
    (void)c;
    *s = malloc(sizeof(body));
    memcpy(*s, b, n);
    return fmi2OK;
}
static double slope(const body *b, unsigned of, unsigned by) {
    const double k = b->v[K], own = FAULT == 7 ? k : -k;
    return of == DER ? (by == X ? own : by == U ? k : 0.0) : (by == X || by == U) ? 1.0 : 0.0;
}
fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference of[], size_t n,
                                        const fmi2ValueReference by[], size_t m,
                                        const fmi2Real seed[], fmi2Real found[]) {
    for (size_t i = 0; i < n; i++) {
        found[i] = 0.0;
        for (size_t k = 0; k < m; k++) {
            found[i] += slope(c, of[i], by[k]) * seed[k];
        }
    }
    return fmi2OK;
}
fmi2Status fmi2EnterEventMode(fmi2Component c) {
    ((body *)c)->event = 1;
    return fmi2OK;
}
fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
    (void)c;
    memset(info, 0, sizeof *info);
    return fmi2OK;
}
fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) {
    ((body *)c)->event = 0;
    return fmi2OK;
}
fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean a, fmi2Boolean *b,
                                       fmi2Boolean *d) {
    (void)c, (void)a, *b = *d = fmi2False;
    return fmi2OK;
}
fmi2Status fmi2SetTime(fmi2Component c, fmi2Real t) {
    (void)c;
    say("SetTime %.6g\n", t);
    return fmi2OK;
}
fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n) {
    (void)n, ((body *)c)->v[X] = x[0];
    return fmi2OK;
}
fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real d[], size_t n) {
    (void)n, rates(c);
    say("GetDerivatives with u = %.6g\n", ((body *)c)->v[U]);
    d[0] = ((body *)c)->v[DER];
    return fmi2OK;
}
fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n) {
    (void)c, (void)z;
    return n ? fmi2Error : fmi2OK;
}
fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    (void)n, x[0] = ((body *)c)->v[X];
    return fmi2OK;
}
fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    (void)c, (void)n, x[0] = 1.0;
    return fmi2OK;
}
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real now, fmi2Real h, fmi2Boolean a) {
    body *b = c;
    (void)a;
    say("DoStep from %.6g by %.6g\n", now, h);
    if (FAULT == 9 && (h < 0.0099 || h > 0.0101)) {
        return fmi2Error;
    }
    if (FAULT == 4) {
        shared += h;
        b->v[X] += h * shared;
    }
    rates(b);
    b->v[X] += h * b->v[DER];
    return fmi2OK;
}
fmi2Status fmi2CancelStep(fmi2Component c) { return c ? fmi2OK : fmi2Error; }
fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                       const fmi2Integer o[], const fmi2Real v[]) {
    (void)c, (void)o;
    for (size_t k = 0; k < n; k++) {
        say("Set derivative of %s = %.6g\n", NAMES[r[k]], v[k]);
    }
    return fmi2OK;
}
fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                        const fmi2Integer o[], fmi2Real v[]) {
    (void)c, (void)r, (void)n, (void)o, (void)v;
    return fmi2Error;
}
#define STATUS(kind, type)                                                                         \
    fmi2Status fmi2Get##kind##Status(fmi2Component c, const fmi2StatusKind s, type *v) {           \
        (void)c, (void)s, (void)v;                                                                 \
        return fmi2Discard;                                                                        \
    }
fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *v) {
    (void)c, (void)s, (void)v;
    return fmi2Discard;
}
STATUS(Real, fmi2Real)
STATUS(Integer, fmi2Integer)
STATUS(Boolean, fmi2Boolean)
STATUS(String, fmi2String)
