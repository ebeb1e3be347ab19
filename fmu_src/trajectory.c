#include "trajectory.h"

#include <string.h>

/* Write one sample; d y/d theta = dg/dx s + dg/dp. Returns 0, or 1 when the model failed. */
static int write_sample(psa_trajectory *run, const psa_solver *solver, const psa_sensitivities *sens,
                        long sample) {
    const double *u = run->u + sample * PSA_NU;
    if (run->x) memcpy(run->x + sample * PSA_NX, solver->x, sizeof solver->x);
    if (run->y && psa_model_outputs(solver->t, solver->x, u, run->p, run->y + sample * PSA_NY))
        return 1;
#ifdef PSA_WITH_SENSITIVITIES
    if (run->count > 0) {
        double jac[PSA_NY * PSA_NX], param[PSA_NY * PSA_NP];
        if (psa_model_output_sensitivity(solver->t, solver->x, u, run->p, jac, param)) return 1;
        for (int c = 0; c < run->count; ++c) {
            double sum = run->which[c] >= 0 ? param[run->output + run->which[c] * PSA_NY] : 0.0;
            for (int i = 0; i < PSA_NX; ++i)
                sum += jac[run->output + i * PSA_NY] * sens->s[i * run->count + c];
            run->dy[sample * run->count + c] = sum;
        }
    }
#else
    (void)sens;
#endif
    return 0;
}

#ifdef PSA_WITH_SENSITIVITIES
/* df/dx, and df/dtheta of the parameters in `which`; zero for initial values. */
static int differentiate(const psa_sensitivities *sens, double t, const double *x, const double *u,
                         const double *p, double *jac, double *forcing) {
    const int *const which = sens->directions;
    const int count = sens->count;
    double param[PSA_NX * PSA_NP];
    if (psa_model_sensitivity(t, x, u, p, jac, param)) return 1;
    for (int i = 0; i < PSA_NX; ++i)
        for (int c = 0; c < count; ++c)
            forcing[i * count + c] = which[c] >= 0 ? param[i + which[c] * PSA_NX] : 0.0;
    return 0;
}
#else
static int differentiate(const psa_sensitivities *sens, double t, const double *x, const double *u,
                         const double *p, double *jac, double *forcing) {
    (void)sens, (void)t, (void)x, (void)u, (void)p, (void)jac, (void)forcing;
    return 1;
}
#endif

static void set_input(const psa_trajectory *run, long sample, psa_input *input) {
    const double span = run->t[sample + 1] - run->t[sample];
    input->origin = run->t[sample];
    for (int i = 0; i < PSA_NU; ++i) {
        const double now = run->u[sample * PSA_NU + i], next = run->u[(sample + 1) * PSA_NU + i];
        input->value[i] = now;
        input->rate[i] = run->zero_order_hold ? 0.0 : (next - now) / span;
    }
}

int psa_run(psa_trajectory *run) {
    psa_solver solver;
    psa_work work;
    psa_input input;
    psa_sensitivities sens = {0}, *carried = NULL;
    int status = PSA_OK;
    psa_solver_start(&solver, run->t[0], run->x0, run->nominal, run->rtol);
    solver.max_step = run->max_step;
    solver.steps_limit = run->steps_limit;
    if (run->count > 0) {
        const long size = (long)PSA_NX * run->count;
        sens.count = run->count;
        sens.differentiate = differentiate;
        sens.directions = run->which;
        sens.s = run->work;
        sens.slope = run->work + size;
        sens.base = run->work + 2 * size;
        sens.stage = run->work + 3 * size;
        memcpy(sens.s, run->s0, sizeof(double) * (size_t)size);
        carried = &sens;
    }
    if (write_sample(run, &solver, carried, 0)) status = PSA_NOT_FINITE;
    for (long sample = 0; sample + 1 < run->samples && status == PSA_OK; ++sample) {
        set_input(run, sample, &input);
        status = (int)psa_solver_advance(&solver, &work, run->t[sample + 1], &input, run->p, carried, NULL);
        if (status == PSA_OK && write_sample(run, &solver, carried, sample + 1))
            status = PSA_NOT_FINITE;
    }
    run->steps = (long)solver.steps;
    run->rejected = (long)solver.rejected;
    run->evaluations = (long)solver.evaluations;
    run->t_failed = solver.t;
    run->culprit = (int)solver.culprit;
    return status;
}
