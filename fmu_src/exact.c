/* Exact steps of a linear part with what is nonlinear beside it, and their exact derivatives.

   Between two samples the input is linear in time. A step of h / 2^level takes the linear part exactly
   (exact_levels.h). States along a path (hysteresis) take one Runge-Kutta step of fourth order over their
   driver's way, whatever its course in time; between the ends they follow Hermite's cubic. A port's values at
   start, half and end make a parabola in time, beside a part that moves with its driver, whose response is
   exact. Ports that feed back to what they depend on are solved for at the half and the end.

   A step is refused and halved where the driver turns or comes to rest inside it, where the Runge-Kutta step
   errs, or where a port at a quarter of the step is off its parabola. */
#include "exact.h"

#include "exact_model.h"
#include "exact_levels.h"

#define SLOWS 0.8        /* a driver whose rate falls to less than this share of it may come to rest */
#define FAST 1e3         /* over the driver's rate: there what a state does in time is nothing */
#define GROWS 0.03       /* of the tolerance: the next step may be twice as long */
#define TURNS 8          /* iterations for the instant at which a driver turns */
#define LOST 1e6         /* times the tolerance: an error of the finest step from which nothing can be told */
#define BENDS 0.05       /* of its way: a driver's course that bends by more is not a smooth one */
#define UNEVEN 2e-3      /* share of its way by which a driver is off the middle at the half of a step */
#define NEWTON_LIMIT 12
#define STILL 1e-9       /* of its nominal size: a driver's way along which nothing can be told */

/* Columns of sensitivities, four at a time; with lanes there are none */
#if PSA_LANES == 1
typedef double column __attribute__((vector_size(32), aligned(8)));
#define COLUMNS 4
#else
typedef real column;
#define COLUMNS 1
#endif

enum { WHOLE, HALF, QUARTER, NODES };

/* One leg of a group's way, on which its driver does not turn, with what the derivatives need */
typedef struct {
    real begin, dt;                       /* share of the step at which it begins; its duration */
    real from[EX_NX], to[EX_NX];          /* path variables at both ends, states at both ends */
    real at[4][EX_NX];                    /* path variables and states of the four evaluations */
    real out[4][EX_GROUP_OUT];            /* slopes and their partial derivatives */
    real last[EX_NX];                     /* slopes at the end */
    real rate, way;                       /* mean rate of the driver, its way */
    int stages;                           /* 4, or 2 where the way is short */
} psa_leg;

/* A group's way: one leg, or two where the driver turns at the share `turn` of the step */
typedef struct {
    psa_leg leg[2];
    int legs;
    real w[NODES + 1], turn;              /* the driver's rate at whole, half, quarter, start */
    real share[NODES];                    /* of the leg's way at the nodes */
    int on[NODES];                        /* the leg of each node; with lanes only the first counts */
    real basis[6];                        /* Hermite's, at the turn */
    real missed;                          /* error of the driver's value there */
    int drifts;                           /* what the states do in time is told apart at the nodes */
    real drift[EX_NX], fast[EX_GROUP_OUT]; /* their slopes in time, and all slopes at a great rate */
    real rate_slopes[NODES + 1][EX_RATE_OUT];
} psa_stages;

/* Change over a step and bend inside it of a driver and of a port, and what sigma is a ratio over */
typedef struct {
    real way, bend, change, bent, over;
} psa_chord;

/* Everything of one step under trial */
typedef struct {
    const psa_level *level;
    real dt, t[NODES];
    real v0[EX_NU + 1], v[NODES][EX_NU + 1], dv[EX_NU + 1];
    real l[ROWS], x[NODES][EX_NX];
    real port[NODES][EX_NPORT + 1];       /* values */
    real slopes[NODES][EX_NPORT + 1][EX_PORT_OUT]; /* values and partial derivatives */
    psa_chord chords[EX_NCH + 1];
    real chord[EX_NCH + 1], beyond[EX_NCH + 1][NL]; /* sigma, and the response to u(t) beyond the parabola */
    psa_stages stages[EX_NG + 1];
    real error;                           /* over the tolerance */
} psa_trial;

/* A partial derivative that counts: by a state (kind 0), the rate (1), or straight into a column (2); the
   list ends with kind -1 */
typedef struct {
    short kind, index, entry;
} psa_active;

