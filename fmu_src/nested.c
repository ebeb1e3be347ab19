/* An FMU of FMI 2.0 for co-simulation that holds other FMUs, and steps them in turn.

   Over a step a part gets what the part before it shows: a straight line where it takes input
   derivatives, else the mean over the step, and at its end the value of that time. So nothing is
   late by a step, as it is between FMUs that a master wires. Which parts there are, whose variables
   are shown and how they are wired says nested_config.h. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#include <windows.h>
#else
#include <dlfcn.h>
#endif

#include "fmi2Functions.h"
#include "nested_config.h"

/* What is called of a part, of either version of FMI. */
typedef struct {
    void *library;
    void *instance;
    fmi2FreeInstanceTYPE *free2;
    fmi2SetupExperimentTYPE *setup2;
    fmi2EnterInitializationModeTYPE *enter2;
    fmi2ExitInitializationModeTYPE *exit2;
    fmi2TerminateTYPE *terminate2;
    fmi2ResetTYPE *reset2;
    fmi2SetRealTYPE *set_real2;
    fmi2GetRealTYPE *get_real2;
    fmi2SetIntegerTYPE *set_integer2;
    fmi2GetIntegerTYPE *get_integer2;
    fmi2SetBooleanTYPE *set_boolean2;
    fmi2GetBooleanTYPE *get_boolean2;
    fmi2SetRealInputDerivativesTYPE *set_slopes2;
    fmi2DoStepTYPE *step2;
} part;

typedef struct {
    fmi2CallbackFunctions calls; /* copies, as a part may keep a pointer to them */
    part parts[NESTED_PARTS];
    double begin[NESTED_WIRES + 1], end[NESTED_WIRES + 1]; /* what wires carry */
} container;

static void *found(void *library, const char *name) {
#ifdef _WIN32
    return (void *)GetProcAddress((HMODULE)library, name);
#else
    return dlsym(library, name);
#endif
}

static void *loaded(const char *path) {
#ifdef _WIN32
    return (void *)LoadLibraryExA(path, NULL, LOAD_WITH_ALTERED_SEARCH_PATH);
#else
    return dlopen(path, RTLD_NOW | RTLD_LOCAL);
#endif
}

static void closed(void *library) {
#ifdef _WIN32
    FreeLibrary((HMODULE)library);
#else
    dlclose(library);
#endif
}

/* A pointer to data becomes one to a function, which ISO C has no conversion for. */
#define FIND(to, name)                                \
    do {                                              \
        void *const place = found(p->library, name); \
        memcpy(&p->to, &place, sizeof place);         \
        if (!place) return 0;                         \
    } while (0)

static int functions(part *p) {
    FIND(free2, "fmi2FreeInstance");
    FIND(setup2, "fmi2SetupExperiment");
    FIND(enter2, "fmi2EnterInitializationMode");
    FIND(exit2, "fmi2ExitInitializationMode");
    FIND(terminate2, "fmi2Terminate");
    FIND(reset2, "fmi2Reset");
    FIND(set_real2, "fmi2SetReal");
    FIND(get_real2, "fmi2GetReal");
    FIND(set_integer2, "fmi2SetInteger");
    FIND(get_integer2, "fmi2GetInteger");
    FIND(set_boolean2, "fmi2SetBoolean");
    FIND(get_boolean2, "fmi2GetBoolean");
    FIND(set_slopes2, "fmi2SetRealInputDerivatives");
    FIND(step2, "fmi2DoStep");
    return 1;
}

/* Turn a URI of a folder into a path: file:///a%20b is /a b. */
static int path_of(const char *uri, char *path, size_t room) {
    const char *from = uri;
    size_t n = 0;
    if (!strncmp(from, "file://", 7)) from += 7;
    else if (!strncmp(from, "file:", 5)) from += 5;
#ifdef _WIN32
    if (from[0] == '/' && from[1] && from[2] == ':') from++;
#endif
    for (; *from && n + 1 < room; from++, n++) {
        unsigned code = 0;
        if (*from == '%' && sscanf(from + 1, "%2x", &code) == 1) {
            path[n] = (char)code;
            from += 2;
        } else {
            path[n] = *from;
        }
    }
    path[n] = 0;
    return !*from;
}

