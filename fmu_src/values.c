#include <math.h>
#include <string.h>

#include "instance.h"

psa_result psa_refresh(psa_instance *instance) {
    const psa_state *const state = &instance->state;
    double u[PSA_NU + 1], *const w = instance->work.w;
    if (instance->fresh) return PSA_FINE;
    psa_result result = psa_begin(instance);
    if (result == PSA_FINE) result = psa_sample_now(instance);
    if (result != PSA_FINE) return result;
    psa_input_at(&state->input, state->solver.since, u);
    psa_watch_range(instance, u, NULL);
    if (psa_model_ode(state->solver.t, state->solver.x, u, state->p, instance->xdot, w) ||
        psa_model_outputs(state->solver.t, state->solver.x, u, state->p, instance->y, w) ||
        psa_model_switches(state->solver.t, state->solver.x, u, state->p, instance->z, w))
        return psa_say(instance, PSA_DISCARD, "The model cannot be evaluated at t = %.9g s.",
                       state->solver.t);
    for (int i = 0; i < PSA_NZ; ++i)
        instance->z[i] =
            state->facing[i] * instance->z[i] + state->event_margin * psa_switch_scales[i];
    instance->fresh = 1;
    return PSA_FINE;
}

const psa_variable *psa_variable_of(psa_instance *instance, unsigned vr) {
    if (vr >= 1 && vr <= PSA_VARIABLES) return &psa_variables[vr - 1];
    psa_say(instance, PSA_ERROR, "There is no variable of value reference %u; they go from 1 to %u.", vr,
            (unsigned)PSA_VARIABLES);
    return NULL;
}

/* Until the initialization is over a sampled state is its start value. */
static double sampled_value(const psa_state *state, int index) {
    const int starting = (state->phase & (PSA_INSTANTIATED | PSA_INITIALIZATION)) != 0;
    return starting && state->at_instant ? state->before[index] : state->p[PSA_NP + index];
}

static double value_of(const psa_instance *instance, const psa_variable *v) {
    switch (v->kind) {
    case PSA_TIME: return instance->state.solver.t;
    case PSA_STATE: return instance->state.solver.x[v->index];
    case PSA_DERIVATIVE: return instance->xdot[v->index];
    case PSA_INPUT: return instance->state.input.value[v->index];
    case PSA_OUTPUT: return instance->y[v->index];
    case PSA_INDICATOR: return instance->z[v->index];
    case PSA_SAMPLED: return sampled_value(&instance->state, v->index);
    case PSA_OPTION: return v->index == PSA_START_VOLTAGE ? instance->state.start_voltage : instance->state.line;
    default: return instance->state.p[v->index];
    }
}

/* Bring what a kind of variables follows from up to date. */
static psa_result up_to_date(psa_instance *instance, psa_kind kind) {
    switch (kind) {
    case PSA_STATE: return psa_begin(instance);
    case PSA_DERIVATIVE:
    case PSA_OUTPUT:
    case PSA_INDICATOR:
    case PSA_SAMPLED: return psa_refresh(instance);
    default: return PSA_FINE;
    }
}

psa_result psa_get(psa_instance *instance, const unsigned *vr, size_t count, double *value) {
    psa_result worst = PSA_FINE;
    if (psa_lacks(instance, count, vr, value)) return PSA_ERROR;
    for (size_t i = 0; i < count; ++i) {
        const psa_variable *const v = psa_variable_of(instance, vr[i]);
        if (!v) return PSA_ERROR;
        const psa_result result = up_to_date(instance, v->kind);
        if (result != PSA_FINE) return result;
        value[i] = value_of(instance, v);
        if (!isfinite(value[i]))
            worst = psa_say(instance, PSA_DISCARD, "'%s' is not finite at t = %.9g s.", v->name,
                            instance->state.solver.t);
    }
    return worst;
}

/* A variable may be set if it is an input, a parameter, or a state that no solver in here is using: in
   model exchange always (CasADi's importer does so), in co-simulation before the first step. */
static psa_result settable(psa_instance *instance, unsigned vr, double value) {
    const psa_variable *const v = psa_variable_of(instance, vr);
    if (!v) return PSA_ERROR;
    if (!isfinite(value))
        return psa_say(instance, PSA_ERROR, "'%s' cannot be set to a value that is not finite.", v->name);
    if (instance->state.phase == PSA_INTERMEDIATE && v->kind != PSA_INPUT)
        return psa_say(instance, PSA_ERROR,
                       "'%s' cannot be set in an intermediate update, only inputs can.", v->name);
    if ((v->kind == PSA_SAMPLED ||
         (v->kind == PSA_STATE && instance->state.interface == PSA_CO_SIMULATION)) &&
        !(instance->state.phase & (PSA_INSTANTIATED | PSA_INITIALIZATION)))
        return psa_say(instance, PSA_ERROR,
                       "State '%s' can be set only before the first step.", v->name);
    if (v->kind == PSA_OPTION && !(instance->state.phase & (PSA_INSTANTIATED | PSA_INITIALIZATION)))
        return psa_say(instance, PSA_ERROR, "'%s' can be set only before the first step.", v->name);
    if (v->kind != PSA_STATE && v->kind != PSA_SAMPLED && v->kind != PSA_INPUT &&
        v->kind != PSA_PARAMETER && v->kind != PSA_OPTION)
        return psa_say(instance, PSA_ERROR, "'%s' is calculated and cannot be set.", v->name);
#ifdef PSA_FIXED_STEP
    if (v->kind == PSA_PARAMETER)
        return psa_say(instance, PSA_ERROR, "'%s' is constant: the fixed step was made for its value.",
                       v->name);
#endif
    if (value < v->low || value > v->high)
        return psa_say(instance, PSA_ERROR, "'%s' cannot be set to %.9g: it must be at %s %.9g.", v->name,
                       value, value < v->low ? "least" : "most", value < v->low ? v->low : v->high);
    if (PSA_NS > 0 && v->kind == PSA_PARAMETER && v->index == PSA_PERIOD &&
        psa_beyond_counting(instance, instance->state.solver.t, value))
        return PSA_ERROR;
    return PSA_FINE;
}

