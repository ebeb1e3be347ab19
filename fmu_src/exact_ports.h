/* Exact steps: the linear part at the nodes of a step, and what the ports add to it (exact.c). */
#ifndef PSA_EXACT_PORTS_H
#define PSA_EXACT_PORTS_H

#include "exact_state.h"

/* sum = L at the end from its start, the input and a constant, all of its rows. A block of rows at a time: its
   sum stays in a register. */
static inline void respond(const psa_whole *whole, const real *l, const real *v0, const real *dv, real *sum) {
    for (int b = 0; b < BLOCKS; ++b) {
        column s = ROWS_OF(l, b) + ROWS_OF(whole->c, b);
        for (int j = 0; j < NL; ++j) s += ROWS_OF(whole->f[j], b) * l[j];
        for (int j = 0; j < EX_NU; ++j) s += ROWS_OF(whole->a1[j], b) * v0[j] + ROWS_OF(whole->a2[j], b) * dv[j];
        ROWS_OF(sum, b) = s;
    }
}

/* sum += what a port's values at the start, the half and the end add to it */
static inline void respond_to_port(const real (*w)[ROWS], real n0, real n1, real n2, real *sum) {
    for (int b = 0; b < BLOCKS; ++b)
        ROWS_OF(sum, b) += ROWS_OF(w[0], b) * n0 + ROWS_OF(w[1], b) * n1 + ROWS_OF(w[2], b) * n2;
}

/* The same of one row inside the step */
static inline real respond_inside(const psa_row *row, int reads, const real *l, const real *v0, const real *dv) {
    real sum = row->c;
    for (int j = 0; j < reads; ++j) sum += row->f[j] * l[j];
    for (int j = 0; j < EX_NU; ++j) sum += row->a1[j] * v0[j] + row->a2[j] * dv[j];
    return sum;
}

/* L at a node without ports, from the start of the step */
static inline void linear_node(psa_trial *trial, int n) {
    if (n == WHOLE) {
        real sum[ROWS];
        respond(&trial->level->whole, trial->l, trial->v0, trial->dv, sum);
        for (int i = 0; i < NL; ++i) trial->x[n][ex_linear[i]] = sum[i];
        return;
    }
    for (int r = 0; r < EX_NEED; ++r) {
        const int i = ex_need[r];
        const psa_row *const row = &trial->level->inner[n - 1][r];
        trial->x[n][ex_linear[i]] = trial->l[i] + respond_inside(row, ex_reads[i], trial->l, trial->v0, trial->dv);
    }
}

/* Add a port's response to L at a node */
static inline void add_port(const psa_state *state, psa_trial *trial, int n, int j) {
    const real n0 = state->port[j], n1 = trial->port[HALF][j], n2 = trial->port[WHOLE][j];
    const psa_whole *const whole = &trial->level->whole;
    if (n == WHOLE)
        for (int i = ex_port_reaches[j]; i < NL; ++i)
            trial->x[n][ex_linear[i]] += whole->w[j][0][i] * n0 + whole->w[j][1][i] * n1 + whole->w[j][2][i] * n2;
    else
        for (int r = 0; r < EX_NEED; ++r) {
            const int i = ex_need[r];
            const real *const w = trial->level->inner[n - 1][r].w[j];
            if (i >= ex_port_reaches[j]) trial->x[n][ex_linear[i]] += w[0] * n0 + w[1] * n1 + w[2] * n2;
        }
}

#if EX_NLOOP > 0
/* Weight of a port's value at the half (1) or the end (2) in a row of L that is wanted inside a step */
static inline real weight_of(const psa_level *level, int n, int j, int value, int r) {
    return n == WHOLE ? level->whole.w[j][value][ex_need[r]] : level->inner[n - 1][r].w[j][value];
}
#endif

static void evaluate_port(psa_state *state, psa_trial *trial, int n, int j, int slopes) {
    if (slopes)
        ex_port_slopes(j, trial->t[n], trial->x[n], trial->v[n], REAL(0.0), state->k,
                       trial->slopes[n][j]);
    else ex_port(j, trial->t[n], trial->x[n], trial->v[n], REAL(0.0), state->k, trial->slopes[n][j]);
    trial->port[n][j] = trial->slopes[n][j][0];
}

/* How much a port that is off its parabola by so much counts: as a bump of that size about the middle */
static void set_bump(psa_state *state, psa_trial *trial, int j, real off) {
    real response = REAL(0.0);
    for (int i = ex_port_reaches[j]; i < NL; ++i)
        response = v_fmax(response, v_fabs(trial->level->whole.w[j][1][i]) * state->over_nominal[ex_linear[i]]);
    set_error(trial, v_fabs(off) * response * state->over_tolerance);
}

/* The parabola through the values a, b and c at 0, 1/2 and 1 */
static inline real parabola(real s, real a, real b, real c) {
    return a + s * (4.0 * b - 3.0 * a - c + 2.0 * s * (a - 2.0 * b + c));
}

/* A port that reads the time may repeat itself at the nodes: it is asked at an odd share too. One whose driver
   turns is asked at the turn, where what depends on the rate has a notch. */
