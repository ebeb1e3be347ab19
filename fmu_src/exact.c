/* Exact steps of a linear part with what is nonlinear beside it, and their exact derivatives.

   Between two samples the input is linear in time. A step of h / 2^level takes the linear part exactly
   (exact_levels.h). States along a path (hysteresis) take one Runge-Kutta step of fourth order over their
   driver's way, whatever its course in time; between the ends they follow Hermite's cubic. A port's values at
   start, half and end make a parabola in time, beside a part that moves with its driver, whose response is
   exact. Ports that feed back to what they depend on are solved for at the half and the end.

   A step is refused and halved where the driver turns or comes to rest inside it, where the Runge-Kutta step
   errs, or where a port at a quarter of the step is off its parabola. */
#include "exact.h"
#include "exact_columns.h"

/* Try the step of `level` from `begin` to `end`, shares of the sample */
static void try_step(psa_state *state, const psa_level *level, long sample, real begin, real length, double h,
                     int slopes) {
    psa_trial *const trial = &state->trial;
    const psa_exact *const run = state->run;
    const double *const now = run->v + sample * EX_NU, *const next = now + EX_NU;
    static const double THETA[NODES] = {1.0, 0.5, 0.25};
    trial->level = level;
    for (int i = 0; i < ROWS; ++i) trial->l[i] = i < NL ? state->x[ex_linear[i]] : REAL(0.0);
    trial->dt = length * h;
    trial->error = REAL(0.0);
    for (int g = 0; g < EX_NG; ++g) trial->stages[g].legs = 1;
    for (int j = 0; j < EX_NU; ++j) {
        const double change = run->zero_order_hold ? 0.0 : next[j] - now[j];
        trial->v0[j] = now[j] + begin * change;
        trial->dv[j] = length * change;
        for (int n = 0; n < NODES; ++n) trial->v[n][j] = trial->v0[j] + THETA[n] * trial->dv[j];
    }
    for (int n = 0; n < NODES; ++n) {
        trial->t[n] = state->t + THETA[n] * trial->dt;
        linear_node(trial, n);
    }
    for (int k = 0; k < EX_NITEMS; ++k) {
        const psa_item *const item = ex_items + k;
        if (item->kind == EX_GROUP) do_group(state, trial, item->members[0], slopes);
        else if (item->kind == EX_PORT) do_port(state, trial, item->members[0], slopes);
#if EX_NLOOP > 0
        else do_loop(state, trial, item->members, item->count);
#endif
    }
}

static const psa_level *level_of(psa_state *state, int step, int level) {
    const psa_exact *const run = state->run;
    const int each = 1 + state->thetas, at = step * (run->finest + 1) + level;
    psa_level *const found = state->levels + (size_t)at * (size_t)each;
    if (!state->ready[at]) {
        for (int lane = 0; lane < PSA_LANES; ++lane)
            for (int t = 0; t < each; ++t)
                fill_level(state->ladders + step * PSA_LANES + lane, level, t, state->scale[lane], lane, found + t);
        state->ready[at] = 1;
    }
    return found;
}

/* Values of the ports at the start of an interval, with their derivatives */
static void start_ports(psa_state *state, const double *input) {
    real v[EX_NU + 1];
    for (int j = 0; j < EX_NU; ++j) v[j] = input[j] + REAL(0.0);
    for (int j = 0; j < EX_NPORT; ++j) {
        real *const out = state->start_slopes[j];
        ex_port_slopes(j, state->t, state->x, v, REAL(0.0), state->k, out);
        state->port[j] = out[0];
#if PSA_LANES == 1
        const int nb = state->blocks;
        if (nb > 0)
            chain(state, state->port_list[j], out + 1, state->s, NULL, ROW(state->sport, j));
#endif
    }
}