/* In model exchange: inputs are given at a new time, and the values before begin their line. */
static void begin_line(psa_state *state) {
    if (state->interface != PSA_MODEL_EXCHANGE || state->solver.t == state->given_at) return;
    state->stride = state->solver.t - state->given_at;
    state->given_at = state->solver.t;
    state->asked = PSA_ASKED_NOTHING;
    memcpy(state->earlier, state->given, sizeof state->earlier);
    memset(state->input.rate, 0, sizeof state->input.rate);
}

/* In model exchange inputs hold between the times at which they are given. An importer that gives them at
   the end of each step, where it asks for the event indicators, but not where it asks for derivatives (fmpy
   with CVode) means them to move: to its solver the steps would be jumps. They follow the line then. */
static void follow_line(psa_state *state) {
    const int moves = state->asked == PSA_ASKED_INDICATORS && state->stride != 0.0;
    state->input.begin = state->given_at - state->solver.t;
    for (int i = 0; i < PSA_NU; ++i)
        state->input.rate[i] = moves ? (state->given[i] - state->earlier[i]) / state->stride : 0.0;
}

static void set_one(psa_instance *instance, const psa_variable *v, double value) {
    psa_state *const state = &instance->state;
    if (v->kind == PSA_INPUT) {
        begin_line(state);
        state->input.value[v->index] = state->given[v->index] = value;
        if (!state->rate_given[v->index]) state->input.rate[v->index] = 0.0;
        return;
    }
    if (v->kind == PSA_OPTION && v->index == PSA_START_VOLTAGE) {
        psa_start_at(instance, value);
        return;
    }
    if (v->kind == PSA_OPTION) {
        state->line = value;
        return;
    }
    if (v->kind == PSA_STATE) state->solver.x[v->index] = value;
    else if (v->kind == PSA_SAMPLED) state->p[PSA_NP + v->index] = state->before[v->index] = value;
    else state->p[v->index] = value;
    if (v->kind == PSA_PARAMETER && v->index == PSA_PERIOD) psa_schedule(instance);
    psa_solver_invalidate(&state->solver);
}

/* All values are taken, or none if one of them cannot be. */
psa_result psa_set(psa_instance *instance, const unsigned *vr, size_t count, const double *value) {
    psa_result worst = PSA_FINE;
    if (psa_lacks(instance, count, vr, value)) return PSA_ERROR;
    for (size_t i = 0; i < count; ++i) {
        const psa_result result = settable(instance, vr[i], value[i]);
        if (result > worst) worst = result;
    }
    if (worst != PSA_FINE) return worst;
    for (size_t i = 0; i < count; ++i) {
        const psa_variable *const v = psa_variable_of(instance, vr[i]);
        set_one(instance, v, value[i]);
        psa_start_changed(instance, v);
    }
    instance->fresh = 0;
    return PSA_FINE;
}

static int mismatch(psa_instance *instance, const void *vector, size_t count) {
    if (count == PSA_STATES && (vector || count == 0)) return 0;
    psa_say(instance, PSA_ERROR, "The model has %d continuous states; a vector of %lu was passed.", PSA_STATES,
            vector ? (unsigned long)count : 0UL);
    return 1;
}

psa_result psa_set_time(psa_instance *instance, double time) {
    if (!isfinite(time)) return psa_say(instance, PSA_ERROR, "The time is not finite.");
    if (psa_beyond_counting(instance, time, instance->state.p[PSA_PERIOD])) return PSA_ERROR;
    psa_solver_move(&instance->state.solver, time);
    follow_line(&instance->state);
    instance->fresh = 0;
    return PSA_FINE;
}

psa_result psa_set_states(psa_instance *instance, const double *x, size_t count) {
    if (mismatch(instance, x, count)) return PSA_ERROR;
    for (int i = 0; i < PSA_STATES; ++i)
        if (!isfinite(x[i]))
            return psa_say(instance, PSA_DISCARD, "State '%s' was set to a value that is not finite.",
                           psa_variables[PSA_FIRST_STATE + i].name);
    if (count > 0) memcpy(instance->state.solver.x, x, sizeof(double) * count);
    instance->fresh = 0;
    return PSA_FINE;
}

