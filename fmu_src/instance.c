#include "instance.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#define DEFAULT_TOLERANCE 1e-6
#define LOOSEST_TOLERANCE 1e-2
/* The solver bounds the error of one step. What an importer means is the error of the trajectory, which
   is that of many steps: each gets this share. */
#define STEP_SHARE 0.01
#define TIGHTEST_STEP_TOLERANCE 1e-12

#define READABLE \
    (PSA_INITIALIZATION | PSA_EVENT | PSA_CONTINUOUS | PSA_STEP_COMPLETE | PSA_STEP_FAILED | PSA_TERMINATED)

/* In which phases each kind of call is allowed (FMI 2.0.5, sections 3.2.3 and 4.2.4). */
static const int ALLOWED[PSA_CALL_COUNT] = {
    [PSA_CALL_ANY] = PSA_INSTANTIATED | READABLE,
    [PSA_CALL_SETUP] = PSA_INSTANTIATED,
    [PSA_CALL_INITIALIZE] = PSA_INSTANTIATED,
    [PSA_CALL_INITIALIZED] = PSA_INITIALIZATION,
    [PSA_CALL_TERMINATE] = PSA_EVENT | PSA_CONTINUOUS | PSA_STEP_COMPLETE | PSA_STEP_FAILED,
    [PSA_CALL_GET] = READABLE,
    [PSA_CALL_SET] =
        PSA_INSTANTIATED | PSA_INITIALIZATION | PSA_EVENT | PSA_CONTINUOUS | PSA_STEP_COMPLETE,
    [PSA_CALL_DIRECTIONAL] = READABLE,
    [PSA_CALL_ENTER_EVENT] = PSA_CONTINUOUS,
    [PSA_CALL_EVENT_UPDATE] = PSA_EVENT,
    [PSA_CALL_SET_TIME] = PSA_EVENT | PSA_CONTINUOUS,
    [PSA_CALL_CONTINUOUS] = PSA_CONTINUOUS,
    [PSA_CALL_READ_DERIVATIVES] = PSA_INITIALIZATION | PSA_EVENT | PSA_CONTINUOUS | PSA_TERMINATED,
    [PSA_CALL_READ_NOMINALS] =
        PSA_INSTANTIATED | PSA_INITIALIZATION | PSA_EVENT | PSA_CONTINUOUS | PSA_TERMINATED,
    [PSA_CALL_SET_RATES] = PSA_INSTANTIATED | PSA_INITIALIZATION | PSA_STEP_COMPLETE,
    [PSA_CALL_READ_RATES] = PSA_STEP_COMPLETE | PSA_STEP_FAILED | PSA_TERMINATED,
    [PSA_CALL_STEP] = PSA_STEP_COMPLETE,
    [PSA_CALL_CANCEL] = 0, /* a step ends before the call returns; there is nothing to cancel */
    [PSA_CALL_STATUS] = PSA_STEP_COMPLETE | PSA_STEP_FAILED | PSA_TERMINATED,
};

static const char *phase_name(int phase) {
    switch (phase) {
    case PSA_INSTANTIATED: return "instantiated";
    case PSA_INITIALIZATION: return "initialization mode";
    case PSA_EVENT: return "event mode";
    case PSA_CONTINUOUS: return "continuous-time mode";
    case PSA_STEP_COMPLETE: return "step complete";
    case PSA_STEP_FAILED: return "step failed";
    case PSA_TERMINATED: return "terminated";
    default: return "unknown";
    }
}

static void say(psa_instance *instance, psa_result result, int detail, const char *format,
                va_list arguments) {
    char sentence[512];
    if (!instance->report) return;
    vsnprintf(sentence, sizeof sentence, format, arguments);
    instance->report(instance->owner, result, detail, sentence);
}

psa_result psa_say(psa_instance *instance, psa_result result, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    say(instance, result, 0, format, arguments);
    va_end(arguments);
    return result;
}

static void whisper(psa_instance *instance, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    say(instance, PSA_FINE, 1, format, arguments);
    va_end(arguments);
}

int psa_admit(psa_instance *instance, psa_call call, const char *name) {
    if (!instance) return 0;
    if (ALLOWED[call] & instance->state.phase) return 1;
    psa_say(instance, PSA_ERROR, "%s is not allowed in the state '%s' of this %s instance of %s at t = %.9g s.",
            name, phase_name(instance->state.phase),
            instance->state.interface == PSA_CO_SIMULATION ? "co-simulation" : "model exchange",
            psa_model_identifier, instance->state.solver.t);
    return 0;
}

