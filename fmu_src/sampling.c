#include <string.h>

#include "instance.h"
#include "instants.h"

int psa_beyond_counting(psa_instance *instance, double time, double period) {
    if (PSA_NS == 0 || psa_countable(time, period)) return 0;
    psa_say(instance, PSA_ERROR,
            "Sample periods of %g s cannot be counted up to %.9g s: a double does not tell them apart there."
            " Count the time from a nearer start.",
            period, time);
    return 1;
}

void psa_schedule(psa_instance *instance) {
    psa_state *const state = &instance->state;
    const double period = state->p[PSA_PERIOD];
    const int starting = (state->phase & (PSA_INSTANTIATED | PSA_INITIALIZATION)) != 0;
    if (PSA_NS == 0) return;
    if (starting && !state->at_instant) memcpy(state->before, state->p + PSA_NP, sizeof(double) * PSA_NS);
    if (starting) {
        state->at_instant = psa_at_instant(state->solver.t, period);
        memcpy(state->p + PSA_NP, state->before, sizeof(double) * PSA_NS);
    }
    state->next_instant = psa_instant_after(state->solver.t, period);
    instance->fresh = 0;
}

void psa_arrive(psa_instance *instance) {
    psa_state *const state = &instance->state;
    if (PSA_NS == 0 || state->at_instant) return;
    if (!psa_reached(state->solver.t, state->next_instant, state->p[PSA_PERIOD])) return;
    memcpy(state->before, state->p + PSA_NP, sizeof(double) * PSA_NS);
    state->at_instant = 1;
    instance->fresh = 0;
}

psa_result psa_sample_now(psa_instance *instance) {
    psa_state *const state = &instance->state;
    double u[PSA_NU + 1];
    if (PSA_NS == 0 || !state->at_instant) return PSA_FINE;
    memcpy(state->p + PSA_NP, state->before, sizeof(double) * PSA_NS);
    psa_input_at(&state->input, state->solver.since, u);
    if (psa_take_sample(state->solver.t, state->solver.x, u, state->p, instance->work.w))
        return psa_say(instance, PSA_DISCARD, "The sampled states cannot be evaluated at t = %.9g s.",
                       state->solver.t);
    return PSA_FINE;
}

psa_result psa_leave_instant(psa_instance *instance) {
    psa_state *const state = &instance->state;
    if (PSA_NS == 0 || !state->at_instant) return PSA_FINE;
    const psa_result result = psa_sample_now(instance);
    if (result != PSA_FINE) return result;
    state->at_instant = 0;
    state->next_instant = psa_instant_after(state->solver.t, state->p[PSA_PERIOD]);
    psa_solver_invalidate(&state->solver);
    instance->fresh = 0;
    return PSA_FINE;
}

psa_result psa_sample_within(psa_instance *instance) {
    psa_arrive(instance);
    instance->state.last.kind = PSA_STEP_SAMPLED;
    return psa_leave_instant(instance);
}

void psa_enter_event(psa_instance *instance) {
    instance->state.phase = PSA_EVENT;
    instance->state.stride = 0.0; /* no line through values before and after a jump */
    instance->state.given_at = instance->state.solver.t;
    if (instance->state.interface == PSA_MODEL_EXCHANGE) psa_arrive(instance);
}

psa_result psa_enter_continuous(psa_instance *instance) {
    const psa_result result = psa_leave_instant(instance);
    if (result == PSA_FINE) instance->state.phase = PSA_CONTINUOUS;
    return result;
}

int psa_next_event(const psa_instance *instance, double *time) {
    const psa_state *const state = &instance->state;
    *time = 0.0;
    if (PSA_NS == 0) return 0;
    *time = state->at_instant ? psa_instant_after(state->solver.t, state->p[PSA_PERIOD])
                              : state->next_instant;
    return 1;
}
