#include "solver.h"

#include <math.h>
#include <string.h>

#include "linear.h"

#define LOOSE 5e-6 /* relative tolerance from which the method of second order costs less */
#define NEWTON_LIMIT 8
#define NEWTON_TOLERANCE 0.02 /* share of the step's error tolerance */
#define SAFETY 0.9
#define SMALLEST 1e-25   /* s; no step is shorter, nor than what the solver's clock can tell */
#define BUSY 10000       /* tried steps of a call from which on states must be of a size that makes sense */
#define ABSURD 1e9       /* size of a state over its usual one that makes none */
#define KINK_ITERATIONS 12
#define KINK_RESOLUTION 1e-3 /* of the step in which a kink is located */
#define KINK_RESTART 0.05    /* first step after a kink over the one that ended there */

/* Stiffly accurate: the last stage is the step's result. */
typedef struct {
    int stages;
    double gamma;                           /* diagonal of a */
    double exponent;                        /* -1 / order of the error estimate */
    double c[PSA_STAGES];
    double a[PSA_STAGES][PSA_STAGES];
    double e[PSA_STAGES];                   /* b minus the weights of the embedded formula */
} psa_method;

static const psa_method ESDIRK4 = {
    6,
    0.25,
    -0.25,
    {0.0, 1.0 / 2.0, 83.0 / 250.0, 31.0 / 50.0, 17.0 / 20.0, 1.0},
    {{0.0},
     {1.0 / 4.0, 0.25},
     {8611.0 / 62500.0, -1743.0 / 31250.0, 0.25},
     {5012029.0 / 34652500.0, -654441.0 / 2922500.0, 174375.0 / 388108.0, 0.25},
     {15267082809.0 / 155376265600.0, -71443401.0 / 120774400.0, 730878875.0 / 902184768.0,
      2285395.0 / 8070912.0, 0.25},
     {82889.0 / 524892.0, 0.0, 15625.0 / 83664.0, 69875.0 / 102672.0, -2260.0 / 8211.0, 0.25}},
    {82889.0 / 524892.0 - 4586570599.0 / 29645900160.0, 0.0,
     15625.0 / 83664.0 - 178811875.0 / 945068544.0, 69875.0 / 102672.0 - 814220225.0 / 1159782912.0,
     -2260.0 / 8211.0 + 3700637.0 / 11593932.0, 1.0 / 4.0 - 61727.0 / 225920.0}};

#define ROOT2 1.4142135623730951
static const psa_method TR_BDF2 = {
    3,
    1.0 - ROOT2 / 2.0,
    -1.0 / 3.0,
    {0.0, 2.0 - ROOT2, 1.0},
    {{0.0}, {1.0 - ROOT2 / 2.0, 1.0 - ROOT2 / 2.0}, {ROOT2 / 4.0, ROOT2 / 4.0, 1.0 - ROOT2 / 2.0}},
    {(ROOT2 - 1.0) / 3.0, -1.0 / 3.0, (2.0 - ROOT2) / 3.0}};

static const psa_method *method_of(const psa_solver *solver) {
    return solver->rtol < LOOSE ? &ESDIRK4 : &TR_BDF2;
}

void psa_input_at(const psa_input *input, double since, double *u) {
    for (int i = 0; i < PSA_NU; ++i) u[i] = input->value[i] + input->rate[i] * (since - input->begin);
}

void psa_solver_move(psa_solver *solver, double t) {
    solver->t = solver->origin = t;
    solver->since = 0.0;
}

void psa_solver_start(psa_solver *solver, double t, const double *x, const double *nominal,
                      double rtol) {
    memset(solver, 0, sizeof *solver);
    psa_solver_move(solver, t);
    solver->rtol = rtol;
    solver->contraction = 1.0;
    memcpy(solver->x, x, sizeof solver->x);
    memcpy(solver->nominal, nominal, sizeof solver->nominal);
}

