/* Exact steps: the derivatives of an accepted step's own equations (exact.c), four columns at a time. */
#ifndef PSA_EXACT_COLUMNS_H
#define PSA_EXACT_COLUMNS_H

#include "exact_groups.h"
#include "exact_loops.h"
#include "exact_ports.h"

#if PSA_SENSITIVE
static const column NONE = {0.0};

/* One block of columns: at the start of the step (states, ports), at its half and its end */
typedef struct {
    const column *s, *sport, *unit;       /* [EX_NX], [EX_NPORT], [EX_NP]: of the parameters themselves */
    column x[2][EX_NX], port[2][EX_NPORT + 1];
} psa_columns;

/* What the matrices' own derivatives are multiplied with: L apart, here the input, the constant, the ports' values,
   and the chords' slopes times what they respond to */
static void tail_of(const psa_state *state, double *tail) {
    const psa_trial *const trial = &state->trial;
    double every[TAIL], *z = every;
    for (int q = 0; q < EX_NU; ++q) *z++ = trial->v0[q];
    for (int q = 0; q < EX_NU; ++q) *z++ = trial->dv[q];
    *z++ = 1.0;
    for (int j = 0; j < EX_NPORT; ++j) {
        *z++ = state->port[j];
        *z++ = trial->port[HALF][j];
        *z++ = trial->port[WHOLE][j];
    }
    for (int c = 0; c < EX_NCH; ++c) {
        const double sigma = trial->chord[c];
        *z++ = sigma;
        for (int k = 0; k < EX_NDRIVE; ++k) *z++ = sigma * trial->l[k];
        for (int q = 0; q < EX_NU; ++q) *z++ = sigma * trial->v0[q];
        for (int q = 0; q < EX_NU; ++q) *z++ = sigma * trial->dv[q];
        for (int k = 0; k < EX_NFEED; ++k) {
            const int j = ex_feed[c][k], no = j < 0;
            *z++ = no ? 0.0 : sigma * state->port[j];
            *z++ = no ? 0.0 : sigma * trial->port[HALF][j];
            *z++ = no ? 0.0 : sigma * trial->port[WHOLE][j];
        }
    }
    for (int k = 0; k < state->tails; ++k) tail[k] = every[state->tail[k]];
}

/* The same of a row of a level's matrices, of which one parameter's derivatives are given: of the whole step, of its
   half behind */
static void row_of_tail(const psa_level *d, int r, double *z) {
    const int i = r < NL ? r : ex_need[r - NL];
    const psa_row *const row = r < NL ? NULL : &d->inner[HALF - 1][r - NL];
    for (int q = 0; q < EX_NU; ++q) *z++ = row ? row->a1[q] : d->whole.a1[q][i];
    for (int q = 0; q < EX_NU; ++q) *z++ = row ? row->a2[q] : d->whole.a2[q][i];
    *z++ = row ? row->c : d->whole.c[i];
    for (int j = 0; j < EX_NPORT; ++j)
        for (int q = 0; q < 3; ++q) *z++ = row ? row->w[j][q] : d->whole.w[j][q][i];
    for (int c = 0; c < EX_NCH; ++c) {
        *z++ = row ? 0.0 : d->chord_c[c][i];
        for (int k = 0; k < EX_NDRIVE; ++k) *z++ = row ? 0.0 : d->chord_f[c][k][i];
        for (int q = 0; q < EX_NU; ++q) *z++ = row ? 0.0 : d->chord_a1[c][q][i];
        for (int q = 0; q < EX_NU; ++q) *z++ = row ? 0.0 : d->chord_a2[c][q][i];
        for (int k = 0; k < EX_NFEED; ++k)
            for (int q = 0; q < 3; ++q) *z++ = row ? 0.0 : d->chord_w[c][k][q][i];
    }
}

/* Write one parameter's derivatives of a level's matrices in the order of ex_own_columns */
APART static void pack_slopes(const psa_state *state, const psa_level *d, int m, column *out) {
    double every[NL + EX_NEED][TAIL];
    for (int r = 0; r < NL + EX_NEED; ++r) row_of_tail(d, r, every[r]);
    for (int first = 0; first < NL + EX_NEED; first += EX_CHUNK) {
        const int last = first + EX_CHUNK < NL + EX_NEED ? first + EX_CHUNK : NL + EX_NEED;
        for (int k = 0; k < state->tails; ++k)
            for (int r = first; r < last; ++r) ((double *)out++)[m] = every[r][state->tail[k]];
        for (int j = 0; j < NL; ++j)
            for (int r = first; r < last; ++r) {
                const int i = r < NL ? r : ex_need[r - NL];
                if (!ex_reach[i][j]) continue;
                ((double *)out++)[m] = r < NL ? d->whole.f[j][i] : d->inner[HALF - 1][r - NL].f[j];
            }
    }
}

