/* The parameter start_voltage: an instance begins settled at a voltage. At the exported value it begins
   with the exported states. At any other one it begins as psa.settled_at has it: the voltage rises from
   0 V to it within RISE, then all states but memories (hysteresis, creep) settle. The other inputs and the
   parameters have the values of now. The rise and the search for the rest end after a number of steps. */
#include <math.h>
#include <string.h>

#include "instance.h"
#include "linear.h"

#define RISE 1.0 /* s */
#define RISE_TOLERANCE 1e-7
#define MOST_STEPS 100000
#define NEWTON_STEPS 30
#define SLOPE_STEP 1e-3 /* of the voltage, at least of 1 V */

#if PSA_VOLTAGE >= 0
/* The equations of some states: those of memory `most` at most. */
typedef struct {
    int most, count, row[PSA_NX];
} some_rows;

/* Factor their part of df/dx, which is left in work->jac. */
static int factor(some_rows *rows, psa_work *work, const double *x, const double *u, const double *p) {
    rows->count = 0;
    for (int i = 0; i < PSA_NX; ++i)
        if (psa_memory[i] <= rows->most) rows->row[rows->count++] = i;
    if (psa_model_jacobian(0.0, x, u, p, work->jac, work->w)) return 1;
    for (int c = 0; c < rows->count; ++c)
        for (int r = 0; r < rows->count; ++r)
            work->lu[r + c * rows->count] = work->jac[rows->row[r] + rows->row[c] * PSA_NX];
    return psa_lu_factor(rows->count, work->lu, work->pivot);
}

/* Newton's method for rates of 0: put those states to rest, the others stay. 1 if there is no rest. */
static int settle(psa_work *work, int most, const double *u, const double *p, double *x) {
    some_rows rows = {0};
    double *const rate = work->f, *const step = work->base, change = HUGE_VAL;
    rows.most = most;
    for (int k = 0; k < NEWTON_STEPS && change > 1e-13; ++k) {
        if (psa_model_ode(0.0, x, u, p, rate, work->w) || factor(&rows, work, x, u, p)) return 1;
        for (int r = 0; r < rows.count; ++r) step[r] = rate[rows.row[r]];
        psa_lu_solve(rows.count, work->lu, work->pivot, step);
        change = 0.0;
        for (int r = 0; r < rows.count; ++r) {
            const int i = rows.row[r];
            x[i] -= step[r];
            if (!isfinite(x[i])) return 1;
            change = fmax(change, fabs(step[r]) / (fabs(x[i]) + psa_state_nominals[i]));
        }
    }
    return change > 1e-9;
}

/* Rest at inputs u: first without effects, as one that saturates would lead Newton's method astray. */
static int rest(psa_work *work, const double *u, const double *p, double *x) {
    double without[PSA_HELD + 1];
    memcpy(without, p, sizeof without);
    for (int i = 0; i < PSA_NP; ++i)
        if (psa_gains[i]) without[i] = 0.0;
    memset(x, 0, sizeof(double) * PSA_NX);
    return settle(work, PSA_MEMORY_SETTLES, u, without, x) || settle(work, PSA_MEMORY_SETTLES, u, p, x);
}

/* Move the states without memory from rest to a steady motion: at the rate of the inputs, along with
   memories that still relax. */
static int set_in_motion(psa_instance *instance, const double *u, const double *rate, double *x) {
    static const double none[PSA_NX + PSA_HELD + 1] = {0.0};
    const double *const p = instance->state.p;
    psa_work *const work = &instance->work;
    double *const by_input = work->f, *const slope = work->base, *const steady = work->error;
    double *const at_rest = work->x;
    some_rows fast = {0};
    memcpy(at_rest, x, sizeof work->x);
    if (psa_model_directional(0.0, at_rest, u, p, 0.0, none, rate, none, by_input, NULL, NULL,
                              instance->calculus.w) ||
        factor(&fast, work, at_rest, u, p))
        return 1;
    for (int k = 0; k < 2; ++k) { /* the motion changes the rates of memories */
        if (psa_model_ode(0.0, x, u, p, slope, work->w)) return 1;
        for (int r = 0; r < fast.count; ++r) {
            steady[r] = -by_input[fast.row[r]];
            for (int i = 0; i < PSA_NX; ++i)
                if (psa_memory[i]) steady[r] -= work->jac[fast.row[r] + i * PSA_NX] * slope[i];
        }
        psa_lu_solve(fast.count, work->lu, work->pivot, steady);
        psa_lu_solve(fast.count, work->lu, work->pivot, steady);
        for (int r = 0; r < fast.count; ++r) x[fast.row[r]] = at_rest[fast.row[r]] + steady[r];
    }
    return 0;
}