psa_result psa_get_states(psa_instance *instance, double *x, size_t count) {
    if (mismatch(instance, x, count)) return PSA_ERROR;
    if (count > 0) memcpy(x, instance->state.solver.x, sizeof(double) * count);
    return PSA_FINE;
}

psa_result psa_get_derivatives(psa_instance *instance, double *xdot, size_t count) {
    if (mismatch(instance, xdot, count)) return PSA_ERROR;
    psa_state *const state = &instance->state;
    const psa_result result = psa_refresh(instance);
    if (result != PSA_FINE) return result;
    if (state->solver.t == state->given_at) state->asked = PSA_ASKED_RATES;
    for (int i = 0; i < PSA_STATES; ++i) {
        xdot[i] = instance->xdot[i];
        if (!isfinite(xdot[i]))
            return psa_say(instance, PSA_DISCARD, "The derivative of '%s' is not finite at t = %.9g s.",
                           psa_variables[PSA_FIRST_STATE + i].name, state->solver.t);
    }
    return PSA_FINE;
}

psa_result psa_get_indicators(psa_instance *instance, double *z, size_t count) {
    if (count != PSA_NZ)
        return psa_say(instance, PSA_ERROR, "The model has %d event indicators; a vector of %lu was passed.",
                       PSA_NZ, (unsigned long)count);
    if (psa_lacks(instance, count, z, z)) return PSA_ERROR;
    psa_state *const state = &instance->state;
    const psa_result result = psa_refresh(instance);
    if (state->solver.t == state->given_at && state->asked == PSA_ASKED_NOTHING)
        state->asked = PSA_ASKED_INDICATORS;
    if (result == PSA_FINE) memcpy(z, instance->z, sizeof(double) * PSA_NZ);
    return result;
}

psa_result psa_update_events(psa_instance *instance) {
    psa_state *const state = &instance->state;
    const psa_result result = psa_refresh(instance);
    if (result != PSA_FINE) return result;
    for (int i = 0; i < PSA_NZ; ++i)
        if (instance->z[i] < 0.5 * state->event_margin * psa_switch_scales[i]) {
            state->facing[i] = -state->facing[i];
            instance->fresh = 0;
        }
    return PSA_FINE;
}

psa_result psa_get_nominals(psa_instance *instance, double *nominal, size_t count) {
    if (mismatch(instance, nominal, count)) return PSA_ERROR;
    if (count > 0) memcpy(nominal, psa_told_nominals, sizeof(double) * count);
    return PSA_FINE;
}

/* First-order rates only: in the coming step an input is value + rate (t - start of the step). */
psa_result psa_set_input_rates(psa_instance *instance, const unsigned *vr, size_t count,
                               const int *order, const double *rate) {
    psa_state *const state = &instance->state;
    if (psa_lacks(instance, count, vr, rate) || psa_lacks(instance, count, order, order))
        return PSA_ERROR;
    for (size_t i = 0; i < count; ++i) {
        const psa_variable *const v = psa_variable_of(instance, vr[i]);
        if (!v) return PSA_ERROR;
        if (v->kind != PSA_INPUT || order[i] != 1 || !isfinite(rate[i]))
            return psa_say(instance, PSA_ERROR,
                           "The derivative of order %d of '%s' cannot be set to %g; inputs take finite"
                           " derivatives of order 1.",
                           order[i], v->name, rate[i]);
    }
    for (size_t i = 0; i < count; ++i) {
        const int index = psa_variable_of(instance, vr[i])->index;
        state->input.rate[index] = rate[i];
        state->rate_given[index] = 1;
    }
    return PSA_FINE;
}

/* dy/dt along the trajectory that ends here, with the input's rate of the last step. */
psa_result psa_get_output_rates(psa_instance *instance, const unsigned *vr, size_t count,
                                const int *order, double *rate) {
    const psa_state *const state = &instance->state;
    static const double none[PSA_HELD + 1] = {0.0};
    double dy[PSA_NY + 1], u[PSA_NU + 1];
    if (psa_lacks(instance, count, vr, rate) || psa_lacks(instance, count, order, order))
        return PSA_ERROR;
    const psa_result result = psa_refresh(instance);
    if (result != PSA_FINE) return result;
    psa_input_at(&state->input, state->solver.since, u);
    if (psa_model_directional(state->solver.t, state->solver.x, u, state->p, 1.0, instance->xdot,
                              state->input.rate, none, NULL, dy, NULL, instance->calculus.w))
        return psa_say(instance, PSA_DISCARD, "The outputs cannot be differentiated here.");
    for (size_t i = 0; i < count; ++i) {
        const psa_variable *const v = psa_variable_of(instance, vr[i]);
        if (!v) return PSA_ERROR;
        if (v->kind != PSA_OUTPUT || order[i] != 1)
            return psa_say(instance, PSA_ERROR,
                           "The derivative of order %d of '%s' is not known; outputs have derivatives of"
                           " order 1.",
                           order[i], v->name);
        rate[i] = dy[v->index];
    }
    return PSA_FINE;
}