/* Columns of L at the end and the half, without ports; `slopes` are the matrices' own, NULL where this block has
   none */
static void linear_columns(const psa_state *state, psa_columns *to, const column *slopes, const double *tail) {
    const psa_level *const level = state->trial.level;
    const real *half[SOME(EX_NEED)];
    column sum[NL + EX_NEED];
    for (int r = 0; r < EX_NEED; ++r) half[r] = level->inner[HALF - 1][r].f;
    ex_linear_columns(level->whole.f[0], half, to->s, sum);
    if (slopes) ex_own_columns(state->trial.l, tail, state->tails, slopes, sum);
    for (int i = 0; i < NL; ++i) to->x[WHOLE][ex_linear[i]] = sum[i];
    for (int r = 0; r < EX_NEED; ++r) to->x[HALF][ex_linear[ex_need[r]]] = sum[NL + r];
}

static void add_port_columns(const psa_state *state, psa_columns *to, int n, int j) {
    const psa_level *const level = state->trial.level;
    const column n0 = to->sport[j], n1 = to->port[HALF][j], n2 = to->port[WHOLE][j];
    if (n == WHOLE) {
        const real (*const w)[ROWS] = level->whole.w[j];
        for (int i = ex_port_reaches[j]; i < NL; ++i)
            to->x[n][ex_linear[i]] += w[0][i] * n0 + w[1][i] * n1 + w[2][i] * n2;
        return;
    }
    for (int r = 0; r < EX_NEED; ++r) {
        const real *const w = level->inner[n - 1][r].w[j];
        if (ex_need[r] >= ex_port_reaches[j])
            to->x[n][ex_linear[ex_need[r]]] += w[0] * n0 + w[1] * n1 + w[2] * n2;
    }
}

static void port_columns(const psa_state *state, psa_columns *to, int n, int j) {
    ex_port_chain(j, state->trial.slopes[n][j] + 1, to->x[n], NONE, to->unit, &to->port[n][j]);
}

static void do_port_columns(const psa_state *state, psa_columns *to, int j) {
    const psa_trial *const trial = &state->trial;
    const int c = ex_port_chord[j];
    port_columns(state, to, HALF, j);
    port_columns(state, to, WHOLE, j);
    add_port_columns(state, to, HALF, j);
    if (c >= 0 && trial->chord[c] != 0.0) {
        const int u = ex_linear[ex_chord_driver[c]];
        const psa_chord *const chord = trial->chords + c;
        const double sigma = trial->chord[c], weight = BENDS * BENDS;
        const column u0 = to->s[u], u1 = to->x[WHOLE][u], dway = u1 - u0;
        const column dbend = to->x[HALF][u] - 0.5 * (u0 + u1);
        const column n0 = to->sport[j], n1 = to->port[WHOLE][j], dchange = n1 - n0;
        const column dbent = to->port[HALF][j] - 0.5 * (n0 + n1);
        const column dsigma = (weight * (chord->way * dchange + chord->change * dway) + chord->bend * dbent +
                               chord->bent * dbend -
                               2.0 * sigma * (weight * chord->way * dway + chord->bend * dbend)) / chord->over;
        column moved[SOME(EX_NDRIVE)];
        for (int q = 0; q < ex_reads[ex_chord_driver[c]]; ++q) moved[q] = sigma * to->s[ex_linear[q]];
        add_port_columns(state, to, WHOLE, j);
        for (int i = 0; i < NL; ++i) {
            column sum = trial->beyond[c][i] * dsigma;
            for (int q = 0; q < ex_reads[ex_chord_driver[c]]; ++q) sum += trial->level->chord_f[c][q][i] * moved[q];
            for (int q = 0; q < EX_NFEED && ex_feed[c][q] >= 0; ++q) {
                const real(*const w)[ROWS] = trial->level->chord_w[c][q];
                const int f = ex_feed[c][q];
                sum += sigma * (w[0][i] * to->sport[f] + w[1][i] * to->port[HALF][f] + w[2][i] * to->port[WHOLE][f]);
            }
            to->x[WHOLE][ex_linear[i]] += sum;
        }
    } else add_port_columns(state, to, WHOLE, j);
}

/* Columns of the driver at its turn: at a zero of its rate, those at a fixed time */
static column turn_column(const psa_state *state, const psa_columns *to, int g) {
    static const int AT[3] = {NODES, HALF, WHOLE};
    const psa_trial *const trial = &state->trial;
    const psa_stages *const stages = trial->stages + g;
    const int u = ex_linear[ex_group_driver[g]];
    column sum = NONE, rate;
    for (int k = 0; k < 3; ++k) {
        const column *const x = AT[k] == NODES ? to->s : to->x[AT[k]];
        ex_rate_chain(g, stages->rate_slopes[AT[k]] + 1, x, NONE, to->unit, &rate);
        sum += stages->basis[2 * k] * x[u] + stages->basis[2 * k + 1] * trial->dt * rate;
    }
    return sum;
}