/* Give parts the start values that are not those of their binaries. */
static fmi2Status started(container *self) {
    fmi2Status worst = fmi2OK;
    for (int k = 0; k < NESTED_STARTS; k++) {
        const part *const p = &self->parts[STARTS[k].part];
        const fmi2ValueReference *const r = &STARTS[k].variable;
        const fmi2Integer whole = (fmi2Integer)STARTS[k].value;
        const fmi2Boolean flag = whole ? fmi2True : fmi2False;
        const char kind = STARTS[k].kind;
        const fmi2Status status = kind == 'B'   ? p->set_boolean2(p->instance, r, 1, &flag)
                                  : kind == 'I' ? p->set_integer2(p->instance, r, 1, &whole)
                                                : p->set_real2(p->instance, r, 1, &STARTS[k].value);
        worst = status > worst ? status : worst;
    }
    return worst;
}

/* Make an instance of a part; `folder` and `text` have room for what is longer than the resources. */
static int made(container *self, int k, fmi2String name, fmi2String resources, fmi2Boolean visible,
                fmi2Boolean logging, char *folder, char *text, size_t room) {
    part *const p = &self->parts[k];
    fmi2InstantiateTYPE *make;
    if (!path_of(resources, folder, room)) return 0;
    snprintf(text, room, "%s/%s/binaries/" NESTED_PLATFORM "/%s" NESTED_SUFFIX, folder,
             NESTED[k].folder, NESTED[k].identifier);
    p->library = loaded(text);
    if (!p->library || !functions(p)) return 0;
    void *const place = found(p->library, "fmi2Instantiate");
    memcpy(&make, &place, sizeof place);
    if (!make) return 0;
    snprintf(text, room, "%s/%s/resources", resources, NESTED[k].folder);
    p->instance = make(name, fmi2CoSimulation, NESTED[k].token, text, &self->calls, visible, logging);
    return p->instance != NULL;
}

static int opened(container *self, int k, fmi2String name, fmi2String resources, fmi2Boolean visible,
                  fmi2Boolean logging) {
    const size_t room = strlen(resources) + strlen(NESTED[k].folder) + strlen(NESTED[k].identifier) + 64;
    char *const folder = malloc(room), *const text = malloc(room);
    const int ready = folder && text &&
                      made(self, k, name, resources, visible, logging, folder, text, room);
    free(folder);
    free(text);
    return ready;
}

void fmi2FreeInstance(fmi2Component c) {
    container *const self = c;
    if (!self) return;
    for (int k = 0; k < NESTED_PARTS; k++) {
        part *const p = &self->parts[k];
        if (p->instance) p->free2(p->instance);
        if (p->library) closed(p->library);
    }
    free(self);
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *given, fmi2Boolean visible,
                              fmi2Boolean logging) {
    static const fmi2CallbackFunctions none = {NULL, NULL, NULL, NULL, NULL};
    const char *problem = NULL;
    container *self = NULL;
    if (type != fmi2CoSimulation || !guid || strcmp(guid, NESTED_TOKEN) || !resources) {
        problem = "The type, the GUID or the place of the resources is not this FMU's.";
    } else if ((self = calloc(1, sizeof *self)) != NULL) {
        const fmi2CallbackFunctions calls = given ? *given : none;
        memcpy(&self->calls, &calls, sizeof calls);
        for (int k = 0; k < NESTED_PARTS && !problem; k++) {
            if (!opened(self, k, name, resources, visible, logging)) {
                problem = "An FMU in the resources gives no instance.";
            }
        }
        if (!problem && started(self) > fmi2Warning) problem = "A start value cannot be set.";
    }
    if (problem && given && given->logger) {
        given->logger(given->componentEnvironment, name ? name : "", fmi2Error, "logStatusError",
                      problem);
    }
    if (problem) {
        fmi2FreeInstance(self);
        return NULL;
    }
    return self;
}

