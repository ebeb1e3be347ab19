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
    trial->over_dt = 1.0 / trial->dt;
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

/* The matrices' derivatives by the parameters, of one of the levels */
#if PSA_SENSITIVE
static column *slopes_of(const psa_state *state, int at) {
    const int blocks = (state->thetas + COLUMNS - 1) / COLUMNS;
    return state->slopes + (size_t)at * (size_t)(blocks * state->slopes_size);
}
#endif

#if PSA_DEVICE
static const psa_level *level_of(psa_state *state, int step, int level) {
    const int at = step * (state->run->finest + 1) + level, place = at % PSA_HELD;
    psa_level *const held = state->held + place;
    if (state->held_at[place] != at) fill_level(state->ladders + step, level, 0, state->scale[0], 0, held);
    state->held_at[place] = at;
    return held;
}
#else
static const psa_level *level_of(psa_state *state, int step, int level) {
    const int at = step * (state->run->finest + 1) + level;
    psa_level *const found = state->levels + at;
    if (!state->ready[at]) {
        for (int lane = 0; lane < PSA_LANES; ++lane)
            fill_level(state->ladders + step * PSA_LANES + lane, level, 0, state->scale[lane], lane, found);
#if PSA_LANES == 1
        for (int m = 0; m < state->thetas; ++m) {
            fill_level(state->ladders + step, level, m + 1, state->scale[0], 0, state->mixed);
            pack_slopes(state, state->mixed, m % COLUMNS, slopes_of(state, at) + (m / COLUMNS) * state->slopes_size);
        }
#endif
        state->ready[at] = 1;
    }
    return found;
}
#endif

/* Values of the ports at the start of an interval, with their derivatives */
static void start_ports(psa_state *state, const double *input) {
    real v[EX_NU + 1];
    for (int j = 0; j < EX_NU; ++j) v[j] = input[j] + REAL(0.0);
    for (int j = 0; j < EX_NPORT; ++j) {
        real *const out = state->start_slopes[j];
        ex_port_slopes(j, state->t, state->x, v, REAL(0.0), state->k, out);
        state->port[j] = out[0];
#if PSA_SENSITIVE
        for (int b = 0; b < state->blocks; ++b)
            ex_port_chain(j, out + 1, state->s + b * EX_NX, NONE, state->unit + b * EX_NP,
                          state->sport + b * (EX_NPORT + 1) + j);
#endif
    }
}

#if !PSA_DEVICE
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
        for (int i = 0; i < EX_NSHOWN; ++i)
            for (int lane = 0; lane < sets; ++lane) {
                run->shown[(sample * EX_NSHOWN + i) * sets + lane] = pace->dead[lane] ? NAN : LANE(out[i], lane);
                if (PSA_LANES == 1 && !isfinite(LANE(out[i], lane))) return 1;
            }
        return 0;
    }
#if PSA_LANES == 1
    double dy[EX_NSHOWN][MOST_UNKNOWNS + COLUMNS], sum = 0.0; /* not finite where one of them is not */
    ex_shown_slopes(state->t, state->x, v, 0.0, state->k, out);
    for (int b = 0; b < state->blocks; ++b) {
        column own[EX_NSHOWN];
        ex_shown_chain(0, out + EX_NSHOWN, state->s + b * EX_NX, NONE, state->unit + b * EX_NP, own);
        for (int i = 0; i < EX_NSHOWN; ++i) memcpy(dy[i] + b * COLUMNS, own + i, sizeof *own);
    }
    double *to = run->dy + sample * EX_NSHOWN * run->count;
    for (int i = 0; i < EX_NSHOWN; ++i) {
        sum += run->shown[sample * EX_NSHOWN + i] = out[i];
        for (int c = 0; c < run->count; ++c) sum += *to++ = dy[i][state->place[c]];
    }
    return !isfinite(sum);
#else
    return 0;
#endif
}
#endif

/* The levels of lanes that differ, put together; what a lane had the last time it has still */
#if PSA_LANES > 1
static const psa_level *gather(psa_state *state, int step, const int *level) {
    const size_t count = sizeof(psa_level) / sizeof(real);
    for (int lane = 0; lane < PSA_LANES; ++lane) {
        const psa_level *const own = level_of(state, step, level[lane]);
        if (own == state->mixed_from[lane]) continue;
        state->mixed_from[lane] = own;
        const double *const from = (const double *)own + lane;
        double *const to = (double *)state->mixed + lane;
        for (size_t k = 0; k < count; ++k) to[k * PSA_LANES] = from[k * PSA_LANES];
    }
    return state->mixed;
}
#endif

/* The end of the step that was tried is where the lanes are that accepted it */
static void keep(psa_state *state, bits accepted) {
    const psa_trial *const trial = &state->trial;
    if (!any(~accepted)) {
        memcpy(state->x, trial->x[WHOLE], sizeof state->x);
        memcpy(state->port, trial->port[WHOLE], sizeof(real) * EX_NPORT);
        return;
    }
    for (int i = 0; i < EX_NX; ++i) state->x[i] = choose(accepted, trial->x[WHOLE][i], state->x[i]);
    for (int j = 0; j < EX_NPORT; ++j) state->port[j] = choose(accepted, trial->port[WHOLE][j], state->port[j]);
}