static void check_elsewhere(psa_state *state, psa_trial *trial, int j, int g) {
    const psa_stages *const turned = g < 0 ? NULL : trial->stages + g;
    real x[EX_NX], v[EX_NU + 1], out[EX_PORT_OUT] = {REAL(0.0)};
    const real s = turned ? turned->turn : REAL(0.6180339887498949);
    for (int i = 0; i < EX_NX; ++i) x[i] = parabola(s, state->x[i], trial->x[HALF][i], trial->x[WHOLE][i]);
    for (int i = 0; i < EX_NU; ++i) v[i] = trial->v0[i] + s * trial->dv[i];
    if (turned) {
        const int u = ex_linear[ex_group_driver[g]];
        x[u] = turned->leg[0].to[u];
        for (int i = 0; i < ex_group_size[g]; ++i) {
            const int q = ex_group_states[ex_group_first[g] + i];
            x[q] = turned->leg[0].to[q];
        }
    }
    ex_port(j, state->t + s * trial->dt, x, v, REAL(0.0), state->k, out);
    const real off = out[0] - parabola(s, state->port[j], trial->port[HALF][j], trial->port[WHOLE][j]);
    set_bump(state, trial, j, turned ? choose(MASK(s < 1.0), off, REAL(0.0)) : off);
}

/* How far a port at the quarter is off the parabola through its values, without what the chord takes */
static void check_port(psa_state *state, psa_trial *trial, int j, real sigma, int driver) {
    evaluate_port(state, trial, QUARTER, j, 0);
    const real s = REAL(0.25);
    real off = trial->port[QUARTER][j] - parabola(s, state->port[j], trial->port[HALF][j], trial->port[WHOLE][j]);
    if (driver >= 0) {
        const int u = ex_linear[driver];
        off -= sigma * (trial->x[QUARTER][u] - parabola(s, state->x[u], trial->x[HALF][u], trial->x[WHOLE][u]));
    }
    set_bump(state, trial, j, off);
    if (ex_port_timed[j]) check_elsewhere(state, trial, j, -1);
    for (int g = 0; g < EX_NG; ++g)
        if (ex_port_along[j][g] && trial->stages[g].legs > 1) check_elsewhere(state, trial, j, g);
}

/* The response to a chord's driver beyond the parabola */
static inline void respond_beyond(const psa_state *state, const psa_trial *trial, const psa_level *level, int c,
                                  real *sum) {
    for (int b = 0; b < BLOCKS; ++b) {
        column s = ROWS_OF(level->chord_c[c], b);
        for (int k = 0; k < ex_reads[ex_chord_driver[c]]; ++k) s += ROWS_OF(level->chord_f[c][k], b) * trial->l[k];
        for (int q = 0; q < EX_NU; ++q)
            s += ROWS_OF(level->chord_a1[c][q], b) * trial->v0[q] + ROWS_OF(level->chord_a2[c][q], b) * trial->dv[q];
        ROWS_OF(sum, b) = s;
    }
    for (int k = 0; k < EX_NFEED && ex_feed[c][k] >= 0; ++k) {
        const int j = ex_feed[c][k];
        respond_to_port(level->chord_w[c][k], state->port[j], trial->port[HALF][j], trial->port[WHOLE][j], sum);
    }
}

/* How a port goes with its driver: the slope sigma that meets best how both change over the step and how both
   bend inside it. What bends is the driver that dies away, while the port may go on in time. The changes count
   with the weight at which a bend of BENDS of the way counts as much. 0 where the driver turns. */
static real chord_slope(psa_state *state, psa_trial *trial, int j, int c, int u) {
    psa_chord *const chord = trial->chords + c;
    chord->way = trial->x[WHOLE][u] - state->x[u];
    chord->bend = trial->x[HALF][u] - 0.5 * (trial->x[WHOLE][u] + state->x[u]);
    chord->change = trial->port[WHOLE][j] - state->port[j];
    chord->bent = trial->port[HALF][j] - 0.5 * (trial->port[WHOLE][j] + state->port[j]);
    chord->over = BENDS * BENDS * chord->way * chord->way + chord->bend * chord->bend;
    const real least = STILL * BENDS * state->nominal[u];
    bits moves = MASK(chord->over > least * least);
    for (int g = 0; g < EX_NG; ++g)
        if (ex_linear[ex_group_driver[g]] == u) moves &= MASK(trial->stages[g].turn >= 1.0);
    const real both = BENDS * BENDS * chord->way * chord->change + chord->bend * chord->bent;
    return choose(moves, both / choose(moves, chord->over, REAL(1.0)), REAL(0.0));
}

static void do_port(psa_state *state, psa_trial *trial, int j, int slopes) {
    const int c = ex_port_chord[j], driver = c >= 0 ? ex_chord_driver[c] : -1;
    real sigma = REAL(0.0);
    evaluate_port(state, trial, HALF, j, slopes);
    evaluate_port(state, trial, WHOLE, j, slopes);
    if (c >= 0) sigma = chord_slope(state, trial, j, c, ex_linear[driver]);
    check_port(state, trial, j, sigma, driver);
    for (int n = 0; n < NODES; ++n) add_port(state, trial, n, j);
    if (c < 0) return;
    trial->chord[c] = sigma;
    const psa_level *const level = trial->level;
    real sum[ROWS];
    respond_beyond(state, trial, level, c, sum);
    for (int i = 0; i < NL; ++i) {
        trial->beyond[c][i] = sum[i];
        trial->x[WHOLE][ex_linear[i]] += sigma * sum[i];
    }
}

#endif
