#include <math.h>
#include <string.h>

#include "instance.h"
#include "linear.h"

/* Where a variable stands among the knowns, or NULL and a report. */
static double *known_place(psa_instance *instance, unsigned vr, psa_knowns *in) {
    const psa_variable *const v = psa_variable_of(instance, vr);
    if (!v) return NULL;
    switch (v->kind) {
    case PSA_TIME: return &in->t;
    case PSA_STATE: return in->x + v->index;
    case PSA_INPUT: return in->u + v->index;
    case PSA_PARAMETER: return in->p + v->index;
    case PSA_SAMPLED: return in->p + PSA_NP + v->index;
    case PSA_OPTION:
        if (v->index == PSA_START_VOLTAGE && instance->state.phase == PSA_INITIALIZATION) return &in->start;
        return &in->option;
    default:
        psa_say(instance, PSA_ERROR, "'%s' is calculated and cannot be varied.", v->name);
        return NULL;
    }
}

/* Where a variable stands among the unknowns, or NULL and a report. */
static double *unknown_place(psa_instance *instance, unsigned vr, psa_unknowns *out) {
    const psa_variable *const v = psa_variable_of(instance, vr);
    if (!v) return NULL;
    switch (v->kind) {
    case PSA_DERIVATIVE: return out->xdot + v->index;
    case PSA_OUTPUT: return out->y + v->index;
    case PSA_INDICATOR: return out->z + v->index;
    case PSA_STATE:
        if (instance->state.interface == PSA_CO_SIMULATION) {
            if (!out->through_step) out->through_step = 1;
            return out->x + v->index;
        }
        break;
    default: break;
    }
    psa_say(instance, PSA_ERROR, "'%s' is not calculated and has no derivative.", v->name);
    return NULL;
}

psa_result psa_directional_derivative(psa_instance *instance, const unsigned *unknown,
                                      size_t unknowns, const unsigned *known, size_t knowns,
                                      const double *seed, double *sensitivity) {
    const psa_state *const state = &instance->state;
    psa_knowns *const in = &instance->calculus.in;
    psa_unknowns *const out = &instance->calculus.out;
    double *const slope = instance->calculus.slope, u[PSA_NU + 1], slope_u[PSA_NU + 1] = {0.0};
    memset(in, 0, sizeof *in);
    memset(out, 0, sizeof *out);
    if (psa_lacks(instance, unknowns, unknown, sensitivity) || psa_lacks(instance, knowns, known, seed))
        return PSA_ERROR;
    for (size_t i = 0; i < knowns; ++i) {
        double *const place = known_place(instance, known[i], in);
        if (!place) return PSA_ERROR;
        *place += seed[i];
    }
    psa_result ready = psa_begin(instance);
    if (ready == PSA_FINE) ready = psa_sample_now(instance);
    if (ready == PSA_FINE && in->start != 0.0) ready = psa_start_slope(instance, slope, slope_u);
    if (ready != PSA_FINE) return ready;
    if (in->start != 0.0) {
        psa_axpy(PSA_NX, in->start, slope, in->x);
        psa_axpy(PSA_NU, in->start, slope_u, in->u);
    }
    psa_input_at(&state->input, state->solver.since, u);
    if (psa_model_directional(state->solver.t, state->solver.x, u, state->p, in->t, in->x, in->u, in->p,
                              out->xdot, out->y, out->z, instance->calculus.w))
        return psa_say(instance, PSA_DISCARD, "The model cannot be differentiated here.");
    for (int i = 0; i < PSA_NZ; ++i) out->z[i] *= state->facing[i];
    for (size_t i = 0; i < unknowns; ++i) {
        const double *const place = unknown_place(instance, unknown[i], out);
        if (!place) return PSA_ERROR;
        if (out->through_step == 1) {
            const psa_result result = psa_step_sensitivity(instance, 1, in, out->x);
            if (result != PSA_FINE) return result;
            out->through_step = 2;
        }
        sensitivity[i] = *place;
    }
    return PSA_FINE;
}

/* Add the weighted sensitivities of the states through the last step, some knowns at a time. */
static psa_result add_through_step(psa_instance *instance, const double *weight,
                                   const unsigned *known, size_t knowns, double *sensitivity) {
    psa_knowns *const along = instance->calculus.along;
    double *const moved = instance->calculus.moved;
    for (size_t done = 0; done < knowns; done += PSA_DIRECTIONS) {
        const int count = knowns - done < PSA_DIRECTIONS ? (int)(knowns - done) : PSA_DIRECTIONS;
        memset(along, 0, sizeof instance->calculus.along);
        for (int c = 0; c < count; ++c) *known_place(instance, known[done + (size_t)c], along + c) = 1.0;
        const psa_result result = psa_step_sensitivity(instance, count, along, moved);
        if (result != PSA_FINE) return result;
        for (int i = 0; i < PSA_NX; ++i)
            for (int c = 0; c < count; ++c)
                sensitivity[done + (size_t)c] += weight[i] * moved[i * count + c];
    }
    return PSA_FINE;
}

psa_result psa_adjoint_derivative(psa_instance *instance, const unsigned *unknown, size_t unknowns,
                                  const unsigned *known, size_t knowns, const double *seed,
                                  double *sensitivity) {
    const psa_state *const state = &instance->state;
    psa_knowns *const in = &instance->calculus.in;
    psa_unknowns *const out = &instance->calculus.out;
    double *const slope = instance->calculus.slope, u[PSA_NU + 1], slope_u[PSA_NU + 1] = {0.0};
    memset(in, 0, sizeof *in);
    memset(out, 0, sizeof *out);
    if (psa_lacks(instance, unknowns, unknown, seed) || psa_lacks(instance, knowns, known, sensitivity))
        return PSA_ERROR;
    for (size_t i = 0; i < unknowns; ++i) {
        double *const place = unknown_place(instance, unknown[i], out);
        if (!place) return PSA_ERROR;
        *place += seed[i];
    }
    for (int i = 0; i < PSA_NZ; ++i) out->z[i] *= state->facing[i];
    psa_result ready = psa_begin(instance);
    if (ready == PSA_FINE) ready = psa_sample_now(instance);
    if (ready != PSA_FINE) return ready;
    psa_input_at(&state->input, state->solver.since, u);
    if (psa_model_adjoint(state->solver.t, state->solver.x, u, state->p, out->xdot, out->y, out->z, &in->t,
                          in->x, in->u, in->p, instance->calculus.w))
        return psa_say(instance, PSA_DISCARD, "The model cannot be differentiated here.");
    in->start = HUGE_VAL;
    for (size_t i = 0; i < knowns; ++i) {
        const double *const place = known_place(instance, known[i], in);
        if (!place) return PSA_ERROR;
        if (place == &in->start && in->start == HUGE_VAL) {
            ready = psa_start_slope(instance, slope, slope_u);
            if (ready != PSA_FINE) return ready;
            in->start = 0.0;
            for (int k = 0; k < PSA_NX; ++k) in->start += in->x[k] * slope[k];
            for (int k = 0; k < PSA_NU; ++k) in->start += in->u[k] * slope_u[k];
        }
        sensitivity[i] = *place;
    }
    if (out->through_step) return add_through_step(instance, out->x, known, knowns, sensitivity);
    return PSA_FINE;
}