/* Steps over one interval between samples. Positions are counted in the finest lengths; a step begins at a
   multiple of its own length. Every lane goes at its own pace, as it would by itself. */
static int next_sample(psa_state *state, long sample, psa_pace *pace) {
    psa_exact *const run = state->run;
    const int step = run->which_step[sample], finest = run->finest;
    const double h = run->length[step];
    const long end = 1L << finest;
    const double unit = 1.0 / (double)end;
    const double share = 0.1 + (double)(sample + 1) / (double)run->samples;
    const double most = (double)run->steps_limit * (share < 1.0 ? share : 1.0);
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
            SET_LANE(begin, lane, (double)pace->at[lane] * unit);
            SET_LANE(length, lane, (double)(end >> level[lane]) * unit);
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
            const int spent = (double)++pace->tried[lane] > most;
            if (spent && PSA_LANES == 1) return 3;
            if (error > 1.0 && level[lane] < finest && !spent) {
                pace->level[lane] += error > FAR && level[lane] + 1 < finest ? 2 : 1;
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
            SET_LANE(state->t, lane, run->t[sample] + h * (double)pace->at[lane] * unit);
            SET_LANE(accepted, lane, -1);
        }
        if (!any(accepted)) continue;
#if PSA_SENSITIVE
        if (run->count > 0) step_columns(state, slopes_of(state, step * (finest + 1) + level[0]));
#endif
        keep(state, accepted);
    }
    state->t = run->t[sample + 1] + REAL(0.0);
    return 0;
}

#if PSA_SENSITIVE
/* Whether an unknown leaves a group's states and its driver's way as they are */
static int passes_by(const psa_exact *run, int g, int c) {
    if (run->which[c] >= 0 && ex_group_by[g][run->which[c]]) return 0;
    for (int i = 0; i < EX_NX; ++i)
        if (ex_group_behind[g][i] && run->s0[i * run->count + c] != 0.0) return 0;
    return 1;
}

static int passes_by_all(const psa_exact *run, int c) {
    for (int g = 0; g < EX_NG; ++g)
        if (!passes_by(run, g, c)) return 0;
    return 1;
}

/* Columns for the unknowns: parameters of the linear part first; 0, or 2 where memory is out */
APART static int set_up_columns(psa_state *state, int *theta) {
    psa_exact *const run = state->run;
    if (run->count > MOST_UNKNOWNS) return 2;
    int found = 0;
    for (int near = 0; near < 2; ++near) /* those that pass by all groups stand together, at both ends */
        for (int m = 0; m < EX_NTHETA; ++m)
            for (int c = 0; c < run->count; ++c)
                if (run->which[c] == ex_theta[m] && passes_by_all(run, c) != near) {
                    theta[found] = m;
                    state->place[c] = found++;
                }
    state->thetas = found;
    for (int far = 0; far < 2; ++far)
        for (int c = 0; c < run->count; ++c) {
            int linear = 0;
            for (int m = 0; m < EX_NTHETA; ++m) linear |= run->which[c] == ex_theta[m];
            if (!linear && passes_by_all(run, c) == far) state->place[c] = found++;
        }
    memset(state->apart, 1, sizeof state->apart);
    for (int g = 0; g < EX_NG; ++g)
        for (int c = 0; c < run->count; ++c)
            if (!passes_by(run, g, c)) state->apart[g][state->place[c] / COLUMNS] = 0;
    int zero[EX_NU + 1];
    for (int q = 0; q < EX_NU; ++q) {
        zero[q] = 1;
        for (long n = 0; n < run->samples && zero[q]; ++n) zero[q] = run->v[n * EX_NU + q] == 0.0;
    }
    for (int k = 0; k < TAIL; ++k) {
        /* inputs stand first, then the constant; a chord has the constant first, inputs behind its driver's part */
        const int each = 1 + EX_NDRIVE + 2 * EX_NU + 3 * EX_NFEED, beside = 2 * EX_NU + 1 + 3 * EX_NPORT;
        const int at = k < beside ? k : (k - beside) % each - 1 - EX_NDRIVE;
        const int constant = k < beside ? k == 2 * EX_NU : at == -1 - EX_NDRIVE;
        const int none = constant ? !EX_CONSTANT : at >= 0 && at < 2 * EX_NU && zero[at % SOME(EX_NU)];
        if (!none || (k + 1 == TAIL && state->tails == 0)) state->tail[state->tails++] = k;
    }
    state->slopes_size = EX_NOWN + (NL + EX_NEED) * state->tails;
    const size_t nb = (size_t)(state->blocks = (run->count + COLUMNS - 1) / COLUMNS);
    const size_t levels = (size_t)run->lengths * (size_t)(run->finest + 1);
    const size_t own = levels * (size_t)((state->thetas + COLUMNS - 1) / COLUMNS * state->slopes_size);
    column *const memory = lined((nb * (EX_NX + EX_NPORT + 1 + EX_NP) + own) * sizeof(column));
    if (!memory) return 2;
    state->s = memory;
    state->sport = state->s + nb * EX_NX;
    state->unit = state->sport + nb * (EX_NPORT + 1);
    state->slopes = state->unit + nb * EX_NP;
    for (int c = 0; c < run->count; ++c) {
        const int b = state->place[c] / COLUMNS, lane = state->place[c] % COLUMNS;
        for (int i = 0; i < EX_NX; ++i) ((double *)(state->s + b * EX_NX + i))[lane] = run->s0[i * run->count + c];
        if (run->which[c] >= 0) ((double *)(state->unit + b * EX_NP + run->which[c]))[lane] = 1.0;
    }
    return 0;
}
#endif