static int write_sample(psa_state *state, long sample, const psa_pace *pace) {
    const psa_exact *const run = state->run;
    const int sets = run->sets;
    real v[EX_NU + 1], out[EX_SHOWN_OUT > EX_NY ? EX_SHOWN_OUT : EX_NY];
    for (int j = 0; j < EX_NU; ++j) v[j] = run->v[sample * EX_NU + j] + REAL(0.0);
    if (run->x)
        for (int i = 0; i < EX_NX; ++i)
            for (int lane = 0; lane < sets; ++lane)
                run->x[(sample * EX_NX + i) * sets + lane] = LANE(state->x[i], lane);
    if (run->y) {
        ex_outputs(state->t, state->x, v, REAL(0.0), state->k, out);
        for (int i = 0; i < EX_NY; ++i)
            for (int lane = 0; lane < sets; ++lane)
                run->y[(sample * EX_NY + i) * sets + lane] = LANE(out[i], lane);
    }
    if (!run->shown) return 0;
    if (run->count == 0) {
        ex_shown(state->t, state->x, v, REAL(0.0), state->k, out);
        for (int lane = 0; lane < sets; ++lane) {
            run->shown[sample * sets + lane] = pace->dead[lane] ? NAN : LANE(out[0], lane);
            if (PSA_LANES == 1 && !isfinite(LANE(out[0], lane))) return 1;
        }
        return 0;
    }
#if PSA_LANES == 1
    column *const dy = state->scratch;
    ex_shown_slopes(state->t, state->x, v, 0.0, state->k, out);
    chain(state, state->shown_list, out + 1, state->s, NULL, dy);
    run->shown[sample] = out[0];
    memcpy(run->dy + sample * run->count, dy, sizeof(double) * (size_t)run->count);
    return !isfinite(out[0]);
#else
    return 0;
#endif
}

/* The levels of lanes that differ, put together */
#if PSA_LANES > 1
static const psa_level *gather(psa_state *state, int step, const int *level) {
    const size_t count = sizeof(psa_level) / sizeof(real);
    for (int lane = 0; lane < PSA_LANES; ++lane) {
        const double *const from = (const double *)level_of(state, step, level[lane]) + lane;
        double *const to = (double *)state->mixed + lane;
        for (size_t k = 0; k < count; ++k) to[k * PSA_LANES] = from[k * PSA_LANES];
    }
    return state->mixed;
}
#endif

/* Steps over one interval between samples. Positions are counted in the finest lengths; a step begins at a
   multiple of its own length. Every lane goes at its own pace, as it would by itself. */
static int next_sample(psa_state *state, long sample, psa_pace *pace) {
    psa_exact *const run = state->run;
    const int step = run->which_step[sample], finest = run->finest;
    const double h = run->length[step];
    const long end = 1L << finest;
    psa_trial *const trial = &state->trial;
    for (int lane = 0; lane < PSA_LANES; ++lane) pace->at[lane] = pace->dead[lane] ? end : 0;
    for (;;) {
        int first = -1, level[PSA_LANES], same = 1;
        real begin = REAL(0.0), length = REAL(1.0);
        for (int lane = PSA_LANES - 1; lane >= 0; --lane)
            if (pace->at[lane] < end) first = lane;
        if (first < 0) break;
        for (int lane = 0; lane < PSA_LANES; ++lane) {
            level[lane] = pace->level[pace->at[lane] < end ? lane : first];
            same &= level[lane] == level[first];
            SET_LANE(begin, lane, ldexp((double)pace->at[lane], -finest));
            SET_LANE(length, lane, ldexp(1.0, -level[lane]));
        }
#if PSA_LANES > 1
        const psa_level *const matrices = same ? level_of(state, step, level[0]) : gather(state, step, level);
#else
        const psa_level *const matrices = level_of(state, step, level[0]);
        (void)same;
#endif
        try_step(state, matrices, sample, begin, length, h, run->count > 0);
        bits accepted = MASK(REAL(0.0) > 1.0);
        for (int lane = 0; lane < PSA_LANES; ++lane) {
            if (pace->at[lane] >= end) continue;
            const double error = LANE(trial->error, lane);
            const int spent = ++pace->tried[lane] > run->steps_limit;
            if (spent && PSA_LANES == 1) return 3;
            if (error > 1.0 && level[lane] < finest && !spent) {
                pace->level[lane]++;
                run->rejected++;
                continue;
            }
            if (!(error < LOST) || spent) {
                if (PSA_LANES == 1) return 1;
                pace->dead[lane] = 1;
                pace->at[lane] = end;
                continue;
            }
            if (error > 1.0) run->forced++;
            const long units = end >> level[lane];
            pace->at[lane] += units;
            run->steps++;
            if (level[lane] > run->coarsest && error < GROWS && pace->at[lane] % (2 * units) == 0)
                pace->level[lane]--;
            SET_LANE(state->t, lane, run->t[sample] + h * ldexp((double)pace->at[lane], -finest));
            SET_LANE(accepted, lane, -1);
        }
        if (!any(accepted)) continue;
#if PSA_LANES == 1
        if (run->count > 0) step_columns(state);
#endif
        for (int i = 0; i < EX_NX; ++i) state->x[i] = choose(accepted, trial->x[WHOLE][i], state->x[i]);
        for (int j = 0; j < EX_NPORT; ++j)
            state->port[j] = choose(accepted, trial->port[WHOLE][j], state->port[j]);
    }
    state->t = run->t[sample + 1] + REAL(0.0);
    return 0;
}

