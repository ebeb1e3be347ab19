/* Exact steps: the derivatives of an accepted step's own equations (exact.c). */
#ifndef PSA_EXACT_COLUMNS_H
#define PSA_EXACT_COLUMNS_H

#include "exact_groups.h"
#include "exact_loops.h"
#include "exact_ports.h"

#if PSA_LANES == 1
#define ROW(array, i) ((array) + (size_t)(i) * (size_t)nb)

static void fill(column *x, int nb) { memset(x, 0, sizeof(column) * (size_t)nb); }
static void copy(const column *from, column *to, int nb) { memcpy(to, from, sizeof(column) * (size_t)nb); }
static inline void axpy(double a, const column *x, column *y, int nb) {
    for (int b = 0; b < nb; ++b) y[b] += a * x[b];
}
static inline void add_to(column *x, int at, double value) { ((double *)x)[at] += value; }

/* The derivative of a value whose partial derivatives stand in `partial`; `x` are the states' columns, `rate`
   those of the driver's rate */
static inline void chain(const psa_state *state, const psa_active *list, const real *partial, const column *x,
                         const column *rate, column *out) {
    const int nb = state->blocks;
    fill(out, nb);
    for (; list->kind >= 0; ++list) {
        const double a = partial[list->entry];
        if (list->kind == 2) add_to(out, list->index, a);
        else axpy(a, list->kind == 0 ? ROW(x, list->index) : rate, out, nb);
    }
}

/* What the matrices' own derivatives add to the columns of L at the nodes: F's, the input's, the ports' weights'
   and the chords', each in the column of its parameter */
static void matrix_columns(psa_state *state) {
    const psa_trial *const trial = &state->trial;
    const int nb = state->blocks;
    for (int m = 0; m < state->thetas; ++m) {
        const psa_level *const d = trial->level + m + 1;
        double sum[ROWS] = {0.0};
        respond(&d->whole, trial->l, trial->v0, trial->dv, sum);
        for (int j = 0; j < EX_NPORT; ++j) {
            const double n0 = state->port[j], n1 = trial->port[HALF][j], n2 = trial->port[WHOLE][j];
            for (int i = 0; i < ROWS; ++i)
                sum[i] += d->whole.w[j][0][i] * n0 + d->whole.w[j][1][i] * n1 + d->whole.w[j][2][i] * n2;
        }
        for (int c = 0; c < EX_NCH; ++c) {
            double beyond[ROWS];
            if (trial->chord[c] == 0.0) continue;
            respond_beyond(state, trial, d, c, beyond);
            for (int i = 0; i < ROWS; ++i) sum[i] += trial->chord[c] * beyond[i];
        }
        for (int i = 0; i < NL; ++i) ((double *)ROW(state->direct, i))[state->theta_column[m]] = sum[i];
        for (int r = 0; r < EX_NEED; ++r) {
            const psa_row *const row = &d->inner[HALF - 1][r];
            double inside = respond_inside(row, NL, trial->l, trial->v0, trial->dv);
            for (int j = 0; j < EX_NPORT; ++j)
                inside += row->w[j][0] * state->port[j] + row->w[j][1] * trial->port[HALF][j] +
                          row->w[j][2] * trial->port[WHOLE][j];
            ((double *)ROW(state->direct, NL + r))[state->theta_column[m]] = inside;
        }
    }
}

/* Columns of L at a node without ports */
static void linear_columns(psa_state *state, int n) {
    const psa_level *const level = state->trial.level;
    const int nb = state->blocks, rows = n == WHOLE ? NL : EX_NEED;
    column *const x = ROW(state->node, n * EX_NX);
    for (int r = 0; r < rows; ++r) {
        const int i = n == WHOLE ? r : ex_need[r];
        column *const out = ROW(x, ex_linear[i]);
        const column *const own = ROW(state->s, ex_linear[i]);
        const column *const direct = ROW(state->direct, n == WHOLE ? i : NL + r);
        for (int b = 0; b < nb; ++b) {
            column sum = own[b] + direct[b];
            for (int j = 0; j < ex_reads[i]; ++j)
                sum += (n == WHOLE ? level->whole.f[j][i] : level->inner[n - 1][r].f[j]) *
                       ROW(state->s, ex_linear[j])[b];
            out[b] = sum;
        }
    }
}

