/* The FMI 3.0 face: life cycle and snapshots, each function a call of the core in instance.h. */
#include <stdlib.h>
#include <string.h>

#include "fmi3_face.h"

static void report(void *owner, psa_result severity, const char *sentence) {
    const psa_component3 *const self = owner;
    if (self->logger)
        self->logger(self->environment, psa_fmi3_status(severity), psa_log_category(severity), sentence);
}

const char *fmi3GetVersion(void) { return "3.0"; }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t count,
                               const fmi3String categories[]) {
    ENTER(PSA_CALL_LOG);
    return psa_fmi3_status(psa_choose_log(core, on, count, categories));
}

/* Refuse an instance: say why and return NULL. */
static psa_component3 *refuse(fmi3LogMessageCallback logger, fmi3InstanceEnvironment environment,
                              const char *why) {
    if (logger) logger(environment, fmi3Error, psa_log_category(PSA_ERROR), why);
    return NULL;
}

static psa_component3 *instantiate(fmi3String name, fmi3String token, psa_interface interface,
                                   fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                   fmi3LogMessageCallback logger) {
    const char *const problem = psa_objection(name, token);
    if (problem) return refuse(logger, environment, problem);
    const size_t length = strlen(name) + 1;
    psa_component3 *const self = calloc(1, sizeof *self + length);
    if (!self) return refuse(logger, environment, "There is no memory for an instance.");
    memcpy(self->name, name, length);
    self->logger = logger;
    self->environment = environment;
    self->core.debug = logging;
    self->core.report = report;
    self->core.owner = self;
    psa_instance_start(&self->core, interface);
    return self;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                          fmi3Boolean visible, fmi3Boolean logging,
                                          fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback logger) {
    (void)resources, (void)visible;
    return instantiate(name, token, PSA_MODEL_EXCHANGE, logging, environment, logger);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                                         fmi3Boolean visible, fmi3Boolean logging,
                                         fmi3Boolean eventModeUsed, fmi3Boolean earlyReturnAllowed,
                                         const fmi3ValueReference required[], size_t count,
                                         fmi3InstanceEnvironment environment,
                                         fmi3LogMessageCallback logger,
                                         fmi3IntermediateUpdateCallback update) {
    (void)resources, (void)visible;
    /* every variable can be read in an intermediate update, so the list only has to make sense */
    for (size_t i = 0; i < count; ++i)
        if (!required || required[i] - 1u >= PSA_VARIABLES)
            return refuse(logger, environment,
                          "The list of required intermediate variables is missing or names a value"
                          " reference that does not exist.");
    psa_component3 *const self =
        instantiate(name, token, PSA_CO_SIMULATION, logging, environment, logger);
    if (!self) return NULL;
    self->update = update;
    self->event_mode_used = eventModeUsed;
    self->early_return_allowed = earlyReturnAllowed;
    return self;
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token,
                                               fmi3String resources, fmi3Boolean visible,
                                               fmi3Boolean logging,
                                               fmi3InstanceEnvironment environment,
                                               fmi3LogMessageCallback logger,
                                               fmi3ClockUpdateCallback clockUpdate,
                                               fmi3LockPreemptionCallback lock,
                                               fmi3UnlockPreemptionCallback unlock) {
    (void)name, (void)token, (void)resources, (void)visible, (void)logging;
    (void)clockUpdate, (void)lock, (void)unlock;
    return refuse(logger, environment,
                  "This FMU has no scheduled execution; use co-simulation or model exchange.");
}

void fmi3FreeInstance(fmi3Instance instance) { free(instance); }

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined,
                                       fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean stopDefined, fmi3Float64 stop) {
    ENTER(PSA_CALL_INITIALIZE);
    const psa_result result = psa_setup(core, toleranceDefined, tolerance, start, stopDefined, stop);
    if (result != PSA_FINE) return psa_fmi3_status(result);
    MOVE_TO(PSA_INITIALIZATION);
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
    ENTER(PSA_CALL_INITIALIZED);
    const psa_result result = psa_begin(core);
    if (result != PSA_FINE) return psa_fmi3_status(result);
    const int events = core->state.interface == PSA_MODEL_EXCHANGE ||
                       ((psa_component3 *)instance)->event_mode_used;
    MOVE_TO(events ? PSA_EVENT : PSA_STEP_COMPLETE);
}

fmi3Status fmi3Terminate(fmi3Instance instance) {
    ENTER(PSA_CALL_TERMINATE);
    MOVE_TO(PSA_TERMINATED);
}

fmi3Status fmi3Reset(fmi3Instance instance) {
    ENTER(PSA_CALL_ANY);
    psa_instance_start(core, (psa_interface)core->state.interface);
    return fmi3OK;
}

/* The model has no structural parameters: it has nothing to configure. */
static fmi3Status nothing_to_configure(psa_instance *core, const char *name) {
    return psa_fmi3_status(psa_say(
        core, PSA_ERROR, "%s: the model has no structural parameters and thus no configuration mode.", name));
}

fmi3Status fmi3EnterConfigurationMode(fmi3Instance instance) {
    ENTER(PSA_CALL_ANY);
    return nothing_to_configure(core, __func__);
}

fmi3Status fmi3ExitConfigurationMode(fmi3Instance instance) {
    ENTER(PSA_CALL_ANY);
    return nothing_to_configure(core, __func__);
}

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *snapshot) {
    ENTER(PSA_CALL_ANY);
    return psa_fmi3_status(psa_snapshot_take(core, snapshot));
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState snapshot) {
    ENTER(PSA_CALL_ANY);
    return psa_fmi3_status(psa_snapshot_restore(core, snapshot));
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *snapshot) {
    ENTER(PSA_CALL_ANY);
    psa_snapshot_release(snapshot);
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState snapshot, size_t *size) {
    ENTER(PSA_CALL_ANY);
    if (psa_lacks(core, 1, snapshot, size)) return fmi3Error;
    *size = psa_snapshot_size();
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState snapshot, fmi3Byte bytes[],
                                 size_t size) {
    ENTER(PSA_CALL_ANY);
    return psa_fmi3_status(psa_snapshot_write(core, snapshot, bytes, size));
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size,
                                   fmi3FMUState *snapshot) {
    ENTER(PSA_CALL_ANY);
    return psa_fmi3_status(psa_snapshot_read(core, bytes, size, snapshot));
}
