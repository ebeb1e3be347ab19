#include "instance.h"

#include <math.h>
#include <string.h>

#include "instants.h"

#define DEFAULT_TOLERANCE 1e-6
#define DESCRIBED_TOLERANCE 1e-5 /* of the DefaultExperiment; importers that integrate take it and do not tell */
#define LOOSEST_TOLERANCE 1e-2
/* The solver bounds the error of one step. What an importer means is the error of the trajectory, which
   is that of many steps: each gets this share. With it, cutting the time axis differently moved no output
   of the named stacks by more than four tolerances of its nominal; with three times as much, by 21. */
#define STEP_SHARE 0.003
/* Margin of the event indicators in tolerances: a solver that bounds the mean over the states errs by more in one. */
#define EVENT_MARGIN 5.0
#define TIGHTEST_STEP_TOLERANCE 1e-11

#define BETWEEN \
    (PSA_INITIALIZATION | PSA_EVENT | PSA_CONTINUOUS | PSA_STEP_COMPLETE | PSA_STEP_FAILED | PSA_TERMINATED)
#define READABLE (BETWEEN | PSA_INTERMEDIATE)
/* Calls of one interface only: bits above those of the phases. */
#define EXCHANGE_ONLY 1024
#define STEPPING_ONLY 2048

/* In which phases each kind of call is allowed (FMI 2.0.5, sections 3.2.3 and 4.2.4; FMI 3.0.2, sections
   2.3, 3.2 and 4.2). */
static const int ALLOWED[PSA_CALL_COUNT] = {
    [PSA_CALL_ANY] = PSA_INSTANTIATED | BETWEEN,
    [PSA_CALL_LOG] = PSA_INSTANTIATED | READABLE,
    [PSA_CALL_SETUP] = PSA_INSTANTIATED,
    [PSA_CALL_INITIALIZE] = PSA_INSTANTIATED,
    [PSA_CALL_INITIALIZED] = PSA_INITIALIZATION,
    [PSA_CALL_TERMINATE] = PSA_EVENT | PSA_CONTINUOUS | PSA_STEP_COMPLETE | PSA_STEP_FAILED,
    [PSA_CALL_GET] = READABLE,
    [PSA_CALL_SET] = PSA_INSTANTIATED | PSA_INITIALIZATION | PSA_EVENT | PSA_CONTINUOUS |
                     PSA_STEP_COMPLETE | PSA_INTERMEDIATE,
    [PSA_CALL_DIRECTIONAL] = READABLE,
    [PSA_CALL_ENTER_EVENT] = PSA_CONTINUOUS,
    [PSA_CALL_ENTER_EVENT3] = PSA_CONTINUOUS | PSA_STEP_COMPLETE,
    [PSA_CALL_EVENT_UPDATE] = PSA_EVENT,
    [PSA_CALL_EVALUATE_DISCRETE] = PSA_INITIALIZATION | PSA_EVENT,
    [PSA_CALL_ENTER_CONTINUOUS] = PSA_EVENT | EXCHANGE_ONLY,
    [PSA_CALL_ENTER_STEP] = PSA_EVENT | STEPPING_ONLY,
    [PSA_CALL_SET_TIME] = PSA_EVENT | PSA_CONTINUOUS | EXCHANGE_ONLY,
    [PSA_CALL_CONTINUOUS] = PSA_CONTINUOUS,
    [PSA_CALL_READ_DERIVATIVES] =
        PSA_INITIALIZATION | PSA_EVENT | PSA_CONTINUOUS | PSA_TERMINATED | EXCHANGE_ONLY,
    [PSA_CALL_READ_NOMINALS] = PSA_INSTANTIATED | PSA_INITIALIZATION | PSA_EVENT | PSA_CONTINUOUS |
                               PSA_TERMINATED | EXCHANGE_ONLY,
    [PSA_CALL_COUNT_VECTORS] = PSA_INSTANTIATED | BETWEEN | EXCHANGE_ONLY,
    [PSA_CALL_SET_RATES] = PSA_INSTANTIATED | PSA_INITIALIZATION | PSA_STEP_COMPLETE | STEPPING_ONLY,
    [PSA_CALL_READ_RATES] =
        PSA_STEP_COMPLETE | PSA_STEP_FAILED | PSA_TERMINATED | PSA_INTERMEDIATE | STEPPING_ONLY,
    [PSA_CALL_STEP] = PSA_STEP_COMPLETE,
    [PSA_CALL_CANCEL] = 0, /* a step ends before the call returns; there is nothing to cancel */
    [PSA_CALL_STATUS] = PSA_STEP_COMPLETE | PSA_STEP_FAILED | PSA_TERMINATED,
};