/* A piece of memory behind the last one, each on cache lines of its own; NULL where only the size is asked for */
static char *piece(char *memory, size_t *size, size_t more) {
    char *const found = memory ? memory + *size : NULL;
    *size += (more + LINE - 1) / LINE * LINE;
    return found;
}

#define PIECE(type, count) ((type *)piece(memory, &size, (size_t)(count) * sizeof(type)))

/* Cut what a run needs from memory, which may be NULL; its size in bytes. Levels, and which are ready, must be 0. */
static size_t cut(psa_state *state, char *memory) {
    const psa_exact *const run = state->run;
    const int one = NL * (NL + EX_NU + 1), ladders = run->lengths * PSA_LANES, below = run->finest + 2;
    const size_t rung = (size_t)(EX_NCH + 1) * (size_t)(state->thetas + 1);
    size_t size = 0;
#if !PSA_DEVICE
    const size_t levels = (size_t)run->lengths * (size_t)(run->finest + 1);
    state->levels = PIECE(psa_level, levels);
    state->mixed = PIECE(psa_level, 1);
    state->ready = PIECE(char, levels);
#endif
    state->plain = PIECE(real, one);
    state->linear_slopes = PIECE(real, state->thetas > 0 ? one * EX_NTHETA : 0);
    state->lin = PIECE(double, one * (state->thetas + 1));
    state->balanced = PIECE(double, one * (state->thetas + 1));
    state->terms = PIECE(psa_block, 3 * rung);
    state->ladders = PIECE(psa_ladder, ladders);
    for (int i = 0; i < ladders; ++i) {
        psa_block *const blocks = PIECE(psa_block, (size_t)RUNGS(below) * rung);
        if (!memory) continue;
        state->ladders[i].count = state->thetas;
        state->ladders[i].levels = below;
        state->ladders[i].blocks = blocks;
    }
    return size;
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
    for (int i = 0; i < EX_NX; ++i) state->over_nominal[i] = 1.0 / state->nominal[i];
    state->tolerance = run->tolerance + REAL(0.0);
    state->over_tolerance = 1.0 / state->tolerance;
    state->brief = v_sqrt(state->tolerance);
    psa_prepare(state->p, state->k);
    int theta[EX_NTHETA + 1];
#if PSA_SENSITIVE
    if (run->count > 0 && set_up_columns(state, theta)) return 2;
#endif
#if !PSA_DEVICE
    state->memory = lined(cut(state, NULL));
    if (!state->memory) return 2;
    cut(state, state->memory);
#endif
    double *const lin = state->lin;
    int status = 0;
    psa_linear(state->p, state->plain);
#if PSA_SENSITIVE
    if (state->thetas > 0) psa_linear_slopes(state->p, state->linear_slopes);
#endif
    for (int lane = 0; lane < PSA_LANES && status == 0; ++lane) {
        for (int i = 0; i < one; ++i) {
            lin[i] = LANE(state->plain[i], lane);
            for (int m = 0; m < state->thetas; ++m)
                lin[(m + 1) * one + i] = LANE(state->linear_slopes[theta[m] * one + i], lane);
        }
        for (int step = 0; step < run->lengths && status == 0; ++step)
            status = build_ladder(state->ladders + step * PSA_LANES + lane, lin, state->scale[lane], run->length[step],
                                  state->balanced, state->terms);
    }
    return status;
}

/* From one sample to the next */
static int go_on(psa_state *state, long sample, psa_pace *pace) {
    const psa_exact *const run = state->run;
    if (run->zero_order_hold && sample > 0) start_ports(state, run->v + sample * EX_NU);
    return next_sample(state, sample, pace);
}

#if !PSA_DEVICE
int psa_run_exact(psa_exact *run) {
    psa_state *const state = lined(sizeof *state);
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
        status = run->stop && *run->stop ? 4 : go_on(state, sample, &pace);
        if (status == 0) status = write_sample(state, sample + 1, &pace);
    }
    run->t_failed = LANE(state->t, 0);
    free_lined(state->memory);
    free_lined(state->s);
    free_lined(state);
    return status;
}
#endif
