/* States without memory start where the inputs and their rates put them; memories at their rest value plus
   a deviation. */
#include "settle.h"

#include <math.h>
#include <string.h>

#include "linear.h"
#include "page_config.h"

#define NEWTON_STEPS 30

/* A module has one thread, and what is large is not on its stack. */
static double jac[PSA_NX * PSA_NX], part[PSA_NX * PSA_NX], by_input[PSA_NX * PSA_NU + 1];
static double work[PAGE_SZ_W > PSA_SZ_W ? PAGE_SZ_W : PSA_SZ_W];

#if PSA_NU > 0
int psa_by_input(const double **arg, double **res, long long int *iw, double *w, int memory);

/* df/du, column-major, PSA_NX by PSA_NU */
static int slopes_by_input(double t, const double *x, const double *u, const double *p, double *slopes) {
    const double *arg[PAGE_SZ_ARG] = {&t, x, u, p};
    double *res[PAGE_SZ_RES] = {slopes};
    long long int iw[PAGE_SZ_IW];
    return psa_by_input(arg, res, iw, work, 0);
}
#else
static int slopes_by_input(double t, const double *x, const double *u, const double *p, double *slopes) {
    (void)t, (void)x, (void)u, (void)p, (void)slopes;
    return 0;
}
#endif

/* Rows of the states without memory, and of these with the memories that have an equilibrium */
static int rows_of(int with_settling, int *rows) {
    int count = 0;
    for (int i = 0; i < PSA_STATES; ++i)
        if (!page_memory[i] || (with_settling && page_settles[i])) rows[count++] = i;
    return count;
}

/* b = jac[rows, rows]^-1 b */
static int solve(int count, const int *rows, double *b) {
    double *const a = part;
    int pivot[PSA_NX];
    for (int j = 0; j < count; ++j)
        for (int i = 0; i < count; ++i) a[i + j * count] = jac[rows[i] + rows[j] * PSA_NX];
    if (psa_lu_factor(count, a, pivot)) return 1;
    psa_lu_solve(count, a, pivot, b);
    return 0;
}

static int newton(const psa_beginning *at, const double *p, int with_settling, double *x) {
    double slope[PSA_NX], b[PSA_NX];
    int rows[PSA_NX];
    const int count = rows_of(with_settling, rows);
    if (psa_model_ode(at->t, x, at->u, p, slope, work)) return 1;
    if (psa_model_jacobian(at->t, x, at->u, p, jac, work)) return 1;
    for (int k = 0; k < count; ++k) b[k] = slope[rows[k]];
    if (solve(count, rows, b)) return 1;
    for (int k = 0; k < count; ++k) x[rows[k]] -= b[k];
    return 0;
}

/* One step towards rest: the memories where they settle, then all others with the memories off it */
static int step(const psa_beginning *at, const double *p, double *x) {
    for (int i = 0; i < PSA_STATES; ++i)
        if (page_memory[i] && !page_settles[i]) x[i] = at->deviation[i];
    if (newton(at, p, 1, x)) return 1;
    for (int i = 0; i < PSA_STATES; ++i)
        if (page_memory[i]) x[i] = page_settles[i] ? x[i] + at->deviation[i] : at->deviation[i];
    return newton(at, p, 0, x);
}

static int rest(const psa_beginning *at, const double *p, double *x) {
    double change = INFINITY;
    for (int k = 0; k < NEWTON_STEPS && change > 1e-13; ++k) {
        double before[PSA_NX];
        memcpy(before, x, sizeof before);
        if (step(at, p, x)) return 1;
        change = 0.0;
        for (int i = 0; i < PSA_STATES; ++i) {
            const double moved = fabs(x[i] - before[i]) / (fabs(x[i]) + at->nominal[i]);
            if (!(moved <= change)) change = moved; /* what is not a number stays */
        }
    }
    return !(change < 1e-9);
}

/* From rest to a steady motion at the rates of inputs and memories */
static int set_in_motion(const psa_beginning *at, const double *still, double *x) {
    double slope[PSA_NX], lag[PSA_NX];
    int rows[PSA_NX];
    const int count = rows_of(0, rows);
    if (psa_model_jacobian(at->t, still, at->u, at->p, jac, work)) return 1;
    if (slopes_by_input(at->t, still, at->u, at->p, by_input)) return 1;
    if (psa_model_ode(at->t, x, at->u, at->p, slope, work)) return 1;
    for (int k = 0; k < count; ++k) {
        lag[k] = 0.0;
        for (int q = 0; q < PSA_NU; ++q) lag[k] -= by_input[rows[k] + q * PSA_NX] * at->rate[q];
        for (int i = 0; i < PSA_STATES; ++i)
            if (page_memory[i]) lag[k] -= jac[rows[k] + i * PSA_NX] * slope[i];
    }
    if (solve(count, rows, lag) || solve(count, rows, lag)) return 1;
    memcpy(x, still, sizeof(double) * PSA_NX);
    for (int k = 0; k < count; ++k) x[rows[k]] += lag[k];
    return 0;
}

int psa_settle(const psa_beginning *at, double *x) {
    double without[PSA_NP + 1], still[PSA_NX];
    int effects = 0;
    memset(x, 0, sizeof(double) * PSA_NX);
    memcpy(without, at->p, sizeof(double) * PSA_NP);
    for (int k = 0; k < PAGE_GAINS; ++k) {
        effects |= without[page_gains[k]] != 0.0;
        without[page_gains[k]] = 0.0; /* a saturating effect would lead Newton astray from far away */
    }
    if (effects && rest(at, without, x)) return 1;
    if (rest(at, at->p, x) || step(at, at->p, x)) return 1;
    memcpy(still, x, sizeof still);
    return set_in_motion(at, still, x) || set_in_motion(at, still, x);
}
