#include "instants.h"

#include <math.h>
#include <string.h>

#include "model.h"

/* Communication points are sums with an error of rounding; this share of a period counts as none. */
#define ROUNDING 1e-6

/* The allowance for rounding is a tenth of a period there. */
#define MOST_PERIODS 1e13

static double slack(double t, double period) { return ROUNDING * period + 1e-14 * fabs(t); }

int psa_countable(double t, double period) { return fabs(t) <= MOST_PERIODS * period; }

int psa_at_instant(double t, double period) {
    return fabs(t - period * nearbyint(t / period)) <= slack(t, period);
}

double psa_instant_after(double t, double period) {
    double k = floor(t / period);
    for (int i = 0; i < 2 && k * period <= t + slack(t, period); ++i) k += 1.0;
    return k * period;
}

int psa_reached(double t, double instant, double period) { return t >= instant - slack(t, period); }

int psa_take_sample(double t, const double *x, const double *u, double *p, double *w) {
    double sampled[PSA_NS + 1];
    if (psa_model_sample(t, x, u, p, sampled, w)) return 1;
    for (int i = 0; i < PSA_NS; ++i)
        if (!isfinite(sampled[i])) return 1;
    memcpy(p + PSA_NP, sampled, sizeof(double) * PSA_NS);
    return 0;
}