/* Columns of a group's states on one leg: at its begin and end, slopes at its begin and end, drift */
typedef struct {
    column begin[EX_NX], end[EX_NX], first[EX_NX], last[EX_NX], drift[EX_NX];
} psa_leg_columns;

/* Columns along one leg; `from` and `to` are those of the path variables. `leg->end` are those of the states at its
   start, which become those at its end. */
static void leg_columns(const psa_state *state, int g, const psa_leg *leg, const column *unit, const column *from,
                        const column *to, psa_leg_columns *own) {
    static const double SHARE[4] = {0.0, 0.5, 0.5, 1.0};
    const int u = ex_linear[ex_group_driver[g]];
    const int first = ex_group_first[g], size = ex_group_size[g];
    const double dt = leg->dt;
    column x[EX_NX], k[4][EX_NX], rate = NONE;
    if (dt > 0.0) rate = (to[u] - from[u]) * (1.0 / dt);
    memcpy(own->begin, own->end, sizeof(column) * (size_t)size);
    for (int stage = 0; stage < leg->stages; ++stage) {
        const double share = SHARE[stage];
        for (int r = 0; r < EX_NPATH; ++r) {
            const int q = ex_path[r];
            x[q] = from[q] + share * (to[q] - from[q]);
        }
        for (int i = 0; i < size; ++i) {
            const int q = ex_group_states[first + i];
            x[q] = own->begin[i];
            if (stage > 0) x[q] += share * dt * k[stage - 1][i];
        }
        ex_group_chain(g, leg->out[stage] + size, x, rate, unit, k[stage]);
        if (stage == 0 && state->trial.stages[g].drifts) {
            ex_group_chain(g, state->trial.stages[g].fast + size, x, FAST * rate, unit, own->drift);
            for (int i = 0; i < size; ++i) own->drift[i] = k[0][i] - own->drift[i] * (1.0 / FAST);
        }
    }
    for (int i = 0; i < size; ++i) {
        own->first[i] = k[0][i];
        if (leg->stages == 4) {
            own->end[i] += dt / 6.0 * (k[0][i] + 2.0 * (k[1][i] + k[2][i]) + k[3][i]);
            own->last[i] = k[3][i];
        } else {
            own->end[i] += dt * k[1][i];
            own->last[i] = 2.0 * k[1][i] - k[0][i];
        }
    }
}

/* Columns of a group's states at the half of the step, if that lies on this leg */
static void half_columns(const psa_state *state, psa_columns *at, int g, const psa_leg *leg, const column *from,
                         const column *to, const psa_leg_columns *own) {
    const psa_trial *const trial = &state->trial;
    const int u = ex_linear[ex_group_driver[g]];
    const int first = ex_group_first[g], size = ex_group_size[g];
    const double s = trial->stages[g].share[HALF], dt = leg->dt;
    const int inside = s > 0.0 && s < 1.0 && fabs(leg->way) > STILL * state->nominal[u];
    const int drifts = trial->stages[g].drifts;
    const column moved = at->x[HALF][u] - from[u] - s * (to[u] - from[u]);
    real basis[4];
    hermite(s, basis);
    for (int i = 0; i < size; ++i) {
        const int q = ex_group_states[first + i];
        const double change = leg->to[q] - leg->from[q], a = dt * leg->out[0][i], e = dt * leg->last[i];
        const double by_share = 6.0 * s * (1.0 - s) * change + (1.0 - s) * (1.0 - 3.0 * s) * a + s * (3.0 * s - 2.0) * e;
        const double slope = by_share - (drifts ? trial->dt * trial->stages[g].drift[i] : 0.0);
        column sum = basis[0] * own->begin[i] + basis[1] * dt * own->first[i] + basis[2] * own->end[i] +
                     basis[3] * dt * own->last[i];
        if (inside) sum += slope / leg->way * moved;
        if (drifts) sum += (0.5 - s) * trial->dt * own->drift[i];
        at->x[HALF][q] = sum;
    }
}