int psa_lacks(psa_instance *instance, size_t count, const void *first, const void *second) {
    if (count == 0 || (first && second)) return 0;
    psa_say(instance, PSA_ERROR, "An array of %lu elements is expected, but a null pointer was passed.",
            (unsigned long)count);
    return 1;
}

void psa_instance_start(psa_instance *instance, psa_interface interface) {
    psa_state *const state = &instance->state;
    memset(state, 0, sizeof *state);
    psa_solver_start(&state->solver, 0.0, psa_start_states, psa_state_nominals,
                     STEP_SHARE * DEFAULT_TOLERANCE);
    memcpy(state->input.value, psa_start_inputs, sizeof state->input.value);
    memcpy(state->p, psa_start_parameters, sizeof state->p);
    state->phase = PSA_INSTANTIATED;
    state->interface = interface;
    instance->fresh = 0;
}

psa_result psa_setup(psa_instance *instance, int tolerance_defined, double tolerance, double start,
                     int stop_defined, double stop) {
    psa_state *const state = &instance->state;
    if (!isfinite(start) || (stop_defined && !(stop >= start)))
        return psa_say(instance, PSA_ERROR, "The experiment from %g s to %g s is impossible.", start, stop);
    if (tolerance_defined && !(tolerance > 0.0))
        return psa_say(instance, PSA_ERROR, "The tolerance %g is not positive.", tolerance);
    if (tolerance_defined)
        state->solver.rtol =
            fmax(STEP_SHARE * fmin(tolerance, LOOSEST_TOLERANCE), TIGHTEST_STEP_TOLERANCE);
    state->solver.t = start;
    state->input.origin = start;
    state->stop_defined = stop_defined;
    state->stop_time = stop_defined ? stop : 0.0;
    instance->fresh = 0;
    return PSA_FINE;
}

static const char *reason(psa_status status) {
    switch (status) {
    case PSA_STEP_TOO_SMALL: return "the tolerance cannot be met however small the step";
    case PSA_NOT_FINITE: return "the model returned a value that is not finite";
    case PSA_TOO_MANY_STEPS: return "too many steps were needed";
    default: return "the solver failed";
    }
}

/* Take the input along to the time the solver has reached, and forget rates that were not renewed. */
static void carry_input(psa_state *state) {
    psa_input_at(&state->input, state->solver.t, state->input.value);
    state->input.origin = state->solver.t;
}

static psa_result advance(psa_instance *instance, double target) {
    psa_state *const state = &instance->state;
    psa_solver *const solver = &state->solver;
    const double begin = solver->t;
    const long steps = solver->steps, rejected = solver->rejected;
    for (int i = 0; i < PSA_NU; ++i)
        if (!state->rate_given[i]) state->input.rate[i] = 0.0;
    state->input.origin = begin;
    const psa_status status = psa_solver_advance(solver, target, &state->input, state->p, NULL);
    carry_input(state);
    memset(state->rate_given, 0, sizeof state->rate_given);
    instance->fresh = 0;
    whisper(instance, "Step from %.9g s to %.9g s: %ld solver steps, %ld rejected.", begin, solver->t,
            solver->steps - steps, solver->rejected - rejected);
    if (status == PSA_OK) return PSA_FINE;
    state->phase = PSA_STEP_FAILED;
    return psa_say(instance, PSA_DISCARD,
                   "The step from %.9g s to %.9g s stopped at %.9g s in state '%s': %s. Likely an input"
                   " or a parameter is far from its physical range, or the tolerance is too tight.",
                   begin, target, solver->t, psa_variables[PSA_FIRST_STATE + solver->culprit].name,
                   reason(status));
}

psa_result psa_do_step(psa_instance *instance, double point, double size) {
    const psa_state *const state = &instance->state;
    const double now = state->solver.t, target = point + size;
    const double slack = 1e-3 * fabs(size) + 1e-12 * (fabs(point) + fabs(now));
    if (!isfinite(point) || !isfinite(size) || size < 0.0)
        return psa_say(instance, PSA_ERROR, "A step of %g s from %g s is impossible.", size, point);
    if (fabs(point - now) > slack)
        return psa_say(instance, PSA_ERROR,
                       "The communication point is %.17g s, but the instance stands at %.17g s.", point,
                       now);
    if (state->stop_defined && target > state->stop_time + slack)
        return psa_say(instance, PSA_ERROR, "The step to %.17g s goes beyond the stop time %.17g s.",
                       target, state->stop_time);
    return size > 0.0 && target > now ? advance(instance, target) : PSA_FINE;
}
