/* An imported model-exchange FMU as two functions in CasADi's form: its rates and outputs, and their
 * derivative in one direction. The Python side loads the FMU, fills `psa_imported` and initialises
 * instances; what is called in every step of a solver is here. */
#include "imported_config.h"

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include "imported.h"

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define VALUE PSA_IMPORTED_NAME
#define SLOPE JOIN(fwd1_, PSA_IMPORTED_NAME)

typedef double real;
typedef long long int integer;

enum { NX = PSA_NX, NU = PSA_NU, NP = PSA_NP, NW = PSA_NX + PSA_NY, NV = PSA_NX + PSA_NU };
/* The base instance of a slot, and two for every parameter: with more of it, and with less. */
enum { PLACES = 1 + 2 * PSA_NP, SLOTS = 64 };
enum { OK_OR_WARNING = 1 };

typedef struct {
    int taken;
    int known;               /* whether `t`, `v` and `w` are of the base instance's last call */
    void *component[PLACES]; /* NULL: not initialised with `p` */
    real p[PLACES][NP + 1];
    real t, v[NV + 1], w[NW + 1];
} slot;

static psa_imported fmu;
static slot slots[SLOTS];

PSA_API void psa_import(const psa_imported *given) { fmu = *given; }

/* A thread comes back to the slot it had, as its stack stays where it is. */
static slot *take(int *index) {
    const uintptr_t place = (uintptr_t)(void *)index >> 20;
    for (unsigned k = 0;; k++) {
        *index = (int)((place + k) % SLOTS);
        if (!__sync_lock_test_and_set(&slots[*index].taken, 1)) {
            return &slots[*index];
        }
    }
}

static void leave(slot *s) { __sync_lock_release(&s->taken); }

static void *ready(slot *s, int index, int place, const real *p) {
    if (!s->component[place] || memcmp(s->p[place], p, NP * sizeof *p) != 0) {
        s->known = place ? s->known : 0;
        s->component[place] = fmu.prepare(index, place, p);
        memcpy(s->p[place], p, NP * sizeof *p);
    }
    return s->component[place];
}

static int set_reals(void *c, const unsigned *which, size_t n, const real *values) {
    return fmu.version == 2 ? fmu.set_real2(c, which, n, values)
                            : fmu.set_real3(c, which, n, values, n);
}

static int get_reals(void *c, const unsigned *which, size_t n, real *values) {
    return fmu.version == 2 ? fmu.get_real2(c, which, n, values)
                            : fmu.get_real3(c, which, n, values, n);
}

/* w = (rates, outputs) at time t and v = (states, inputs); 0 if all is finite. */
static int evaluate(void *c, real t, const real *v, real *w) {
    if (!c || fmu.set_time(c, t) > OK_OR_WARNING ||
        (NX > 0 && fmu.set_states(c, v, NX) > OK_OR_WARNING) ||
        (NU > 0 && set_reals(c, fmu.inputs, NU, v + NX) > OK_OR_WARNING) ||
        (NX > 0 && fmu.get_rates(c, w, NX) > OK_OR_WARNING) ||
        (PSA_NY > 0 && get_reals(c, fmu.shown + NX, PSA_NY, w + NX) > OK_OR_WARNING)) {
        return 1;
    }
    for (int k = 0; k < NW; k++) {
        if (!isfinite(w[k])) {
            return 1;
        }
    }
    return 0;
}

/* The base instance at a point; what it returned there is kept in the slot. */
static int at_point(slot *s, int index, real t, const real *v, const real *p) {
    void *c = ready(s, index, 0, p);
    if (s->known && s->t == t && memcmp(s->v, v, NV * sizeof *v) == 0) {
        return 0;
    }
    s->known = 0;
    if (evaluate(c, t, v, s->w)) {
        return 1;
    }
    s->t = t;
    memcpy(s->v, v, NV * sizeof *v);
    s->known = 1;
    return 0;
}

static int asks_fmu(void *c, const real *seed, real *w) {
    if (fmu.version == 2) {
        return fmu.slope2(c, fmu.shown, NW, fmu.known, NV, seed, w) > OK_OR_WARNING;
    }
    return fmu.slope3(c, fmu.shown, NW, fmu.known, NV, seed, NV, w, NW) > OK_OR_WARNING;
}