static void add_port_columns(psa_state *state, int n, int j) {
    const psa_level *const level = state->trial.level;
    const int nb = state->blocks, rows = n == WHOLE ? NL : EX_NEED;
    const column *const n0 = ROW(state->sport, j), *const n1 = ROW(state->snode_port, HALF * (EX_NPORT + 1) + j);
    const column *const n2 = ROW(state->snode_port, WHOLE * (EX_NPORT + 1) + j);
    for (int r = 0; r < rows; ++r) {
        const int i = n == WHOLE ? r : ex_need[r];
        if (i < ex_port_reaches[j]) continue;
        column *const out = ROW(ROW(state->node, n * EX_NX), ex_linear[i]);
        double w[3];
        for (int q = 0; q < 3; ++q) w[q] = n == WHOLE ? level->whole.w[j][q][i] : level->inner[n - 1][r].w[j][q];
        for (int b = 0; b < nb; ++b) out[b] += w[0] * n0[b] + w[1] * n1[b] + w[2] * n2[b];
    }
}

static void port_columns(psa_state *state, int n, int j) {
    const int nb = state->blocks;
    column *const out = ROW(state->snode_port, n * (EX_NPORT + 1) + j);
    chain(state, state->port_list[j], state->trial.slopes[n][j] + 1, ROW(state->node, n * EX_NX), NULL, out);
}

static void do_port_columns(psa_state *state, int j) {
    const psa_trial *const trial = &state->trial;
    const int nb = state->blocks, c = ex_port_chord[j];
    port_columns(state, HALF, j);
    port_columns(state, WHOLE, j);
    add_port_columns(state, HALF, j);
    if (c >= 0 && trial->chord[c] != 0.0) {
        const int u = ex_linear[ex_chord_driver[c]];
        const psa_chord *const chord = trial->chords + c;
        const double sigma = trial->chord[c], weight = BENDS * BENDS;
        const column *const half = ROW(state->node, HALF * EX_NX + u);
        const column *const nh = ROW(state->snode_port, HALF * (EX_NPORT + 1) + j);
        column *const x = ROW(state->node, WHOLE * EX_NX), *const dsigma = state->scratch;
        const column *const n0 = ROW(state->sport, j);
        const column *const n1 = ROW(state->snode_port, WHOLE * (EX_NPORT + 1) + j);
        for (int b = 0; b < nb; ++b) {
            const column u0 = ROW(state->s, u)[b], u1 = ROW(x, u)[b];
            const column dway = u1 - u0, dbend = half[b] - 0.5 * (u0 + u1);
            const column dchange = n1[b] - n0[b], dbent = nh[b] - 0.5 * (n0[b] + n1[b]);
            dsigma[b] = (weight * (chord->way * dchange + chord->change * dway) + chord->bend * dbent +
                         chord->bent * dbend -
                         2.0 * sigma * (weight * chord->way * dway + chord->bend * dbend)) / chord->over;
        }
        add_port_columns(state, WHOLE, j);
        for (int i = 0; i < NL; ++i) {
            column *const out = ROW(x, ex_linear[i]);
            const double beyond = trial->beyond[c][i];
            for (int b = 0; b < nb; ++b) {
                column sum = beyond * dsigma[b];
                for (int q = 0; q < ex_reads[ex_chord_driver[c]]; ++q)
                    sum += sigma * trial->level->chord_f[c][q][i] * ROW(state->s, ex_linear[q])[b];
                for (int q = 0; q < EX_NFEED && ex_feed[c][q] >= 0; ++q) {
                    const real(*const w)[ROWS] = trial->level->chord_w[c][q];
                    const int f = ex_feed[c][q];
                    sum += sigma * (w[0][i] * ROW(state->sport, f)[b] +
                                    w[1][i] * ROW(state->snode_port, HALF * (EX_NPORT + 1) + f)[b] +
                                    w[2][i] * ROW(state->snode_port, WHOLE * (EX_NPORT + 1) + f)[b]);
                }
                out[b] += sum;
            }
        }
    } else add_port_columns(state, WHOLE, j);
}

