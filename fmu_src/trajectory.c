#include "trajectory.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "instants.h"

/* The sampled states of a trajectory: they stand behind the parameters in p. */
typedef struct {
    double p[PSA_HELD + 1];
    double next; /* time of the next instant */
} psa_held;

/* What a run works with; too much for a stack. */
typedef struct {
    psa_solver solver;
    psa_work work;
    psa_held held;
    psa_sensitivities sens;
    const int *which;
    double by_state[PSA_NY * PSA_NX + 1], by_parameter[(PSA_NX + PSA_NY) * PSA_NP + 1];
} psa_workshop;

/* Write one sample; d y/d theta = dg/dx s + dg/dp. Returns 0, or 1 when the model failed. `p` has the
   sampled states behind the parameters. */
static int write_sample(psa_trajectory *run, psa_workshop *at, long sample) {
    const psa_solver *const solver = &at->solver;
    const double *const u = run->u + sample * PSA_NU, *const p = at->held.p;
    double *const w = at->work.w;
    if (run->x) memcpy(run->x + sample * PSA_NX, solver->x, sizeof solver->x);
    if (run->z) memcpy(run->z + sample * PSA_NS, p + PSA_NP, sizeof(double) * PSA_NS);
    if (run->y && psa_model_outputs(solver->t, solver->x, u, p, run->y + sample * PSA_NY, w)) return 1;
#ifdef PSA_WITH_SENSITIVITIES
    if (run->count > 0) {
        double *const jac = at->by_state, *const param = at->by_parameter;
        if (psa_model_output_sensitivity(solver->t, solver->x, u, p, jac, param, w)) return 1;
        const int count = run->count;
        const double *const s = at->sens.s;
        double *dy = run->dy + sample * run->shown * count;
        for (int j = 0; j < run->shown; ++j) {
            const int row = run->outputs[j];
            for (int c = 0; c < count; ++c) {
                double sum = run->which[c] >= 0 ? param[row + run->which[c] * PSA_NY] : 0.0;
                for (int i = 0; i < PSA_NX; ++i) sum += jac[row + i * PSA_NY] * s[i * count + c];
                *dy++ = sum;
            }
        }
    }
#endif
    return 0;
}

#ifdef PSA_WITH_SENSITIVITIES
/* df/dx, and df/dtheta of the parameters in `which`; zero for initial values. */
static int differentiate(const psa_sensitivities *sens, double t, const double *x, const double *u,
                         const double *p, double *jac, double *forcing, double *w) {
    psa_workshop *const at = sens->owner;
    const int *const which = at->which, count = sens->count;
    double *const param = at->by_parameter;
    if (psa_model_sensitivity(t, x, u, p, jac, param, w)) return 1;
    for (int i = 0; i < PSA_NX; ++i)
        for (int c = 0; c < count; ++c)
            forcing[i * count + c] = which[c] >= 0 ? param[i + which[c] * PSA_NX] : 0.0;
    return 0;
}
#else
static int differentiate(const psa_sensitivities *sens, double t, const double *x, const double *u,
                         const double *p, double *jac, double *forcing, double *w) {
    (void)sens, (void)t, (void)x, (void)u, (void)p, (void)jac, (void)forcing, (void)w;
    return 1;
}
#endif

static void set_input(const psa_trajectory *run, long sample, psa_input *input) {
    const double span = run->t[sample + 1] - run->t[sample];
    input->begin = 0.0;
    for (int i = 0; i < PSA_NU; ++i) {
        const double now = run->u[sample * PSA_NU + i], next = run->u[(sample + 1) * PSA_NU + i];
        input->value[i] = now;
        input->rate[i] = run->zero_order_hold ? 0.0 : (next - now) / span;
    }
}

static int sample_at(psa_workshop *at, const double *u) {
    psa_solver *const solver = &at->solver;
    psa_held *const held = &at->held;
    if (psa_take_sample(solver->t, solver->x, u, held->p, at->work.w)) return PSA_NOT_FINITE;
    held->next = psa_instant_after(solver->t, held->p[PSA_PERIOD]);
    psa_solver_invalidate(solver);
    return PSA_OK;
}