static void do_group_columns(const psa_state *state, psa_columns *to, int g) {
    const psa_trial *const trial = &state->trial;
    const psa_stages *const stages = trial->stages + g;
    const int u = ex_linear[ex_group_driver[g]], first = ex_group_first[g], size = ex_group_size[g];
    column turn[EX_NX];
    psa_leg_columns own;
    for (int i = 0; i < size; ++i) own.end[i] = to->s[ex_group_states[first + i]];
    if (stages->legs > 1) {
        for (int r = 0; r < EX_NPATH; ++r) {
            const int q = ex_path[r];
            turn[q] = to->s[q] + stages->turn * (to->x[WHOLE][q] - to->s[q]);
        }
        turn[u] = turn_column(state, to, g);
    }
    for (int n = 0; n < stages->legs; ++n) {
        const column *const a = n == 0 ? to->s : turn, *const b = n + 1 == stages->legs ? to->x[WHOLE] : turn;
        leg_columns(state, g, stages->leg + n, to->unit, a, b, &own);
        if (stages->on[HALF] == n) half_columns(state, to, g, stages->leg + n, a, b, &own);
    }
    for (int i = 0; i < size; ++i) to->x[WHOLE][ex_group_states[first + i]] = own.end[i];
}

/* Columns of a group that feels none of a block's unknowns */
static void rest_columns(psa_columns *to, int g) {
    for (int i = 0; i < ex_group_size[g]; ++i) {
        const int q = ex_group_states[ex_group_first[g] + i];
        to->x[HALF][q] = to->x[WHOLE][q] = NONE;
    }
}

#if EX_NLOOP > 0
static void do_loop_columns(const psa_state *state, psa_columns *to, const int *ports, int count) {
    static const int AT[2] = {HALF, WHOLE};
    const psa_trial *const trial = &state->trial;
    const int size = 2 * count;
    real a[4 * EX_NPORT * EX_NPORT];
    column b[2 * EX_NPORT];
    /* first with the ports' values held at half and end, then what they change by */
    for (int n = 0; n < 2; ++n)
        for (int j = 0; j < count; ++j) to->port[AT[n]][ports[j]] = NONE;
    for (int n = 0; n < 2; ++n)
        for (int j = 0; j < count; ++j) add_port_columns(state, to, AT[n], ports[j]);
    for (int n = 0; n < 2; ++n)
        for (int j = 0; j < count; ++j) port_columns(state, to, AT[n], ports[j]);
    loop_matrix(trial, ports, count, a);
    for (int k = 0; k < size; ++k) b[k] = to->port[AT[k / count]][ports[k % count]];
    for (int k = 0; k < size; ++k)
        for (int i = k + 1; i < size; ++i) {
            const double factor = a[i * size + k] / a[k * size + k];
            for (int j = k; j < size; ++j) a[i * size + j] -= factor * a[k * size + j];
            b[i] -= factor * b[k];
        }
    for (int k = size - 1; k >= 0; --k) {
        for (int j = k + 1; j < size; ++j) b[k] -= a[k * size + j] * b[j];
        b[k] *= 1.0 / a[k * size + k];
    }
    for (int k = 0; k < size; ++k) to->port[AT[k / count]][ports[k % count]] = b[k];
    for (int n = 0; n < 2; ++n)
        for (int r = 0; r < (AT[n] == WHOLE ? NL : EX_NEED); ++r) {
            const int i = AT[n] == WHOLE ? r : ex_need[r];
            for (int j = 0; j < count; ++j)
                for (int m = 0; m < 2; ++m) {
                    const real weight = AT[n] == WHOLE ? trial->level->whole.w[ports[j]][m + 1][i]
                                                       : trial->level->inner[AT[n] - 1][r].w[ports[j]][m + 1];
                    to->x[AT[n]][ex_linear[i]] += weight * to->port[AT[m]][ports[j]];
                }
        }
}
#endif

/* Take all columns over the step that was accepted */
static void step_columns(psa_state *state, const column *slopes) {
    double tail[TAIL];
    if (state->thetas > 0) tail_of(state, tail);
    for (int b = 0; b < state->blocks; ++b) {
        column *const s = state->s + b * EX_NX, *const sport = state->sport + b * (EX_NPORT + 1);
        psa_columns to; /* what it is not given here it is by the items, in their order */
        to.s = s;
        to.sport = sport;
        to.unit = state->unit + b * EX_NP;
        const int own = 4 * b < state->thetas;
        linear_columns(state, &to, own ? slopes + (size_t)b * state->slopes_size : NULL, tail);
        for (int k = 0; k < EX_NITEMS; ++k) {
            const psa_item *const item = ex_items + k;
            if (item->kind == EX_GROUP && state->apart[item->members[0]][b]) rest_columns(&to, item->members[0]);
            else if (item->kind == EX_GROUP) do_group_columns(state, &to, item->members[0]);
            else if (item->kind == EX_PORT) do_port_columns(state, &to, item->members[0]);
#if EX_NLOOP > 0
            else do_loop_columns(state, &to, item->members, item->count);
#endif
        }
        memcpy(s, to.x[WHOLE], sizeof to.x[WHOLE]);
        memcpy(sport, to.port[WHOLE], sizeof(column) * EX_NPORT);
    }
}
#endif

#endif