/* Where the lanes stand within a sample, the levels of their next steps, and which have come to an end */
typedef struct {
    long at[PSA_LANES];
    int level[PSA_LANES], dead[PSA_LANES];
} psa_pace;

typedef struct {
    psa_exact *run;
    real t, x[EX_NX], port[EX_NPORT + 1], start_slopes[EX_NPORT + 1][EX_PORT_OUT];
    real p[EX_NP + 1], k[EX_NK + 1];
    real nominal[EX_NX], inverse_nominal[NL], tolerance, brief;
    psa_ladder *ladders;                  /* [lengths][lanes] */
    psa_level *levels;                    /* [lengths][finest + 1][1 + thetas] */
    psa_level *mixed;                     /* of lanes whose levels differ */
    char *ready;                          /* [lengths][finest + 1] */
    double scale[PSA_LANES][NL];
    int thetas;                           /* unknown parameters of the linear part */
    int theta_column[EX_NTHETA + 1];
    int column_of[EX_NP + 1];             /* -1: not asked for */
    int blocks;                           /* of columns */
    column *s, *sport;                    /* [EX_NX][blocks], [EX_NPORT][blocks] */
    column *node, *snode_port, *scratch;  /* work of one step */
    column *direct;                       /* [NL + EX_NEED][blocks]: of the matrices' own derivatives */
    psa_active group_list[EX_NX + 1][EX_GROUP_OUT + 1], port_list[EX_NPORT + 1][EX_PORT_OUT + 1],
        rate_list[EX_NG + 1][EX_RATE_OUT + 1], shown_list[EX_SHOWN_OUT + 1];
    psa_trial trial;
} psa_state;

static int any(bits mask) {
    int found = 0;
    for (int lane = 0; lane < PSA_LANES; ++lane) found |= LANE(mask, lane) != 0;
    return found;
}

static void set_error(psa_trial *trial, real error) {
    /* a number that is not finite counts as an infinite error */
    const bits fine = MASK(error <= 1e300);
    trial->error = v_fmax(trial->error, choose(fine, error, REAL(1e300)));
}

/* ---- values ------------------------------------------------------------------------------------------ */

/* sum += the response of L to its start, the input and a constant; the whole of it */
static inline void respond(const psa_whole *whole, const real *l, const real *v0, const real *dv, real *sum) {
    for (int i = 0; i < ROWS; ++i) sum[i] += whole->c[i];
    for (int j = 0; j < NL; ++j)
        for (int i = 0; i < ROWS; ++i) sum[i] += whole->f[j][i] * l[j];
    for (int j = 0; j < EX_NU; ++j)
        for (int i = 0; i < ROWS; ++i) sum[i] += whole->a1[j][i] * v0[j] + whole->a2[j][i] * dv[j];
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
        for (int i = 0; i < ROWS; ++i) sum[i] = trial->l[i];
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
        response = v_fmax(response, v_fabs(trial->level->whole.w[j][1][i]) * state->inverse_nominal[i]);
    set_error(trial, v_fabs(off) * response / state->tolerance);
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
    real off = trial->port[QUARTER][j] - 0.375 * state->port[j] - 0.75 * trial->port[HALF][j] +
               0.125 * trial->port[WHOLE][j];
    if (driver >= 0) {
        const int u = ex_linear[driver];
        off -= sigma * (trial->x[QUARTER][u] - 0.375 * state->x[u] - 0.75 * trial->x[HALF][u] +
                        0.125 * trial->x[WHOLE][u]);
    }
    set_bump(state, trial, j, off);
    if (ex_port_timed[j]) check_elsewhere(state, trial, j, -1);
    for (int g = 0; g < EX_NG; ++g)
        if (ex_port_along[j][g] && trial->stages[g].legs > 1) check_elsewhere(state, trial, j, g);
}