/* Central difference along a change of states and inputs, by cbrt(eps) of their sizes at most. */
static int differs(slot *s, real t, const real *v, const real *seed, real *w) {
    real moved[NV + 1], above[NW + 1], below[NW + 1], steepest = 0.0;
    for (int k = 0; k < NV; k++) {
        const real size = fmax(fabs(v[k]), fmu.sizes[k]);
        steepest = fmax(steepest, fabs(seed[k]) / size);
    }
    const real h = PSA_STEP / steepest;
    s->known = 0;
    for (int side = 0; side < 2; side++) {
        for (int k = 0; k < NV; k++) {
            moved[k] = v[k] + (side ? -h : h) * seed[k];
        }
        if (evaluate(s->component[0], t, moved, side ? below : above)) {
            return 1;
        }
    }
    for (int k = 0; k < NW; k++) {
        w[k] = (above[k] - below[k]) / (2.0 * h);
    }
    return 0;
}

/* Adds seed times the derivative by parameter j: central, one-sided where one side is refused. */
static int by_parameter(slot *s, int index, real t, const real *v, const real *p, int j, real seed,
                        real *w) {
    real moved[NP + 1], side[2][NW + 1], reach[2];
    const real size = fmax(fabs(p[j]), fmu.sizes[NV + j]);
    if (at_point(s, index, t, v, p)) {
        return 1;
    }
    for (int k = 0; k < 2; k++) {
        memcpy(moved, p, NP * sizeof *p);
        moved[j] += k ? -PSA_STEP * size : PSA_STEP * size;
        reach[k] = moved[j];
        if (evaluate(ready(s, index, 1 + 2 * j + k, moved), t, v, side[k])) {
            reach[k] = p[j];
            memcpy(side[k], s->w, sizeof side[k]);
        }
    }
    if (reach[0] == reach[1]) {
        return 1;
    }
    for (int k = 0; k < NW; k++) {
        w[k] += seed * (side[0][k] - side[1][k]) / (reach[0] - reach[1]);
    }
    return 0;
}

static int moves(const real *seed, int n) {
    for (int k = 0; k < n; k++) {
        if (seed && seed[k] != 0.0) {
            return 1;
        }
    }
    return 0;
}

static const real nothing[NV + NP + 1];

static const real *given(const real *argument) { return argument ? argument : nothing; }

/* (t, v, p) -> w */
PSA_API int VALUE(const real **arg, real **res, integer *iw, real *w, int mem) {
    (void)iw, (void)w, (void)mem;
    int index;
    slot *s = take(&index);
    const int failed = at_point(s, index, given(arg[0])[0], given(arg[1]), given(arg[2]));
    if (!failed && res[0]) {
        memcpy(res[0], s->w, NW * sizeof(real));
    }
    leave(s);
    return failed;
}

/* (t, v, p, w, seeds of t, v and p) -> derivative of w along the seeds; none along time. */
PSA_API int SLOPE(const real **arg, real **res, integer *iw, real *work, int mem) {
    (void)iw, (void)work, (void)mem;
    const real t = given(arg[0])[0], *v = given(arg[1]), *p = given(arg[2]);
    const real *seed = given(arg[5]), *changes = given(arg[6]);
    real w[NW + 1] = {0.0};
    int index, failed = moves(arg[4], 1);
    slot *s = take(&index);
    if (!failed && moves(seed, NV)) {
        failed = at_point(s, index, t, v, p) ||
                 (fmu.slope2 || fmu.slope3 ? asks_fmu(s->component[0], seed, w)
                                           : differs(s, t, v, seed, w));
    }
    for (int j = 0; j < NP && !failed; j++) {
        failed = changes[j] != 0.0 && by_parameter(s, index, t, v, p, j, changes[j], w);
    }
    leave(s);
    if (!failed && res[0]) {
        memcpy(res[0], w, NW * sizeof(real));
    }
    return failed;
}

/* What CasADi asks of a function that it loads: how many arguments and results, and their shapes. */
static const integer one[] = {1, 1, 1}, moving[] = {NV, 1, 1}, tuned[] = {NP, 1, 1},
                     shown[] = {NW, 1, 1};

static const integer *shape(integer k) {
    const integer *const shapes[] = {one, moving, tuned, shown, one, moving, tuned};
    return shapes[k];
}

PSA_API integer JOIN(VALUE, _n_in)(void) { return 3; }
PSA_API integer JOIN(VALUE, _n_out)(void) { return 1; }
PSA_API const integer *JOIN(VALUE, _sparsity_in)(integer k) { return shape(k); }
PSA_API const integer *JOIN(VALUE, _sparsity_out)(integer k) { return shape(k + 3); }
PSA_API integer JOIN(SLOPE, _n_in)(void) { return 7; }
PSA_API integer JOIN(SLOPE, _n_out)(void) { return 1; }
PSA_API const integer *JOIN(SLOPE, _sparsity_in)(integer k) { return shape(k); }
PSA_API const integer *JOIN(SLOPE, _sparsity_out)(integer k) { return shape(k + 3); }