/* The entries of one row that count here */
APART static void activate(const psa_state *state, const psa_entry *entries, int count, int row, psa_active *list) {
    for (int e = 0; e < count; ++e) {
        if (entries[e].row != row) continue;
        const int asked = entries[e].kind == 2 ? state->column_of[entries[e].index] : entries[e].index;
        if (asked < 0) continue;
        *list++ = (psa_active){entries[e].kind, (short)asked, (short)e};
    }
    list->kind = -1;
}

APART static void activate_all(psa_state *state) {
    for (int g = 0; g < EX_NG; ++g) {
        activate(state, ex_rate_entries[g], ex_rate_count[g], 0, state->rate_list[g]);
        for (int i = 0; i < ex_group_size[g]; ++i)
            activate(state, ex_group_entries[g], ex_group_count[g], i, state->group_list[ex_group_first[g] + i]);
    }
    for (int j = 0; j < EX_NPORT; ++j)
        activate(state, ex_port_entries[j], ex_port_count[j], 0, state->port_list[j]);
    activate(state, ex_shown_entries, EX_SHOWN_OUT - 1, 0, state->shown_list);
}

APART static int set_up(psa_state *state) {
    psa_exact *const run = state->run;
    const int one = NL * (NL + EX_NU + 1);
    for (int lane = 0; lane < PSA_LANES; ++lane) {
        const int set = lane < run->sets ? lane : 0; /* lanes without a set of their own go with the first */
        for (int i = 0; i < EX_NP; ++i) SET_LANE(state->p[i], lane, run->p[i * run->sets + set]);
        for (int i = 0; i < EX_NX; ++i) {
            SET_LANE(state->nominal[i], lane, run->nominal[i * run->sets + set]);
            SET_LANE(state->x[i], lane, run->x0[i * run->sets + set]);
        }
        for (int i = 0; i < NL; ++i) state->scale[lane][i] = run->nominal[ex_linear[i] * run->sets + set];
    }
    for (int i = 0; i < NL; ++i) state->inverse_nominal[i] = 1.0 / state->nominal[ex_linear[i]];
    state->tolerance = run->tolerance + REAL(0.0);
    state->brief = v_sqrt(state->tolerance);
    psa_prepare(state->p, state->k);
    for (int i = 0; i < EX_NP; ++i) state->column_of[i] = -1;
    for (int c = 0; c < run->count; ++c)
        if (run->which[c] >= 0) state->column_of[run->which[c]] = c;
    activate_all(state);
    int theta[EX_NTHETA + 1];
    state->thetas = 0;
    for (int m = 0; m < EX_NTHETA; ++m)
        if (state->column_of[ex_theta[m]] >= 0) {
            theta[state->thetas] = m;
            state->theta_column[state->thetas++] = state->column_of[ex_theta[m]];
        }
    state->ladders = calloc((size_t)(run->lengths * PSA_LANES), sizeof(psa_ladder));
    const size_t levels = (size_t)run->lengths * (size_t)(run->finest + 1);
    state->levels = calloc(levels * (size_t)(1 + state->thetas), sizeof(psa_level));
    state->ready = calloc(levels, 1);
    state->mixed = PSA_LANES > 1 ? malloc(sizeof(psa_level)) : NULL;
    real *const plain = malloc((size_t)one * sizeof(real));
    real *const slopes = malloc((size_t)(one * (EX_NTHETA + 1)) * sizeof(real));
    double *const lin = malloc((size_t)(one * (state->thetas + 1)) * sizeof(double));
    int status = (PSA_LANES > 1 && !state->mixed) || !state->ladders || !state->levels || !state->ready || !plain || !slopes || !lin ? 2 : 0;
    if (status == 0) {
        psa_linear(state->p, plain);
        if (state->thetas > 0) psa_linear_slopes(state->p, slopes);
    }
    for (int lane = 0; lane < PSA_LANES && status == 0; ++lane) {
        for (int i = 0; i < one; ++i) {
            lin[i] = LANE(plain[i], lane);
            for (int m = 0; m < state->thetas; ++m)
                lin[(m + 1) * one + i] = LANE(slopes[theta[m] * one + i], lane);
        }
        for (int step = 0; step < run->lengths && status == 0; ++step)
            status = build_ladder(state->ladders + step * PSA_LANES + lane, state->thetas, lin, state->scale[lane],
                                  run->length[step], run->finest + 2);
    }
    free(plain);
    free(slopes);
    free(lin);
#if PSA_LANES == 1
    if (run->count > 0 && status == 0) {
        const int nb = state->blocks = (run->count + COLUMNS - 1) / COLUMNS;
        const size_t rows = EX_NX + EX_NPORT + NODES * (EX_NX + EX_NPORT + 1) + NL + EX_NEED + 9 * EX_NX + 3;
        column *const memory = calloc(rows * (size_t)nb, sizeof(column));
        if (!memory) return 2;
        state->s = memory;
        state->sport = ROW(state->s, EX_NX);
        state->node = ROW(state->sport, EX_NPORT);
        state->snode_port = ROW(state->node, NODES * EX_NX);
        state->direct = ROW(state->snode_port, NODES * (EX_NPORT + 1));
        state->scratch = ROW(state->direct, NL + EX_NEED);
        for (int i = 0; i < EX_NX; ++i)
            memcpy(ROW(state->s, i), run->s0 + i * run->count, sizeof(double) * (size_t)run->count);
    }
#endif
    return status;
}