#define EACH(call)                                          \
    container *const self = c;                              \
    fmi2Status worst = fmi2OK;                              \
    for (int k = 0; self && k < NESTED_PARTS; k++) {        \
        part *const p = &self->parts[k];                    \
        const fmi2Status status = call;                     \
        worst = status > worst ? status : worst;            \
    }                                                       \
    return self ? worst : fmi2Error

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String names[]) {
    (void)on, (void)n, (void)names;
    return c ? fmi2OK : fmi2Error;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean defined, fmi2Real tolerance,
                               fmi2Real start, fmi2Boolean ends, fmi2Real stop) {
    EACH(p->setup2(p->instance, defined, tolerance, start, ends, stop));
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) { EACH(p->enter2(p->instance)); }

/* Read what the wires from a part carry now. */
static fmi2Status read_wires(container *self, int from, double *values) {
    fmi2Status worst = fmi2OK;
    for (int w = 0; w < NESTED_WIRES; w++) {
        if (WIRES[w].from == from) {
            const part *const p = &self->parts[from];
            const fmi2Status status = p->get_real2(p->instance, &WIRES[w].output, 1, &values[w]);
            worst = status > worst ? status : worst;
        }
    }
    return worst;
}

/* Set the wires into a part: their values, or their mean over a step. */
static fmi2Status set_wires(container *self, int to, const double *a, const double *b) {
    fmi2Status worst = fmi2OK;
    for (int w = 0; w < NESTED_WIRES; w++) {
        if (WIRES[w].to == to) {
            const part *const p = &self->parts[to];
            const double value = 0.5 * (a[w] + b[w]);
            const fmi2Status status = p->set_real2(p->instance, &WIRES[w].input, 1, &value);
            worst = status > worst ? status : worst;
        }
    }
    return worst;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    container *const self = c;
    if (!self) return fmi2Error;
    for (int k = 0; k < NESTED_PARTS; k++) {
        const part *const p = &self->parts[k];
        if (set_wires(self, k, self->begin, self->begin) > fmi2Warning) return fmi2Error;
        if (p->exit2(p->instance) > fmi2Warning) return fmi2Error;
        if (read_wires(self, k, self->begin) > fmi2Warning) return fmi2Error;
    }
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c) { EACH(p->terminate2(p->instance)); }

fmi2Status fmi2Reset(fmi2Component c) {
    container *const self = c;
    for (int k = 0; self && k < NESTED_PARTS; k++) {
        if (self->parts[k].reset2(self->parts[k].instance) > fmi2Warning) return fmi2Error;
    }
    return self ? started(self) : fmi2Error;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real now, fmi2Real size, fmi2Boolean keeps) {
    static const fmi2Integer first = 1;
    container *const self = c;
    if (!self) return fmi2Error;
    for (int k = 0; k < NESTED_PARTS; k++) {
        const part *const p = &self->parts[k];
        const int lines = NESTED[k].lines;
        if (set_wires(self, k, self->begin, lines ? self->begin : self->end) > fmi2Warning) {
            return fmi2Error;
        }
        for (int w = 0; lines && w < NESTED_WIRES; w++) {
            const double slope = (self->end[w] - self->begin[w]) / size;
            if (WIRES[w].to == k &&
                p->set_slopes2(p->instance, &WIRES[w].input, 1, &first, &slope) > fmi2Warning) {
                return fmi2Error;
            }
        }
        const fmi2Status status = p->step2(p->instance, now, size, keeps);
        if (status > fmi2Warning) return status;
        if (set_wires(self, k, self->end, self->end) > fmi2Warning) return fmi2Error;
        if (read_wires(self, k, self->end) > fmi2Warning) return fmi2Error;
    }
    memcpy(self->begin, self->end, sizeof self->end);
    return fmi2OK;
}

/* A variable of this FMU is one of a part, by its place in SHOWN. */
#define PASS(Kind, field, type, constant)                                                            \
    fmi2Status fmi2##Kind(fmi2Component c, const fmi2ValueReference r[], size_t n, constant type v[]) { \
        container *const self = c;                                                                   \
        fmi2Status worst = self ? fmi2OK : fmi2Error;                                                \
        for (size_t k = 0; self && k < n; k++) {                                                     \
            if (r[k] >= NESTED_SHOWN) return fmi2Error;                                              \
            const part *const p = &self->parts[SHOWN[r[k]].part];                                    \
            const fmi2Status status = p->field(p->instance, &SHOWN[r[k]].variable, 1, &v[k]);        \
            worst = status > worst ? status : worst;                                                 \
        }                                                                                            \
        return worst;                                                                                \
    }
