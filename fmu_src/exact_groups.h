/* Exact steps: the states along a driver's way, with the driver's turns and rests (exact.c). */
#ifndef PSA_EXACT_GROUPS_H
#define PSA_EXACT_GROUPS_H

#include "exact_state.h"

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
    const real finish = leg->begin + leg->dt * trial->over_dt;
    /* the midpoint rule errs by a 24th of the cube of the way: nothing beside the tolerance, where the way is
       its root */
    const bits brief = MASK(v_fabs(leg->way) < state->brief * state->nominal[ex_linear[ex_group_driver[g]]]);
    leg->stages = any(~brief) ? 4 : 2;
    ex_group_rate(g, leg->rate, state->k);
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
            const real apart = leg->dt * v_fabs(k3 - k2) * state->over_nominal[q];
            mean = choose(brief, mean, (k1 + 2.0 * (k2 + k3) + k4) * (1.0 / 6.0));
            last = choose(brief, last, k4);
            e = choose(brief, e, apart * v_sqrt(apart));
            bent = choose(brief, bent, leg->dt * (1.0 / 6.0) * v_fabs(k1 - k2 - k3 + k4) * state->over_nominal[q]);
        }
        leg->to[q] = leg->from[q] + leg->dt * mean;
        /* powers of a state have a kink at its zero, where the orders do not hold: there the difference of the
           trapezoidal and the midpoint rule tells */
        e = choose(MASK(leg->from[q] * leg->to[q] < 0.0), v_fmax(e, 0.3 * bent), e);
        leg->last[i] = last;
        set_error(trial, e * state->over_tolerance);
    }
}

/* The states at a node, by Hermite's cubic over the way of the leg on which it lies */
static void group_node(psa_trial *trial, int g, int n, double theta) {
    psa_stages *const stages = trial->stages + g;
    const int u = ex_linear[ex_group_driver[g]];
    real basis[2][4];
    bits second = MASK(REAL(0.0) > 1.0);
    stages->on[n] = 0;
    for (int k = 0; k < stages->legs; ++k) {
        const psa_leg *const leg = stages->leg + k;
        const real in_time = (theta - leg->begin) * trial->dt * leg->over_dt;
        const real on_way = (trial->x[n][u] - leg->from[u]) * leg->over_way;
        const real s = v_fmin(v_fmax(choose(MASK(leg->over_way != 0.0), on_way, in_time), REAL(0.0)), REAL(1.0));
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

/* A group's slopes at a rate of its driver */
static void group_at(psa_state *state, int g, real t, const real *x, const real *v, real rate, real *out) {
    ex_group_rate(g, rate, state->k);
    ex_group(g, t, x, v, rate, state->k, out);
}

/* A driver that slows down may come to rest, or all but so. What its states do in time and not along its way
   (what is left of r when its part in proportion to the rate is taken off) is then not that at the mean rate:
   Simpson's rule tells by how much. */
static void check_rest(psa_state *state, psa_trial *trial, int g, const real *w, real most, bits slows) {
    static const double WEIGHT[4] = {-1.0, 1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0};
    const int u = ex_linear[ex_group_driver[g]];
    const real mean = (trial->x[WHOLE][u] - state->x[u]) * trial->over_dt;
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
        group_at(state, g, state->t, x, v[k], FAST * most, fast);
        group_at(state, g, state->t, x, v[k], rates[k], out);
        for (int i = 0; i < ex_group_size[g]; ++i) {
            const real in_time = out[i] - fast[i] * (v_fabs(rates[k]) / (FAST * v_fabs(most)));
            missed[i] = WEIGHT[k] * in_time + (k ? missed[i] : REAL(0.0));
            const int q = ex_group_states[ex_group_first[g] + i];
            const real largest = v_fabs(in_time) * trial->dt * state->over_nominal[q];
            counts |= MASK(largest > 0.3 * state->tolerance);
        }
        if (k == 0 && !any(counts & slows)) return; /* at no rate is it more */
    }
    for (int i = 0; i < ex_group_size[g]; ++i) {
        const real e = trial->dt * v_fabs(missed[i]) * state->over_nominal[ex_group_states[ex_group_first[g] + i]];
        set_error(trial, choose(slows, e * state->over_tolerance, REAL(0.0)));
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
        const bits lasts = MASK(leg->dt > 0.0), moves = MASK(v_fabs(leg->way) > STILL * state->nominal[u]);
        leg->over_dt = choose(lasts, 1.0 / choose(lasts, leg->dt, REAL(1.0)), REAL(0.0));
        leg->over_way = choose(moves, 1.0 / choose(moves, leg->way, REAL(1.0)), REAL(0.0));
        leg->rate = leg->way * leg->over_dt;
    }
}

/* Where the driver is far on its way at the half of the step (it dies away), what its states do in time is not:
   their slopes at a great rate tell the two apart */
static void find_drift(psa_state *state, psa_trial *trial, int g, int slopes) {
    psa_stages *const stages = trial->stages + g;
    const psa_leg *const leg = stages->leg;
    const int u = ex_linear[ex_group_driver[g]];
    const real share = (trial->x[HALF][u] - leg->from[u]) * leg->over_way;
    const bits uneven = MASK(leg->over_way != 0.0) & MASK(v_fabs(share - 0.5) > UNEVEN) & MASK(stages->turn >= 1.0);
    stages->drifts = any(uneven);
    if (!stages->drifts) return;
    const real rate = FAST * leg->rate;
    ex_group_rate(g, rate, state->k);
    if (slopes) ex_group_slopes(g, state->t, leg->at[0], trial->v0, rate, state->k, stages->fast);
    else ex_group(g, state->t, leg->at[0], trial->v0, rate, state->k, stages->fast);
    for (int i = 0; i < ex_group_size[g]; ++i)
        stages->drift[i] = choose(uneven, leg->out[0][i] - stages->fast[i] * (1.0 / FAST), REAL(0.0));
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
    group_at(state, g, t, leg->at[0], trial->v[HALF], FAST * mean, fast);
    group_at(state, g, t, leg->at[0], trial->v[HALF], far, out);
    for (int i = 0; i < ex_group_size[g]; ++i) {
        const real apart = (out[i] - leg->out[0][i]) - fast[i] / FAST * (far - mean) / mean;
        const real e = leg->dt * v_fabs(apart) * state->over_nominal[ex_group_states[ex_group_first[g] + i]];
        set_error(trial, choose(turned, e * state->over_tolerance, REAL(0.0)));
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
            set_error(trial, v_fabs(slope) * stages->missed * state->over_nominal[q] * state->over_tolerance);
        }
    }
    find_drift(state, trial, g, slopes);
    group_node(trial, g, HALF, 0.5);
    group_node(trial, g, QUARTER, 0.25);
}

#endif
