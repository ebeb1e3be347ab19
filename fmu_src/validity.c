#include <math.h>

#include "instance.h"

/* So much beyond a range, over its size, is still inside: rounding, and the noise of a sensor. */
#define MARGIN 0.01

static int beyond(double value, double low, double high) {
    const double slack = isfinite(high - low) ? MARGIN * (high - low) : 0.0;
    return value < low - slack || value > high + slack;
}

static void tell(psa_instance *instance, const char *what, const char *of, double value, double low,
                 double high) {
    instance->outside_told = 1;
    psa_say(instance, PSA_WARNING,
            "%s%s is %.6g at t = %.9g s; the records behind this model go from %.6g to %.6g. From here on"
            " the results are extrapolated. This is said once.",
            what, of, value, instance->state.solver.t, low, high);
}

void psa_watch_range(psa_instance *instance, const double *u, const double *rate) {
    const double spent = instance->state.solver.t - instance->start_time;
    const int64_t before = PSA_INSTANTIATED | PSA_INITIALIZATION; /* inputs may still be set */
    if (instance->outside_told || !instance->report || instance->state.phase & before) return;
    for (int i = 0; i < PSA_NU; ++i) {
        const psa_range *const seen = &psa_seen[i];
        const char *const name = psa_variables[PSA_FIRST_STATE + 2 * PSA_STATES + i].name;
        if (beyond(u[i], seen->low, seen->high)) {
            tell(instance, "", name, u[i], seen->low, seen->high);
            return;
        }
        if (rate && fabs(rate[i]) > (1.0 + MARGIN) * seen->rate) {
            tell(instance, "The rate per second of ", name, rate[i], -seen->rate, seen->rate);
            return;
        }
    }
    if (spent > (1.0 + MARGIN) * psa_seen_duration)
        tell(instance, "The time since the start", "", spent, 0.0, psa_seen_duration);
}