void psa_solver_invalidate(psa_solver *solver) {
    solver->slope_valid = 0;
    solver->landed = 0;
}

static double scaled_norm(const psa_work *work, const double *v, int64_t *worst) {
    double sum = 0.0, largest = -1.0;
    for (int i = 0; i < PSA_NX; ++i) {
        const double e = v[i] / work->weight[i];
        if (!(fabs(e) <= largest)) {
            largest = fabs(e);
            if (worst) *worst = i;
        }
        sum += e * e;
    }
    return sqrt(sum / PSA_NX);
}

static void set_weights(const psa_solver *solver, psa_work *work) {
    for (int i = 0; i < PSA_NX; ++i)
        work->weight[i] = solver->rtol * (fabs(solver->x[i]) + solver->nominal[i]);
}

/* lu = factors of I - h_gamma * df/dx */
static int factorise(psa_work *work, const double *jac, double h_gamma) {
    for (int i = 0; i < PSA_NX * PSA_NX; ++i) work->lu[i] = -h_gamma * jac[i];
    for (int i = 0; i < PSA_NX; ++i) work->lu[i + i * PSA_NX] += 1.0;
    return psa_lu_factor(PSA_NX, work->lu, work->pivot);
}

/* Solve k = f(t, base + h gamma k) by simplified Newton iteration; 0 when converged. */
static int solve_stage(psa_solver *solver, psa_work *work, int stage, const double *base, double h_gamma,
                       const double *u, const double *p) {
    double *x = work->stage_x[stage], *k = work->stage_k[stage];
    double *const f = work->f, previous = 0.0;
    /* Hairer and Wanner, Solving ODEs II, IV.8: trust the contraction seen last, a little less each time */
    double contraction = pow(fmax(solver->contraction, 1e-10), 0.8);
    for (int iteration = 0; iteration < NEWTON_LIMIT; ++iteration) {
        for (int i = 0; i < PSA_NX; ++i) x[i] = base[i] + h_gamma * k[i];
        if (psa_model_ode(work->stage_t[stage], x, u, p, f, work->w)) return 1;
        solver->evaluations++;
        for (int i = 0; i < PSA_NX; ++i) f[i] -= k[i];
        psa_lu_solve(PSA_NX, work->lu, work->pivot, f);
        for (int i = 0; i < PSA_NX; ++i) {
            k[i] += f[i];
            f[i] *= h_gamma;
        }
        const double change = scaled_norm(work, f, &solver->culprit);
        if (!(change < 1e12)) return 1;
        if (iteration > 0) {
            const double theta = change / previous;
            if (theta > 2.0) return 1;
            contraction = theta < 0.99 ? theta / (1.0 - theta) : 99.0;
            solver->contraction = contraction;
        }
        if (change <= 1e-12 || contraction * change <= NEWTON_TOLERANCE) {
            for (int i = 0; i < PSA_NX; ++i) x[i] = base[i] + h_gamma * k[i];
            solver->contraction = contraction;
            return 0;
        }
        previous = change;
    }
    return 1;
}

/* The time of a stage of a step of size h, and the input then. */
static void set_stage(const psa_solver *solver, psa_work *work, int stage, double h,
                      const psa_input *input, double *u) {
    const double since = solver->since + method_of(solver)->c[stage] * h;
    work->stage_t[stage] = solver->origin + since;
    psa_input_at(input, since, u);
}