/* Columns of the driver at its turn: at a zero of its rate, those at a fixed time */
static void turn_columns(psa_state *state, int g, column *out, column *rate) {
    static const int AT[3] = {NODES, HALF, WHOLE};
    const psa_trial *const trial = &state->trial;
    const psa_stages *const stages = trial->stages + g;
    const int nb = state->blocks, u = ex_linear[ex_group_driver[g]];
    fill(out, nb);
    for (int k = 0; k < 3; ++k) {
        const column *const x = AT[k] == NODES ? state->s : ROW(state->node, AT[k] * EX_NX);
        chain(state, state->rate_list[g], stages->rate_slopes[AT[k]] + 1, x, NULL, rate);
        axpy(stages->basis[2 * k], ROW(x, u), out, nb);
        axpy(stages->basis[2 * k + 1] * trial->dt, rate, out, nb);
    }
}

/* Columns along one leg: `from` and `to` are those of the path variables, `x` those of the states at its
   start, which become those at its end; `k` holds the four slopes' */
static void leg_columns(psa_state *state, int g, const psa_leg *leg, const column *from, const column *to,
                        column *start, column *x, column *k, column *drift) {
    static const double SHARE[4] = {0.0, 0.5, 0.5, 1.0};
    const int nb = state->blocks, u = ex_linear[ex_group_driver[g]];
    const int first = ex_group_first[g], size = ex_group_size[g];
    const double dt = leg->dt;
    column *const rate = ROW(k, 4 * size);
    if (dt > 0.0)
        for (int b = 0; b < nb; ++b) rate[b] = (ROW(to, u)[b] - ROW(from, u)[b]) / dt;
    else fill(rate, nb);
    for (int stage = 0; stage < leg->stages; ++stage) {
        const double share = SHARE[stage];
        for (int r = 0; r < EX_NPATH; ++r) {
            const int q = ex_path[r];
            for (int b = 0; b < nb; ++b)
                ROW(x, q)[b] = ROW(from, q)[b] + share * (ROW(to, q)[b] - ROW(from, q)[b]);
        }
        for (int i = 0; i < size; ++i) {
            const int q = ex_group_states[first + i];
            copy(ROW(start, i), ROW(x, q), nb);
            if (stage > 0) axpy(share * dt, ROW(k, (stage - 1) * size + i), ROW(x, q), nb);
        }
        for (int i = 0; i < size; ++i) {
            column *const out = ROW(k, stage * size + i);
            chain(state, state->group_list[first + i], leg->out[stage] + size, x, rate, out);
        }
        if (stage == 0 && state->trial.stages[g].drifts) {
            column *const great = ROW(drift, size);
            for (int b = 0; b < nb; ++b) great[b] = FAST * rate[b];
            for (int i = 0; i < size; ++i) {
                column *const out = ROW(drift, i);
                chain(state, state->group_list[first + i], state->trial.stages[g].fast + size, x, great, out);
                for (int b = 0; b < nb; ++b) out[b] = ROW(k, i)[b] - out[b] / FAST;
            }
        }
    }
    for (int i = 0; i < size; ++i) {
        const column *const k1 = ROW(k, i), *const k2 = ROW(k, size + i), *const k3 = ROW(k, 2 * size + i);
        column *const k4 = ROW(k, 3 * size + i), *const x1 = ROW(start, i);
        if (leg->stages == 4)
            for (int b = 0; b < nb; ++b) x1[b] += dt / 6.0 * (k1[b] + 2.0 * (k2[b] + k3[b]) + k4[b]);
        else
            for (int b = 0; b < nb; ++b) {
                x1[b] += dt * k2[b];
                k4[b] = 2.0 * k2[b] - k1[b]; /* the slope at the end */
            }
    }
}