/* The states after the rise, settled. 1 if there are none. */
static int risen(psa_instance *instance, double *x) {
    const psa_state *const state = &instance->state;
    const psa_end end = {RISE, RISE};
    psa_solver *const solver = &instance->calculus.solver;
    psa_input input = state->input;
    input.begin = 0.0;
    memset(input.rate, 0, sizeof input.rate);
    input.value[PSA_VOLTAGE] = 0.0;
    if (rest(&instance->work, input.value, state->p, x)) return 1;
    if (state->start_voltage != 0.0) {
        input.rate[PSA_VOLTAGE] = state->start_voltage / RISE;
        if (set_in_motion(instance, input.value, input.rate, x)) return 1;
        psa_solver_start(solver, 0.0, x, psa_state_nominals, psa_step_tolerance(RISE_TOLERANCE));
        solver->steps_limit = MOST_STEPS;
        if (psa_solver_advance(solver, &instance->work, end, &input, state->p, NULL, NULL) != PSA_OK)
            return 1;
        memcpy(x, solver->x, sizeof solver->x);
        input.value[PSA_VOLTAGE] = state->start_voltage;
        memset(input.rate, 0, sizeof input.rate);
    }
    for (int i = 0; i < PSA_NX; ++i)
        if (state->own_start[i] && psa_memory[i]) x[i] = state->solver.x[i];
    return settle(&instance->work, PSA_MEMORY_NONE, input.value, state->p, x) ||
           set_in_motion(instance, input.value, input.rate, x);
}

static psa_result restless(psa_instance *instance) {
    return psa_say(instance, PSA_ERROR,
                   "There is no settled state at the start_voltage of %.9g V. Likely it, an input or a"
                   " parameter is far from its physical range.",
                   instance->state.start_voltage);
}

psa_result psa_start_slope(psa_instance *instance, double *x, double *u) {
    psa_state *const state = &instance->state;
    const double voltage = state->start_voltage, step = SLOPE_STEP * fmax(fabs(voltage), 1.0);
    double *const less = instance->calculus.base;
    state->start_voltage = voltage + step;
    int failed = risen(instance, x);
    state->start_voltage = voltage - step;
    failed |= risen(instance, less);
    state->start_voltage = voltage;
    if (failed) return restless(instance);
    for (int i = 0; i < PSA_NX; ++i) x[i] = state->own_start[i] ? 0.0 : 0.5 * (x[i] - less[i]) / step;
    memset(u, 0, sizeof(double) * PSA_NU);
    u[PSA_VOLTAGE] = state->voltage_given ? 0.0 : 1.0;
    return PSA_FINE;
}

psa_result psa_begin(psa_instance *instance) {
    psa_state *const state = &instance->state;
    double x[PSA_NX];
    if (!state->start_due) return PSA_FINE;
    if (state->start_voltage == psa_start_inputs[PSA_VOLTAGE]) memcpy(x, psa_start_states, sizeof x);
    else if (risen(instance, x)) return restless(instance);
    for (int i = 0; i < PSA_NX; ++i)
        if (!state->own_start[i]) state->solver.x[i] = x[i];
    psa_solver_invalidate(&state->solver);
    state->start_due = 0;
    instance->fresh = 0;
    return PSA_FINE;
}

void psa_start_at(psa_instance *instance, double voltage) {
    psa_state *const state = &instance->state;
    state->start_voltage = voltage;
    state->start_due = 1;
    if (state->voltage_given) return;
    state->input.value[PSA_VOLTAGE] = voltage;
    state->given[PSA_VOLTAGE] = state->earlier[PSA_VOLTAGE] = voltage;
}

/* A value was set before the first step: the settled state follows, but not a state set by itself. */
void psa_start_changed(psa_instance *instance, const psa_variable *v) {
    psa_state *const state = &instance->state;
    if (!(state->phase & (PSA_INSTANTIATED | PSA_INITIALIZATION))) return;
    if (v->kind == PSA_STATE) state->own_start[v->index] = 1;
    if (v->kind == PSA_INPUT && v->index == PSA_VOLTAGE) state->voltage_given = 1;
    else if (state->start_voltage != psa_start_inputs[PSA_VOLTAGE]) state->start_due = 1;
}
#else
psa_result psa_begin(psa_instance *instance) {
    (void)instance;
    return PSA_FINE;
}

psa_result psa_start_slope(psa_instance *instance, double *x, double *u) {
    (void)instance, (void)x, (void)u;
    return PSA_FINE;
}

void psa_start_at(psa_instance *instance, double voltage) { (void)instance, (void)voltage; }

void psa_start_changed(psa_instance *instance, const psa_variable *v) { (void)instance, (void)v; }
#endif