/* Try one step of size h; returns the scaled error (<= 1 accepts), or a negative number on failure. */
static double try_step(psa_solver *solver, psa_work *work, double h, const psa_input *input,
                       const double *p) {
    const psa_method *const method = method_of(solver);
    const double h_gamma = h * method->gamma;
    double *const base = work->base, *const error = work->error, u[PSA_NU + 1];
    if (work->lu_factor_h != h_gamma) {
        if (factorise(work, work->jac, h_gamma)) return -1.0;
        work->lu_factor_h = h_gamma;
    }
    memcpy(work->stage_x[0], solver->x, sizeof solver->x);
    memcpy(work->stage_k[0], solver->slope, sizeof solver->slope);
    set_stage(solver, work, 0, h, input, u);
    for (int stage = 1; stage < method->stages; ++stage) {
        set_stage(solver, work, stage, h, input, u);
        for (int i = 0; i < PSA_NX; ++i) {
            double sum = 0.0;
            for (int j = 0; j < stage; ++j) sum += method->a[stage][j] * work->stage_k[j][i];
            base[i] = solver->x[i] + h * sum;
        }
        memcpy(work->stage_k[stage], work->stage_k[stage > 1 ? stage - 1 : 0], sizeof work->base);
        if (solve_stage(solver, work, stage, base, h_gamma, u, p)) return -1.0;
    }
    for (int i = 0; i < PSA_NX; ++i) {
        error[i] = 0.0;
        for (int j = 0; j < method->stages; ++j) error[i] += h * method->e[j] * work->stage_k[j][i];
    }
    psa_lu_solve(PSA_NX, work->lu, work->pivot, error);
    return scaled_norm(work, error, &solver->culprit);
}

static int prepare_slope(psa_solver *solver, psa_work *work, const psa_input *input, const double *p) {
    double u[PSA_NU + 1];
    int same = solver->slope_valid != 0;
    psa_input_at(input, solver->since, u);
    for (int i = 0; i < PSA_NU; ++i)
        if (fabs(u[i] - solver->last_input[i]) > 1e-12 * (fabs(u[i]) + fabs(solver->last_input[i])))
            same = 0;
    if (same) return 0;
    if (psa_model_ode(solver->t, solver->x, u, p, solver->slope, work->w)) return 1;
    solver->evaluations++;
    for (int i = 0; i < PSA_NX; ++i)
        if (!isfinite(solver->slope[i])) {
            solver->culprit = i;
            return 1;
        }
    solver->slope_valid = 1;
    return 2;
}

static double first_step(const psa_solver *solver, const psa_work *work) {
    const double slope = scaled_norm(work, solver->slope, NULL);
    return slope > 0.0 ? 0.5 / slope : INFINITY;
}

/* dX_i/dtheta of all stages of the accepted step: differentiates the discrete equations exactly. The
   slopes are J base + df/dtheta, all [PSA_NX][count]. */
static int step_sensitivities(const psa_solver *solver, psa_work *work, double h,
                              const psa_input *input, const double *p, psa_sensitivities *sens) {
    const psa_method *const method = method_of(solver);
    const int count = sens->count, size = PSA_NX * count, stages = method->stages;
    const size_t bytes = sizeof(double) * (size_t)size;
    double *const jac = work->jac, u[PSA_NU + 1];
    for (int stage = sens->slope_valid ? 1 : 0; stage < stages; ++stage) {
        double *const slopes = stage > 0 ? sens->stage + (long)stage * size : sens->slope;
        set_stage(solver, work, stage, h, input, u);
        if (sens->differentiate(sens, work->stage_t[stage], work->stage_x[stage], u, p, jac, slopes,
                                work->w))
            return 1;
        memcpy(sens->base, sens->s, bytes);
        for (int j = 0; j < stage; ++j)
            if (method->a[stage][j] != 0.0)
                psa_axpy(size, h * method->a[stage][j], j > 0 ? sens->stage + (long)j * size : sens->slope,
                         sens->base);
        for (int i = 0; i < PSA_NX; ++i)
            for (int j = 0; j < PSA_NX; ++j)
                if (jac[i + j * PSA_NX] != 0.0)
                    psa_axpy(count, jac[i + j * PSA_NX], sens->base + j * count, slopes + i * count);
        if (stage == 0) continue;
        if (factorise(work, jac, h * method->gamma)) return 1;
        psa_lu_solve_many(PSA_NX, work->lu, work->pivot, count, slopes);
    }
    memcpy(sens->slope, sens->stage + (long)(stages - 1) * size, bytes);
    memcpy(sens->s, sens->base, bytes);
    psa_axpy(size, h * method->gamma, sens->slope, sens->s);
    sens->slope_valid = 1;
    return 0;
}