APART static void tear_down(psa_state *state) {
    if (state->ladders)
        for (int i = 0; i < state->run->lengths * PSA_LANES; ++i) free(state->ladders[i].blocks);
    free(state->ladders);
    free(state->levels);
    free(state->ready);
    free(state->mixed);
    free(state->s);
}

int psa_run_exact(psa_exact *run) {
    psa_state *const state = calloc(1, sizeof *state);
    if (!state) return 2;
    state->run = run;
    run->steps = run->rejected = run->forced = 0;
    psa_pace pace;
    memset(&pace, 0, sizeof pace);
    for (int lane = 0; lane < PSA_LANES; ++lane) pace.level[lane] = run->coarsest;
    int status = set_up(state);
    state->t = run->t[0] + REAL(0.0);
    if (status == 0) {
        start_ports(state, run->v);
        status = write_sample(state, 0, &pace);
    }
    for (long sample = 0; sample + 1 < run->samples && status == 0; ++sample) {
        if (run->zero_order_hold && sample > 0) start_ports(state, run->v + sample * EX_NU);
        status = next_sample(state, sample, &pace);
        if (status == 0) status = write_sample(state, sample + 1, &pace);
    }
    run->t_failed = LANE(state->t, 0);
    tear_down(state);
    free(state);
    return status;
}
