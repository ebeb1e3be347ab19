/* Exact steps: ports that feed back to what they depend on, by Newton's method (exact.c). */
#ifndef PSA_EXACT_LOOPS_H
#define PSA_EXACT_LOOPS_H

#include "exact_ports.h"

#if EX_NLOOP > 0
/* A port's partial derivative by a linear state, 0 where it has none */
static real port_by_linear(const psa_trial *trial, int n, int j, int linear) {
    const int at = ex_port_by_linear[j][linear];
    return at < 0 ? REAL(0.0) : trial->slopes[n][j][at];
}

/* I - d(values)/d(values) of the ports of a loop at half and end: their own response seen by themselves */
static void loop_matrix(const psa_trial *trial, const int *ports, int count, real *a) {
    static const int AT[2] = {HALF, WHOLE};
    const int size = 2 * count;
    for (int n = 0; n < 2; ++n)
        for (int j = 0; j < count; ++j)
            for (int m = 0; m < 2; ++m)
                for (int i = 0; i < count; ++i) {
                    real sum = n == m && i == j ? REAL(1.0) : REAL(0.0);
                    for (int r = 0; r < EX_NEED; ++r) {
                        const int q = ex_need[r];
                        sum -= port_by_linear(trial, AT[n], ports[j], q) *
                               weight_of(trial->level, AT[n], ports[i], m + 1, r);
                    }
                    a[(n * count + j) * size + m * count + i] = sum;
                }
}

/* Gauss elimination without exchanges: the matrix is the unit one and a contraction */
static void eliminate(int size, real *a, real *b) {
    for (int k = 0; k < size; ++k)
        for (int i = k + 1; i < size; ++i) {
            const real factor = a[i * size + k] / a[k * size + k];
            a[i * size + k] = factor;
            for (int j = k + 1; j < size; ++j) a[i * size + j] -= factor * a[k * size + j];
            b[i] -= factor * b[k];
        }
    for (int k = size - 1; k >= 0; --k) {
        for (int j = k + 1; j < size; ++j) b[k] -= a[k * size + j] * b[j];
        b[k] /= a[k * size + k];
    }
}

static void do_loop(psa_state *state, psa_trial *trial, const int *ports, int count) {
    static const int AT[2] = {HALF, WHOLE};
    real without[2][EX_NX], a[4 * EX_NPORT * EX_NPORT], b[2 * EX_NPORT];
    real change = REAL(1e300);
    bits settled = MASK(change < 0.0);
    for (int n = 0; n < 2; ++n) memcpy(without[n], trial->x[AT[n]], sizeof without[n]);
    for (int j = 0; j < count; ++j)
        trial->port[HALF][ports[j]] = trial->port[WHOLE][ports[j]] = state->port[ports[j]];
    for (int iteration = 0; iteration < NEWTON_LIMIT; ++iteration) {
        for (int n = 0; n < 2; ++n) {
            memcpy(trial->x[AT[n]], without[n], sizeof without[n]);
            for (int j = 0; j < count; ++j) add_port(state, trial, AT[n], ports[j]);
        }
        for (int n = 0; n < 2; ++n)
            for (int j = 0; j < count; ++j) {
                const real guess = trial->port[AT[n]][ports[j]];
                evaluate_port(state, trial, AT[n], ports[j], 1);
                b[n * count + j] = trial->port[AT[n]][ports[j]] - guess;
                trial->port[AT[n]][ports[j]] = guess;
            }
        loop_matrix(trial, ports, count, a);
        eliminate(2 * count, a, b);
        real moved = REAL(0.0);
        for (int n = 0; n < 2; ++n)
            for (int j = 0; j < count; ++j) {
                trial->port[AT[n]][ports[j]] += choose(settled, REAL(0.0), b[n * count + j]);
                real response = REAL(0.0);
                for (int r = 0; r < EX_NEED; ++r) {
                    const int q = ex_need[r];
                    response = v_fmax(response, v_fabs(trial->level->whole.w[ports[j]][n + 1][q]) *
                                                    state->over_nominal[ex_linear[q]]);
                }
                moved = v_fmax(moved, v_fabs(b[n * count + j]) * response);
            }
        change = choose(settled, change, moved);
        settled |= MASK(change <= 1e-3 * state->tolerance);
        if (!any(~settled)) break;
    }
    set_error(trial, change * state->over_tolerance);
    for (int n = 0; n < 2; ++n) {
        memcpy(trial->x[AT[n]], without[n], sizeof without[n]);
        for (int j = 0; j < count; ++j) add_port(state, trial, AT[n], ports[j]);
    }
    for (int j = 0; j < count; ++j) add_port(state, trial, QUARTER, ports[j]);
    for (int j = 0; j < count; ++j) check_port(state, trial, ports[j], REAL(0.0), -1);
}
#endif

#endif