PASS(SetReal, set_real2, fmi2Real, const)
PASS(GetReal, get_real2, fmi2Real, )
PASS(SetInteger, set_integer2, fmi2Integer, const)
PASS(GetInteger, get_integer2, fmi2Integer, )
PASS(SetBoolean, set_boolean2, fmi2Boolean, const)
PASS(GetBoolean, get_boolean2, fmi2Boolean, )

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                       const fmi2Integer order[], const fmi2Real v[]) {
    container *const self = c;
    for (size_t k = 0; self && k < n; k++) {
        if (r[k] >= NESTED_SHOWN) return fmi2Error;
        const part *const p = &self->parts[SHOWN[r[k]].part];
        if (NESTED[SHOWN[r[k]].part].lines &&
            p->set_slopes2(p->instance, &SHOWN[r[k]].variable, 1, &order[k], &v[k]) > fmi2Warning) {
            return fmi2Error;
        }
    }
    return self ? fmi2OK : fmi2Error;
}

/* What this FMU does not announce. */
#define NONE(name, ...)            \
    fmi2Status name(__VA_ARGS__) { \
        (void)c;                   \
        return fmi2Error;          \
    }
#define UNUSED(x) x __attribute__((unused))
NONE(fmi2GetString, fmi2Component c, const fmi2ValueReference UNUSED(r[]), size_t UNUSED(n),
     fmi2String UNUSED(v[]))
NONE(fmi2SetString, fmi2Component c, const fmi2ValueReference UNUSED(r[]), size_t UNUSED(n),
     const fmi2String UNUSED(v[]))
NONE(fmi2GetFMUstate, fmi2Component c, fmi2FMUstate *UNUSED(s))
NONE(fmi2SetFMUstate, fmi2Component c, fmi2FMUstate UNUSED(s))
NONE(fmi2FreeFMUstate, fmi2Component c, fmi2FMUstate *UNUSED(s))
NONE(fmi2SerializedFMUstateSize, fmi2Component c, fmi2FMUstate UNUSED(s), size_t *UNUSED(n))
NONE(fmi2SerializeFMUstate, fmi2Component c, fmi2FMUstate UNUSED(s), fmi2Byte UNUSED(b[]),
     size_t UNUSED(n))
NONE(fmi2DeSerializeFMUstate, fmi2Component c, const fmi2Byte UNUSED(b[]), size_t UNUSED(n),
     fmi2FMUstate *UNUSED(s))
NONE(fmi2GetDirectionalDerivative, fmi2Component c, const fmi2ValueReference UNUSED(u[]),
     size_t UNUSED(n), const fmi2ValueReference UNUSED(v[]), size_t UNUSED(m),
     const fmi2Real UNUSED(a[]), fmi2Real UNUSED(b[]))
NONE(fmi2GetRealOutputDerivatives, fmi2Component c, const fmi2ValueReference UNUSED(r[]),
     size_t UNUSED(n), const fmi2Integer UNUSED(o[]), fmi2Real UNUSED(v[]))
NONE(fmi2CancelStep, fmi2Component c)
NONE(fmi2GetStatus, fmi2Component c, const fmi2StatusKind UNUSED(s), fmi2Status *UNUSED(v))
NONE(fmi2GetRealStatus, fmi2Component c, const fmi2StatusKind UNUSED(s), fmi2Real *UNUSED(v))
NONE(fmi2GetIntegerStatus, fmi2Component c, const fmi2StatusKind UNUSED(s), fmi2Integer *UNUSED(v))
NONE(fmi2GetBooleanStatus, fmi2Component c, const fmi2StatusKind UNUSED(s), fmi2Boolean *UNUSED(v))
NONE(fmi2GetStringStatus, fmi2Component c, const fmi2StatusKind UNUSED(s), fmi2String *UNUSED(v))