/* Columns of a group's states at the half of the step, if that lies on this leg */
static void half_columns(psa_state *state, int g, const psa_leg *leg, const column *from, const column *to,
                         const column *begin, const column *end, const column *k, const column *drift) {
    const psa_trial *const trial = &state->trial;
    const int nb = state->blocks, u = ex_linear[ex_group_driver[g]];
    const int first = ex_group_first[g], size = ex_group_size[g];
    const double s = trial->stages[g].share[HALF], dt = leg->dt;
    const int inside = s > 0.0 && s < 1.0 && fabs(leg->way) > STILL * state->nominal[u];
    const int drifts = trial->stages[g].drifts;
    column *const half = ROW(state->node, HALF * EX_NX);
    real basis[4];
    hermite(s, basis);
    for (int i = 0; i < size; ++i) {
        const int q = ex_group_states[first + i];
        const double change = leg->to[q] - leg->from[q], a = dt * leg->out[0][i], e = dt * leg->last[i];
        const double by_share = 6.0 * s * (1.0 - s) * change + (1.0 - s) * (1.0 - 3.0 * s) * a + s * (3.0 * s - 2.0) * e;
        const column *const k1 = ROW(k, i), *const k4 = ROW(k, 3 * size + i);
        for (int b = 0; b < nb; ++b) {
            column sum = basis[0] * ROW(begin, i)[b] + basis[1] * dt * k1[b] + basis[2] * ROW(end, i)[b] +
                         basis[3] * dt * k4[b];
            const double slope = by_share - (drifts ? trial->dt * trial->stages[g].drift[i] : 0.0);
            if (inside)
                sum += slope / leg->way *
                       (ROW(half, u)[b] - ROW(from, u)[b] - s * (ROW(to, u)[b] - ROW(from, u)[b]));
            if (drifts) sum += (0.5 - s) * trial->dt * ROW(drift, i)[b];
            ROW(half, q)[b] = sum;
        }
    }
}

static void do_group_columns(psa_state *state, int g) {
    const psa_trial *const trial = &state->trial;
    const psa_stages *const stages = trial->stages + g;
    const int nb = state->blocks, u = ex_linear[ex_group_driver[g]];
    const int first = ex_group_first[g], size = ex_group_size[g];
    column *const x = state->scratch, *const k = ROW(x, EX_NX), *const turn = ROW(k, 4 * size + 1);
    column *const begin = ROW(turn, EX_NX), *const end = ROW(begin, size), *const drift = ROW(end, size);
    const column *from = state->s, *to = ROW(state->node, WHOLE * EX_NX);
    for (int i = 0; i < size; ++i) copy(ROW(state->s, ex_group_states[first + i]), ROW(end, i), nb);
    if (stages->legs > 1) {
        const double s = stages->turn;
        for (int r = 0; r < EX_NPATH; ++r) {
            const int q = ex_path[r];
            for (int b = 0; b < nb; ++b)
                ROW(turn, q)[b] = ROW(from, q)[b] + s * (ROW(to, q)[b] - ROW(from, q)[b]);
        }
        turn_columns(state, g, ROW(turn, u), k);
    }
    for (int n = 0; n < stages->legs; ++n) {
        const column *const a = n == 0 ? from : turn, *const b = n + 1 == stages->legs ? to : turn;
        memcpy(begin, end, sizeof(column) * (size_t)(size * nb));
        leg_columns(state, g, stages->leg + n, a, b, end, x, k, drift);
        if (stages->on[HALF] == n) half_columns(state, g, stages->leg + n, a, b, begin, end, k, drift);
    }
    for (int i = 0; i < size; ++i)
        copy(ROW(end, i), ROW(state->node, WHOLE * EX_NX + ex_group_states[first + i]), nb);
}