static const char *phase_name(int64_t phase) {
    switch (phase) {
    case PSA_INSTANTIATED: return "instantiated";
    case PSA_INITIALIZATION: return "initialization mode";
    case PSA_EVENT: return "event mode";
    case PSA_CONTINUOUS: return "continuous-time mode";
    case PSA_STEP_COMPLETE: return "step complete";
    case PSA_STEP_FAILED: return "step failed";
    case PSA_TERMINATED: return "terminated";
    case PSA_INTERMEDIATE: return "intermediate update";
    default: return "unknown";
    }
}

int psa_admit(psa_instance *instance, psa_call call, const char *name) {
    if (!instance) return 0;
    const int other = instance->state.interface == PSA_CO_SIMULATION ? EXCHANGE_ONLY : STEPPING_ONLY;
    if (!(ALLOWED[call] & other)) {
        if (ALLOWED[call] & instance->state.phase) return 1;
    }
    psa_say(instance, PSA_ERROR, "%s is not allowed in the state '%s' of this %s instance of %s at t = %.9g s.",
            name, phase_name(instance->state.phase),
            instance->state.interface == PSA_CO_SIMULATION ? "co-simulation" : "model exchange",
            psa_model_identifier, instance->state.solver.t);
    return 0;
}

const char *psa_objection(const char *name, const char *token) {
    if (!name || !*name) return "The instance name is missing.";
    if (!token || strcmp(token, psa_token))
        return "The token (GUID) differs from the one in this binary: modelDescription.xml and binary are"
               " not of the same export.";
    return NULL;
}

void psa_instance_start(psa_instance *instance, psa_interface interface) {
    psa_state *const state = &instance->state;
    memset(state, 0, sizeof *state);
    psa_solver_start(&state->solver, 0.0, psa_start_states, psa_state_nominals,
                     STEP_SHARE * DEFAULT_TOLERANCE);
    memcpy(state->input.value, psa_start_inputs, sizeof state->input.value);
    memcpy(state->given, psa_start_inputs, sizeof state->given);
    memcpy(state->earlier, psa_start_inputs, sizeof state->earlier);
    memcpy(state->p, psa_start_parameters, sizeof state->p);
#if PSA_VOLTAGE >= 0
    state->start_voltage = psa_start_inputs[PSA_VOLTAGE];
#endif
    for (int i = 0; i < PSA_NZ; ++i) state->facing[i] = 1.0;
    state->event_margin =
        EVENT_MARGIN * (interface == PSA_MODEL_EXCHANGE ? DESCRIBED_TOLERANCE : DEFAULT_TOLERANCE);
    state->phase = PSA_INSTANTIATED;
    state->interface = interface;
    instance->start_time = 0.0;
    instance->outside_told = instance->limit_told = 0;
    psa_schedule(instance);
    instance->fresh = 0;
}

double psa_step_tolerance(double tolerance) {
    return fmax(STEP_SHARE * fmin(tolerance, LOOSEST_TOLERANCE), TIGHTEST_STEP_TOLERANCE);
}

