/* The FMI 2.0 face: both interfaces, each function a call of the core in instance.h. */
#include <stdlib.h>
#include <string.h>

#include "fmi2_face.h"

typedef struct {
    psa_instance core; /* first, so that a component is a core too */
    fmi2CallbackLogger logger;
    fmi2ComponentEnvironment environment;
    char name[]; /* copy of the instance name */
} component;

/* A message of FMI 2.0 is a format of printf, in which #r1# stands for the name of a variable: the signs
   that begin such things are doubled. Importers that print the message as it is can read it too, which
   they could not if it came as an argument of "%s". */
static void report(void *owner, psa_result severity, const char *sentence) {
    const component *const self = owner;
    char message[2 * PSA_SENTENCE];
    size_t length = 0;
    if (!self->logger) return;
    for (; *sentence && length + 2 < sizeof message; ++sentence) {
        if (*sentence == '%' || *sentence == '#') message[length++] = *sentence;
        message[length++] = *sentence;
    }
    message[length] = 0;
    self->logger(self->environment, self->name, psa_fmi2_status(severity), psa_log_category(severity),
                 message);
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t count,
                               const fmi2String categories[]) {
    ENTER(PSA_CALL_LOG);
    return psa_fmi2_status(psa_choose_log(core, on != fmi2False, count, categories));
}

/* Why an instance cannot be made, or NULL. */
static const char *objection(fmi2String name, fmi2Type type, fmi2String guid) {
    if (type != fmi2ModelExchange && type != fmi2CoSimulation) return "The FMU type is unknown.";
    return psa_objection(name, guid);
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean logging) {
    const fmi2CallbackFunctions none = {NULL, NULL, NULL, NULL, NULL};
    const fmi2CallbackFunctions *const given = functions ? functions : &none;
    const char *const problem = objection(name, type, guid);
    (void)resources, (void)visible;
    if (problem) {
        if (given->logger)
            given->logger(given->componentEnvironment, name ? name : "", fmi2Error,
                          psa_log_category(PSA_ERROR), problem);
        return NULL;
    }
    const size_t length = strlen(name) + 1;
    component *const self = calloc(1, sizeof *self + length);
    if (!self) return NULL;
    memcpy(self->name, name, length);
    self->logger = given->logger;
    self->environment = given->componentEnvironment;
    self->core.debug = logging != fmi2False;
    self->core.report = report;
    self->core.owner = self;
    psa_instance_start(&self->core, type == fmi2CoSimulation ? PSA_CO_SIMULATION : PSA_MODEL_EXCHANGE);
    return self;
}

void fmi2FreeInstance(fmi2Component c) {
    free(c);
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance,
                               fmi2Real start, fmi2Boolean stopDefined, fmi2Real stop) {
    ENTER(PSA_CALL_SETUP);
    return psa_fmi2_status(psa_setup(core, toleranceDefined, tolerance, start, stopDefined, stop));
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    ENTER(PSA_CALL_INITIALIZE);
    MOVE_TO(PSA_INITIALIZATION);
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    ENTER(PSA_CALL_INITIALIZED);
    const psa_result result = psa_begin(core);
    if (result != PSA_FINE) return psa_fmi2_status(result);
    MOVE_TO(core->state.interface == PSA_CO_SIMULATION ? PSA_STEP_COMPLETE : PSA_EVENT);
}

fmi2Status fmi2Terminate(fmi2Component c) {
    ENTER(PSA_CALL_TERMINATE);
    MOVE_TO(PSA_TERMINATED);
}

fmi2Status fmi2Reset(fmi2Component c) {
    ENTER(PSA_CALL_ANY);
    psa_instance_start(core, (psa_interface)core->state.interface);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[]) {
    ENTER(PSA_CALL_GET);
    return psa_fmi2_status(psa_get(core, vr, nvr, value));
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                       const fmi2Real value[]) {
    ENTER(PSA_CALL_SET);
    return psa_fmi2_status(psa_set(core, vr, nvr, value));
}

/* All variables are Real: other types are fine only where none is asked for. */
#define OTHER_TYPE(function, call, type)                                                          \
    fmi2Status function(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, type value[]) { \
        ENTER(call);                                                                              \
        (void)vr, (void)value;                                                                    \
        if (nvr == 0) return fmi2OK;                                                              \
        return psa_fmi2_status(psa_say(core, PSA_ERROR, "%s: all variables are of type Real.", __func__));  \
    }
OTHER_TYPE(fmi2GetInteger, PSA_CALL_GET, fmi2Integer)
OTHER_TYPE(fmi2GetBoolean, PSA_CALL_GET, fmi2Boolean)
OTHER_TYPE(fmi2GetString, PSA_CALL_GET, fmi2String)
OTHER_TYPE(fmi2SetInteger, PSA_CALL_SET, const fmi2Integer)
OTHER_TYPE(fmi2SetBoolean, PSA_CALL_SET, const fmi2Boolean)
OTHER_TYPE(fmi2SetString, PSA_CALL_SET, const fmi2String)

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *snapshot) {
    ENTER(PSA_CALL_ANY);
    return psa_fmi2_status(psa_snapshot_take(core, snapshot));
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate snapshot) {
    ENTER(PSA_CALL_ANY);
    return psa_fmi2_status(psa_snapshot_restore(core, snapshot));
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *snapshot) {
    ENTER(PSA_CALL_ANY);
    psa_snapshot_release(snapshot);
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate snapshot, size_t *size) {
    ENTER(PSA_CALL_ANY);
    if (psa_lacks(core, 1, snapshot, size)) return fmi2Error;
    *size = psa_snapshot_size();
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate snapshot, fmi2Byte bytes[],
                                 size_t size) {
    ENTER(PSA_CALL_ANY);
    return psa_fmi2_status(psa_snapshot_write(core, snapshot, bytes, size));
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size,
                                   fmi2FMUstate *snapshot) {
    ENTER(PSA_CALL_ANY);
    return psa_fmi2_status(psa_snapshot_read(core, bytes, size, snapshot));
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[],
                                        size_t unknowns, const fmi2ValueReference known[],
                                        size_t knowns, const fmi2Real seed[],
                                        fmi2Real sensitivity[]) {
    ENTER(PSA_CALL_DIRECTIONAL);
    return psa_fmi2_status(
        psa_directional_derivative(core, unknown, unknowns, known, knowns, seed, sensitivity));
}
