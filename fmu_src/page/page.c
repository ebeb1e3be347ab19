/* A model in a page: a whole record at once, its numbers in the module's own memory.

   JavaScript writes parameters, times and inputs where `page_...` say, calls `page_run`, and reads states and
   outputs. The ways through a record and their tolerances are those of psa_casadi/simulation/ways.py. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "page_config.h"
#include "settle.h"
#include "trajectory.h"
#if PAGE_EXACT
#include "exact.h"
#endif

#define EXPORT __attribute__((visibility("default")))

enum { NO_EQUILIBRIUM = 10, NO_MEMORY = 11 };
enum { STEPPER, EXACT_STEPS };

static double parameters[PSA_NP + 1], nominal[PSA_NX], error_size[PSA_NX];
static double deviation[PSA_NX], start[PSA_NX], no_state[PSA_NS + 1];

static struct {
    long samples;
    size_t mark;
    double *t, *u, *x, *y;
    double *shown, *before; /* the displacement of two runs */
    int *which;             /* step after each sample */
    double length[PAGE_LENGTHS];
    int lengths;            /* 0: too many different ones for exact steps */
    int way;
    long steps;
} record;

static void *numbers(long count) { return malloc((size_t)count * sizeof(double)); }

/* Make room for a record; what pointed into the last one's is gone. 0, or NO_MEMORY. */
EXPORT int page_reserve(long samples) {
    if (record.mark) page_release(record.mark);
    record.mark = page_mark();
    record.samples = samples;
    record.t = numbers(samples);
    record.u = numbers(samples * PSA_NU + 1);
    record.x = numbers(samples * PSA_NX);
    record.y = numbers(samples * PSA_NY + 1);
    record.shown = numbers(samples);
    record.before = numbers(samples);
    record.which = malloc((size_t)samples * sizeof(int));
    return record.t && record.u && record.x && record.y && record.shown && record.before && record.which
               ? 0
               : NO_MEMORY;
}

EXPORT double *page_parameters(void) { return parameters; }
EXPORT double *page_nominal(void) { return nominal; }
EXPORT double *page_error_size(void) { return error_size; }
EXPORT double *page_deviation(void) { return deviation; }
EXPORT double *page_start(void) { return start; }
EXPORT double *page_times(void) { return record.t; }
EXPORT double *page_inputs(void) { return record.u; }
EXPORT double *page_states(void) { return record.x; }
EXPORT double *page_outputs(void) { return record.y; }
EXPORT long page_steps(void) { return record.steps; }
EXPORT int page_way(void) { return record.way; }

/* How fast an input changes at the start: the smallest of the first three rates, 0 where they disagree. */
static double first_rate(int input) {
    double least = 0.0;
    int up = 0, down = 0, count = 0;
    for (long k = 0; k < 3 && k + 1 < record.samples; ++k, ++count) {
        const double change = record.u[(k + 1) * PSA_NU + input] - record.u[k * PSA_NU + input];
        const double rate = change / (record.t[k + 1] - record.t[k]);
        up += rate > 0.0;
        down += rate < 0.0;
        if (k == 0 || fabs(rate) < fabs(least)) least = rate;
    }
    return up == count || down == count ? least : 0.0;
}

/* The state where the first inputs and their rates, or these inputs at rest, put it, with the deviations */
static int begin(int at_rest) {
    double rate[PSA_NU + 1];
    for (int j = 0; j < PSA_NU; ++j) rate[j] = at_rest ? 0.0 : first_rate(j);
    const psa_beginning at = {record.t[0], record.u, rate, parameters, deviation, nominal};
    if (psa_settle(&at, start)) return NO_EQUILIBRIUM;
    for (int i = 0; i < PSA_STATES; ++i)
        if (!page_memory[i]) start[i] += deviation[i];
    return 0;
}

static int step_through(double rtol, int hold) {
    psa_trajectory run;
    memset(&run, 0, sizeof run);
    run.samples = record.samples;
    run.t = record.t;
    run.u = record.u;
    run.zero_order_hold = hold;
    run.p = parameters;
    run.x0 = start;
    run.z0 = no_state;
    run.nominal = nominal;
    run.rtol = rtol;
    run.x = record.x;
    run.y = record.y;
    const int status = psa_run(&run);
    record.way = STEPPER;
    record.steps = run.steps;
    return status == PSA_NO_MEMORY ? NO_MEMORY : status;
}