psa_result psa_setup(psa_instance *instance, int tolerance_defined, double tolerance, double start,
                     int stop_defined, double stop) {
    psa_state *const state = &instance->state;
    if (!isfinite(start) || (stop_defined && !(stop >= start)))
        return psa_say(instance, PSA_ERROR, "The experiment from %g s to %g s is impossible.", start, stop);
    if (tolerance_defined && !(tolerance > 0.0))
        return psa_say(instance, PSA_ERROR, "The tolerance %g is not positive.", tolerance);
    if (psa_beyond_counting(instance, start, state->p[PSA_PERIOD])) return PSA_ERROR;
    if (tolerance_defined) {
        state->solver.rtol = psa_step_tolerance(tolerance);
        state->event_margin = EVENT_MARGIN * fmin(tolerance, LOOSEST_TOLERANCE);
    }
    psa_solver_move(&state->solver, start);
    instance->start_time = state->given_at = start;
    state->input.begin = 0.0;
    state->stop_defined = stop_defined;
    state->stop_time = stop_defined ? stop : 0.0;
    psa_schedule(instance);
    instance->fresh = 0;
    return PSA_FINE;
}

static const char *reason(psa_status status) {
    switch (status) {
    case PSA_STEP_TOO_SMALL: return "the tolerance cannot be met however small the step";
    case PSA_NOT_FINITE: return "the model returned a value that is not finite";
    case PSA_TOO_MANY_STEPS: return "too many steps were needed";
    default: return "the solver failed";
    }
}

/* Take the input along to the time the solver has reached, and forget rates that were not renewed. */
static void carry_input(psa_state *state) {
    psa_input_at(&state->input, state->solver.since, state->input.value);
    state->input.begin = state->solver.since;
}

/* Count the time from here on, so that the clock can tell short steps again; return by how much it was
   set back. */
static double restart_clock(psa_state *state) {
    const double since = state->solver.since;
    psa_solver_move(&state->solver, state->solver.t);
    state->input.begin = 0.0;
    return since;
}

/* After an accepted step of the solver: let the importer look at the intermediate time, set inputs from
   here on, or end the communication step earlier. */
static void look(void *owner, psa_end *end) {
    psa_instance *const instance = owner;
    psa_state *const state = &instance->state;
    psa_end *const goal = &instance->goal;
    const psa_end now = {state->solver.since, state->solver.t};
    const int more = now.since < goal->since;
    double wanted = goal->t;
    carry_input(state);
    instance->fresh = 0;
    const psa_input input = state->input;
    state->phase = PSA_INTERMEDIATE;
    const int early = instance->update(instance->owner, now.t, more, &wanted);
    state->phase = PSA_STEP_COMPLETE;
    if (more && early && !(wanted > now.t)) *goal = now;
    else if (more && early && wanted < goal->t) {
        goal->since = now.since + (wanted - now.t);
        goal->t = wanted;
        state->last.kind = PSA_STEP_VARIED;
    }
    if (goal->since < end->since) *end = *goal;
    if (!more || !memcmp(&input, &state->input, sizeof input)) return;
    state->last.kind = PSA_STEP_VARIED;
    const double back = restart_clock(state);
    goal->since -= back;
    end->since -= back;
}

/* How the inputs move over the coming step: by the rate that the importer gave, else along the line, but
   by no more than over the last step, which may have been much shorter. */
static void aim_inputs(psa_state *state, double size) {
    for (int i = 0; i < PSA_NU; ++i) {
        if (!state->rate_given[i]) state->input.rate[i] = 0.0;
        if (!state->rate_given[i] && state->line > 0.0) {
            state->input.value[i] = state->given[i];
            if (state->stride > 0.0)
                state->input.rate[i] =
                    state->line * (state->given[i] - state->earlier[i]) / fmax(state->stride, size);
        }
        state->earlier[i] = state->input.value[i];
    }
}

/* What the next line goes through, at the end of a step. */
static void remember_inputs(psa_state *state, double begin) {
    const int same_clock = state->last.kind == PSA_STEP_KNOWN;
    state->stride = same_clock ? state->solver.since : fmax(state->solver.t - begin, 0.0);
    for (int i = 0; i < PSA_NU; ++i)
        if (state->rate_given[i] || state->line == 0.0) state->given[i] = state->input.value[i];
    memset(state->rate_given, 0, sizeof state->rate_given);
}