/* The response to a chord's driver beyond the parabola */
static inline void respond_beyond(const psa_state *state, const psa_trial *trial, const psa_level *level, int c,
                                  real *sum) {
    for (int i = 0; i < ROWS; ++i) sum[i] = level->chord_c[c][i];
    for (int k = 0; k < ex_reads[ex_chord_driver[c]]; ++k)
        for (int i = 0; i < ROWS; ++i) sum[i] += level->chord_f[c][k][i] * trial->l[k];
    for (int q = 0; q < EX_NU; ++q)
        for (int i = 0; i < ROWS; ++i)
            sum[i] += level->chord_a1[c][q][i] * trial->v0[q] + level->chord_a2[c][q][i] * trial->dv[q];
    for (int k = 0; k < EX_NFEED && ex_feed[c][k] >= 0; ++k) {
        const int j = ex_feed[c][k];
        for (int i = 0; i < ROWS; ++i)
            sum[i] += level->chord_w[c][k][0][i] * state->port[j] + level->chord_w[c][k][1][i] * trial->port[HALF][j] +
                      level->chord_w[c][k][2][i] * trial->port[WHOLE][j];
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

/* Hermite's cubic at s between values a and b with slopes da and db over the interval */
static void hermite(real s, real basis[4]) {
    const real r = 1.0 - s;
    basis[0] = r * r * (1.0 + 2.0 * s);
    basis[1] = s * r * r;
    basis[2] = s * s * (3.0 - 2.0 * s);
    basis[3] = -(s * s * r);
}

/* Hermite's quintic through values and slopes at 0, 1/2 and 1: weights at s, or those of its slope */
static void quintic(real s, int slope, real basis[6]) {
    const real l[3] = {2.0 * (s - 0.5) * (s - 1.0), -4.0 * s * (s - 1.0), 2.0 * s * (s - 0.5)};
    const real dl[3] = {4.0 * s - 3.0, 4.0 - 8.0 * s, 4.0 * s - 1.0};
    static const double AT[3] = {0.0, 0.5, 1.0}, LEAN[3] = {6.0, 0.0, -6.0}; /* -2 l'(at itself) */
    for (int i = 0; i < 3; ++i) {
        const real d = s - AT[i], lean = 1.0 + LEAN[i] * d;
        basis[2 * i] = slope ? LEAN[i] * l[i] * l[i] + 2.0 * lean * l[i] * dl[i] : lean * l[i] * l[i];
        basis[2 * i + 1] = slope ? l[i] * l[i] + 2.0 * d * l[i] * dl[i] : d * l[i] * l[i];
    }
}

static real combine(const real basis[6], const real *u, const real *w) {
    return basis[0] * u[0] + basis[1] * w[0] + basis[2] * u[1] + basis[3] * w[1] + basis[4] * u[2] + basis[5] * w[2];
}

/* Where the driver turns: the zero of its rate on Hermite's quintic, and its value there. The quarter's value
   tells the quintic's error, which is returned. */
static real find_turn(psa_state *state, psa_trial *trial, psa_stages *stages, int u, bits late, real *value) {
    const real x[3] = {state->x[u], trial->x[HALF][u], trial->x[WHOLE][u]}, d = trial->dt;
    const real w[3] = {stages->w[NODES] * d, stages->w[HALF] * d, stages->w[WHOLE] * d};
    real low = choose(late, REAL(0.5), REAL(0.0)), high = low + 0.5, basis[6];
    real wl = choose(late, w[1], w[0]), wh = choose(late, w[2], w[1]);
    real s = low - wl * (high - low) / choose(MASK(wh == wl), REAL(1.0), wh - wl);
    bits was_right = MASK(low > 1.0), was_left = was_right;
    for (int k = 0; k < TURNS; ++k) { /* regula falsi, Illinois's variant: an end that stays counts half */
        quintic(s, 1, basis);
        const real slope = combine(basis, x, w);
        const bits right = MASK(slope * wh > 0.0);
        wl = choose(right, choose(was_right, 0.5 * wl, wl), slope);
        wh = choose(right, slope, choose(was_left, 0.5 * wh, wh));
        was_right = right;
        was_left = ~right;
        low = choose(right, low, s);
        high = choose(right, s, high);
        s = choose(MASK(slope == 0.0), s, low - wl * (high - low) / choose(MASK(wh == wl), REAL(1.0), wh - wl));
    }
    quintic(s, 0, stages->basis);
    *value = combine(stages->basis, x, w);
    stages->turn = s;
    quintic(REAL(0.25), 0, basis);
    return v_fabs(trial->x[QUARTER][u] - combine(basis, x, w));
}

/* One Runge-Kutta step along a leg, of fourth order; where the way is short the midpoint rule */
static void do_leg(psa_state *state, psa_trial *trial, int g, psa_leg *leg, int slopes) {
    static const double SHARE[4] = {0.0, 0.5, 0.5, 1.0};
    const int first = ex_group_first[g], size = ex_group_size[g];
    const real finish = leg->begin + leg->dt / trial->dt;
    /* the midpoint rule errs by a 24th of the cube of the way: nothing beside the tolerance, where the way is
       its root */
    const bits brief = MASK(v_fabs(leg->way) < state->brief * state->nominal[ex_linear[ex_group_driver[g]]]);
    leg->stages = any(~brief) ? 4 : 2;
    for (int stage = 0; stage < leg->stages; ++stage) {
        real *const x = leg->at[stage], v[EX_NU + 1];
        const double s = SHARE[stage];
        for (int r = 0; r < EX_NPATH; ++r) {
            const int q = ex_path[r];
            x[q] = leg->from[q] + s * (leg->to[q] - leg->from[q]);
        }
        for (int j = 0; j < EX_NU; ++j)
            v[j] = trial->v0[j] + (leg->begin + s * (finish - leg->begin)) * trial->dv[j];
        for (int i = 0; i < size; ++i) {
            const int q = ex_group_states[first + i];
            x[q] = leg->from[q];
            if (stage > 0) x[q] += s * leg->dt * leg->out[stage - 1][i];
        }
        const real t = state->t + leg->begin * trial->dt + s * leg->dt;
        if (slopes) ex_group_slopes(g, t, x, v, leg->rate, state->k, leg->out[stage]);
        else ex_group(g, t, x, v, leg->rate, state->k, leg->out[stage]);
    }
    for (int i = 0; i < size; ++i) {
        const int q = ex_group_states[first + i];
        const real k1 = leg->out[0][i], k2 = leg->out[1][i];
        real mean = k2, last = 2.0 * k2 - k1, e = REAL(0.0), bent = REAL(0.0);
        if (leg->stages == 4) {
            const real k3 = leg->out[2][i], k4 = leg->out[3][i];
            /* the two slopes at the middle differ in third order, the step errs in fifth: between the two */
            const real apart = leg->dt * v_fabs(k3 - k2) / state->nominal[q];
            mean = choose(brief, mean, (k1 + 2.0 * (k2 + k3) + k4) / 6.0);
            last = choose(brief, last, k4);
            e = choose(brief, e, apart * v_sqrt(apart));
            bent = choose(brief, bent, leg->dt / 6.0 * v_fabs(k1 - k2 - k3 + k4) / state->nominal[q]);
        }
        leg->to[q] = leg->from[q] + leg->dt * mean;
        /* powers of a state have a kink at its zero, where the orders do not hold: there the difference of the
           trapezoidal and the midpoint rule tells */
        e = choose(MASK(leg->from[q] * leg->to[q] < 0.0), v_fmax(e, 0.3 * bent), e);
        leg->last[i] = last;
        set_error(trial, e / state->tolerance);
    }
}

/* The states at a node, by Hermite's cubic over the way of the leg on which it lies */
static void group_node(psa_state *state, psa_trial *trial, int g, int n, double theta) {
    psa_stages *const stages = trial->stages + g;
    const int u = ex_linear[ex_group_driver[g]];
    real basis[2][4];
    bits second = MASK(REAL(0.0) > 1.0);
    stages->on[n] = 0;
    for (int k = 0; k < stages->legs; ++k) {
        const psa_leg *const leg = stages->leg + k;
        const bits moves = MASK(v_fabs(leg->way) > STILL * state->nominal[u]);
        const real in_time = (theta - leg->begin) * trial->dt / choose(MASK(leg->dt > 0.0), leg->dt, REAL(1.0));
        const real on_way = (trial->x[n][u] - leg->from[u]) / choose(moves, leg->way, REAL(1.0));
        const real s = v_fmin(v_fmax(choose(moves, on_way, in_time), REAL(0.0)), REAL(1.0));
        hermite(s, basis[k]);
        if (k == 0) stages->share[n] = s;
        else {
            second = MASK(theta + REAL(0.0) > leg->begin);
            stages->share[n] = choose(second, s, stages->share[n]);
            stages->on[n] = LANE(second, 0) != 0;
        }
    }
    for (int i = 0; i < ex_group_size[g]; ++i) {
        const int q = ex_group_states[ex_group_first[g] + i];
        for (int k = 0; k < stages->legs; ++k) {
            const psa_leg *const leg = stages->leg + k;
            const real x = basis[k][0] * leg->from[q] + basis[k][1] * leg->dt * leg->out[0][i] +
                           basis[k][2] * leg->to[q] + basis[k][3] * leg->dt * leg->last[i];
            trial->x[n][q] = k ? choose(second, x, trial->x[n][q]) : x;
        }
        if (stages->drifts) trial->x[n][q] += (theta - stages->share[n]) * trial->dt * stages->drift[i];
    }
}

/* A driver that slows down may come to rest, or all but so. What its states do in time and not along its way
   (what is left of r when its part in proportion to the rate is taken off) is then not that at the mean rate:
   Simpson's rule tells by how much. */
static void check_rest(psa_state *state, psa_trial *trial, int g, const real *w, real most, bits slows) {
    static const double WEIGHT[4] = {-1.0, 1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0};
    const int u = ex_linear[ex_group_driver[g]];
    const real mean = (trial->x[WHOLE][u] - state->x[u]) / trial->dt;
    const real rates[4] = {mean, w[NODES], w[HALF], w[WHOLE]};
    const real *const at[4] = {NULL, state->x, trial->x[HALF], trial->x[WHOLE]};
    const real *const v[4] = {trial->v[HALF], trial->v0, trial->v[HALF], trial->v[WHOLE]};
    real fast[EX_GROUP_OUT] = {REAL(0.0)}, out[EX_GROUP_OUT] = {REAL(0.0)}, missed[EX_NX], x[EX_NX];
    memcpy(x, state->x, sizeof x);
    for (int k = 0; k < 4; ++k) {
        bits counts = MASK(REAL(0.0) > 1.0);
        for (int r = 0; r < EX_NPATH; ++r) {
            const int q = ex_path[r];
            x[q] = at[k] ? at[k][q] : 0.5 * (state->x[q] + trial->x[WHOLE][q]);
        }
        ex_group(g, state->t, x, v[k], FAST * most, state->k, fast);
        ex_group(g, state->t, x, v[k], rates[k], state->k, out);
        for (int i = 0; i < ex_group_size[g]; ++i) {
            const real in_time = out[i] - fast[i] * (v_fabs(rates[k]) / (FAST * v_fabs(most)));
            missed[i] = WEIGHT[k] * in_time + (k ? missed[i] : REAL(0.0));
            const real largest = v_fabs(in_time) * trial->dt / state->nominal[ex_group_states[ex_group_first[g] + i]];
            counts |= MASK(largest > 0.3 * state->tolerance);
        }
        if (k == 0 && !any(counts & slows)) return; /* at no rate is it more */
    }
    for (int i = 0; i < ex_group_size[g]; ++i) {
        const real e = trial->dt * v_fabs(missed[i]) / state->nominal[ex_group_states[ex_group_first[g] + i]];
        set_error(trial, choose(slows, e / state->tolerance, REAL(0.0)));
    }
}

/* The legs of a group's way: two where the driver's rate changes sign once between start, half and end */
static void find_legs(psa_state *state, psa_trial *trial, int g, int slopes) {
    static const int AT[4] = {WHOLE, HALF, QUARTER, NODES};
    psa_stages *const stages = trial->stages + g;
    const int u = ex_linear[ex_group_driver[g]];
    for (int k = 0; k < 4; ++k) {
        const int n = AT[k], start = n == NODES;
        if (n == QUARTER) continue;
        const real *const x = start ? state->x : trial->x[n], *const v = start ? trial->v0 : trial->v[n];
        if (slopes) ex_rate_slopes(g, start ? state->t : trial->t[n], x, v, REAL(0.0), state->k,
                                   stages->rate_slopes[n]);
        else ex_rate(g, start ? state->t : trial->t[n], x, v, REAL(0.0), state->k, stages->rate_slopes[n]);
        /* a rate that is all but 0 is rounding, whose sign says nothing */
        const real w = stages->rate_slopes[n][0];
        stages->w[n] = choose(MASK(v_fabs(w) * trial->dt > STILL * state->nominal[u]), w, REAL(0.0));
    }
    const real w0 = stages->w[NODES], w1 = stages->w[HALF], w2 = stages->w[WHOLE];
    const real most = v_fmax(v_fmax(v_fabs(w0), v_fabs(w1)), v_fabs(w2));
    const real least = v_fmin(v_fmin(v_fabs(w0), v_fabs(w1)), v_fabs(w2));
    const bits early = MASK(w0 * w1 < 0.0), late = MASK(w1 * w2 < 0.0) | (MASK(w1 == 0.0) & MASK(w0 * w2 < 0.0));
    const bits slows = MASK(least < SLOWS * most) & ~(early | late);
    psa_leg *const one = stages->leg, *const two = stages->leg + 1;
    stages->legs = 1;
    stages->turn = REAL(1.0);
    memcpy(one->from, state->x, sizeof one->from);
    memcpy(one->to, trial->x[WHOLE], sizeof one->to);
    one->begin = REAL(0.0);
    one->dt = trial->dt;
    const bits resting = slows & MASK(most > 0.0), turned = early | late;
    stages->missed = REAL(0.0);
    if (any(resting)) check_rest(state, trial, g, stages->w, choose(MASK(w0 + w2 > 0.0), most, -most), resting);
    set_error(trial, choose(early & late, REAL(1e3), REAL(0.0))); /* it turns twice */
    if (any(turned)) {
        real value;
        stages->missed = choose(turned, find_turn(state, trial, stages, u, ~early, &value), REAL(0.0));
        stages->turn = choose(turned, stages->turn, REAL(1.0));
        stages->legs = 2;
        *two = *one;
        one->dt = choose(turned, stages->turn * trial->dt, trial->dt);
        for (int r = 0; r < EX_NPATH; ++r) {
            const int q = ex_path[r];
            const real there = one->from[q] + stages->turn * (one->to[q] - one->from[q]);
            one->to[q] = choose(turned, there, one->to[q]);
        }
        one->to[u] = choose(turned, value, one->to[u]);
        memcpy(two->from, one->to, sizeof two->from);
        two->begin = stages->turn;
        two->dt = trial->dt - one->dt;
    }
    for (int k = 0; k < stages->legs; ++k) {
        psa_leg *const leg = stages->leg + k;
        leg->way = leg->to[u] - leg->from[u];
        const bits lasts = MASK(leg->dt > 0.0);
        leg->rate = choose(lasts, leg->way / choose(lasts, leg->dt, REAL(1.0)), REAL(0.0));
    }
}

/* Where the driver is far on its way at the half of the step (it dies away), what its states do in time is not:
   their slopes at a great rate tell the two apart */
static void find_drift(psa_state *state, psa_trial *trial, int g, int slopes) {
    psa_stages *const stages = trial->stages + g;
    const psa_leg *const leg = stages->leg;
    const int u = ex_linear[ex_group_driver[g]];
    const bits moves = MASK(v_fabs(leg->way) > STILL * state->nominal[u]);
    const real share = (trial->x[HALF][u] - leg->from[u]) / choose(moves, leg->way, REAL(1.0));
    const bits uneven = moves & MASK(v_fabs(share - 0.5) > UNEVEN) & MASK(stages->turn >= 1.0);
    stages->drifts = any(uneven);
    if (!stages->drifts) return;
    const real rate = FAST * leg->rate;
    if (slopes) ex_group_slopes(g, state->t, leg->at[0], trial->v0, rate, state->k, stages->fast);
    else ex_group(g, state->t, leg->at[0], trial->v0, rate, state->k, stages->fast);
    for (int i = 0; i < ex_group_size[g]; ++i)
        stages->drift[i] = choose(uneven, leg->out[0][i] - stages->fast[i] / FAST, REAL(0.0));
}

/* On a leg to or from a turn the rate goes from 0 to that at its far end: what the states do in time must be the
   same at the mean and at the far end, or the leg must be so short that it does not count */
static void check_turn(psa_state *state, psa_trial *trial, int g, int k) {
    const psa_stages *const stages = trial->stages + g;
    const psa_leg *const leg = stages->leg + k;
    const real far = k == 0 ? stages->w[NODES] : stages->w[WHOLE];
    const bits turned = MASK(stages->turn < 1.0) & MASK(leg->rate != 0.0);
    const real mean = choose(turned, leg->rate, REAL(1.0)), t = state->t + leg->begin * trial->dt;
    real fast[EX_GROUP_OUT] = {REAL(0.0)}, out[EX_GROUP_OUT] = {REAL(0.0)};
    ex_group(g, t, leg->at[0], trial->v[HALF], FAST * mean, state->k, fast);
    ex_group(g, t, leg->at[0], trial->v[HALF], far, state->k, out);
    for (int i = 0; i < ex_group_size[g]; ++i) {
        const real apart = (out[i] - leg->out[0][i]) - fast[i] / FAST * (far - mean) / mean;
        const real e = leg->dt * v_fabs(apart) / state->nominal[ex_group_states[ex_group_first[g] + i]];
        set_error(trial, choose(turned, e / state->tolerance, REAL(0.0)));
    }
}

static void do_group(psa_state *state, psa_trial *trial, int g, int slopes) {
    psa_stages *const stages = trial->stages + g;
    const int first = ex_group_first[g], size = ex_group_size[g];
    find_legs(state, trial, g, slopes);
    for (int k = 0; k < stages->legs; ++k) {
        psa_leg *const leg = stages->leg + k;
        if (k > 0)
            for (int i = 0; i < size; ++i) {
                const int q = ex_group_states[first + i];
                leg->from[q] = stages->leg[k - 1].to[q];
            }
        do_leg(state, trial, g, leg, slopes);
        if (stages->legs > 1) check_turn(state, trial, g, k);
    }
    const psa_leg *const last = stages->leg + stages->legs - 1;
    for (int i = 0; i < size; ++i) {
        const int q = ex_group_states[first + i];
        trial->x[WHOLE][q] = last->to[q];
        if (stages->legs > 1) {
            /* where the turn is missed counts as far as the branches before and after it differ */
            real slope = REAL(0.0);
            for (int k = 0; k < 2; ++k) {
                const psa_leg *const leg = stages->leg + k;
                const bits moves = MASK(leg->rate != 0.0);
                const real own = k ? leg->out[0][i] : leg->last[i];
                slope = choose(moves, own / choose(moves, leg->rate, REAL(1.0)), REAL(0.0)) - slope;
            }
            set_error(trial, v_fabs(slope) * stages->missed / state->nominal[q] / state->tolerance);
        }
    }
    find_drift(state, trial, g, slopes);
    group_node(state, trial, g, HALF, 0.5);
    group_node(state, trial, g, QUARTER, 0.25);
}

#if EX_NLOOP > 0
/* Entry of a port's partial derivatives by a linear state, 0 where it has none */
static real port_by_linear(const psa_trial *trial, int n, int j, int linear) {
    real sum = REAL(0.0);
    for (int e = 0; e < ex_port_count[j]; ++e)
        if (ex_port_entries[j][e].kind == 0 && ex_port_entries[j][e].index == ex_linear[linear])
            sum += trial->slopes[n][j][1 + e];
    return sum;
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
                    response = v_fmax(response, v_fabs(trial->level->whole.w[ports[j]][n + 1][q]) /
                                                    state->nominal[ex_linear[q]]);
                }
                moved = v_fmax(moved, v_fabs(b[n * count + j]) * response);
            }
        change = choose(settled, change, moved);
        settled |= MASK(change <= 1e-3 * state->tolerance);
        if (!any(~settled)) break;
    }
    set_error(trial, change / state->tolerance);
    for (int n = 0; n < 2; ++n) {
        memcpy(trial->x[AT[n]], without[n], sizeof without[n]);
        for (int j = 0; j < count; ++j) add_port(state, trial, AT[n], ports[j]);
    }
    for (int j = 0; j < count; ++j) add_port(state, trial, QUARTER, ports[j]);
    for (int j = 0; j < count; ++j) check_port(state, trial, ports[j], REAL(0.0), -1);
}
#endif

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

/* ---- derivatives -------------------------------------------------------------------------------------- */

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

/* ---- the run ------------------------------------------------------------------------------------------ */

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
    long left = run->steps_limit;
    psa_trial *const trial = &state->trial;
    for (int lane = 0; lane < PSA_LANES; ++lane) pace->at[lane] = pace->dead[lane] ? end : 0;
    for (;;) {
        int first = -1, level[PSA_LANES], same = 1;
        real begin = REAL(0.0), length = REAL(1.0);
        for (int lane = PSA_LANES - 1; lane >= 0; --lane)
            if (pace->at[lane] < end) first = lane;
        if (first < 0) break;
        if (--left < 0) return 3;
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
            if (error > 1.0 && level[lane] < finest) {
                pace->level[lane]++;
                run->rejected++;
                continue;
            }
            if (!(error < LOST)) {
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
