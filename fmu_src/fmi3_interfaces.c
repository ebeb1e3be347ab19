/* The FMI 3.0 face, continued: events, what only model exchange has, and co-simulation steps. A
   component is its core (see fmi3_face.h). */
#include "fmi3_face.h"

fmi3Status fmi3EnterEventMode(fmi3Instance instance) {
    ENTER(PSA_CALL_ENTER_EVENT3);
    if (core->state.interface == PSA_CO_SIMULATION && !((psa_component3 *)instance)->event_mode_used)
        return psa_fmi3_status(
            psa_say(core, PSA_ERROR, "%s: this instance was made without event mode.", __func__));
    psa_enter_event(core);
    return fmi3OK;
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance instance) {
    ENTER(PSA_CALL_EVALUATE_DISCRETE);
    return fmi3OK;
}

/* Sampled states follow the inputs at an instant until event mode is left; nothing is left to repeat. */
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *needUpdate,
                                    fmi3Boolean *terminate, fmi3Boolean *nominalsChanged,
                                    fmi3Boolean *valuesChanged, fmi3Boolean *nextEventTimeDefined,
                                    fmi3Float64 *nextEventTime) {
    ENTER(PSA_CALL_EVENT_UPDATE);
    if (psa_lacks(core, 1, needUpdate, terminate) || psa_lacks(core, 1, nominalsChanged, valuesChanged) ||
        psa_lacks(core, 1, nextEventTimeDefined, nextEventTime))
        return fmi3Error;
    *needUpdate = fmi3False;
    *terminate = fmi3False;
    *nominalsChanged = fmi3False;
    *valuesChanged = fmi3False;
    *nextEventTimeDefined = psa_next_event(core, nextEventTime) != 0;
    return psa_fmi3_status(psa_update_events(core));
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance) {
    ENTER(PSA_CALL_ENTER_CONTINUOUS);
    return psa_fmi3_status(psa_enter_continuous(core));
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi3Boolean *enterEventMode, fmi3Boolean *terminateSimulation) {
    ENTER(PSA_CALL_CONTINUOUS);
    (void)noSetFMUStatePriorToCurrentPoint;
    if (psa_lacks(core, 1, enterEventMode, terminateSimulation)) return fmi3Error;
    *enterEventMode = fmi3False;
    *terminateSimulation = fmi3False;
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time) {
    ENTER(PSA_CALL_SET_TIME);
    return psa_fmi3_status(psa_set_time(core, time));
}

fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 x[], size_t nx) {
    ENTER(PSA_CALL_CONTINUOUS);
    return psa_fmi3_status(psa_set_states(core, x, nx));
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 derivatives[],
                                             size_t nx) {
    ENTER(PSA_CALL_READ_DERIVATIVES);
    return psa_fmi3_status(psa_get_derivatives(core, derivatives, nx));
}

fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 indicators[], size_t nz) {
    ENTER(PSA_CALL_READ_DERIVATIVES);
    return psa_fmi3_status(psa_get_indicators(core, indicators, nz));
}

fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 x[], size_t nx) {
    ENTER(PSA_CALL_READ_DERIVATIVES);
    return psa_fmi3_status(psa_get_states(core, x, nx));
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[],
                                             size_t nx) {
    ENTER(PSA_CALL_READ_NOMINALS);
    return psa_fmi3_status(psa_get_nominals(core, nominals, nx));
}

static fmi3Status tell(psa_instance *core, size_t *target, size_t value) {
    if (psa_lacks(core, 1, target, target)) return fmi3Error;
    *target = value;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *count) {
    ENTER(PSA_CALL_COUNT_VECTORS);
    return tell(core, count, PSA_NZ);
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *count) {
    ENTER(PSA_CALL_COUNT_VECTORS);
    return tell(core, count, PSA_STATES);
}

fmi3Status fmi3EnterStepMode(fmi3Instance instance) {
    ENTER(PSA_CALL_ENTER_STEP);
    MOVE_TO(PSA_STEP_COMPLETE);
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance instance, const fmi3ValueReference vr[], size_t nvr,
                                    const fmi3Int32 orders[], fmi3Float64 values[], size_t nvalues) {
    ENTER(PSA_CALL_READ_RATES);
    if (nvr != nvalues)
        return psa_fmi3_status(psa_say(core, PSA_ERROR, "%lu output derivatives are not %lu values.",
                                       (unsigned long)nvr, (unsigned long)nvalues));
    return psa_fmi3_status(psa_get_output_rates(core, vr, nvr, orders, values));
}

/* Between two steps of the solver: show the importer the intermediate time, and hear whether the
   communication step shall end at an earlier time. */
static int intermediate(void *owner, double time, int more, double *end) {
    const psa_component3 *const self = owner;
    fmi3Boolean wanted = fmi3False;
    fmi3Float64 until = time;
    const int early = more && self->early_return_allowed;
    self->update(self->environment, time, more != 0, fmi3True, fmi3True, early != 0, &wanted, &until);
    if (!early || !wanted) return 0;
    *end = until;
    return 1;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 point, fmi3Float64 size,
                      fmi3Boolean noSetFMUStatePriorToCurrentPoint, fmi3Boolean *eventHandlingNeeded,
                      fmi3Boolean *terminateSimulation, fmi3Boolean *earlyReturn,
                      fmi3Float64 *lastSuccessfulTime) {
    ENTER(PSA_CALL_STEP);
    (void)noSetFMUStatePriorToCurrentPoint;
    if (psa_lacks(core, 1, eventHandlingNeeded, terminateSimulation) ||
        psa_lacks(core, 1, earlyReturn, lastSuccessfulTime))
        return fmi3Error;
    int early = 0;
    const psa_result result = psa_do_step(
        core, point, size, ((psa_component3 *)instance)->update ? intermediate : NULL, &early);
    *eventHandlingNeeded = ((psa_component3 *)instance)->event_mode_used && core->state.at_instant;
    *terminateSimulation = fmi3False;
    *earlyReturn = early != 0;
    *lastSuccessfulTime = core->state.solver.t;
    return psa_fmi3_status(result);
}