/* Whether the coming step is inside what the records have shown: of inputs that are held the rate is
   that from step to step. */
static void watch_step(psa_instance *instance) {
    const psa_state *const state = &instance->state;
    double rate[PSA_NU + 1] = {0.0};
    for (int i = 0; i < PSA_NU; ++i) {
        if (state->rate_given[i]) rate[i] = state->input.rate[i];
        else if (state->stride > 0.0)
            rate[i] = (state->input.value[i] - state->earlier[i]) / state->stride;
    }
    psa_watch_range(instance, state->input.value, rate);
}

/* Keep what the coming communication step starts from, for its sensitivities. */
static void remember(psa_state *state, psa_end end) {
    psa_last_step *const last = &state->last;
    last->solver = state->solver;
    last->input = state->input;
    memcpy(last->p, state->p, sizeof last->p);
    last->end = end;
    last->kind = PSA_STEP_KNOWN;
}

#ifdef PSA_FIXED_STEP
/* Keep the voltage, over a step from u along its change, where the step is as good as it is said to be. */
static void limit_voltage(psa_instance *instance, double since, double *u, double *change) {
#ifdef PSA_FIXED_LIMIT
    const double wanted = u[PSA_VOLTAGE], end = wanted + change[PSA_VOLTAGE], most = PSA_FIXED_LIMIT;
    if (fabs(wanted) <= most && fabs(end) <= most) return;
    u[PSA_VOLTAGE] = fmin(fmax(wanted, -most), most);
    change[PSA_VOLTAGE] = fmin(fmax(end, -most), most) - u[PSA_VOLTAGE];
    if (instance->limit_told) return;
    instance->limit_told = 1;
    psa_say(instance, PSA_WARNING,
            "The voltage of %.6g V at t = %.9g s is beyond %.6g V, up to which this fixed step is good; it is"
            " limited to that. This is said once.",
            fabs(end) > most ? end : wanted, instance->state.solver.origin + since, most);
#else
    (void)instance, (void)since, (void)u, (void)change;
#endif
}

/* Steps of fixed length to the goal of the communication step, which is a multiple of them. */
static psa_status run_fixed(psa_instance *instance) {
    psa_state *const state = &instance->state;
    psa_solver *const solver = &state->solver;
    const double count = round(instance->goal.since / PSA_FIXED_STEP);
    double u[PSA_NU + 1], change[PSA_NU + 1];
    for (double k = 0.0; k < count; k += 1.0) {
        psa_input_at(&state->input, k * PSA_FIXED_STEP, u);
        for (int i = 0; i < PSA_NU; ++i) change[i] = state->input.rate[i] * PSA_FIXED_STEP;
        limit_voltage(instance, k * PSA_FIXED_STEP, u, change);
        psa_fixed_step(solver->origin + k * PSA_FIXED_STEP, solver->x, u, change);
        solver->steps++;
    }
    solver->since = instance->goal.since;
    solver->t = instance->goal.t;
    psa_solver_invalidate(solver);
    carry_input(state);
    instance->fresh = 0;
    state->last.kind = PSA_STEP_VARIED; /* no sensitivities */
    for (int i = 0; i < PSA_NX; ++i)
        if (!isfinite(solver->x[i])) {
            solver->culprit = i;
            return PSA_NOT_FINITE;
        }
    return PSA_OK;
}
#endif

/* Run the solver to the goal of the communication step, with stops at the sample instants before it. */
static psa_status run_solver(psa_instance *instance) {
    psa_state *const state = &instance->state;
    psa_solver *const solver = &state->solver;
    const psa_watch watch = {look, instance};
#ifdef PSA_FIXED_STEP
    if (state->interface == PSA_CO_SIMULATION) return run_fixed(instance);
#endif
    for (;;) {
        const double period = state->p[PSA_PERIOD], next = state->next_instant;
        const psa_end instant = {next - solver->origin, next};
        const int stop = PSA_NS > 0 && !psa_reached(next, instance->goal.t, period);
        const psa_status status =
            psa_solver_advance(solver, &instance->work, stop ? instant : instance->goal, &state->input,
                               state->p, NULL, instance->update ? &watch : NULL);
        carry_input(state);
        instance->fresh = 0;
        if (status != PSA_OK) return status;
        if (!stop || psa_reached(solver->t, instance->goal.t, period)) return PSA_OK;
        if (psa_sample_within(instance) != PSA_FINE) return PSA_NOT_FINITE;
    }
}

