/* The FMI 2.0 face, continued: what only model exchange or only co-simulation has. A component is its
   core (see fmi2.c). */
#include "fmi2_face.h"

fmi2Status fmi2EnterEventMode(fmi2Component c) {
    ENTER(PSA_CALL_ENTER_EVENT);
    psa_enter_event(core);
    return fmi2OK;
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
    ENTER(PSA_CALL_EVENT_UPDATE);
    if (psa_lacks(core, 1, info, info)) return fmi2Error;
    info->newDiscreteStatesNeeded = fmi2False;
    info->terminateSimulation = fmi2False;
    info->nominalsOfContinuousStatesChanged = fmi2False;
    info->valuesOfContinuousStatesChanged = fmi2False;
    info->nextEventTimeDefined = psa_next_event(core, &info->nextEventTime);
    return psa_fmi2_status(psa_update_events(core));
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) {
    ENTER(PSA_CALL_ENTER_CONTINUOUS);
    return psa_fmi2_status(psa_enter_continuous(core));
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi2Boolean *enterEventMode, fmi2Boolean *terminateSimulation) {
    ENTER(PSA_CALL_CONTINUOUS);
    (void)noSetFMUStatePriorToCurrentPoint;
    if (psa_lacks(core, 1, enterEventMode, terminateSimulation)) return fmi2Error;
    *enterEventMode = fmi2False;
    *terminateSimulation = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) {
    ENTER(PSA_CALL_SET_TIME);
    return psa_fmi2_status(psa_set_time(core, time));
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t nx) {
    ENTER(PSA_CALL_CONTINUOUS);
    return psa_fmi2_status(psa_set_states(core, x, nx));
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t nx) {
    ENTER(PSA_CALL_READ_DERIVATIVES);
    return psa_fmi2_status(psa_get_derivatives(core, derivatives, nx));
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real indicators[], size_t ni) {
    ENTER(PSA_CALL_READ_DERIVATIVES);
    return psa_fmi2_status(psa_get_indicators(core, indicators, ni));
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t nx) {
    ENTER(PSA_CALL_READ_DERIVATIVES);
    return psa_fmi2_status(psa_get_states(core, x, nx));
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real nominal[], size_t nx) {
    ENTER(PSA_CALL_READ_NOMINALS);
    return psa_fmi2_status(psa_get_nominals(core, nominal, nx));
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                       const fmi2Integer order[], const fmi2Real value[]) {
    ENTER(PSA_CALL_SET_RATES);
    return psa_fmi2_status(psa_set_input_rates(core, vr, nvr, order, value));
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Integer order[], fmi2Real value[]) {
    ENTER(PSA_CALL_READ_RATES);
    return psa_fmi2_status(psa_get_output_rates(core, vr, nvr, order, value));
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real point, fmi2Real size,
                      fmi2Boolean noSetFMUStatePriorToCurrentPoint) {
    ENTER(PSA_CALL_STEP);
    (void)noSetFMUStatePriorToCurrentPoint;
    return psa_fmi2_status(psa_do_step(core, point, size, NULL, NULL));
}

fmi2Status fmi2CancelStep(fmi2Component c) {
    ENTER(PSA_CALL_CANCEL);
    return fmi2Error;
}

/* Steps are never pending: only the last successful time and the wish to terminate are known. */
static fmi2Status unknown_status(psa_instance *core, const char *name) {
    return psa_fmi2_status(psa_say(
        core, PSA_DISCARD, "%s: this status is not known, as steps are never pending.", name));
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value) {
    ENTER(PSA_CALL_STATUS);
    if (psa_lacks(core, 1, value, value)) return fmi2Error;
    if (kind != fmi2DoStepStatus) return unknown_status(core, __func__);
    *value = core->state.phase == PSA_STEP_FAILED ? fmi2Discard : fmi2OK;
    return fmi2OK;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
    ENTER(PSA_CALL_STATUS);
    if (psa_lacks(core, 1, value, value)) return fmi2Error;
    if (kind != fmi2LastSuccessfulTime) return unknown_status(core, __func__);
    *value = core->state.solver.t;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value) {
    ENTER(PSA_CALL_STATUS);
    (void)kind, (void)value;
    return unknown_status(core, __func__);
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
    ENTER(PSA_CALL_STATUS);
    if (psa_lacks(core, 1, value, value)) return fmi2Error;
    if (kind != fmi2Terminated) return unknown_status(core, __func__);
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value) {
    ENTER(PSA_CALL_STATUS);
    (void)kind, (void)value;
    return unknown_status(core, __func__);
}
