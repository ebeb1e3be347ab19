#include <math.h>
#include <string.h>

#include "instance.h"
#include "instants.h"

#define LARGEST_COUNT INT64_C(9007199254740992) /* 2^53 */
/* Over the nominal value. Far beyond, rounding keeps the solver's error from its tolerance, for millions of steps. */
#define LARGEST_STATE 1e12

static int all_finite(const double *values, int count) {
    for (int i = 0; i < count; ++i)
        if (!isfinite(values[i])) return 0;
    return 1;
}

static int is_flag(int64_t value) { return value == 0 || value == 1; }

static int is_count(int64_t value) { return value >= 0 && value <= LARGEST_COUNT; }

static const char *solver_fault(const psa_solver *solver) {
    if (!isfinite(solver->t) || !isfinite(solver->origin) || !(solver->since >= 0.0) ||
        !isfinite(solver->since))
        return "the time";
    for (int i = 0; i < PSA_NX; ++i)
        if (!(fabs(solver->x[i]) <= LARGEST_STATE * (psa_state_nominals[i] + fabs(psa_start_states[i]))))
            return "a state";
    if (memcmp(solver->nominal, psa_state_nominals, sizeof solver->nominal)) return "a nominal value";
    if (!(solver->rtol >= psa_step_tolerance(0.0) && solver->rtol <= psa_step_tolerance(INFINITY)))
        return "the tolerance";
    if (solver->max_step != 0.0 || solver->steps_limit != 0 || !(solver->step >= 0.0))
        return "the step size";
    if (!is_flag(solver->slope_valid) || !is_flag(solver->landed)) return "a flag";
    if (solver->slope_valid &&
        !(all_finite(solver->slope, PSA_NX) && all_finite(solver->last_input, PSA_NU)))
        return "a slope";
    if (!(solver->contraction >= 0.0 && isfinite(solver->contraction))) return "the contraction";
    if (!is_count(solver->steps) || !is_count(solver->rejected) || !is_count(solver->evaluations))
        return "a count";
    return solver->culprit >= 0 && solver->culprit < PSA_NX ? NULL : "an index";
}

static const char *input_fault(const psa_input *input) {
    return isfinite(input->begin) && all_finite(input->value, PSA_NU) && all_finite(input->rate, PSA_NU)
               ? NULL
               : "an input";
}

static const char *held_fault(const double *p) {
    if (!all_finite(p, PSA_HELD)) return "a parameter or a sampled state";
    for (int vr = 0; vr < PSA_VARIABLES; ++vr) {
        const psa_variable *const v = &psa_variables[vr];
        if (v->kind == PSA_PARAMETER && !(p[v->index] >= v->low && p[v->index] <= v->high)) return v->name;
    }
    return NULL;
}

static const char *fault_at(const psa_solver *solver, const psa_input *input, const double *p) {
    const char *const in_solver = solver_fault(solver), *const in_input = input_fault(input);
    return in_solver ? in_solver : in_input ? in_input : held_fault(p);
}

static const char *last_fault(const psa_last_step *last) {
    if (last->kind == PSA_NO_STEP) return NULL;
    if (last->kind < PSA_NO_STEP || last->kind > PSA_STEP_SAMPLED) return "the kind of the last step";
    if (!isfinite(last->end.since) || !isfinite(last->end.t)) return "the end of the last step";
    return fault_at(&last->solver, &last->input, last->p);
}

static const char *phase_fault(const psa_state *state) {
    const int64_t always = PSA_INSTANTIATED | PSA_INITIALIZATION | PSA_EVENT | PSA_TERMINATED;
    const int64_t own = state->interface == PSA_CO_SIMULATION ? PSA_STEP_COMPLETE | PSA_STEP_FAILED
                                                              : PSA_CONTINUOUS;
    if (!is_flag(state->interface)) return "the interface";
    /* one bit of those */
    return state->phase > 0 && !(state->phase & ~(always | own)) && !(state->phase & (state->phase - 1))
               ? NULL
               : "the state of the life cycle";
}

static const char *sampling_fault(const psa_state *state) {
    const double period = state->p[PSA_PERIOD];
    if (!is_flag(state->at_instant)) return "a flag";
    if (PSA_NS == 0) return NULL;
    if (!all_finite(state->before, PSA_NS)) return "a sampled state";
    if (!psa_countable(state->solver.t, period)) return "the time";
    return fabs(state->next_instant - state->solver.t) <= 4.0 * period ? NULL : "the next sample instant";
}

static const char *start_fault(const psa_state *state) {
    for (int i = 0; i < PSA_NX; ++i)
        if (!is_flag(state->own_start[i])) return "a flag";
    if (!is_flag(state->voltage_given) || !is_flag(state->start_due)) return "a flag";
    if (state->start_due && !(state->phase & (PSA_INSTANTIATED | PSA_INITIALIZATION))) return "a flag";
    return isfinite(state->start_voltage) ? NULL : "the voltage of the start";
}

const char *psa_state_fault(const psa_state *state) {
    const char *const fault = fault_at(&state->solver, &state->input, state->p);
    const char *const in_phase = phase_fault(state), *const in_last = last_fault(&state->last);
    if (fault) return fault;
    if (in_phase || in_last) return in_phase ? in_phase : in_last;
    for (int i = 0; i < PSA_NU; ++i)
        if (!is_flag(state->rate_given[i])) return "a flag";
    if (state->asked < PSA_ASKED_NOTHING || state->asked > PSA_ASKED_RATES) return "a flag";
    if (!(state->line >= 0.0 && state->line <= 1.0) || !isfinite(state->stride) ||
        !isfinite(state->given_at) ||        !all_finite(state->given, PSA_NU) || !all_finite(state->earlier, PSA_NU))
        return "the line of the inputs";
    for (int i = 0; i < PSA_NZ; ++i)
        if (fabs(state->facing[i]) != 1.0) return "an event indicator";
    if (!(state->event_margin > 0.0 && state->event_margin <= 1.0)) return "the margin of events";
    if (isnan(state->stop_time) || !is_flag(state->stop_defined)) return "the stop time";
    const char *const in_start = start_fault(state);
    return in_start ? in_start : sampling_fault(state);
}