static psa_result advance(psa_instance *instance, psa_end end) {
    psa_state *const state = &instance->state;
    psa_solver *const solver = &state->solver;
    const double begin = solver->t;
    const int sampled = PSA_NS > 0 && state->at_instant;
    const int64_t steps = solver->steps, rejected = solver->rejected;
    restart_clock(state);
    watch_step(instance);
    aim_inputs(state, end.since);
    if (psa_leave_instant(instance) != PSA_FINE) return PSA_DISCARD;
    remember(state, end);
    if (sampled) state->last.kind = PSA_STEP_SAMPLED;
    instance->goal = end;
    const psa_status status = run_solver(instance);
    remember_inputs(state, begin);
    psa_arrive(instance);
    psa_whisper(instance, "Step from %.9g s to %.9g s: %ld solver steps, %ld rejected.", begin, solver->t,
            (long)(solver->steps - steps), (long)(solver->rejected - rejected));
    if (status == PSA_OK) return PSA_FINE;
    state->phase = PSA_STEP_FAILED;
    state->last.kind = PSA_STEP_BROKEN;
    return psa_say(instance, PSA_DISCARD,
                   "The step from %.9g s to %.9g s stopped at %.9g s in state '%s': %s. Likely an input"
                   " or a parameter is far from its physical range, or the tolerance is too tight.",
                   begin, end.t, solver->t,
                   PSA_STATES > 0 ? psa_variables[PSA_FIRST_STATE + solver->culprit].name : "sampled",
                   reason(status));
}

psa_result psa_do_step(psa_instance *instance, double point, double size, psa_update *update,
                       int *early) {
    const psa_state *const state = &instance->state;
    const double now = state->solver.t;
    /* an importer that stands elsewhere by rounding gets the end that it expects */
    const psa_end end = {size + (point - now), point + size};
    const double slack = 1e-3 * fabs(size) + 1e-12 * (fabs(point) + fabs(now));
    if (!isfinite(point) || !isfinite(size) || size < 0.0)
        return psa_say(instance, PSA_ERROR, "A step of %g s from %g s is impossible.", size, point);
    if (fabs(point - now) > slack)
        return psa_say(instance, PSA_ERROR,
                       "The communication point is %.17g s, but the instance stands at %.17g s.", point,
                       now);
    if (size > 0.0 && !(end.t > point))
        return psa_say(instance, PSA_ERROR,
                       "The step of %g s from %.17g s is too short: a double cannot tell its end from its"
                       " begin. Count the time from a nearer start.",
                       size, point);
    if (psa_beyond_counting(instance, end.t, state->p[PSA_PERIOD])) return PSA_ERROR;
    if (state->stop_defined && end.t > state->stop_time + slack)
        return psa_say(instance, PSA_ERROR, "The step to %.17g s goes beyond the stop time %.17g s.",
                       end.t, state->stop_time);
    if (!(size > 0.0 && end.since > 0.0 && end.t > now)) return PSA_FINE;
#ifdef PSA_FIXED_STEP
    const double steps = end.since / PSA_FIXED_STEP;
    if (!(round(steps) >= 1.0) || fabs(steps - round(steps)) > 1e-3)
        return psa_say(instance, PSA_ERROR,
                       "The step of %.9g s is no multiple of %.9g s, the fixed step of this FMU; choose a"
                       " communication step that is.",
                       end.since, PSA_FIXED_STEP);
#endif
    instance->update = update;
    const psa_result result = advance(instance, end);
    instance->update = NULL;
    if (early) *early = result == PSA_FINE && state->solver.t < end.t;
    return result;
}
