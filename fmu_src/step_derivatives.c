/* Sensitivity of the last communication step: it is taken once more from where it started, with the
   discrete equations of each of its solver steps differentiated along some directions. */
#include <string.h>

#include "instance.h"

typedef struct {
    const psa_knowns *along;
    psa_calculus *calculus;
} psa_directions;

/* df/dx, and the change of f along the directions at constant x. */
static int differentiate(const psa_sensitivities *sens, double t, const double *x, const double *u,
                         const double *p, double *jac, double *forcing, double *w) {
    static const double none[PSA_NX + 1] = {0.0};
    const psa_directions *const given = sens->owner;
    const psa_knowns *const along = given->along;
    double *const f = given->calculus->f;
    if (psa_model_jacobian(t, x, u, p, jac, w)) return 1;
    for (int c = 0; c < sens->count; ++c) {
        if (psa_model_directional(t, x, u, p, along[c].t, none, along[c].u, along[c].p, f, NULL, NULL,
                                  given->calculus->w))
            return 1;
        for (int i = 0; i < PSA_NX; ++i) forcing[i * sens->count + c] = f[i];
    }
    return 0;
}

/* A step that the importer ended early stops where it did the first time. */
typedef struct {
    const psa_solver *solver;
    double stop; /* on the clock of the step */
} psa_repetition;

static void stop_there(void *owner, psa_end *end) {
    const psa_repetition *const repetition = owner;
    if (repetition->solver->since >= repetition->stop) end->since = repetition->solver->since;
}

static psa_result refuse(psa_instance *instance) {
    const int failed = instance->state.last.kind == PSA_STEP_BROKEN;
#ifdef PSA_FIXED_STEP
    if (!failed)
        return psa_say(instance, PSA_DISCARD,
                       "The sensitivity of the last step is not known: it was taken by steps of fixed length.");
#endif
    if (instance->state.last.kind == PSA_STEP_SAMPLED)
        return psa_say(instance, PSA_DISCARD,
                       "The sensitivity of the last step is not known, because a sample instant fell into"
                       " it; take a step between two instants.");
    return psa_say(instance, PSA_DISCARD,
                   "The sensitivity of the last step is not known, because %s; take a step from the start"
                   " of it %s.",
                   failed ? "that step failed" : "inputs or its end changed within it",
                   failed ? "that succeeds" : "without a change");
}

psa_result psa_step_sensitivity(psa_instance *instance, int count, const psa_knowns *directions,
                                double *moved) {
    const psa_last_step *const last = &instance->state.last;
    psa_calculus *const calculus = &instance->calculus;
    psa_directions given = {directions, calculus};
    psa_sensitivities sens = {count, differentiate, &given, moved, calculus->slope, calculus->stage,
                              calculus->base, 0};
    psa_repetition repetition = {&calculus->solver, instance->state.solver.since};
    const psa_watch watch = {stop_there, &repetition};
    for (int i = 0; i < PSA_NX; ++i)
        for (int c = 0; c < count; ++c) moved[i * count + c] = directions[c].x[i];
    if (last->kind == PSA_NO_STEP) return PSA_FINE;
    if (last->kind != PSA_STEP_KNOWN) return refuse(instance);
    calculus->solver = last->solver;
    if (psa_solver_advance(&calculus->solver, &instance->work, last->end, &last->input, last->p, &sens, &watch))
        return psa_say(instance, PSA_DISCARD, "The last step cannot be differentiated.");
    return PSA_FINE;
}