#if EX_NLOOP > 0
static void do_loop_columns(psa_state *state, const int *ports, int count) {
    static const int AT[2] = {HALF, WHOLE};
    const psa_trial *const trial = &state->trial;
    const int nb = state->blocks, size = 2 * count;
    real a[4 * EX_NPORT * EX_NPORT];
    /* first with the ports' values held at half and end, then what they change by */
    for (int n = 0; n < 2; ++n)
        for (int j = 0; j < count; ++j) fill(ROW(state->snode_port, AT[n] * (EX_NPORT + 1) + ports[j]), nb);
    for (int n = 0; n < 2; ++n)
        for (int j = 0; j < count; ++j) add_port_columns(state, AT[n], ports[j]);
    for (int n = 0; n < 2; ++n)
        for (int j = 0; j < count; ++j) port_columns(state, AT[n], ports[j]);
    loop_matrix(trial, ports, count, a);
    for (int k = 0; k < size; ++k)
        for (int i = k + 1; i < size; ++i) {
            const double factor = a[i * size + k] / a[k * size + k];
            for (int j = k; j < size; ++j) a[i * size + j] -= factor * a[k * size + j];
            axpy(-factor, ROW(state->snode_port, AT[k / count] * (EX_NPORT + 1) + ports[k % count]),
                 ROW(state->snode_port, AT[i / count] * (EX_NPORT + 1) + ports[i % count]), nb);
        }
    for (int k = size - 1; k >= 0; --k) {
        column *const b = ROW(state->snode_port, AT[k / count] * (EX_NPORT + 1) + ports[k % count]);
        for (int j = k + 1; j < size; ++j)
            axpy(-a[k * size + j], ROW(state->snode_port, AT[j / count] * (EX_NPORT + 1) + ports[j % count]), b,
                 nb);
        for (int q = 0; q < nb; ++q) b[q] /= a[k * size + k];
    }
    for (int n = 0; n < 2; ++n)
        for (int r = 0; r < (AT[n] == WHOLE ? NL : EX_NEED); ++r) {
            const int i = AT[n] == WHOLE ? r : ex_need[r];
            column *const out = ROW(ROW(state->node, AT[n] * EX_NX), ex_linear[i]);
            for (int j = 0; j < count; ++j)
                for (int m = 0; m < 2; ++m)
                    axpy(AT[n] == WHOLE ? trial->level->whole.w[ports[j]][m + 1][i]
                                        : trial->level->inner[AT[n] - 1][r].w[ports[j]][m + 1],
                         ROW(state->snode_port, AT[m] * (EX_NPORT + 1) + ports[j]), out, nb);
        }
}
#endif

static void step_columns(psa_state *state) {
    matrix_columns(state);
    linear_columns(state, HALF);
    linear_columns(state, WHOLE);
    for (int k = 0; k < EX_NITEMS; ++k) {
        const psa_item *const item = ex_items + k;
        if (item->kind == EX_GROUP) do_group_columns(state, item->members[0]);
        else if (item->kind == EX_PORT) do_port_columns(state, item->members[0]);
#if EX_NLOOP > 0
        else do_loop_columns(state, item->members, item->count);
#endif
    }
    const int nb = state->blocks;
    memcpy(state->s, ROW(state->node, WHOLE * EX_NX), sizeof(column) * (size_t)(EX_NX * nb));
    for (int j = 0; j < EX_NPORT; ++j)
        copy(ROW(state->snode_port, WHOLE * (EX_NPORT + 1) + j), ROW(state->sport, j), nb);
}
#endif

#endif