/* x at t + theta h of the step just tried: cubic Hermite interpolation. */
static void interpolate(const psa_solver *solver, const psa_work *work, double h, double theta,
                        double *x) {
    const int last = method_of(solver)->stages - 1;
    const double *x1 = work->stage_x[last], *k1 = work->stage_k[last];
    for (int i = 0; i < PSA_NX; ++i) {
        const double x0 = solver->x[i], change = x1[i] - x0;
        x[i] = x0 + theta * change +
               theta * (theta - 1.0) *
                   ((1.0 - 2.0 * theta) * change + (theta - 1.0) * h * solver->slope[i] +
                    theta * h * k1[i]);
    }
}

static int switches_at(const psa_solver *solver, psa_work *work, double h, double theta,
                       const psa_input *input, const double *p, double *z) {
    double u[PSA_NU + 1];
    const double since = solver->since + theta * h;
    interpolate(solver, work, h, theta, work->x);
    psa_input_at(input, since, u);
    return psa_model_switches(solver->origin + since, work->x, u, p, z, work->w);
}

/* Share of the step just tried after which the first switch has changed its sign; 1 if none does.
   Illinois's variant of the secant method on the interpolated states. */
static double first_kink(const psa_solver *solver, psa_work *work, double h,
                         const psa_input *input, const double *p) {
    double first = 1.0, low[PSA_NZ + 1], high[PSA_NZ + 1], z[PSA_NZ + 1];
    if (PSA_NZ == 0 || switches_at(solver, work, h, 0.0, input, p, low) ||
        switches_at(solver, work, h, 1.0, input, p, high))
        return 1.0;
    for (int s = 0; s < PSA_NZ; ++s) {
        double a = 0.0, b = 1.0, za = low[s], zb = high[s];
        if (!(za * zb < 0.0)) continue;
        for (int i = 0; i < KINK_ITERATIONS && b - a > KINK_RESOLUTION; ++i) {
            const double margin = 0.01 * (b - a), secant = b - zb * (b - a) / (zb - za);
            const double theta = fmin(fmax(secant, a + margin), b - margin);
            if (switches_at(solver, work, h, theta, input, p, z)) return 1.0;
            if (z[s] * zb > 0.0) {
                b = theta;
                zb = z[s];
                za *= 0.5;
            } else {
                a = theta;
                za = z[s];
                zb *= 0.5;
            }
        }
        if (b < first) first = b;
    }
    return first;
}

static psa_status accept(psa_solver *solver, psa_work *work, psa_end reached, double h,
                         const psa_input *input, const double *p, psa_sensitivities *sens) {
    if (sens && step_sensitivities(solver, work, h, input, p, sens)) return PSA_NOT_FINITE;
    const int last = method_of(solver)->stages - 1;
    memcpy(solver->x, work->stage_x[last], sizeof solver->x);
    memcpy(solver->slope, work->stage_k[last], sizeof solver->slope);
    solver->since = reached.since;
    solver->t = reached.t;
    psa_input_at(input, reached.since, solver->last_input);
    solver->steps++;
    return PSA_OK;
}

/* What one call of psa_solver_advance may still spend and reach. */
typedef struct {
    psa_end end;
    int64_t attempts; /* left */
} psa_bounds;

/* Bounds a step from below, for the clock must move; one that is not shorter is tried before it fails. */
static double smallest_step(const psa_solver *solver) {
    return fmax(SMALLEST, 8.0 * 2.220446049250313e-16 * solver->since);
}

static psa_end after(const psa_solver *solver, double h) {
    const double since = solver->since + h;
    const psa_end reached = {since, solver->origin + since};
    return reached;
}