#if PAGE_EXACT
static const struct {
    double share;
    int coarsest;
} ladder[] = PAGE_LADDER;

/* The different steps of the times; 0 of them where there are more than a few */
static void measure_steps(void) {
    long count[PAGE_LENGTHS];
    double mean[PAGE_LENGTHS];
    record.lengths = 0;
    for (long k = 0; k + 1 < record.samples; ++k) {
        const double step = record.t[k + 1] - record.t[k];
        int at = 0;
        while (at < record.lengths && fabs(step - mean[at]) > PAGE_ALIKE * mean[at]) ++at;
        if (at == PAGE_LENGTHS) {
            record.lengths = 0;
            return;
        }
        if (at == record.lengths) mean[record.lengths] = 0.0, count[record.lengths++] = 0;
        mean[at] += (step - mean[at]) / (double)++count[at];
        record.which[k] = at;
    }
    memcpy(record.length, mean, sizeof mean);
    if (record.lengths == 1)
        record.length[0] = (record.t[record.samples - 1] - record.t[0]) / (double)(record.samples - 1);
}

static int run_exactly(double tolerance, int coarsest, int hold, long *forced) {
    const size_t mark = page_mark();
    psa_exact run;
    memset(&run, 0, sizeof run);
    run.samples = record.samples;
    run.t = record.t;
    run.v = record.u;
    run.zero_order_hold = hold;
    run.lengths = record.lengths;
    run.length = record.length;
    run.which_step = record.which;
    run.sets = 1;
    run.p = parameters;
    run.x0 = start;
    run.nominal = error_size;
    run.tolerance = tolerance;
    run.coarsest = coarsest;
    run.finest = coarsest > PAGE_FINEST ? coarsest : PAGE_FINEST;
    const double most = PAGE_MOST * fmax(1.0, sqrt(PAGE_AT / tolerance)) * (double)record.samples;
    run.steps_limit = (long)fmin(ldexp(most, coarsest), 2e9);
    run.x = record.x;
    run.y = record.y;
    run.shown = record.shown;
    const int status = psa_run_exact(&run);
    page_release(mark);
    record.way = EXACT_STEPS;
    record.steps = run.steps;
    *forced = run.forced;
    return status;
}

static int agrees(double allowed, double shown_nominal) {
    double low = INFINITY, high = -INFINITY, off = 0.0;
    for (long k = 0; k < record.samples; ++k) {
        low = fmin(low, record.shown[k]);
        high = fmax(high, record.shown[k]);
        off = fmax(off, fabs(record.shown[k] - record.before[k]));
    }
    return off <= allowed * fmax(high - low, PAGE_STILL * shown_nominal);
}

/* Exact steps, finer until two runs agree; one run if `quick`. 1 where they did it. */
static int exactly(double rtol, int hold, int quick, double shown_nominal) {
    measure_steps();
    if (record.lengths == 0) return 0;
    for (int k = 0; k < (int)(sizeof ladder / sizeof *ladder); ++k) {
        long forced;
        if (run_exactly(fmax(ladder[k].share * rtol, 1e-13), ladder[k].coarsest, hold, &forced)) return 0;
        if (quick) return 1;
        if (k > 0 && forced == 0 && agrees(PAGE_AGREE * rtol, shown_nominal)) return 1;
        double *const last = record.before;
        record.before = record.shown;
        record.shown = last;
    }
    return 0;
}
#endif

/* Run the record that was written: 0, or why it could not be.

   `settle` lets it start where its first inputs put it, with the deviations: moving (1) or at rest (2); at 0 it
   starts at `page_start`.
   `quick` is one run of exact steps, whose error nothing has measured. */
EXPORT int page_run(double rtol, int hold, int settle, int quick, double shown_nominal) {
    const size_t mark = page_mark();
    int status = settle ? begin(settle == 2) : 0;
#if PAGE_EXACT
    if (status == 0 && rtol >= PAGE_TIGHTEST && exactly(rtol, hold, quick, shown_nominal)) return 0;
#else
    (void)quick, (void)shown_nominal;
#endif
    if (status == 0) status = step_through(fmax(PAGE_STEP_SHARE * rtol, PAGE_SMALLEST_RTOL), hold);
    page_release(mark);
    return status;
}