/* The sampled states before the first time, and after an instant at that time. */
static int start_held(const psa_trajectory *run, psa_workshop *at) {
    const psa_solver *const solver = &at->solver;
    psa_held *const held = &at->held;
    memset(held, 0, sizeof *held);
    memcpy(held->p, run->p, sizeof(double) * PSA_NP);
    if (PSA_NS == 0) return PSA_OK;
    memcpy(held->p + PSA_NP, run->z0, sizeof(double) * PSA_NS);
    held->next = psa_instant_after(solver->t, held->p[PSA_PERIOD]);
    if (!psa_at_instant(solver->t, held->p[PSA_PERIOD])) return PSA_OK;
    return sample_at(at, run->u);
}

static int stopped(const psa_trajectory *run) { return run->stop && *run->stop; }

/* After each step: one that was stopped goes no further. */
static void end_if_stopped(void *owner, psa_end *end) {
    if (stopped(owner)) end->since = end->t = -HUGE_VAL;
}

/* Integrate over one interval between samples; steps end at the instants inside. One at its end is taken
   with the next sample's input, which is the one after a jump where the input is held. */
static int next_sample(const psa_trajectory *run, psa_workshop *at, long sample) {
    psa_solver *const solver = &at->solver;
    psa_work *const work = &at->work;
    psa_held *const held = &at->held;
    psa_sensitivities *const sens = run->count > 0 ? &at->sens : NULL;
    const double begin = run->t[sample], end = run->t[sample + 1], period = held->p[PSA_PERIOD];
    const psa_end next = {end - begin, end};
    double u[PSA_NU + 1];
    psa_input input;
    const psa_watch watch = {end_if_stopped, (void *)run};
    set_input(run, sample, &input);
    psa_solver_move(solver, begin);
    while (PSA_NS > 0 && !psa_reached(held->next, end, period)) {
        const psa_end instant = {held->next - begin, held->next};
        int status = (int)psa_solver_advance(solver, work, instant, &input, held->p, sens, &watch);
        if (status != PSA_OK) return status;
        if (stopped(run)) return PSA_STOPPED;
        psa_input_at(&input, solver->since, u);
        status = sample_at(at, u);
        if (status != PSA_OK) return status;
    }
    const int status = (int)psa_solver_advance(solver, work, next, &input, held->p, sens, &watch);
    if (status == PSA_OK && stopped(run)) return PSA_STOPPED;
    if (status != PSA_OK || PSA_NS == 0 || !psa_reached(end, held->next, period)) return status;
    return sample_at(at, run->u + (sample + 1) * PSA_NU);
}

static int run_all(psa_trajectory *run, psa_workshop *at) {
    psa_solver *const solver = &at->solver;
    psa_sensitivities *const sens = &at->sens;
    psa_solver_start(solver, run->t[0], run->x0, run->nominal, run->rtol);
    solver->max_step = run->max_step;
    solver->steps_limit = run->steps_limit;
    if (run->count > 0) {
        const long size = (long)PSA_NX * run->count;
        at->which = run->which;
        sens->count = run->count;
        sens->differentiate = differentiate;
        sens->owner = at;
        sens->s = run->work;
        sens->slope = run->work + size;
        sens->base = run->work + 2 * size;
        sens->stage = run->work + 3 * size;
        memcpy(sens->s, run->s0, sizeof(double) * (size_t)size);
    }
    int status = start_held(run, at);
    if (status == PSA_OK && write_sample(run, at, 0)) status = PSA_NOT_FINITE;
    for (long sample = 0; sample + 1 < run->samples && status == PSA_OK; ++sample) {
        status = next_sample(run, at, sample);
        if (status == PSA_OK && write_sample(run, at, sample + 1)) status = PSA_NOT_FINITE;
        const double share = fmin(1.0, 0.1 + (double)(sample + 1) / (double)run->samples);
        const double done = (double)(solver->steps + solver->rejected);
        if (status == PSA_OK && run->steps_most > 0 && done > share * (double)run->steps_most)
            status = PSA_TOO_MANY_STEPS;
    }
    run->steps = (long)solver->steps;
    run->rejected = (long)solver->rejected;
    run->evaluations = (long)solver->evaluations;
    run->t_failed = solver->t;
    run->culprit = (int)solver->culprit;
    return status;
}

int psa_run(psa_trajectory *run) {
    psa_workshop *const at = calloc(1, sizeof *at);
    const int status = at ? run_all(run, at) : PSA_NO_MEMORY;
    free(at);
    return status;
}