/* One accepted step towards the end, after as many attempts as it takes. */
static psa_status one_step(psa_solver *solver, psa_work *work, psa_bounds *bounds,
                           const psa_input *input, const double *p, psa_sensitivities *sens) {
    const double exponent = method_of(solver)->exponent, smallest = smallest_step(solver);
    const double left = bounds->end.since - solver->since;
    double u[PSA_NU + 1];
    double aimed = 0.0; /* length of the step that ends at a kink; 0: no kink is in sight */
    psa_input_at(input, solver->since, u);
    set_weights(solver, work);
    if (psa_model_jacobian(solver->t, solver->x, u, p, work->jac, work->w)) return PSA_NOT_FINITE;
    work->lu_factor_h = 0.0;
    for (;;) {
        double h = fmax(solver->step, smallest);
        if (solver->max_step > 0.0) h = fmin(h, solver->max_step);
        const int last = h * 1.01 >= left && aimed == 0.0;
        if (aimed > 0.0) h = fmin(h, aimed);
        else if (last) h = left;
        else if (2.0 * h > left) h = 0.5 * left;
        if (--bounds->attempts < 0) return PSA_TOO_MANY_STEPS;
        const double error = try_step(solver, work, h, input, p);
        const int good = error >= 0.0 && error <= 1.0;
        const double kink =
            good && !solver->landed && aimed == 0.0 ? first_kink(solver, work, h, input, p) : 1.0;
        if (kink < 1.0 && kink * h > smallest) {
            aimed = kink * h;
            solver->rejected++;
        } else if (good) {
            const double factor = fmin(5.0, fmax(0.2, SAFETY * pow(fmax(error, 1e-10), exponent)));
            const psa_status status =
                accept(solver, work, last ? bounds->end : after(solver, h), h, input, p, sens);
            if (status != PSA_OK) return status;
            solver->landed = aimed > 0.0 && h >= aimed;
            if (solver->landed) solver->step = KINK_RESTART * h;
            else solver->step = h < solver->step ? fmax(solver->step, h * factor) : h * factor;
            return PSA_OK;
        } else {
            solver->rejected++;
            if (!(h > smallest)) return PSA_STEP_TOO_SMALL;
            solver->step = error > 0.0 ? h * fmax(0.1, SAFETY * pow(error, exponent)) : 0.25 * h;
        }
    }
}

/* Whether a state is so far beyond its usual size that no step towards the end is worth its time. */
static int beyond_all_size(psa_solver *solver) {
    for (int i = 0; i < PSA_NX; ++i)
        if (!(fabs(solver->x[i]) <= ABSURD * solver->nominal[i])) {
            solver->culprit = i;
            return 1;
        }
    return 0;
}

psa_status psa_solver_advance(psa_solver *solver, psa_work *work, psa_end end,
                              const psa_input *input, const double *p, psa_sensitivities *sens,
                              const psa_watch *watch) {
    const int64_t limit = solver->steps_limit > 0 ? solver->steps_limit : 10000000;
    psa_bounds bounds = {end, limit};
    while (solver->since < bounds.end.since) {
        /* afresh for each step, because who watches may have changed the input */
        switch (prepare_slope(solver, work, input, p)) {
        case 1: return PSA_NOT_FINITE;
        case 2:
            if (sens) sens->slope_valid = 0;
            break;
        default: break;
        }
        if (!(solver->step > 0.0)) {
            set_weights(solver, work);
            solver->step = first_step(solver, work);
        }
        const psa_status status = one_step(solver, work, &bounds, input, p, sens);
        if (status != PSA_OK) return status;
        if (limit - bounds.attempts > BUSY && beyond_all_size(solver)) return PSA_TOO_MANY_STEPS;
        if (watch) watch->accepted(watch->owner, &bounds.end);
    }
    return PSA_OK;
}
